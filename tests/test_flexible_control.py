"""Optimal control with flexible bodies: gradients go through beams and shells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.gallery.panel_slew import as_a_rigid_body
from natcoord_jax.gallery.plugging import along_a_smooth_path, joint_angles

pytestmark = pytest.mark.exhaustive


@pytest.fixture(scope="module")
def plugged():
    example = gallery.load("plugging")
    best = example.solved(example.steps, example.dt, progress=False)
    assert best is not None
    return best.problem, along_a_smooth_path(best.problem), best


def test_the_plug_reaches_its_socket_with_the_cable_at_rest(plugged):
    problem, guess, best = plugged
    assert best.ok, best.explain()
    assert len(best.history) <= 20
    assert max(abs(x) for x in best.missing.values()) < 1e-9
    assert best.history[-1].stationarity < 1e-8
    # Simulated again, as anyone would: the plug is where it belongs, and the cable hangs there and rests.
    trajectory = nc.simulate(
        problem.system, problem.state, dt=problem.dt, steps=problem.steps, inputs=best.inputs
    )
    last = jax.tree.map(lambda x: x[-1], trajectory.states)
    angles = [float(problem.system.coordinate(last, k)) for k in ("shoulder", "elbow", "wrist")]
    np.testing.assert_allclose(angles, joint_angles(), rtol=0, atol=1e-9)
    hanging = problem.cost.terms[1].goal.residual(problem.system, last)
    assert float(jnp.max(jnp.abs(hanging))) < 0.01  # m: a sixtieth of the cable
    effort = float(problem.dt) * float(jnp.sum(guess**2))
    assert best.cost < 0.1 * effort


def test_the_gradient_through_the_cable(plugged):
    """Of effort and of what the cable misses, along a direction of the torques, against differences."""
    problem, guess, _ = plugged

    def cost(inputs):
        trajectory = nc.simulate(
            problem.system, problem.state, dt=problem.dt, steps=problem.steps, inputs=inputs
        )
        last = jax.tree.map(lambda x: x[-1], trajectory.states)
        return problem.dt * jnp.sum(inputs**2) + problem.cost.terminal(problem.system, last)

    direction = jax.random.normal(jax.random.key(0), guess.shape)
    slope = jnp.vdot(jax.grad(cost)(guess), direction)
    h = 1e-4
    difference = (cost(guess + h * direction) - cost(guess - h * direction)) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_a_spacecraft_and_its_panels_come_to_rest():
    """The torques that would be best for a rigid craft leave swinging panels; less effort leaves none."""
    example = gallery.load("panel_slew")
    assert example.system.structure.dofs == example.facts["dofs"]
    best = example.solved(example.steps, example.dt, progress=False)
    assert best is not None and best.ok, best.explain()
    assert max(abs(x) for x in best.missing.values()) < 1e-9
    problem, energies = best.problem, []
    for inputs in (as_a_rigid_body(best.problem), best.inputs):
        trajectory = nc.simulate(problem.system, problem.state, dt=problem.dt, inputs=inputs)
        energy = np.asarray(problem.system.energy(trajectory).total)
        energies.append(energy[-1] / energy.max())
        assert nc.balance(problem.system, trajectory).energy.max() < 1e-11
    assert energies[0] > 0.1 and energies[1] < 1e-3, "parts of the largest energy that are left"
    turned = problem.system.sense(trajectory.states, "hub").rotation[-1]
    np.testing.assert_allclose(turned, problem.goal.parts[0].rotation, atol=1e-9)
