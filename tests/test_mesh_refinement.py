"""Meshes that follow the local error, on problems whose answers are known in closed form."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

MASS = 1.0
"""Of the cart [kg]."""
AT_REST = nc.goal.Coordinate("rail", 1.0) & nc.goal.Rest()
FIRST = 20
"""Steps of a first mesh."""


@pytest.fixture(scope="module")
def cart():
    """A cart that a force drives along a rail: its steps are exact while the force stays."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=MASS, inertia=(1.0, 1.0, 1.0), name="cart"))
    rail = scene.add(nc.Prismatic(nc.ground, body, axis=(1, 0, 0), name="rail"))
    scene.add(nc.JointForce(rail, name="motor"))
    return scene.compile()


def on_rail(cart, *, steps=FIRST, **options):
    """A problem of a second."""
    fields = {"dt": 1.0 / np.sum(steps), "steps": steps, "cost": nc.cost.Effort(), "goal": AT_REST}
    return nc.OptimalControl(*cart, **(fields | options))


def lengths(solution) -> np.ndarray:
    """Durations of all steps [s]."""
    t = np.asarray(solution.trajectory.states.t, float)
    return t[1:] - t[:-1]


@pytest.mark.exhaustive
def test_steps_gather_where_the_force_of_least_time_switches(cart):
    """With forces from -1 to 2 the way of 1 takes sqrt(3), and the force switches after a third of it."""
    problem = on_rail(
        cart, dt=0.1, cost=nc.cost.Duration(), bounds=nc.bounds.Input(-1.0, 2.0), free_time=True
    )
    found = nc.refine(problem, tolerance=1e-9, max_rounds=3, progress=False)
    assert not found.ok and "after 3 rounds" in found.reason
    # They are only moved, which is the same program with other numbers.
    assert [row.steps for row in found.rounds] == [FIRST] * 4
    off = np.array([row.cost for row in found.rounds]) - math.sqrt(3.0)
    assert 1e-3 < off[0] and np.all(np.diff(off) < 0) and 0 < off[-1] < 1e-5
    errors = np.array([row.error for row in found.rounds])
    # Of a switch the error of positions, relative to the way of 1, is that of the time to within a factor.
    assert np.all((errors > 0.2 * off) & (errors < 5.0 * off))
    size, u = lengths(found.solution), found.solution.inputs[:, 0]
    between = int(np.argmin(np.abs(u - 0.5)))
    assert size[between] == pytest.approx(size.min(), rel=0.5) and size.min() < 0.1 * size.mean()
    switch = size[:between].sum() + size[between] * (u[between] + 1.0) / 3.0
    assert switch == pytest.approx(math.sqrt(3.0) / 3.0, abs=1e-5)


@pytest.mark.exhaustive
def test_steps_stay_equal_where_their_errors_are(cart):
    """Least effort from rest to rest is a force that falls steadily: 6 (1 - 2 t), at a cost of 12."""
    found = nc.refine(on_rail(cart), tolerance=2e-5, progress=False)
    assert found.ok and len(found.rounds) == 2
    size = lengths(found.solution)
    assert found.solution.problem.steps > FIRST and size.max() < 1.001 * size.min()
    # u' h^3 / 12 of a step that holds a steady change; the part of it that two halves show is exact.
    assert found.errors == pytest.approx(12.0 * size**3 / 12.0, rel=1e-2)
    assert found.rounds[0].error == pytest.approx(FIRST**-3.0, rel=1e-2)
    # A solution already found goes on, and nothing is asked for that it has.
    same = nc.refine(found.solution, tolerance=2e-5, progress=False)
    assert same.solution is found.solution and len(same.rounds) == 1


