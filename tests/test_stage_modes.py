"""The eigenvalues of the Runge-Kutta matrix take matrices of several stages apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.assembly.equations import prepare
from natcoord_jax.linsolve.stages import complex_inverse, fitted, modes_of, stagewise_inverse
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.stepping.newton import newton
from natcoord_jax.stepping.probe import FAILURES, Probe, jacobian_by_differences

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


def driven(probe, y, equations):
    """The probe once its Jacobian at y is complete, and the number of evaluations that it took."""

    def trip(carry):
        probe, _, count = carry
        residual, no = equations.residual(probe.moved(y, equations))[0], jnp.array(False)
        return *probe.with_column(y, residual, equations, no, jnp.array(0), no), count + 1

    start = probe, jnp.array(False), 0
    probe, _, count = jax.lax.while_loop(lambda carry: ~carry[1], trip, start)
    return probe, count


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
    probe, count = driven(Probe.first(6, 2, y.dtype), y, equations)
    assert count == 1 + 3
    alike = equations.matrix[:, equations.stage_places].sum(axis=1).T
    np.testing.assert_allclose(probe.columns[:3], alike, atol=1e-12)


def test_stages_are_told_apart_where_that_is_needed():
    equations, y, yes = Linear(), jnp.ones(6), jnp.array(True)
    residual, probe = equations.residual(y)[0], Probe.first(6, 2, y.dtype)
    for failures in range(1, FAILURES + 1):
        probe, _ = driven(probe, y, equations)
        # A later step begins with stages that are alike; where that is not enough, they are told apart.
        probe, _ = probe.with_column(y, residual, equations, yes, jnp.array(1), yes)
        assert not probe.alike and probe.failures == failures
        probe, count = driven(probe, y, equations)
        assert count == 4 + 1, "multipliers of all stages need one evaluation, a known residual none"
        np.testing.assert_allclose(probe.matrix(equations), equations.matrix, atol=1e-12)
        probe, _ = probe.with_column(y, residual, equations, yes, jnp.array(0), ~yes)
        assert probe.alike == (failures < FAILURES)


@pytest.mark.parametrize("name", ["four_bar", "bricard", "robot_arm"])
def test_jacobian_with_multipliers_of_all_stages_together(name):
    # What could go wrong: forces of a constraint, or of a drive, that reach another stage.
    example = gallery.load(name)
    system = example.system
    u = jnp.full((2, len(system.structure.inputs)), 0.1)
    equations = prepare(system, example.state, u, jnp.asarray(example.dt), gauss(2, True))
    y = equations.guess()
    y = y + 0.1 * jax.random.normal(jax.random.key(0), y.shape)
    found = jax.jit(lambda y: jacobian_by_differences(equations, y))(y)
    exact = jax.jit(lambda y: equations.jacobian(y))(y)
    np.testing.assert_allclose(found, exact, atol=1e-5 * float(jnp.max(jnp.abs(exact))))


@pytest.mark.parametrize("order", [4, 6])
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
        probe, _ = driven(Probe.first(y.shape[0], tableau.stages, y.dtype), y, equations)
        columns = probe.columns[: equations.stage_places.shape[1]]
        found = equations.factorised_alike(columns)[0].inverse
        return jnp.eye(y.shape[0]) - found @ equations.jacobian(y), code

    matrix, code = left()
    assert code == 0
    assert np.max(np.abs(np.linalg.eigvals(matrix))) < 0.18
