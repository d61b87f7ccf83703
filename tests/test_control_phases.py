"""Optimal control with systems of their own in phases: joints close and open, and bodies meet."""

from functools import cache
from operator import itemgetter
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import natcoord_jax as nc

STEPS = (20, 30)
DT = 0.05
HEAVY, LIGHT = 2.0, 1.0
COORDINATE, REST, AT = nc.goal.Coordinate, nc.goal.Rest, nc.goal.At


@cache
def carts(coupled, motor=True):
    """Two carts on one track, the first one driven; the second takes hold of it or has its own rail."""
    scene = nc.Scene()
    first = scene.add(nc.RigidBody(mass=HEAVY, inertia=(1, 1, 1), name="first"))
    second = scene.add(nc.RigidBody(mass=LIGHT, inertia=(1, 1, 1), position=(1, 0, 0), name="second"))
    rail = scene.add(nc.Prismatic(nc.ground, first, axis=(1, 0, 0), name="rail"))
    if coupled:
        scene.add(nc.Fixed(first, second, name="coupling"))
    else:
        scene.add(nc.Prismatic(nc.ground, second, axis=(1, 0, 0), name="other"))
    if motor:
        scene.add(nc.JointForce(rail, name="motor"))
    return scene.compile()


def least_effort(mass, way, start, end, time):
    """Integral of the squared force that moves a mass by a way between two velocities."""
    square = start**2 + start * end + end**2
    return mass**2 * (12 * way**2 / time**3 - 12 * way * (start + end) / time**2 + 4 * square / time)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("method", "order"), [("shooting", 2), ("lifted", 2), ("ipopt", 2), ("lifted", 4)])
def test_a_cart_picks_up_another_with_least_effort(method, order):
    """It drives to 0.8 m, takes the other one along, which rests at 1 m, and both come to rest at 2 m."""
    if method == "ipopt":
        pytest.importorskip("casadi")
    (system, state), (train, _) = carts(False), carts(True)
    goal = AT(COORDINATE("rail", 0.8), step=STEPS[0]) & COORDINATE("rail", 2.0) & REST()
    options = {"dt": DT, "steps": STEPS, "cost": nc.cost.Effort(), "scheme": nc.EnergyMomentum(order)}
    problem = nc.OptimalControl((system, train), state, goal=goal, **options)
    found = nc.optimise(problem, method=method, progress=False)
    assert found.ok and len(found.history) <= 6
    # The momentum stays at the impact. Costs of the continuous problem, minimal in the speed of meeting.
    speed, times = np.linspace(0.0, 3.0, 300_001), [DT * count for count in STEPS]
    after = speed * HEAVY / (HEAVY + LIGHT)
    costs = least_effort(HEAVY, 0.8, 0.0, speed, times[0])
    costs = costs + least_effort(HEAVY + LIGHT, 1.2, after, 0.0, times[1])
    assert found.cost == pytest.approx(costs.min(), rel=1e-3)
    (alone, meeting), (together, carried) = found.phases.pairs
    assert float(meeting.states.v[-1, 0, 0]) == pytest.approx(speed[costs.argmin()], rel=1e-3)
    before = float(alone.momentum(meeting.states)[-1, 0])
    later = float(together.momentum(carried.states)[0, 0])
    assert later == pytest.approx(before, rel=1e-12)
    # Where they met is kept: a gap of 0.2 m.
    names = together.structure.bodies
    places = {name: np.asarray(carried.states.q)[:, 4 * k, 0] for k, name in enumerate(names)}
    np.testing.assert_allclose(places["second"] - places["first"], 0.2, atol=1e-12)
    assert places["first"][-1] == pytest.approx(2.0, abs=1e-9)
    assert max(abs(x) for x in found.missing.values()) < 1e-9
    # What was optimised is this motion, velocities normal to the rails included.
    nodes, size = np.asarray(found.iterate.path.nodes.x), carried.states.v[0].size
    along = nodes[STEPS[0] + 1 :, size : 2 * size].reshape(carried.states.v[1:].shape)
    np.testing.assert_allclose(along, carried.states.v[1:], atol=1e-9)
    with pytest.raises(ValueError, match="solution.phases"):
        _ = found.trajectory


def test_systems_that_are_not_of_one_motion_are_refused():
    (system, state), (train, _), (idle, _) = carts(False), carts(True), carts(True, motor=False)
    shared = {"dt": DT, "cost": nc.cost.Effort(), "goal": REST()}
    with pytest.raises(ValueError, match=r"2 systems and 3 phases.*steps=\(20, 20\)"):
        nc.OptimalControl((system, train), state, steps=(5, 5, 5), **shared)
    with pytest.raises(ValueError, match=r"phase 2 has the input channels.*\['motor'\]"):
        nc.OptimalControl((system, idle), state, steps=(5, 5), **shared)
    other = nc.Scene()
    other.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="third"))
    with pytest.raises(ValueError, match=r"phase 2 has the bodies \['third'\]"):
        nc.OptimalControl((system, other.compile()[0]), state, steps=(5, 5), **shared)
    shared["goal"] = AT(REST(), step=7)
    with pytest.raises(ValueError, match=r"another size in the systems of other phases.*goal\.Motion"):
        nc.OptimalControl((system, train), state, steps=(5, 5), **shared)
    with pytest.raises(ValueError, match="system"):
        nc.OptimalControl((system, 3.0), state, steps=(5, 5), **shared)


@pytest.mark.exhaustive
def test_the_ground_gives_what_the_reactions_say():
    """The force of the bound, mean over a step, against reactions at the instants before and after it."""
    scene = nc.Scene()
    arm = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0, 0), name="arm"))
    hinge = scene.add(nc.Revolute(nc.ground, arm, point=(0, 0, 0), axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointForce(hinge, name="motor"))
    scene.add(nc.Gravity())
    scene.add(nc.PointForce((nc.Point(arm),), force=(0.0, 0.0, 3.0), name="pull"))
    system, state = scene.compile()
    bound = nc.bounds.Support(friction=0.5, least=1.0)
    motion = nc.simulate(system, state, dt=1e-3, steps=300, inputs=np.ones((300, 1)))
    forces, unit = np.asarray(system.instant(motion).forces)[:, 0], 2 * 9.81
    for k in (0, 150, 299):
        before, after = (jax.tree.map(itemgetter(i), motion.states) for i in (k, k + 1))
        step = SimpleNamespace(before=before, after=after, dt=1e-3, u=motion.inputs[k])
        pressing, sliding = (float(x) * unit for x in bound.of_step(system, np.zeros(0), step))
        force = 0.5 * (forces[k] + forces[k + 1])
        assert 1.0 - pressing == pytest.approx(force[2], abs=1e-3)
        # (The cone is rounded by a thousandth of the weight.)
        assert sliding == pytest.approx(np.hypot(force[0], force[1]) - 0.5 * force[2], abs=1.1e-3 * unit)


def test_what_knows_one_system_only_says_so():
    (system, state), (train, _) = carts(False), carts(True)
    shared = {"dt": DT, "cost": nc.cost.Effort(), "goal": REST()}
    problem = nc.OptimalControl((system, train), state, steps=(5, 5), **shared)
    with pytest.raises(ValueError, match=r"has 2; use nc\.optimise"):
        nc.descend(problem, progress=False)
