"""Optimal control from where a user starts: restoration, reasons, several starts, zeros of joints."""

import numpy as np
import pytest

import natcoord_jax as nc

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
    fields = {"dt": 0.05, "steps": 20, "cost": nc.cost.Effort(), "goal": goal}
    if limit is not None:
        fields["bounds"] = nc.bounds.Input(-limit, limit)
    return nc.OptimalControl(*made, **(fields | options))


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
    fields = {"dt": 0.05, "steps": 60, "goal": goal, "bounds": nc.bounds.Input(-2.0, 2.0)}
    return nc.OptimalControl(*pendulum, **(fields | options))


# --- feasibility restoration ------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_feasibility_is_restored_where_the_first_attempt_gets_lost(pendulum):
    """Least time from a guess that goes straight up, which the motor cannot; IPOPT ends infeasible there.

    From random starts IPOPT finds 2.54075 s on the same equations.
    """
    problem = swing_up(pendulum, cost=nc.cost.Duration(), free_time=(0.5, 10.0))
    end = nc.optimise(problem, method="lifted", progress=False)
    assert end.ok and end.cost == pytest.approx(2.5407527, rel=1e-6)
    first, restoration = end.attempts
    assert first.outcome is nc.Outcome.STALLED and "hinge" in first.reason and first.seconds > 0
    assert restoration.outcome.ok and first.iterations + restoration.iterations < len(end.history)
    assert [row.iteration for row in end.history] == list(range(1, len(end.history) + 1))
    assert "before that, feasibility restoration" in end.explain()


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["auto", "shooting", "lifted"])
def test_swing_up_by_least_effort(pendulum, method):
    """The cost that IPOPT finds on the same equations from starts where it does not end infeasible."""
    end = nc.optimise(swing_up(pendulum, cost=nc.cost.Effort()), method=method, progress=False)
    assert end.ok and end.cost == pytest.approx(5.6284862, rel=1e-7)


# --- reasons ----------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("inputs", [nc.inputs.Spline(), nc.inputs.piecewise_linear(5)])
def test_limits_that_are_too_narrow_are_told_with_what_they_would_have_to_be(made, inputs):
    lost = nc.optimise(turn(made, 0.75 * LEAST, inputs=inputs), progress=False)
    assert lost.outcome is nc.Outcome.UNREACHABLE, lost.explain()
    assert "misses" in lost.reason and "'hinge'" in lost.reason
    assert "input 'motor' below its upper bound in" in lost.reason
    assert "with 1.5 times the limits of the inputs" in lost.reason
    assert {attempt.outcome for attempt in lost.attempts} - {nc.Outcome.OPTIMAL}
    # The nearest motion pushes from the start: first coefficients of splines move like the others.
    assert lost.inputs[0, 0] > 0.1 * np.max(np.abs(lost.inputs))
    assert nc.optimise(turn(made, 1.5 * 0.75 * LEAST, inputs=inputs), progress=False).ok


@pytest.mark.exhaustive
def test_limits_that_hold_are_named_where_a_method_stalls(made):
    lost = nc.optimise(turn(made, 0.75 * LEAST), method="shooting", progress=False)
    assert lost.outcome is nc.Outcome.STALLED and "widen limits" in lost.explain()
    assert "at the limits: input 'motor'" in lost.reason and "of 20 steps" in lost.reason


@pytest.mark.exhaustive
def test_a_guess_that_cannot_be_simulated_is_left(pendulum):
    end = nc.optimise(swing_up(pendulum, cost=nc.cost.Effort()), np.full((60, 1), 1e7), progress=False)
    assert end.ok and end.cost == pytest.approx(5.6284862, rel=1e-7), end.explain()
    assert end.attempts[0].outcome is nc.Outcome.SIMULATION_FAILED


@pytest.mark.exhaustive
def test_limits_hold_for_all_attempts(made):
    end = nc.optimise(turn(made, 0.75 * LEAST), progress=False, max_iterations=25)
    assert not end.ok and len(end.history) <= 25
    # What is returned is the best of all attempts: it misses less than no inputs do.
    assert max(abs(x) for x in end.missing.values()) < 1.0
    late = nc.optimise(turn(made, 0.75 * LEAST), progress=False, time_limit=1e-6)
    assert late.outcome is nc.Outcome.TIME_LIMIT


