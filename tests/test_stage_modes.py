"""The eigenvalues of the Runge-Kutta matrix take matrices of several stages apart."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.linsolve.stages import complex_inverse, fitted, modes_of, stagewise_inverse
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.stepping.difference_jacobian import FAILURES, DifferenceJacobian, matrix_of
from natcoord_jax.stepping.newton import newton

SIZES = [(5, 0), (5, 2), (50, 3)]


def parts(balances, constraints, seed=0):
    """N, D and K of random numbers, with the signs of inertia and constraints."""
    rng, size = np.random.default_rng(seed), balances + constraints
    inertia, damping, stiffness = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    root, rows = rng.normal(size=(balances, balances)), rng.normal(size=(constraints, balances))
    inertia[:balances, :balances] = root @ root.T + balances * np.eye(balances)
    damping[:balances, :balances] = rng.normal(size=(balances, balances))
    damping[:balances, balances:], damping[balances:, :balances] = -rows.T, rows
    stiffness[:, :balances] = rng.normal(size=(size, balances))
    return inertia, damping, stiffness


def whole(inertia, damping, stiffness, tableau):
    """The matrix of all stages."""
    unit = np.eye(tableau.stages)
    return (
        np.kron(tableau.a_inverse, inertia) + np.kron(unit, damping) + np.kron(np.array(tableau.a), stiffness)
    )


@pytest.mark.parametrize("stages", range(2, 6))
def test_modes_give_the_matrix_back(stages):
    tableau = gauss(stages)
    values, couplings = modes_of(tableau)
    assert len(values) == (stages + 1) // 2
    found = np.sum(values[:, None, None] * couplings, axis=0).real
    np.testing.assert_allclose(found, tableau.a, atol=1e-14)
    np.testing.assert_allclose(np.sum(couplings, axis=0).real, np.eye(stages), atol=1e-13)


@pytest.mark.parametrize("stages", range(2, 6))
@pytest.mark.parametrize("balances, constraints", SIZES)
def test_inverse_of_all_stages(stages, balances, constraints):
    tableau = gauss(stages)
    given = parts(balances, constraints)
    matrix, size = whole(*given, tableau), balances + constraints
    alike = matrix.reshape(stages, size, stages, size).sum(axis=2)
    inertia = jnp.asarray(given[0])
    damping, stiffness = fitted(jnp.asarray(alike), inertia, balances, tableau)
    np.testing.assert_allclose(damping, given[1], atol=1e-11)
    np.testing.assert_allclose(stiffness, given[2], atol=1e-11)
    inertias = jnp.diagonal(inertia)[:balances]
    found = stagewise_inverse(inertia, damping, stiffness, inertias, tableau)
    found = np.asarray(found).reshape(matrix.shape)
    # Without constraints exact; with them, but for the diagonal that redundant rows need.
    np.testing.assert_allclose(found @ matrix, np.eye(len(matrix)), atol=1e-7 if constraints else 1e-11)


@pytest.mark.parametrize("size", [3, 60])
def test_complex_inverse_needs_no_diagonal(size):
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(size, size)) + 1j * rng.normal(size=(size, size))
    matrix[np.diag_indices(size)] = 0.0
    real, imaginary = complex_inverse(jnp.asarray(matrix.real), jnp.asarray(matrix.imag))
    found = np.asarray(real) + 1j * np.asarray(imaginary)
    np.testing.assert_allclose(found @ matrix, np.eye(size), atol=1e-10)


class Found(NamedTuple):
    residual: Any


def begun(y, equations):
    """The probe before the first Jacobian."""
    return DifferenceJacobian.first(equations, y)


def found_at(probe, y, equations):
    """The probe and the equations, evaluated at y and wherever the probe wants to."""

    def evaluate(y, *_):
        return Found(equations.residual(y)[0])

    return probe.evaluated(equations, y, evaluate, Found(jnp.zeros_like(y)))


def formed(probe, y, equations, rounds=0):
    """The probe once it has formed a Jacobian at y, the step having had so many."""
    probe = probe.asked(jnp.array(True), jnp.array(rounds), equations.tableau.stages)
    return found_at(probe, y, equations)[0]


def evaluations(probe):
    """Number of columns that were evaluated, in the first Jacobian of a probe."""
    return int(jnp.sum(jnp.any(probe.moved[:-1] != 0.0, axis=1)))


class Linear:
    """Equations of two stages with two rates and a multiplier each, with the Jacobian `matrix`."""

    tableau = gauss(2)
    balances = 4
    stage_places = np.array([[0, 1, 4], [2, 3, 5]])
    matrix = np.arange(36.0).reshape(6, 6)
    matrix[np.ix_([2, 3, 5], [4])] = matrix[np.ix_([0, 1, 4], [5])] = 0.0  # multipliers act at their stage

    def probes(self, y):
        return jnp.array([0.5, 0.25, 0.5, 0.25, 2.0, 1.0])

    def residual(self, y):
        return (self.matrix @ y,)


def test_columns_of_changes_that_are_the_same_at_all_stages():
    equations, y = Linear(), jnp.ones(6)
    probe = formed(begun(y, equations), y, equations)
    assert evaluations(probe) == 3
    alike = equations.matrix[:, equations.stage_places].sum(axis=1).T
    np.testing.assert_allclose(probe.columns(equations, y)[:3], alike, atol=1e-12)


def test_stages_are_told_apart_where_that_is_needed():
    equations, y = Linear(), jnp.ones(6)
    assert evaluations(formed(begun(y, equations), y, equations, rounds=1)) == 5, "one for both multipliers"
    probe = begun(y, equations)
    for failures in range(1, FAILURES + 1):
        # A later step begins with stages that are alike; where that is not enough, they are told apart.
        probe = formed(probe, y, equations)
        assert probe.alike and probe.failures == failures - 1
        probe = formed(probe, y, equations, rounds=1)
        assert not probe.alike and probe.failures == failures
        np.testing.assert_allclose(matrix_of(equations, probe.columns(equations, y)), equations.matrix)
    assert not formed(probe, y, equations).alike


def test_without_a_jacobian_the_equations_are_evaluated_once():
    equations, y, no = Linear(), jnp.ones(6), jnp.array(False)
    probe = begun(y, equations).asked(no, jnp.array(0), 2)
    probe, found = found_at(probe, y, equations)
    assert evaluations(probe) == 0 and not probe.making
    np.testing.assert_array_equal(found.residual, equations.residual(y)[0])


def test_evaluations_of_a_jacobian_are_told_what_they_are_for():
    # Kicks are found anew only where rates are others, and the last evaluation is that of the residual.
    equations, y = Linear(), jnp.ones(6)

    def told(y, at_end, moving):
        return Found(equations.residual(y)[0] * 0.0 + jnp.where(at_end, 2.0, jnp.where(moving, 1.0, 0.0)))

    for alike, expected in ((True, [1, 1, 0]), (False, [1, 1, 1, 1, 0])):
        probe = begun(y, equations).asked(jnp.array(True), jnp.array(0 if alike else 1), 2)
        probe, found = probe.evaluated(equations, y, told, Found(jnp.zeros_like(y)))
        np.testing.assert_array_equal(probe.moved[: len(expected), 0], expected)
        assert np.all(np.asarray(found.residual) == 2.0)


@pytest.mark.parametrize(
    "name",
    [
        "bricard",
        pytest.param("four_bar", marks=pytest.mark.slow),
        pytest.param("robot_arm", marks=pytest.mark.exhaustive),
    ],
)
def test_jacobian_with_multipliers_of_all_stages_together(name):
    # What could go wrong: forces of a constraint, or of a drive, that reach another stage.
    example = gallery.load(name)
    system = example.system
    u = jnp.full((2, len(system.structure.inputs)), 0.1)
    equations = prepare(system, example.state, u, jnp.asarray(example.dt), gauss(2, True))
    y = equations.guess()
    y = y + 0.1 * jax.random.normal(jax.random.key(0), y.shape)

    @jax.jit
    def by_differences(y):
        probe = formed(begun(y, equations), y, equations, rounds=1)
        return matrix_of(equations, probe.columns(equations, y))

    found = by_differences(y)
    exact = jax.jit(lambda y: equations.jacobian(y))(y)
    np.testing.assert_allclose(found, exact, atol=1e-5 * float(jnp.max(jnp.abs(exact))))


@pytest.mark.parametrize("order", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_stiff_springs_are_nearly_alike_at_all_stages(order):
    # What is left of an error after one correction, with w h = 160; along axes that rest 0.23.
    example = gallery.load("stiff_chain", rods=3)
    h, tableau = jnp.asarray(1 / 128), gauss(order // 2, True)
    moved = nc.simulate(example.system, example.state, dt=h, steps=32, scheme=nc.EnergyMomentum(order=order))
    state = jax.tree.map(lambda x: x[-1], moved.states)
    equations = prepare(example.system, state, jnp.zeros(0), h, tableau)

    @jax.jit
    def left():
        y, code = newton(equations, 1e-16)
        columns = formed(begun(y, equations), y, equations).columns(equations, y)
        columns = columns[: equations.stage_places.shape[1]]
        found = equations.factorised_alike(columns)[0].inverse
        return jnp.eye(y.shape[0]) - found @ equations.jacobian(y), code

    matrix, code = left()
    assert code == 0
    assert np.max(np.abs(np.linalg.eigvals(matrix))) < 0.18
