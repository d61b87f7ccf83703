"""Where an optimisation starts by itself, a second method, and when a goal counts as out of reach."""

import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import natcoord_jax as nc
from natcoord_jax.control import sequential
from natcoord_jax.control.guess import unknowns_of
from natcoord_jax.control.iterate import Options
from natcoord_jax.control.nlp import program_of
from natcoord_jax.control.problem import numeric
from natcoord_jax.control.proposal import formed
from natcoord_jax.control.reach import unreached

pytestmark = pytest.mark.exhaustive


def arm(limit=30.0):
    """Two links that gravity pulls down, from one posture at rest to another."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = {"mass": 1.0, "inertia": (1 / 12, 1 / 12, 0.001)}
    upper = scene.add(nc.RigidBody(**rod, com=(0, 0, -0.5), name="upper"))
    lower = scene.add(nc.RigidBody(**rod, com=(0, 0, -1.5), name="lower"))
    first = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 1, 0), name="shoulder"))
    second = scene.add(nc.Revolute(upper, lower, point=(0, 0, -1), axis=(0, 1, 0), name="elbow"))
    for joint in (first, second):
        scene.add(nc.JointTorque(joint, name=f"motor of {joint.name}"))
    goal = nc.goal.Coordinate(first, 2.0) & nc.goal.Coordinate(second, -1.0) & nc.goal.Rest()
    fields = {"cost": nc.cost.Effort(), "goal": goal, "bounds": nc.bounds.Input(-limit, limit)}
    return nc.OptimalControl(*scene.compile(), dt=0.05, steps=20, **fields)


def turn():
    """A disc by a radian, from rest to rest, by a torque that is at its limits for most of the time."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    fields = {"cost": nc.cost.Effort(), "bounds": nc.bounds.Input(-9.0, 9.0)}
    goal = nc.goal.Coordinate(hinge, 1.0) & nc.goal.Rest()
    return nc.OptimalControl(*scene.compile(), dt=0.05, steps=20, goal=goal, **fields)


def parts_of(program, x):
    """Largest residual of the steps, of the goal, and largest excess over bounds."""
    values = np.abs(np.asarray(program.constraints(x)))
    equation = np.array([name.startswith("equation") for name in program.names])
    bound = np.isinf(program.lower)
    signed = np.asarray(program.constraints(x))
    return values[equation].max(), values[~equation & ~bound].max(), signed[bound].max()


def test_the_start_is_a_motion_that_leads_to_the_goal_by_inverse_dynamics():
    program = nc.to_nlp(arm())
    left, missed, excess = parts_of(program, program.start)
    assert left < 1e-9 and missed < 0.05 and excess < 0
    # Within limits that are too narrow for it, it comes as near as they let it.
    narrow = nc.to_nlp(arm(1.0))
    left, _, excess = parts_of(narrow, narrow.start)
    assert left > 1.0 and excess <= 1e-12


def test_two_methods_find_the_same_optimum():
    pytest.importorskip("casadi")
    ours, other = (nc.optimise(turn(), method=method, progress=False) for method in ("auto", "ipopt"))
    assert ours.ok and other.ok and "IPOPT" in other.explain()
    assert other.cost == pytest.approx(ours.cost, rel=1e-8)
    np.testing.assert_allclose(other.inputs, ours.inputs, atol=1e-5 * np.max(np.abs(ours.inputs)))
    assert max(abs(x) for x in other.missing.values()) < 1e-8
    assert 1 < len(other.history) < 60
    ended = nc.optimise(turn(), method="ipopt", progress=False, max_iterations=3)
    assert not ended.ok and ended.attempts[0].outcome is nc.Outcome.MAX_ITERATIONS


def test_what_the_second_method_needs_is_told(monkeypatch):
    monkeypatch.setattr("natcoord_jax.control.ipopt.installed", lambda: False)
    with pytest.raises(ModuleNotFoundError, match=r"natcoord-jax\[ipopt\]"):
        nc.optimise(arm(), method="ipopt", progress=False)


