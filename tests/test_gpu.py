"""On a GPU: motions, balances, derivatives, batches and failures are those of the CPU.

Run with `pytest -m gpu -n 0`: in one process, since each would take most of the memory of the GPU.
"""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.results import Result

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(jax.default_backend() == "cpu", reason="JAX finds no GPU here"),
]

STEPS = 20
LANES = 64
OPTIONS = {"chain": {"bodies": 40}}
# Trees, loops, redundant rows, many bodies by the sparse form, stiff springs, beams.
SCENES = ("heavy_top", "spacecraft", "four_bar", "bricard", "chain", "stiff_chain", "cantilever")
SMALL = ("heavy_top", "spacecraft", "four_bar")
CASES = [(name, 2) for name in SCENES] + [(name, order) for name in SMALL for order in (4, 6)]


@cache
def scene(name):
    return gallery.load(name, **OPTIONS.get(name, {}))


def run(name, order, velocity=1.0, torque=1.0, **options):
    """Some steps of a scene, its start velocities and inputs scaled."""
    example = scene(name)
    start = example.state
    return nc.simulate(
        example.system,
        eqx.tree_at(lambda s: s.v, start, velocity * start.v),
        dt=example.dt,
        inputs=torque * example.inputs(STEPS, example.dt),
        scheme=nc.EnergyMomentum(order=order),
        **options,
    )


def on_the_cpu(function, *arguments):
    """The same, compiled for the processor beside the GPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return function(*arguments)


def assert_same(found, expected, tolerance):
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        size = float(np.max(np.abs(other), initial=1.0))
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), rtol=0, atol=tolerance * size)


@pytest.mark.parametrize(("name", "order"), CASES)
def test_motion_is_that_of_the_cpu_and_conserves(name, order):
    found, expected = run(name, order), on_the_cpu(run, name, order)
    platforms = [{device.platform for device in t.states.q.devices()} for t in (found, expected)]
    assert platforms == [{jax.default_backend()}, {"cpu"}]
    system = scene(name).system
    assert np.max(nc.balance(system, found).energy, initial=0.0) <= tol.ENERGY
    assert np.max(system.constraint_errors(found).position, initial=0.0) <= tol.CONSTRAINT
    assert_same(found.states, expected.states, tol.SAME_TRAJECTORY)


def loss(name, order, numbers):
    return jnp.sum(run(name, order, *numbers).v[-1] ** 2)


@pytest.mark.parametrize(("name", "order"), [(name, order) for name in SMALL for order in (2, 4)])
def test_derivatives_are_those_of_the_cpu(name, order):
    numbers = jnp.array([0.9, 1.1])
    both = jax.value_and_grad(partial(loss, name, order))
    found, expected = both(numbers), on_the_cpu(both, numbers)
    assert_same(found, expected, tol.SAME_GRADIENT)
    _, tangent = jax.jvp(partial(loss, name, order), (numbers,), (numbers,))
    assert_same(tangent, jnp.dot(expected[1], numbers), tol.SAME_GRADIENT)


def test_a_second_derivative_is_that_of_the_cpu():
    hessian = jax.hessian(partial(loss, "heavy_top", 2))
    numbers = jnp.array([0.9, 1.1])
    assert_same(hessian(numbers), on_the_cpu(hessian, numbers), tol.SAME_GRADIENT)


@pytest.mark.parametrize(("name", "order"), [("heavy_top", 4), ("spacecraft", 2), ("four_bar", 2)])
def test_lanes_of_a_batch_are_as_if_alone(name, order):
    velocities, system = jnp.linspace(0.5, 1.5, LANES), scene(name).system
    together = jax.jit(jax.vmap(lambda x: run(name, order, x)))(velocities)
    leaves, structure = jax.tree.flatten(together)
    for lane in (0, LANES // 2, LANES - 1):
        found, alone = structure.unflatten([x[lane] for x in leaves]), run(name, order, velocities[lane])
        assert np.max(nc.balance(system, found).energy) <= tol.ENERGY
        assert_same(found.states, alone.states, tol.SAME_TRAJECTORY)


def test_only_the_sick_lane_fails():
    torques, _ = jnp.ones(LANES).at[7].set(jnp.nan), scene("spacecraft")
    together = jax.jit(jax.vmap(lambda x: run("spacecraft", 2, 1.0, x, throw=False)))(torques)
    sick = np.flatnonzero(np.asarray(together.result) != Result.SUCCESSFUL)
    assert sick.tolist() == [7]
    assert np.all(np.isfinite(np.delete(np.asarray(together.states.q), 7, axis=0)))


def test_a_failure_is_raised_with_its_name():
    example = scene("spacecraft")

    def torques(time, state):
        return jnp.where(time > 10 * example.dt, jnp.nan, example.torques(time))

    with pytest.raises(nc.SimulationError, match="step 1[01]"):
        nc.simulate(example.system, example.state, dt=example.dt, steps=STEPS, inputs=torques)


def test_steps_are_chosen_by_tolerance():
    found = run("heavy_top", 4, rtol=1e-9)
    assert int(found.steps_taken) > 0
    expected = on_the_cpu(partial(run, "heavy_top", 4, rtol=1e-9))
    assert int(found.steps_taken) == int(expected.steps_taken)
    assert_same(found.states, expected.states, tol.SAME_TRAJECTORY)
