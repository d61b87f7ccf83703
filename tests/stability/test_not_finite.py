"""States and parameters that are not finite: every run comes back, with a result that says so.

What could go wrong: an iteration that begins anew where it began, at a number that is none, for ever; a batch
that waits for such a lane.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.core.results import Result

STIFFNESS = 3.0


@cache
def arms(solver):
    """Three arms with hinges, a spring and a motor."""
    scene, last, hinges = nc.Scene(), nc.ground, []
    for i in range(3):
        body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(i, 0, 0), name=f"arm {i}"))
        hinges.append(scene.add(nc.Revolute(last, body, point=(i - 0.5, 0, 0), axis=(0, 1, 0))))
        last = body
    scene.add(nc.JointSpring(hinges[0], stiffness=STIFFNESS))
    scene.add(nc.JointTorque(hinges[1], name="motor"))
    scene.add(nc.Gravity())
    return *scene.compile(solver=solver), hinges[0]


def until(state):
    """An event that never comes."""
    return state.q[0, 0] + 100.0


@cache
def program(order, rtol, event):
    """The run, also of many."""

    def run(system, state, torque):
        return nc.simulate(
            system,
            state,
            dt=0.01,
            steps=4,
            inputs=jnp.zeros((4, 1)).at[2].set(torque),
            scheme=nc.EnergyMomentum(order=order),
            rtol=rtol,
            until=until if event else None,
            throw=False,
        )

    return jax.jit(run)


def sick(solver):
    """Systems, states and torques with a number that is not finite, by what it is."""
    system, state, hinge = arms(solver)
    bad = {
        "places": (system, eqx.tree_at(lambda s: s.q, state, state.q * jnp.nan), 0.0),
        "a place": (system, eqx.tree_at(lambda s: s.q, state, state.q.at[5, 1].set(jnp.nan)), 0.0),
        "far away": (system, eqx.tree_at(lambda s: s.q, state, state.q.at[4, 0].set(jnp.inf)), 0.0),
        "speeds": (system, eqx.tree_at(lambda s: s.v, state, state.v * jnp.nan), 0.0),
        "too fast": (system, eqx.tree_at(lambda s: s.v, state, state.v.at[4, 0].set(jnp.inf)), 0.0),
        "coordinate": (system, jax.jit(lambda x: system.with_coordinate(state, hinge, x))(jnp.nan), 0.0),
        "mass": (eqx.tree_at(lambda s: s.mass, system, system.mass * jnp.nan), state, 0.0),
        "torque": (system, state, jnp.nan),
    }

    def stiffness(s):
        return [g.effect.stiffness for g in s.effects if g.effect.kind == "joint spring"]

    bad["stiffness"] = (eqx.tree_at(stiffness, system, replace_fn=lambda x: x * jnp.nan), state, 0.0)
    return bad


FORMS = [
    pytest.param("reduced", 2, None, False),
    pytest.param("reduced", 2, 1e-6, True, marks=pytest.mark.slow),
    pytest.param("reduced", 4, None, False, marks=pytest.mark.slow),
    pytest.param("full", 2, None, False, marks=pytest.mark.slow),
    pytest.param("full", 4, None, False, marks=pytest.mark.exhaustive),
    pytest.param("recursive", 2, None, False, marks=pytest.mark.slow),
    pytest.param("recursive", 4, 1e-6, False, marks=pytest.mark.slow),
    pytest.param("sparse", 2, None, False, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("solver, order, rtol, event", FORMS)
def test_a_run_comes_back(solver, order, rtol, event):
    """In a few attempts, at the step where the number is."""
    for what, (system, state, torque) in sick(solver).items():
        found = program(order, rtol, event)(system, state, torque)
        assert Result(int(found.result)) is Result.NONFINITE, what
        assert int(found.failed_step) == (2 if what == "torque" else 0), what


class Undefined(nc.Potential):
    """A spring whose energy is none beyond a length, where its slope is a number (zero)."""

    def invariants(self, x):
        """The squared length."""
        return ((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def energy(self, invariants):
        """As far as it is known."""
        return jnp.where(invariants[0] < 4.0, invariants[0], jnp.nan)


@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["joint", "markers"])
def test_an_energy_that_is_none(kind, speed):
    """Of a law whose slope is a number: the first step says so, at rest as in motion."""
    scene = nc.Scene()
    inertia = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)}
    ball = scene.add(nc.RigidBody(**inertia, position=(2.5, 0, 0), velocity=(speed, 0, 0)))
    if kind == "joint":
        slider = scene.add(nc.Prismatic(nc.ground, ball, axis=(1, 0, 0)))
        scene.add(nc.JointPotential(slider, law=lambda c: jnp.where(c > 10.0, c, jnp.nan)))
    else:
        scene.add(Undefined((nc.Point(nc.ground), nc.Point(ball))))
    found = nc.simulate(*scene.compile(), dt=0.01, steps=4, throw=False)
    assert Result(int(found.result)) is Result.NONFINITE
    assert int(found.failed_step) == 0


def test_other_lanes_are_untouched():
    """A batch with a lane that is not finite: the others are what they are alone."""
    system, state, _ = arms("reduced")
    speeds = jnp.array([0.0, jnp.nan, 0.3])

    def run(speed):
        moving = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 2].set(speed))
        return program(2, None, False)(system, moving, 0.0)

    batch = jax.jit(jax.vmap(run))(speeds)
    assert [Result(int(x)) for x in batch.result] == [
        Result.SUCCESSFUL,
        Result.NONFINITE,
        Result.SUCCESSFUL,
    ]
    for lane in (0, 2):
        np.testing.assert_array_equal(batch.q[lane], run(speeds[lane]).q)


@pytest.mark.slow
def test_gradients_come_back():
    """Of a run that has failed: nothing is said of their value but that it is not a hang."""
    system, state, _ = arms("reduced")

    @jax.jit
    @jax.grad
    def slope(speed):
        moving = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 2].set(speed))
        return jnp.sum(program(2, None, False)(system, moving, 0.0).q[-1])

    assert np.isfinite(slope(0.3))
    slope(jnp.nan).block_until_ready()


@pytest.mark.slow
def test_other_analyses_come_back():
    """Equilibria, modes, assembly and accelerations of a state that is not finite."""
    system, state, _ = arms("reduced")
    bad = eqx.tree_at(lambda s: s.q, state, state.q.at[5, 1].set(jnp.nan))
    for analysis in (nc.assemble, nc.equilibrium, nc.modes):
        with pytest.raises((nc.SimulationError, ValueError)):
            jax.block_until_ready(analysis(system, bad))
    assert not np.isfinite(np.asarray(system.instant(bad).accelerations)).all()