def test_a_goal_is_out_of_reach_only_where_no_input_leads_nearer(monkeypatch):
    far = nc.optimise(arm(), method="lifted", progress=False, max_iterations=0)
    assert not far.ok and unreached(far.problem, far.iterate, np.ones(4)) < 1e-6
    # (A program that is too large for the second method is left to restorations.)
    monkeypatch.setattr("natcoord_jax.control.run.MOST", 10)
    # Of so little torque, all is used, and what is missing is not changed any more.
    lost = nc.optimise(arm(2.0), progress=False)
    assert lost.outcome is nc.Outcome.UNREACHABLE, lost.explain()
    assert "at the limits: input 'motor of" in lost.reason and "IPOPT" not in lost.explain()
    assert unreached(lost.problem, lost.iterate, np.ones(4)) > 0.05


def test_least_time_of_two_links():
    """2.98335 s (PROPT's collection; R. Luus, Iterative Dynamic Programming, 2000) at vanishing step."""
    problems = pytest.importorskip("benchmarks.control_problems", reason="only a checkout has it")
    found = nc.optimise(problems.two_links(), progress=False)
    assert found.ok and found.cost == pytest.approx(2.98335, rel=2e-4)


@pytest.mark.parametrize(
    ("name", "cost"),
    [
        ("two poles, least time", 1.561554),
        ("acrobot", 72.06625),
        ("flying robot", 7.953951),
        ("throw, two links", -28.14726),
    ],
)
def test_hard_cases_are_solved_from_the_default_start_by_the_method_itself(name, cost):
    """Costs at the optima that this found when it first did; a better one would be welcome."""
    starts = pytest.importorskip("benchmarks.control_starts", reason="only a checkout has it")
    found = nc.optimise(starts.CASES[name].problem(), progress=False)
    assert found.ok and "IPOPT" not in found.explain()
    assert found.cost < cost + 1e-5 * abs(cost)


@pytest.mark.benchmark
def test_seven_axes_with_gravity_and_limits():
    """Below 49.84, which IPOPT finds in minimal coordinates by the implicit midpoint rule."""
    problems = pytest.importorskip("benchmarks.control_problems", reason="only a checkout has it")
    found = nc.optimise(problems.panda(), progress=False)
    assert found.ok and "IPOPT" not in found.explain()
    assert found.cost < 49.84, found.explain()


def test_the_model_bends_as_the_lagrangian_does():
    """The curvature along changes of the inputs is that of `nc.to_nlp`, constraints kept."""
    problem = numeric(arm())
    options, first = Options(True), unknowns_of(problem, None, True)
    iterate = sequential.init(problem, options, first)
    for _ in range(4):
        iterate = sequential.step(problem, options, iterate)
    x = np.asarray(ravel_pytree(iterate.unknowns)[0])
    program, m = program_of(problem, first), iterate.multipliers
    bending = iterate.derivatives.bending.residuals * problem.dt
    weights = np.concatenate([np.ravel(part) for part in (bending, m.goal, m.path, m.end)])
    hessian, jacobian = program.hessian(x, 1.0, weights), np.asarray(program.jacobian(x))
    count, equations = problem.steps * problem.channels, iterate.path.stages.residual.size
    motion = -np.linalg.solve(jacobian[:equations, count:], jacobian[:equations, :count])
    tangent = np.vstack([np.eye(count), motion])
    found = formed(problem, iterate)
    nodes = np.zeros((found.forward.shape[1], count))
    total = np.zeros((count, count))
    for k in range(problem.steps):
        inputs = np.eye(count)[k * problem.channels : (k + 1) * problem.channels]
        both = np.vstack([nodes, inputs])
        total += both.T @ np.asarray(found.hessian[k]) @ both
        nodes = np.asarray(found.forward[k]) @ both
    total += nodes.T @ np.asarray(found.last_hessian) @ nodes
    wanted = tangent.T @ np.asarray(hessian) @ tangent
    np.testing.assert_allclose(total, wanted, atol=1e-5 * np.abs(wanted).max())
    goal = jacobian[equations : equations + m.goal.size] @ tangent
    np.testing.assert_allclose(np.asarray(found.goal) @ nodes, goal, atol=1e-5 * np.abs(goal).max())
