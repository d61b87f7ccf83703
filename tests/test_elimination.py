"""Small matrices: inverses, factors, projectors and rotations, with derivatives in every mode.

Could go wrong: a derivative that goes through the loop of an elimination, which keeps all its turns (that of
a kick took twice as long for it); ranges of dependent columns; rotations of subspaces that stop too soon.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from natcoord_jax.maths.elimination import definite_inverse, definite_solution, inverse_cholesky
from natcoord_jax.maths.projectors import nearest_orthogonal, pseudo_inverse, range_projector


def _definite(size: int, seed: int) -> jax.Array:
    root = np.random.default_rng(seed).normal(size=(size, size + 2))
    return jnp.asarray(root @ root.T / size + np.eye(size))


def _right(matrix):
    return jnp.sin(jnp.arange(matrix.shape[0]) + 1.0)


FUNCTIONS = {
    "inverse": (definite_inverse, jnp.linalg.inv),
    "solution": (lambda m: definite_solution(m, _right(m)), lambda m: jnp.linalg.solve(m, _right(m))),
    "solution by its right-hand side": (
        lambda m: definite_solution(_definite(m.shape[0], 4), m[0]),
        lambda m: jnp.linalg.solve(_definite(m.shape[0], 4), m[0]),
    ),
    "factor": (inverse_cholesky, lambda m: jnp.linalg.inv(jnp.linalg.cholesky(m))),
}


def answers(function, matrix, change):
    """Value and derivative along a change; gradient of a sum of sines, and its derivative along it."""
    slope = jax.grad(lambda x: jnp.sum(jnp.sin(function(0.5 * (x + x.T)))))
    return jax.jvp(function, (matrix,), (change,)), jax.jvp(slope, (matrix,), (change,))


# The largest is beyond the loops.
SIZES = [4, 60, *(pytest.param(size, marks=pytest.mark.exhaustive) for size in (1, 9))]


@pytest.mark.parametrize("size", SIZES)
def test_values_and_derivatives_are_those_of_lapack(size):
    matrix, change = _definite(size, 1), _definite(size, 2)

    @jax.jit
    def answers_of_all(matrix, change):
        return {name: [answers(f, matrix, change) for f in pair] for name, pair in FUNCTIONS.items()}

    for name, pair in answers_of_all(matrix, change).items():
        for one, other in zip(*map(jax.tree.leaves, pair), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10, err_msg=name)


def test_derivatives_go_through_no_loop():
    matrix, looped = _definite(6, 1), []
    for name, (function, _) in FUNCTIONS.items():
        value, back = jax.vjp(function, matrix)
        pulled = str(jax.make_jaxpr(back)(jnp.ones_like(value)))
        looped += [name for word in ("scan[", "while[") if word in pulled]
    assert not looped


# --- subspaces ---------------------------------------------------------------------------------------------


def test_pseudo_inverses_from_projectors():
    """Of matrices of rank three, whose columns or rows depend on each other; nothing has one, too."""
    rng = np.random.default_rng(1)
    for shape in ((9, 6), (5, 7), (4, 4)):
        tall, wide = rng.normal(size=(shape[0], 3)), rng.normal(size=(3, shape[1]))
        matrices = np.stack([tall @ np.diag([1.0, 1.0, least]) @ wide for least in (1.0, 1e-2, 1e-4)])
        inverses = jax.jit(jax.vmap(lambda x: pseudo_inverse(x, range_projector(x, 3), 3)))(matrices)
        wanted = np.linalg.pinv(matrices, rcond=1e-9)
        for one, other in zip(inverses, wanted, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-11 * np.abs(other).max())
    nothing = jnp.zeros((3, 2))
    np.testing.assert_array_equal(pseudo_inverse(nothing, range_projector(nothing, 1), 1), nothing.T)


ANGLES = (0.0, 1e-9, 1e-4, 0.1, 0.7, 1.1)


def turned_subspaces(angle, size=5):
    """A matrix whose nearest orthogonal one is wanted, as of subspaces at an angle, and that one."""
    basis = np.linalg.qr(np.random.default_rng(2).normal(size=(size, size)))[0]
    turn = np.eye(size)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    projector = np.diag([1.0] + [0.0] * (size - 1))
    start, end = basis @ projector @ basis.T, basis @ turn @ projector @ turn.T @ basis.T
    unit = np.eye(size)
    return end @ start + (unit - end) @ (unit - start), basis @ turn @ basis.T


def test_direct_rotations_are_orthogonal_and_have_all_derivatives():
    rng = np.random.default_rng(3)
    change, weights = rng.normal(size=(2, 5, 5))

    @jax.jit
    @jax.vmap
    def rotations(matrix):
        slope = jax.grad(lambda x: jnp.sum(weights * nearest_orthogonal(x)))(matrix)
        return *jax.jvp(nearest_orthogonal, (matrix,), (change,)), jnp.sum(slope * change)

    matrices, turns = (np.stack(x) for x in zip(*map(turned_subspaces, ANGLES)))
    for matrix, expected, turn, moved, back in zip(matrices, turns, *rotations(matrices), strict=True):
        np.testing.assert_allclose(turn, expected, atol=2e-15)
        # Of the polar factor: dR = R W, W S + S W = R^T dX - dX^T R with S = R^T X.
        skew = expected.T @ change - change.T @ expected
        stretch, unit = expected.T @ matrix, np.eye(len(matrix))
        spin = np.linalg.solve(np.kron(unit, stretch) + np.kron(stretch.T, unit), skew.T.reshape(-1))
        exact = expected @ spin.reshape(skew.shape).T
        np.testing.assert_allclose(moved, exact, atol=1e-12)
        np.testing.assert_allclose(back, np.sum(weights * exact), rtol=1e-11)
