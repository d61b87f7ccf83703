"""Optimal control from where a user starts: restoration, reasons, several starts, paths of problems."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.control import line_search, proposal, sequential
from natcoord_jax.control.guess import goal_scale, unknowns_of
from natcoord_jax.control.iterate import Options
from natcoord_jax.control.problem import numeric

LEAST = 8.0
"""Torque that just turns an inertia of 2 by 1 rad in 1 s, pushing and braking all the time [N m]."""


def disc():
    """A disc on a hinge with a motor."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, body, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def turn(made, limit=None, **options):
    """One radian from rest to rest in a second, and 20 steps."""
    goal = nc.goal.Coordinate("hinge", 1.0) & nc.goal.Rest()
    given = {"dt": 0.05, "steps": 20, "cost": nc.cost.Effort(), "goal": goal}
    if limit is not None:
        given["bounds"] = nc.bounds.Input(-limit, limit)
    return nc.OptimalControl(*made, **(given | options))


@pytest.fixture(scope="module")
def made():
    return disc()


@pytest.fixture(scope="module")
def pendulum():
    """A rod that its motor cannot lift at once: it has to swing."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 1 / 12, 1 / 12), com=(0, 0, -0.5), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def swing_up(pendulum, **options):
    goal = nc.goal.Coordinate("hinge", np.pi) & nc.goal.Rest()
    given = {"dt": 0.05, "steps": 60, "goal": goal, "bounds": nc.bounds.Input(-2.0, 2.0)}
    return nc.OptimalControl(*pendulum, **(given | options))


# Feasibility restoration


@pytest.mark.slow
def test_feasibility_is_restored_where_the_first_attempt_gets_lost(pendulum):
    """Least time from a guess that goes straight up, which the motor cannot; IPOPT ends infeasible there.

    From random starts IPOPT finds 2.54075 s on the same equations.
    """
    problem = swing_up(pendulum, cost=nc.cost.Duration(), free_time=(0.5, 10.0))
    found = nc.optimise(problem, progress=False)
    assert found.ok and found.cost == pytest.approx(2.5407527, rel=1e-6)
    first, restoration = found.attempts
    assert first.outcome is nc.Outcome.STALLED and "hinge" in first.reason and first.seconds > 0
    assert restoration.outcome.ok and first.iterations + restoration.iterations < len(found.history)
    assert [row.iteration for row in found.history] == list(range(1, len(found.history) + 1))
    assert "before that, feasibility restoration" in found.explain()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "shooting", pytest.param("lifted", marks=pytest.mark.exhaustive)])
def test_swing_up_by_least_effort(pendulum, method):
    """The cost that IPOPT finds on the same equations from starts where it does not end infeasible."""
    found = nc.optimise(swing_up(pendulum, cost=nc.cost.Effort()), method=method, progress=False)
    assert found.ok and found.cost == pytest.approx(5.6284862, rel=1e-7)


@pytest.mark.slow
def test_a_soft_goal_costs_what_missing_it_does(made):
    """The minimum of effort and of what is missed, of a linear motion: one solution of linear equations."""
    problem = numeric(turn(made))
    scale = goal_scale(problem, unknowns_of(problem, None, True))
    np.testing.assert_allclose(scale, [1.0, 1.0], atol=0.1)
    iterate = sequential.init(problem, Options(), unknowns_of(problem, None, False), scale)
    softness = np.asarray(iterate.softness)
    np.testing.assert_allclose(softness, np.asarray(scale) ** 2 / (2 * sequential.MISSED * iterate.unit))
    iterate = sequential.step(problem, Options(), iterate)

    def missing(u):
        last = nc.simulate(*made, dt=0.05, inputs=u[:, None]).states
        state = jax.tree.map(lambda x: x[-1], last)
        return problem.goal.residual(problem.system, state)

    matrix, first = np.asarray(jax.jacfwd(missing)(jnp.zeros(20))), np.asarray(missing(jnp.zeros(20)))
    whole = 0.05 * np.eye(20) + matrix.T @ np.diag(1.0 / softness) @ matrix
    weight = float(nc.cost.Effort().running(problem.system, problem.state, jnp.ones(1), 0.0))
    whole[np.diag_indices(20)] += 0.05 * (2.0 * weight - 1.0)
    exact = -np.linalg.solve(whole, matrix.T @ (first / softness))
    np.testing.assert_allclose(np.asarray(iterate.unknowns.coefficients)[:, 0], exact, rtol=1e-5)


@pytest.mark.slow
def test_first_coefficients_of_inputs_move_in_a_restoration(made):
    """They are no parameters: only time and what is free besides stays as it is."""
    problem = numeric(turn(made, inputs=nc.inputs.piecewise_linear(5)))
    scale = goal_scale(problem, unknowns_of(problem, None, True))
    iterate = sequential.init(problem, Options(), unknowns_of(problem, None, False), scale)
    iterate = sequential.step(problem, Options(), iterate)
    coefficients = np.abs(np.asarray(iterate.unknowns.coefficients)[:, 0])
    assert coefficients[0] > 0.1 * coefficients.max()


@pytest.mark.slow
def test_a_step_that_a_bound_cuts_in_half_is_not_corrected(made):
    """Twice its length is a whole one, and was none."""
    problem = numeric(turn(made, 20.0))
    options = Options()
    iterate = sequential.init(problem, options, unknowns_of(problem, None, False))
    proposal_ = proposal.propose(problem, options, iterate)
    nothing = jax.tree.map(jnp.zeros_like, proposal_.direction)
    half = -line_search.BOUNDARY * iterate.slacks.path.at[1:].set(0.0) / 0.5
    direction = dataclasses.replace(nothing, slacks=dataclasses.replace(nothing.slacks, path=half))
    found = line_search.search(problem, options, iterate, direction, jnp.zeros(()), proposal_.factors)
    assert not found.corrected and found.length <= 0.5


# Reasons


@pytest.mark.exhaustive
def test_limits_that_are_too_narrow_are_told_with_what_they_would_have_to_be(made):
    found = nc.optimise(turn(made, 0.75 * LEAST), progress=False)
    assert found.outcome is nc.Outcome.UNREACHABLE, found.explain()
    assert "misses" in found.reason and "'hinge'" in found.reason
    assert "input 'motor' below its upper bound in" in found.reason
    assert "with 1.5 times the limits of the inputs" in found.reason
    assert {attempt.outcome for attempt in found.attempts} - {nc.Outcome.OPTIMAL}
    assert nc.optimise(turn(made, 1.5 * 0.75 * LEAST), progress=False).ok


@pytest.mark.slow
def test_what_is_no_number_is_named(made):
    root = nc.cost.Running(lambda state, u, t: jnp.sqrt(0.5 - t) + u[0] ** 2)
    found = nc.optimise(turn(made, cost=root), progress=False, method="shooting")
    assert found.outcome is nc.Outcome.NONFINITE
    assert "the running cost is no number in step" in found.reason and "undefined" in found.explain()
    where = nc.goal.Equal(lambda state: jnp.log(-1.0 - state.coordinates[0] ** 2), "impossible")
    found = nc.optimise(turn(made, goal=where), progress=False, method="shooting")
    assert found.outcome is nc.Outcome.NONFINITE
    assert "the goal is no number: impossible" in found.reason


def test_a_motion_that_cannot_be_simulated_is_told_with_its_step(pendulum):
    problem = swing_up(pendulum, cost=nc.cost.Effort(), bounds=nc.bounds.Bound())
    found = nc.optimise(problem, np.full((60, 1), 1e7), method="shooting", progress=False)
    assert found.outcome is nc.Outcome.SIMULATION_FAILED
    assert "step" in found.reason and "t = " in found.reason, found.explain()


@pytest.mark.exhaustive
def test_a_guess_that_cannot_be_simulated_is_left(pendulum):
    found = nc.optimise(swing_up(pendulum, cost=nc.cost.Effort()), np.full((60, 1), 1e7), progress=False)
    assert found.ok and found.cost == pytest.approx(5.6284862, rel=1e-7), found.explain()
    assert found.attempts[0].outcome is nc.Outcome.SIMULATION_FAILED


@pytest.mark.slow
def test_what_stalls_says_how_far_it_got(made):
    found = nc.optimise(turn(made, 0.75 * LEAST), method="shooting", progress=False)
    assert found.outcome is nc.Outcome.STALLED, found.explain()
    assert "steps in a row made nothing better" in found.reason and "'hinge'" in found.reason


@pytest.mark.slow
def test_multipliers_that_grow_without_end_are_divergence(made):
    """By name; the judgement alone, as no problem is known that gets there on every machine."""
    problem = numeric(turn(made))
    options = Options(True)
    iterate = sequential.init(problem, options, unknowns_of(problem, None, True))
    huge = iterate.multipliers.goal.at[1].set(1e13 * iterate.unit)
    iterate = dataclasses.replace(iterate, multipliers=dataclasses.replace(iterate.multipliers, goal=huge))
    assert nc.Outcome(int(sequential._judged(options, iterate))) is nc.Outcome.DIVERGED
    from natcoord_jax.control.reasons import seen

    text = seen(problem, iterate, nc.Outcome.DIVERGED)
    assert "largest multiplier: rest of 'disc'" in text


@pytest.mark.slow
def test_limits_hold_for_all_attempts(made):
    found = nc.optimise(turn(made, 0.75 * LEAST), progress=False, max_iterations=25)
    assert not found.ok and len(found.history) <= 25
    late = nc.optimise(turn(made, 0.75 * LEAST), progress=False, time_limit=1e-6)
    assert late.outcome is nc.Outcome.TIME_LIMIT


@pytest.mark.exhaustive
def test_a_switch_within_a_step_is_told(made):
    """Of a turn in least time, halfway: in the middle of the middle step, if their number is odd."""
    options = {"cost": nc.cost.Duration(), "free_time": (0.1, 5.0), "steps": 11, "dt": 0.1}
    found = nc.optimise(turn(made, 20.0, **options), progress=False)
    assert found.ok and found.cost == pytest.approx(2 * np.sqrt(2.0 / 20.0), rel=0.01)
    verdict = nc.check(found, refine=False)
    assert verdict.switches == {"input 'motor'": [5]}
    assert "switches within step 5" in str(verdict)


# No compiling anew


def test_other_numbers_and_an_equal_scene_compile_nothing(made, monkeypatch):
    first = nc.optimise(turn(made, 20.0), progress=False)
    assert first.ok
    traced = []
    monkeypatch.setattr(proposal, "model", lambda *given: traced.append(given))
    for problem in (
        turn(made, 15.0),
        turn(made, 20.0, dt=0.06),
        turn(made, 20.0, cost=nc.cost.Effort(weight=2.0)),
        turn(disc(), 20.0),
    ):
        assert nc.optimise(problem, progress=False).ok
    assert nc.optimise(turn(made, 20.0), progress=False, tol=1e-6, goal_tol=1e-8, max_iterations=99).ok
    assert not traced


# Several starts, and paths


@pytest.mark.exhaustive
def test_several_starts_are_tallied(made):
    found = nc.multi_start(turn(made, 20.0), starts=4, spread=3.0)
    assert len(found) == 1 and found.outcomes == [nc.Outcome.OPTIMAL] * 4
    assert "4 of 4 starts converged" in str(found) and f"4 to cost {found[0].cost:.8g}" in str(found)


@pytest.mark.exhaustive
def test_starts_that_get_lost_go_on(pendulum):
    """Least times, of which the lifted form alone finds none from the middle."""
    problem = swing_up(pendulum, cost=nc.cost.Duration(), free_time=(0.5, 10.0))
    found = nc.multi_start(problem, starts=4, rates=1.0, spread=1.0)
    assert sum(outcome.ok for outcome in found.outcomes) >= 3, str(found)
    assert found[0].cost == pytest.approx(2.5407527, rel=1e-6)
    alone = nc.multi_start(problem, starts=4, rates=1.0, spread=1.0, method="lifted")
    assert sum(outcome.ok for outcome in alone.outcomes) < sum(outcome.ok for outcome in found.outcomes)
    assert " not: " in str(alone)


def test_a_path_is_followed_as_far_as_there_are_solutions(made):
    """Limits close to what is needed at least, and no further; nothing is compiled on the way."""

    def narrower(problem, s):
        limit = 20.0 + s * (4.0 - 20.0)
        return dataclasses.replace(problem, bounds=nc.bounds.Input(-limit, limit))

    found = nc.continuation(turn(made, 20.0), narrower, progress=False, least=1e-3)
    assert not found.ok and "it was given up" in found.reason
    limit = 20.0 + found.at[-1] * (4.0 - 20.0)
    assert LEAST * (1 - 1e-9) < limit < 1.01 * LEAST
    assert np.max(np.abs(found[-1].inputs)) <= limit
    costs = [s.cost for s in found]
    assert np.all(np.diff(costs) > -1e-9 * costs[0])


@pytest.mark.slow
def test_a_path_reaches_its_end(made):
    def further(problem, s):
        goal = nc.goal.Coordinate("hinge", 1.0 + s) & nc.goal.Rest()
        return dataclasses.replace(problem, goal=goal)

    found = nc.continuation(turn(made), further, progress=False)
    assert found.ok and found.at[0] == 0.0 and found.at[-1] == 1.0
    for s, solution in zip(found.at, found):
        assert solution.cost == pytest.approx((1.0 + s) ** 2 * found[0].cost, rel=1e-2)
    with pytest.raises(ValueError, match="the path returned NoneType at s = 0"):
        nc.continuation(turn(made), lambda problem, s: None, progress=False)


# Where coordinates count from


@pytest.mark.slow
def test_rates_of_a_guess_are_named_in_their_order():
    scene = nc.Scene()
    base = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 2.5), name="base"))
    wheel = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="wheel"))
    hinge = scene.add(nc.Revolute(base, wheel, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    problem = nc.OptimalControl(*scene.compile(), dt=0.1, steps=4)
    assert problem.rates[-1] == "'wheel' about axis 3 of its joint [rad/s]" and len(problem.rates) == 7
    assert problem.rates[0] == "'base' about axis 1 of the body [rad/s]"
    assert problem.rates[3] == "'base' along axis 1 of the body [m/s]"
    guess = nc.Guess(rates=(0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 2.0))
    begun = sequential.init(numeric(problem), Options(True), unknowns_of(problem, guess, True))
    last = np.asarray(begun.path.nodes.x[-1])
    assert last[0] == pytest.approx(0.5 * 0.35, rel=1e-6)  # taken up over the first step
    assert last[2 * problem.state.q.size] == pytest.approx(2.0 * 0.35, rel=0.01)


def cart_and_pole(zero, slide_zero):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cart = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), name="cart"))
    pole = scene.add(nc.RigidBody(mass=0.5, inertia=(0.01, 0.01, 0.001), com=(0, 0, -0.25), name="pole"))
    slide = nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="slide", zero=slide_zero)
    scene.add(slide)
    hinge = scene.add(nc.Revolute(cart, pole, axis=(0, 1, 0), name="hinge", zero=zero))
    scene.add(nc.JointSpring(hinge, stiffness=2.0, rest=0.3 - zero))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


@pytest.mark.parametrize("zero, slide_zero", [(0.7, -0.3), (-np.pi, 1.0), (7.0, 0.0)])
def test_the_zero_of_coordinates_moves_them_and_nothing_else(zero, slide_zero):
    plain, other = cart_and_pole(0.0, 0.0), cart_and_pole(zero, slide_zero)
    runs = []
    for made, shift in ((plain, (0.0, 0.0)), (other, (zero, slide_zero))):
        assert float(made[0].coordinate(made[1], "hinge")) == pytest.approx(-shift[0], abs=1e-15)
        trajectory = nc.simulate(*made, dt=0.01, inputs=np.full((100, 1), 0.5))
        angle = made[0].coordinate(trajectory, "hinge") + shift[0]
        runs.append((trajectory.states.q, angle, made[0].coordinate(trajectory, "slide") + shift[1]))
    for a, b in zip(*runs):
        np.testing.assert_allclose(a, b, atol=1e-12)
