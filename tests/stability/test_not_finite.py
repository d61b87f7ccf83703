"""States and parameters that are not finite: each run comes back, with a result that says so.

What could go wrong: an iteration that begins anew where it began, at a number that is none, for ever; a batch
that waits for such a lane (that other lanes are untouched: `test_failures.test_sick_lanes`).
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc


@cache
def arms(solver):
    """Three arms with hinges, a spring and a motor."""
    scene, last, hinges = nc.Scene(), nc.ground, []
    for i in range(3):
        body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(i, 0, 0), name=f"arm {i}"))
        hinges.append(scene.add(nc.Revolute(last, body, point=(i - 0.5, 0, 0), axis=(0, 1, 0))))
        last = body
    scene.add(nc.JointSpring(hinges[0], stiffness=3.0, name="coil"))
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

    def placed(change):
        return system, eqx.tree_at(lambda s: s.q, state, change(state.q)), 0.0

    def moving(change):
        return system, eqx.tree_at(lambda s: s.v, state, change(state.v)), 0.0

    def traced(change):
        return jax.jit(change)(jnp.nan)

    return {
        "places": placed(lambda q: q * jnp.nan),
        "a place": placed(lambda q: q.at[5, 1].set(jnp.nan)),
        "far away": placed(lambda q: q.at[4, 0].set(jnp.inf)),
        "speeds": moving(lambda v: v * jnp.nan),
        "too fast": moving(lambda v: v.at[4, 0].set(jnp.inf)),
        "coordinate": (system, traced(lambda x: system.with_coordinate(state, hinge, x)), 0.0),
        "mass": (traced(lambda x: system.set("arm 1", mass=x)), state, 0.0),
        "stiffness": (traced(lambda x: system.set("coil", stiffness=x)), state, 0.0),
        "torque": (system, state, jnp.nan),
    }


FORMS = [
    pytest.param("reduced", 2, None, False),
    pytest.param("recursive", 4, 1e-6, False, marks=pytest.mark.exhaustive),
    pytest.param("reduced", 2, 1e-6, True, marks=pytest.mark.exhaustive),
    pytest.param("reduced", 4, None, False, marks=pytest.mark.exhaustive),
    pytest.param("full", 2, None, False, marks=pytest.mark.exhaustive),
    pytest.param("full", 4, None, False, marks=pytest.mark.exhaustive),
    pytest.param("recursive", 2, None, False, marks=pytest.mark.exhaustive),
    pytest.param("sparse", 2, None, False, marks=pytest.mark.exhaustive),
]


@pytest.mark.parametrize("solver, order, rtol, event", FORMS)
def test_a_run_comes_back(solver, order, rtol, event):
    """In a few attempts, at the step where the number is."""
    ends = {}
    for what, case in sick(solver).items():
        run = program(order, rtol, event)(*case)
        ends[what] = nc.Result(int(run.result)), int(run.failed_step)
    assert ends == {what: (nc.Result.NONFINITE, 2 if what == "torque" else 0) for what in ends}


class Undefined(nc.Potential):
    """A spring whose energy is none beyond a length, where its slope is a number (zero)."""

    def invariants(self, x):
        """The squared length."""
        return ((x[1] - x[0]) @ (x[1] - x[0]))[None]

    def energy(self, invariants):
        """As far as it is known."""
        return jnp.where(invariants[0] < 4.0, invariants[0], jnp.nan)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("markers", marks=pytest.mark.slow),
        pytest.param("joint", marks=pytest.mark.exhaustive),
    ],
)
def test_an_energy_that_is_none(kind):
    """Of a law whose slope is a number: the first step says so, at rest as in motion."""
    for speed in (0.0, 1.0):
        scene = nc.Scene()
        inertia = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)}
        ball = scene.add(nc.RigidBody(**inertia, position=(2.5, 0, 0), velocity=(speed, 0, 0)))
        if kind == "joint":
            slider = scene.add(nc.Prismatic(nc.ground, ball, axis=(1, 0, 0)))
            scene.add(nc.JointPotential(slider, law=lambda c: jnp.where(c > 10.0, c, jnp.nan)))
        else:
            scene.add(Undefined((nc.Point(nc.ground), nc.Point(ball))))
        run = nc.simulate(*scene.compile(), dt=0.01, steps=4, throw=False)
        assert nc.Result(int(run.result)) is nc.Result.NONFINITE, speed
        assert int(run.failed_step) == 0, speed


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


@pytest.mark.exhaustive
def test_other_analyses_come_back():
    """Equilibria, modes, assembly and accelerations of a state that is not finite."""
    system, state, _ = arms("reduced")
    bad = eqx.tree_at(lambda s: s.q, state, state.q.at[5, 1].set(jnp.nan))
    for analysis in (nc.assemble, nc.equilibrium, nc.modes):
        with pytest.raises((nc.SimulationError, ValueError)):
            jax.block_until_ready(analysis(system, bad))
    assert not np.isfinite(np.asarray(system.instant(bad).accelerations)).all()