@pytest.mark.exhaustive
def test_steps_gather_in_a_layer_at_the_start(cart):
    """Small error and cheap force: from 1 at rest it costs 1 / sqrt(2 k), as of an endless horizon."""
    k = 400.0

    def running(state, u, t):
        return 0.5 * (u[0] / k) ** 2 + 0.5 * state.coordinates[0] ** 2

    system, state = cart
    begun = system.with_coordinate(state, "rail", 1.0)
    options = {"cost": nc.cost.Running(running), "goal": nc.goal.Goal()}
    problem = nc.OptimalControl(system, begun, dt=1.0 / FIRST, steps=FIRST, **options)
    found = nc.refine(problem, tolerance=1e-3, progress=False)
    assert found.ok, found
    steps, size = found.solution.problem.steps, lengths(found.solution)
    equal = nc.optimise(
        nc.OptimalControl(system, begun, dt=1.0 / steps, steps=steps, **options), progress=False
    )
    exact = 1.0 / math.sqrt(2.0 * k)
    refined, plain = (abs(one.cost - exact) for one in (found.solution, equal))
    assert refined < 0.3 * plain
    assert size[:5].max() < 0.4 * size[-5:].min()


def pendulum():
    """A bob on a rod that a weak motor turns."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    bob = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), com=(0, 0, -1), name="bob"))
    hinge = scene.add(nc.Revolute(nc.ground, bob, axis=(0, 1, 0), name="rail"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


@pytest.mark.exhaustive
def test_estimates_are_the_errors_of_the_steps():
    """Beside the same steps in 64 parts, with the same inputs: on purpose these are held over two steps."""
    system, state = pendulum()
    goal = nc.goal.Coordinate("rail", 2.0) & nc.goal.Rest()
    options = {"cost": nc.cost.Effort(), "inputs": nc.inputs.Spline(every=2), "goal": goal}
    problem = nc.OptimalControl(system, state, dt=0.06, steps=FIRST, **options)
    found = nc.refine(problem, tolerance=1e-5, max_rounds=1, max_steps=FIRST, progress=False)
    states, inputs, size = found.solution.trajectory.states, found.solution.inputs, lengths(found.solution)
    # Both steps of an interval stay equal, and intervals have been moved so that errors are equal as well.
    np.testing.assert_allclose(size[::2], size[1::2], rtol=1e-12)
    assert size.max() > 1.2 * size.min()
    assert found.rounds[1].steps == FIRST and found.rounds[1].error < 0.8 * found.rounds[0].error
    begun = jax.tree.map(lambda x: x[:-1], states)

    def finer(state, u, dt):
        held = jnp.broadcast_to(u, (64, 1))
        return jax.tree.map(lambda x: x[-1], nc.simulate(system, state, dt=dt / 64, inputs=held).states)

    fine = jax.vmap(finer)(begun, jnp.asarray(inputs), jnp.asarray(size))
    rates, ends = (np.asarray(jax.vmap(lambda s: system.rate(s, "rail"))(x)) for x in (states, fine))
    # (The point of the bob that its place is told by is on the hinge: directors turn, by so many radians.)
    off = np.linalg.norm(np.asarray(states.q[1:] - fine.q), axis=-1).max(axis=1)
    true = np.maximum(off, np.abs(rates[1:] - ends) / np.abs(rates).max())
    assert true.max() > 1e-5
    np.testing.assert_allclose(found.errors, true, rtol=0.3, atol=0.02 * true.max())


@pytest.mark.exhaustive
def test_a_waypoint_stays_in_its_place(cart):
    """Half-way after 0.4 s of one, after another number of steps."""
    half = nc.goal.At(nc.goal.Coordinate("rail", 0.5), step=8)
    found = nc.refine(on_rail(cart, goal=half & AT_REST), tolerance=1e-4, max_rounds=1, progress=False)
    (place,) = (x for x in found.solution.problem.goal.everything() if isinstance(x, nc.goal.At))
    states = found.solution.trajectory.states
    assert found.solution.problem.steps > FIRST and place.step != 8
    assert float(states.t[place.step]) == pytest.approx(0.4, abs=1e-12)
    assert float(states.coordinates[place.step, 0]) == pytest.approx(0.5, abs=1e-9)
    assert float(states.t[-1]) == pytest.approx(1.0, abs=1e-12)


def test_a_waypoint_inside_an_interval_of_the_inputs_is_refused_before_anything_is_solved(cart):
    half = nc.goal.At(nc.goal.Coordinate("rail", 0.5), step=7)
    problem = on_rail(cart, goal=half & AT_REST, inputs=nc.inputs.Spline(every=2))
    with pytest.raises(ValueError, match=r"every=2 steps, and a phase or waypoint ends after step 7"):
        nc.refine(problem, progress=False)
