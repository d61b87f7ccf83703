"""Eliminations of small matrices: values, derivatives in every mode, and that these go through no loop.

A loop that is differentiated keeps all its turns: the derivative of a kick took twice as long for it, and
nothing but the time would have told.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from natcoord_jax.maths.elimination import definite_inverse, definite_solution, inverse_cholesky

SIZES = (1, 4, 9, 60)  # the last one beyond the loops


def _definite(size: int, seed: int) -> jax.Array:
    some = np.random.default_rng(seed).normal(size=(size, size + 2))
    return jnp.asarray(some @ some.T / size + np.eye(size))


def _solution(matrix):
    return definite_solution(matrix, jnp.sin(jnp.arange(matrix.shape[0]) + 1.0))


def _reference_solution(matrix):
    return jnp.linalg.solve(matrix, jnp.sin(jnp.arange(matrix.shape[0]) + 1.0))


def _reference_factor(matrix):
    return jnp.linalg.inv(jnp.linalg.cholesky(matrix))


FUNCTIONS = {
    "inverse": (definite_inverse, jnp.linalg.inv),
    "solution": (_solution, _reference_solution),
    "factor": (inverse_cholesky, _reference_factor),
}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_are_those_of_lapack(name, size):
    own, reference = FUNCTIONS[name]
    matrix, change = _definite(size, 1), _definite(size, 2)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=own(matrix).shape))

    def along(function):
        return jax.jvp(function, (matrix,), (change,))

    def second(function):
        slope = jax.grad(lambda x: jnp.sum(weights * function(0.5 * (x + x.T))))
        return slope(matrix), jax.jvp(slope, (matrix,), (change,))[1]

    for found, expected in zip((*along(own), *second(own)), (*along(reference), *second(reference))):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-10)


def test_a_solution_changes_with_its_right_hand_side():
    matrix, right = _definite(5, 1), jnp.arange(5.0)
    found = jax.jacrev(definite_solution, 1)(matrix, right)
    np.testing.assert_allclose(found, np.linalg.inv(matrix), atol=1e-12)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_go_through_no_loop(name):
    own, _ = FUNCTIONS[name]
    matrix = _definite(6, 1)
    _, back = jax.vjp(own, matrix)
    pulled = jax.make_jaxpr(back)(jnp.ones_like(own(matrix)))
    assert not any(word in str(pulled) for word in ("scan[", "while["))