# --- several starts ---------------------------------------------------------------------------------------


def two_turns(**options):
    """Two discs on hinges of their own, half a radian from rest to rest."""
    scene, goal = nc.Scene(), nc.goal.Rest()
    for name in ("left", "right"):
        body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name=name))
        hinge = scene.add(nc.Revolute(nc.ground, body, name=f"hinge of {name}"))
        scene.add(nc.JointTorque(hinge, name=f"motor of {name}"))
        goal = goal & nc.goal.Coordinate(hinge, 0.5)
    fields = {"dt": 0.1, "steps": 4, "cost": nc.cost.Effort(), "goal": goal}
    return nc.OptimalControl(*scene.compile(), **(fields | options))


@pytest.mark.exhaustive
def test_starts_of_several_inputs():
    optima = nc.multi_start(two_turns(), starts=3, spread=np.array([1.0, 3.0]))
    assert len(optima) == 1 and all(outcome.ok for outcome in optima.outcomes)


def test_numbers_for_each_are_as_many_as_there_are():
    """Another length is refused by name; of one input three weights would have counted it three times."""
    three = np.array([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"spread has shape \(3,\).*each input channel.*\(2,\)"):
        nc.multi_start(two_turns(), starts=2, spread=three)
    with pytest.raises(ValueError, match=r"rates has shape \(3,\).*\(2,\)"):
        nc.multi_start(two_turns(), starts=2, rates=three)
    with pytest.raises(ValueError, match=r"Effort: weight has shape \(3,\).*input channel"):
        nc.optimise(two_turns(cost=nc.cost.Effort(weight=three)), progress=False)
    with pytest.raises(ValueError, match=r"bounds.Input: lower has shape \(3,\)"):
        nc.optimise(two_turns(bounds=nc.bounds.Input(-three, 1.0)), progress=False)


@pytest.mark.exhaustive
def test_several_starts_are_tallied(made):
    optima = nc.multi_start(turn(made, 20.0), starts=4, spread=3.0)
    assert len(optima) == 1 and optima.outcomes == [nc.Outcome.OPTIMAL] * 4
    assert "4 of 4 starts converged" in str(optima) and f"4 to cost {optima[0].cost:.8g}" in str(optima)


@pytest.mark.exhaustive
def test_starts_that_get_lost_go_on(pendulum):
    """Least times, of which the lifted form alone finds none from the middle."""
    problem = swing_up(pendulum, cost=nc.cost.Duration(), free_time=(0.5, 10.0))
    optima = nc.multi_start(problem, starts=4, rates=1.0, spread=1.0)
    assert sum(outcome.ok for outcome in optima.outcomes) >= 3, str(optima)
    assert optima[0].cost == pytest.approx(2.5407527, rel=1e-6)
    alone = nc.multi_start(problem, starts=4, rates=1.0, spread=1.0, method="lifted")
    assert sum(outcome.ok for outcome in alone.outcomes) < sum(outcome.ok for outcome in optima.outcomes)
    assert " not: " in str(alone)


# --- where coordinates count from -------------------------------------------------------------------------


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


@pytest.mark.slow
def test_the_zero_of_coordinates_moves_them_and_nothing_else():
    def run(zero, slide_zero):
        system, state = cart_and_pole(zero, slide_zero)
        assert float(system.coordinate(state, "hinge")) == pytest.approx(-zero, abs=1e-15)
        # Placed by its coordinates, and moving.
        start = system.with_coordinate(state, "hinge", 0.4 - zero, rate=1.0)
        start = system.with_coordinate(start, "slide", 0.2 - slide_zero)
        again = nc.assemble(system, start)
        assert float(system.coordinate(again, "hinge")) == pytest.approx(0.4 - zero, abs=1e-12)
        trajectory = nc.simulate(system, start, dt=0.01, inputs=np.full((100, 1), 0.5))
        angle = system.coordinate(trajectory, "hinge") + zero
        return trajectory.states.q, angle, system.coordinate(trajectory, "slide") + slide_zero

    plain = run(0.0, 0.0)
    for zeros in ((0.7, -0.3), (-np.pi, 1.0), (7.0, 0.0)):
        for a, b in zip(plain, run(*zeros)):
            np.testing.assert_allclose(a, b, atol=1e-12, err_msg=str(zeros))
