"""Closed loops of receding horizons: they reach their goals, and what an update costs is told."""

import dataclasses

import jax
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.gallery import manoeuvres


def disc(inertia=1.0, limit=6.0, **more):
    """A disc turned by 1 rad in one second against a spring-like weight."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, -9.81, 0.0)))
    body = nc.RigidBody(mass=0.2, inertia=(1.0, 1.0, inertia), com=(0.0, -0.5, 0.0), name="disc")
    body = scene.add(body)
    hinge = scene.add(nc.Revolute(nc.ground, body, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    fields = {"dt": 0.05, "steps": 20, "cost": nc.cost.Effort(), "bounds": nc.bounds.Input(-limit, limit)}
    goal = nc.goal.Coordinate(hinge, 1.0) & nc.goal.Rest()
    return nc.OptimalControl(*scene.compile(), goal=goal, **(fields | more))


def cold(problem, loop, updates, steps_each):
    """Iterations of plans from nothing, from where the plant was at the start of some updates."""
    counts, names = [], ("t", "q", "v", "coordinates", "rates")
    for k in updates:
        there = loop.trajectory[k * steps_each]
        state = dataclasses.replace(problem.state, **{name: getattr(there, name) for name in names})
        now = dataclasses.replace(problem, state=state)
        found = nc.optimise(now, method="lifted", progress=False, tol=1e-6, goal_tol=1e-8)
        assert found.ok
        counts.append(len(found.history))
    return np.mean(counts), np.mean(loop.iterations[list(updates)])


@pytest.mark.exhaustive
def test_what_cannot_recede_is_refused_by_name():
    problem = disc()
    with pytest.raises(ValueError, match="pass horizon='shrinking'"):
        free = dataclasses.replace(problem, free_time=True)
        nc.receding_horizon(free, problem.system, updates=2)
    with pytest.raises(ValueError, match="shrinking horizon has 20 steps; pass fewer"):
        nc.receding_horizon(problem, problem.system, updates=21, horizon="shrinking")
    with pytest.raises(ValueError, match="rates of inputs"):
        costly = dataclasses.replace(problem, cost=nc.cost.InputRate())
        nc.receding_horizon(costly, problem.system, updates=2)


@pytest.mark.exhaustive
def test_parts_of_an_optimum_are_optimal():
    """The principle of optimality: with a perfect model, a loop that plans again does what it had planned."""
    problem = disc()
    strict = {"tol": 1e-10, "goal_tol": 1e-11}
    plan = nc.optimise(problem, method="lifted", progress=False, **strict)
    loop = nc.receding_horizon(problem, problem.system, updates=18, horizon="shrinking", guess=plan, **strict)
    assert plan.ok and np.all(loop.codes == 0)
    assert np.max(np.abs(loop.trajectory.inputs - plan.inputs[:18])) < 1e-6 * np.max(np.abs(plan.inputs))
    # What is left of the cost is that of the rest, and the end stays where it is.
    spent = np.cumsum(0.5 * 0.05 * np.sum(np.asarray(plan.inputs) ** 2, axis=1))
    weight = loop.costs[0] / spent[-1]
    np.testing.assert_allclose(loop.costs[1:], loop.costs[0] - weight * spent[:17], rtol=1e-6)
    np.testing.assert_allclose(loop.ends, 1.0, atol=1e-6)
    # So does a plan for other numbers come to its end.
    again = nc.receding_horizon(
        disc(1.1), disc(1.2).system, updates=18, horizon="shrinking", guess=plan, **strict
    )
    assert np.all(again.codes[:15] == 0)


@pytest.mark.exhaustive
def test_a_plan_that_fails_leaves_the_last_one_in_force():
    problem = disc()
    hinge, system = "hinge", problem.system

    def pushed(k, state):
        rate = 40.0 if k == 3 else None
        return system.with_coordinate(state, hinge, system.coordinate(state, hinge), rate=rate)

    loop = nc.receding_horizon(problem, system, updates=5, disturbance=pushed, max_iterations=15)
    calm = nc.receding_horizon(problem, system, updates=4)
    assert np.all(loop.codes[:4] == 0) and loop.codes[4] != 0
    before = nc.optimise(
        dataclasses.replace(problem, state=calm.trajectory[3]), progress=False, tol=1e-6, goal_tol=1e-8
    )
    assert np.abs(loop.trajectory.inputs[4] - before.inputs[1]).max() < 1e-4


@pytest.mark.exhaustive
def test_one_iteration_for_each_update_is_enough():
    loop = nc.receding_horizon(disc(), disc(1.2).system, updates=50, iterations=1, plant_steps=4)
    assert np.all(loop.iterations[1:] <= 1) and np.all(np.isin(loop.codes, (0, 2)))
    end = loop.trajectory[-1]
    assert abs(disc().system.coordinate(end, "hinge") - 1.0) < 0.02
    assert len(loop.trajectory) == 201 and loop.seconds.shape == loop.times.shape == (50,)


@pytest.mark.exhaustive
def test_least_time_arrives_with_a_plant_that_is_heavier():
    problem = disc(cost=nc.cost.Duration(), free_time=(0.05, 5.0))
    plant = disc(1.1).system
    loop = nc.receding_horizon(problem, plant, updates=60, horizon="shrinking")
    end = loop.trajectory[-1]
    # With hardly any time left what is missed can no more be made up; then the last plan goes on.
    assert np.all(loop.codes[:-3] == 0) and len(loop.codes) < 60
    assert abs(plant.coordinate(end, "hinge") - 1.0) < 0.02
    assert loop.ends[0] < loop.ends[-1] < 1.3 * loop.ends[0]


@pytest.mark.exhaustive
def test_a_pushed_cart_comes_back_with_its_pole_upright():
    swing = manoeuvres.cart_pole(50, t_end=2.0)
    system = swing.system
    rail, upright = nc.goal.Coordinate("rail", 0.0), nc.goal.Coordinate("hinge", np.pi)
    problem = dataclasses.replace(
        swing,
        state=system.with_coordinate(swing.state, "hinge", np.pi),
        goal=rail & upright & nc.goal.Rest(),
        cost=nc.cost.Effort() + nc.cost.Missed(rail, rate=100.0, weight=0.0),
    )

    def pushed(k, state):
        if k != 3:
            return state
        return system.with_coordinate(state, "rail", system.coordinate(state, "rail"), rate=1.0)

    loop = nc.receding_horizon(problem, system, updates=50, disturbance=pushed, plant_steps=2)
    states = loop.trajectory.states
    carts = np.asarray(jax.vmap(lambda s: system.coordinate(s, "rail"))(states))
    poles = np.asarray(jax.vmap(lambda s: system.coordinate(s, "hinge"))(states))
    assert np.all(loop.codes == 0) and np.max(loop.missing) < 1e-8
    assert np.max(carts) > 0.2 and abs(carts[-1]) < 0.03 and abs(poles[-1] - np.pi) < 0.1
    never, again = cold(problem, loop, (4, 10, 20, 30), 2)
    assert again <= never / 3


def arm(payload=0.0):
    """Three joints, a shoulder and an elbow on a turning base, and what the hand may hold [kg]."""
    scene, before, place = nc.Scene(), nc.ground, np.zeros(3)
    scene.add(nc.Gravity())
    for k, (axis, mass) in enumerate((((0, 0, 1), 4.0), ((0, 1, 0), 3.0), ((0, 1, 0), 2.0 + payload))):
        com = (0.0, 0.0, 0.1) if k == 0 else (0.25, 0.0, 0.0)
        if k == 2:
            com = ((2.0 * 0.25 + payload * 0.5) / mass, 0.0, 0.0)
        link = nc.RigidBody(mass=mass, inertia=(0.05, 0.08, 0.08), com=com, position=place, name=f"link {k}")
        link = scene.add(link)
        joint = scene.add(nc.Revolute(before, link, point=place, axis=axis, name=f"joint {k}"))
        scene.add(nc.JointTorque(joint, name=f"motor {k}"))
        before, place = link, place + ((0, 0, 0.2) if k == 0 else (0.5, 0, 0))
    return scene.compile()


@pytest.mark.exhaustive
@pytest.mark.xfail(reason="the elbow is 0.5 rad off, five steps before the end: its weight is not estimated")
def test_an_arm_takes_a_payload_it_does_not_know_to_a_pose():
    pose, limits, goal = (1.0, -0.8, 1.2), np.array([60.0, 80.0, 40.0]), nc.goal.Rest()
    for k, angle in enumerate(pose):
        goal = goal & nc.goal.Coordinate(f"joint {k}", angle)
    fields = {"dt": 0.02, "steps": 55, "cost": nc.cost.Effort(), "bounds": nc.bounds.Input(-limits, limits)}
    problem = nc.OptimalControl(*arm(), goal=goal, **fields)
    plant = arm(0.5)[0]
    loop = nc.receding_horizon(problem, plant, updates=50, horizon="shrinking", plant_steps=2)
    there = [float(plant.coordinate(loop.trajectory[-1], f"joint {k}")) for k in range(3)]
    assert np.all(loop.codes == 0)
    assert np.max(np.abs(np.array(there) - pose)) < 0.05
    assert np.median(loop.iterations[1:]) <= loop.iterations[0] / 3


def craft(torque=None):
    """A body with three wheels, and a torque upon it [N m]."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=10.0, inertia=(1.5, 2.5, 3.5), name="body"))
    for k, direction in enumerate(np.eye(3)):
        wheel = nc.RigidBody(mass=1.0, inertia=0.05 * (1.0 + direction), name=f"wheel {k}")
        hinge = scene.add(nc.Revolute(body, scene.add(wheel), axis=direction, name=f"hinge {k}"))
        scene.add(nc.JointTorque(hinge, name=f"motor {k}"))
    if torque is not None:
        scene.add(nc.BodyTorque((nc.Direction(body, (1.0, 0.0, 0.0)),), torque=torque))
    return scene.compile()


@pytest.mark.exhaustive
def test_a_spacecraft_turns_by_its_wheels_against_a_torque():
    turned = nc.goal.Attitude("body", (np.cos(0.5), np.sin(0.5), 0.0, 0.0))
    problem = nc.OptimalControl(
        *craft(),
        dt=0.1,
        steps=20,
        cost=nc.cost.Effort(),
        goal=turned & nc.goal.Motion("body"),
        bounds=nc.bounds.Input(-8.0, 8.0),
    )
    plant = craft((0.02, -0.04, 0.02))[0]
    loop = nc.receding_horizon(problem, plant, updates=50)
    missed = np.asarray(problem.goal.residual(plant, loop.trajectory[-1]))
    assert np.all(loop.codes == 0)
    assert np.max(np.abs(missed)) < 0.05
    never, again = cold(problem, loop, (1, 5, 10), 1)
    assert again <= never / 3
