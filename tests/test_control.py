"""Optimal control of a disc on a hinge: what solutions say, conditions, files, limits, bad input, paths.

All tests of one structure share its programs; optima of other systems are in `test_control_optima`.
"""

import dataclasses
import io
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import natcoord_jax as nc

LEAST = 8.0
"""Torque that just turns an inertia of 2 by 1 rad in 1 s, pushing and braking all the time [N m]."""


def solved(problem, guess=None, **options):
    solution = nc.optimise(problem, guess, progress=False, **options)
    assert solution.ok, solution.explain()
    return solution


def disc():
    """A disc on a hinge with a motor: 12 I^2 angle^2 / T^3."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, body, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


@pytest.fixture(scope="module")
def hinged():
    return disc()


def rest_to_rest(hinged, limit=None, *, steps=20, angle=1.0, **options):
    """From rest to rest in a second."""
    goal = nc.goal.Coordinate("hinge", angle) & nc.goal.Rest()
    fields = {"dt": 1.0 / max(steps, 1), "steps": steps, "cost": nc.cost.Effort(), "goal": goal}
    if limit is not None:
        fields["bounds"] = nc.bounds.Input(-limit, limit)
    return nc.OptimalControl(*hinged, **(fields | options))


@pytest.fixture(scope="module")
def solution(hinged):
    # (Compiling takes longer than that, and does not count.)
    return solved(rest_to_rest(hinged), time_limit=5.0)


# --- what a solution says ---------------------------------------------------------------------------------


def test_solution_reports_what_it_is(solution):
    assert solution.inputs.shape == (20, 1)
    # 12 I^2 angle^2 / T^3 for vanishing steps; held inputs and angles by tangents add some h^2 to it.
    assert solution.cost == pytest.approx(48.0, rel=2 * 0.05**2)
    assert max(abs(x) for x in solution.missing.values()) < 1e-10
    assert solution.history[-1].stationarity < 1e-8
    assert set(solution.multipliers) == set(solution.missing)
    assert "optimal after" in solution.explain() and "shooting" in solution.method
    assert float(solution.trajectory.states.coordinates[-1, 0]) == pytest.approx(1.0, abs=1e-10)
    # d cost / d angle = 24 I^2 angle / T^3 with the discrete T^3; the multiplier is its opposite.
    price = 2.0 * solution.cost
    assert solution.multipliers["coordinate 0 of 'hinge' [rad or m]"] == pytest.approx(-price, rel=5e-3)


@pytest.mark.exhaustive
def test_with_its_multipliers_the_simulation_is_stationary(solution):
    """Costates are the gradient of `nc.simulate`: cost and goal pull the inputs in opposite directions."""
    problem, prices = solution.problem, jnp.array(list(solution.multipliers.values()))

    def pull(u):
        states = nc.simulate(problem.system, problem.state, dt=problem.dt, inputs=u).states
        return prices @ problem.goal.residual(problem.system, jax.tree.map(lambda x: x[-1], states))

    u = jnp.asarray(solution.inputs)
    np.testing.assert_allclose(jax.grad(pull)(u), -2.0 * problem.dt * u, rtol=1e-6)


@pytest.mark.exhaustive
def test_check_finds_a_constant_hamiltonian(solution):
    verdict = nc.check(solution, refine=False)
    assert verdict.stationarity < 1e-8
    assert verdict.angular_momentum is None or verdict.angular_momentum < 1e-10
    assert verdict.energy < 1e-10
    assert verdict.hamiltonian_spread < 0.02
    assert verdict.kind == "minimum" and "Hamiltonian" in str(verdict)


@pytest.mark.slow
def test_warm_start_from_solution_and_file(solution, tmp_path):
    again = solved(solution.problem, solution)
    assert len(again.history) <= 2
    file = tmp_path / "solution.json"
    solution.save(file)
    guess = nc.load_guess(file)
    np.testing.assert_allclose(guess.inputs, solution.inputs)
    assert len(solved(solution.problem, guess).history) <= 2
    assert nc.load_guess(file, steps=40).inputs.shape == (40, 1)
    with pytest.raises(ValueError, match="not a solution"):
        file.write_text("{}")
        nc.load_guess(file)


def test_solutions_go_through_files(solution, tmp_path):
    """All numbers of it; what is read goes into a solution of the same problem."""
    file = tmp_path / "solution.eqx"
    eqx.tree_serialise_leaves(file, solution)
    assert file.stat().st_size > 10_000
    other = eqx.tree_at(lambda s: (s.inputs, s.cost, s.code), solution, (0 * solution.inputs, 0.0, 2))
    again = eqx.tree_deserialise_leaves(file, other)
    assert eqx.tree_equal(again, solution) and again.outcome is solution.outcome is not other.outcome
    assert again.explain() == solution.explain()


def test_other_numbers_and_an_equal_scene_compile_nothing(solution, hinged, programs):
    problems = (
        rest_to_rest(hinged, angle=2.0),
        rest_to_rest(hinged, dt=0.06),
        rest_to_rest(hinged, cost=nc.cost.Effort(weight=2.0)),
        rest_to_rest(disc()),
    )
    solved(problems[0])
    programs.clear()
    costs = [solved(problem).cost for problem in problems]
    assert not programs
    # Only what judges an iterate knows the tolerances.
    solved(problems[0], tol=1e-6, goal_tol=1e-8, max_iterations=99)
    assert len(programs) <= 1
    factors = 4.0, 1.2**-3, 2.0, 1.0
    np.testing.assert_allclose(costs, solution.cost * np.array(factors), rtol=1e-2)


def test_limits_of_iterations_and_time(solution):
    few = {"method": "shooting", "max_iterations": 1, "tol": 1e-300}
    stopped = nc.optimise(solution.problem, progress=False, **few)
    assert stopped.outcome is nc.Outcome.MAX_ITERATIONS and "more iterations" in stopped.explain()
    late = nc.optimise(solution.problem, progress=False, time_limit=0.0)
    assert late.outcome is nc.Outcome.TIME_LIMIT and late.inputs.shape == (20, 1)


def test_progress_names_the_worst_condition_and_an_interruption_returns_what_was_reached(
    solution, monkeypatch
):
    class Impatient(io.StringIO):
        """Interrupts where the first iteration is shown."""

        def write(self, text):
            super().write(text)
            if text.split()[:1] == ["1"]:
                raise KeyboardInterrupt

    monkeypatch.setattr(sys, "stderr", Impatient())
    stopped = nc.optimise(solution.problem)
    assert stopped.outcome is nc.Outcome.STOPPED and not stopped.ok and len(stopped.history) == 1
    shown = sys.stderr.getvalue()
    assert "violation" in shown and "hinge" in shown


def test_every_outcome_has_its_words(solution):
    ends = [dataclasses.replace(solution, code=int(outcome)) for outcome in nc.Outcome]
    assert [end.ok for end in ends] == [end.outcome is nc.Outcome.OPTIMAL for end in ends]
    assert len({end.explain().partition(" after ")[0] for end in ends}) == len(ends)


def test_a_motion_that_cannot_be_simulated_is_told_with_its_step(solution):
    lost = nc.optimise(solution.problem, np.full((20, 1), 1e200), method="shooting", progress=False)
    assert lost.outcome is nc.Outcome.SIMULATION_FAILED
    assert "step" in lost.reason and "t = " in lost.reason, lost.explain()


@pytest.mark.exhaustive
def test_what_is_no_number_is_named(hinged):
    root = nc.cost.Running(lambda state, u, t: jnp.sqrt(0.5 - t) + u[0] ** 2)
    lost = nc.optimise(rest_to_rest(hinged, cost=root), progress=False, method="shooting")
    assert lost.outcome is nc.Outcome.NONFINITE
    assert "the running cost is no number in step" in lost.reason and "undefined" in lost.explain()
    where = nc.goal.Equal(lambda state: jnp.log(-1.0 - state.coordinates[0] ** 2), "impossible")
    lost = nc.optimise(rest_to_rest(hinged, goal=where), progress=False, method="shooting")
    assert lost.outcome is nc.Outcome.NONFINITE
    assert "the goal is no number: impossible" in lost.reason


@pytest.mark.exhaustive
def test_contradictory_goal_is_reported_by_name(hinged):
    # (Two values of the coordinate itself are refused: this is a function that nobody looks into.)
    elsewhere = nc.goal.Equal(lambda state: state.coordinates[0] - 2.0, "elsewhere")
    goal = nc.goal.Coordinate("hinge", 1.0) & elsewhere & nc.goal.Rest()
    lost = nc.optimise(rest_to_rest(hinged, goal=goal), progress=False)
    assert lost.outcome is nc.Outcome.UNREACHABLE
    assert "hinge" in lost.explain() and "contradict" in lost.explain()


# --- bad input --------------------------------------------------------------------------------------------


def test_a_start_outside_of_a_limit_is_seen_before_the_first_iteration(hinged):
    bounds = nc.bounds.Coordinate(0.5, 2.0, joint="hinge") & nc.bounds.Input(-1.0, 1.0)
    outside = nc.optimise(rest_to_rest(hinged, bounds=bounds), progress=False)
    assert outside.outcome is nc.Outcome.INFEASIBLE_START and not outside.history
    assert "'hinge'" in outside.explain() and "missed by 0.67 of half the range" in outside.explain()


def test_bad_problems_are_refused(hinged):
    for options, words in (
        ({"steps": 0}, "steps"),
        ({"dt": -0.1}, "dt"),
        ({"free_time": (2.0, 1.0)}, "free_time"),
        ({"cost": nc.cost.Running(lambda s, u, t: u * jnp.ones(2))}, "scalar|Type-check"),
        ({"goal": nc.goal.Equal(lambda s: s.q[0], "own", count=3) & nc.goal.Coordinate("none", 1.0)}, "none"),
        ({"parameters": (nc.Parameter("a", where=lambda s: s.mass, index=(0, 0, 0)),) * 2}, "names"),
    ):
        with pytest.raises((ValueError, TypeError), match=words):
            rest_to_rest(hinged, **options)
    with pytest.raises(ValueError, match="not below"):
        nc.bounds.Input(1.0, -1.0)
    with pytest.raises(ValueError, match="where"):
        nc.Parameter("nowhere")
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    with pytest.raises(ValueError, match="no input channels"):
        nc.OptimalControl(*scene.compile(), dt=0.1, steps=2)


def test_bad_guesses_are_refused(hinged):
    problem = rest_to_rest(hinged)
    with pytest.raises(ValueError, match="shape"):
        nc.optimise(problem, jnp.zeros((3, 1)), progress=False)
    with pytest.raises(ValueError, match="finite"):
        nc.optimise(problem, jnp.full((20, 1), jnp.nan), progress=False)
    with pytest.raises(ValueError, match="method"):
        nc.optimise(problem, method="magic", progress=False)


# --- parts of a problem -----------------------------------------------------------------------------------


def test_costs_add_up(hinged):
    system, state = hinged
    u, t = jnp.array([2.0]), jnp.array(0.5)
    total = nc.cost.Effort(3.0) + nc.cost.Duration(2.0) + nc.cost.Running(lambda s, u, t: t, weight=4.0)
    assert float(total.running(system, state, u, t)) == 12.0 + 2.0 + 2.0
    end = nc.cost.Terminal(lambda s: 5.0) + nc.cost.Missed(nc.goal.Coordinate("hinge", 2.0), weight=0.5)
    assert float(end.terminal(system, state)) == 5.0 + 2.0


def test_a_problem_with_rest_is_posed_inside_of_jit(hinged):
    system, state = hinged

    def missing(scale):
        heavier = dataclasses.replace(system, mass=scale * system.mass)
        problem = rest_to_rest((heavier, state), angle=scale)
        return problem.goal.residual(problem.system, problem.state)

    np.testing.assert_allclose(jax.jit(jax.vmap(missing))(jnp.array([1.0, 2.0])), [[-1.0, 0.0], [-2.0, 0.0]])


@pytest.mark.exhaustive
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
    program = nc.to_nlp(problem, nc.Guess(rates=(0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 2.0)))
    # Coefficients of the inputs come first, then the rates of all steps, taken up over the first one.
    rates = program.start[4:].reshape(4, 7)
    np.testing.assert_allclose(rates[1:] / rates[-1, 3], [[0, 0, 0, 1, 0, 0, 4]] * 3, atol=1e-12)
    assert rates[-1, 3] == pytest.approx(0.5) and 0.0 < rates[0, 3] < 0.5


@pytest.mark.exhaustive
def test_another_solver_gets_the_same_problem(hinged):
    """Derivatives of `nc.to_nlp` against differences, where inputs are splines and time is free."""
    free = {"free_time": (0.5, 2.0), "inputs": nc.inputs.piecewise_linear(3)}
    program = nc.to_nlp(rest_to_rest(hinged, 9.0, steps=6, **free))
    x = np.asarray(program.start) + 0.1 * np.sin(np.arange(program.start.size))
    multipliers = np.cos(np.arange(program.lower.size))
    h, d = 1e-6, np.cos(1.0 + np.arange(x.size))

    def difference(f):
        return (np.asarray(f(x + h * d)) - np.asarray(f(x - h * d))) / (2 * h)

    def slope(x):
        return program.gradient(x) + np.asarray(program.jacobian(x)).T @ multipliers

    pairs = (
        (program.gradient(x) @ d, difference(program.cost)),
        (program.jacobian(x) @ d, difference(program.constraints)),
        (program.hessian(x, 1.0, multipliers) @ d, difference(slope)),
    )
    for exact, quotient in pairs:
        assert np.max(np.abs(np.asarray(exact) - quotient)) <= 1e-6 * max(1.0, float(np.max(np.abs(exact))))
    assert len(program.names) == program.lower.size == program.constraints(x).size
    assert np.asarray(program.inputs(x)).shape == (6, 1) and set(program.free(x)) == {"final time [s]"}


# --- bounds, splines, free time ---------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_a_path_is_followed_as_far_as_there_are_solutions(hinged, programs):
    """Limits close to what is needed at least, and no further; nothing is compiled on the way."""

    def narrower(problem, s):
        limit = 20.0 + s * (4.0 - 20.0)
        return dataclasses.replace(problem, bounds=nc.bounds.Input(-limit, limit))

    wide = rest_to_rest(hinged, 20.0)
    solved(wide)
    programs.clear()
    path = nc.continuation(wide, narrower, progress=False, least=1e-3)
    assert len(programs) <= 1, "besides what judges an iterate by other limits"
    assert not path.ok and "it was given up" in path.reason
    limit = 20.0 + path.at[-1] * (4.0 - 20.0)
    assert LEAST * (1 - 1e-9) < limit < 1.01 * LEAST
    assert np.max(np.abs(path[-1].inputs)) <= limit
    costs = [s.cost for s in path]
    assert np.all(np.diff(costs) > -1e-9 * costs[0])


def test_a_path_reaches_its_end(solution, hinged):
    def further(problem, s):
        goal = nc.goal.Coordinate("hinge", 1.0 + s) & nc.goal.Rest()
        return dataclasses.replace(problem, goal=goal)

    path = nc.continuation(solution.problem, further, progress=False)
    assert path.ok and path.at[0] == 0.0 and path.at[-1] == 1.0
    for s, end in zip(path.at, path):
        assert end.cost == pytest.approx((1.0 + s) ** 2 * path[0].cost, rel=1e-2)
    with pytest.raises(ValueError, match="the path returned NoneType at s = 0"):
        nc.continuation(solution.problem, lambda problem, s: None, progress=False)


@pytest.mark.exhaustive
def test_what_stalls_says_how_far_it_got(hinged):
    lost = nc.optimise(rest_to_rest(hinged, 0.75 * LEAST), method="shooting", progress=False)
    assert lost.outcome is nc.Outcome.STALLED, lost.explain()
    assert "steps in a row made nothing better" in lost.reason and "'hinge'" in lost.reason


@pytest.mark.slow
def test_least_time_switches_halfway_which_a_check_tells(hinged):
    """Between limits of the input: in the middle of the middle step, if their number is odd."""
    options = {"cost": nc.cost.Duration(), "free_time": (0.1, 5.0), "steps": 11, "dt": 0.1}
    fastest = nc.optimise(rest_to_rest(hinged, 20.0, **options), progress=False)
    assert fastest.ok and "lifted" in fastest.method
    assert fastest.free["final time [s]"] == pytest.approx(fastest.cost)
    assert fastest.cost == pytest.approx(2 * np.sqrt(2.0 / 20.0), rel=0.01)
    verdict = nc.check(fastest, refine=False)
    assert verdict.switches == {"input 'motor'": [5]}
    assert "switches within step 5" in str(verdict)


@pytest.mark.exhaustive
def test_limit_of_a_joint_is_kept_and_felt(hinged):
    system, state = hinged
    # Moving at 3 rad/s at first, it would overshoot what it has to come to rest at.
    moving = system.with_coordinate(state, "hinge", 0.0, rate=3.0)
    free = solved(rest_to_rest((system, moving), angle=0.2))
    limit = nc.bounds.Coordinate(-1.0, 0.35, joint="hinge")
    kept = solved(rest_to_rest((system, moving), angle=0.2, bounds=limit))
    highest = [float(s.trajectory.states.coordinates.max()) for s in (free, kept)]
    assert highest[0] > 0.4
    assert highest[1] == pytest.approx(0.35, abs=1e-5)
    assert kept.cost > 1.05 * free.cost
    pressing = kept.multipliers["coordinate 0 of 'hinge' below its upper bound"]
    assert pressing.max() > 1e-3


@pytest.mark.exhaustive
def test_piecewise_linear_inputs_hold_the_optimum(hinged, solution):
    # The optimum falls linearly with time: splines of degree one contain it.
    straight = solved(rest_to_rest(hinged, inputs=nc.inputs.piecewise_linear(5)))
    assert straight.cost == pytest.approx(solution.cost, rel=1e-3)
    # Simulated with the inputs that are made of its coefficients.
    assert max(abs(x) for x in straight.missing.values()) < 1e-10
    slopes = np.diff(np.asarray(straight.inputs)[:, 0])
    np.testing.assert_allclose(slopes, slopes.mean(), rtol=0.05)


@pytest.mark.exhaustive
def test_parameters_and_splines_are_optimised_together(hinged):
    # A heavier disc costs effort, a lighter one is fined: the optimum of both is between the bounds.
    parameter = nc.Parameter(
        "scale of inertia",
        apply=lambda system, value: dataclasses.replace(
            system, mass=system.mass.at[0, 1:3, 1:3].multiply(value)
        ),
        value=1.0,
        lower=0.2,
        upper=3.0,
    )
    best = solved(rest_to_rest(hinged, 50.0, parameters=(parameter,), inputs=nc.inputs.cubic(5)))
    # Nothing but effort counts: the lightest disc is best.
    assert best.free["scale of inertia"] == pytest.approx(0.2, abs=1e-6)
    assert best.cost == pytest.approx(0.04 * 48.0, rel=2e-2)
    assert max(abs(x) for x in best.missing.values()) < 1e-10


@pytest.mark.exhaustive
def test_derivative_of_the_optimum_by_a_parameter(hinged):
    system, state = hinged

    def make(value):
        heavier = dataclasses.replace(system, mass=system.mass.at[0, 1:3, 1:3].multiply(value))
        return rest_to_rest((heavier, state), 9.0)

    optimum = nc.optimum(make, solved(make(1.0), method="shooting").iterate)
    one = jnp.ones(())

    def loss(value):
        best = optimum(value)
        return jnp.sum(best.coefficients[:5] ** 3) + best.cost

    slope = jax.grad(loss)(one)
    h = 1e-4
    differences = (loss(one + h) - loss(one - h)) / (2 * h)
    assert float(slope) == pytest.approx(float(differences), rel=1e-5)


# --- first order ------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_first_order_descent_comes_near(hinged):
    near = nc.descend(rest_to_rest(hinged), iterations=400, rounds=8, progress=False)
    assert near.ok, near.explain()
    assert near.cost == pytest.approx(48.0, rel=2e-2)


@pytest.mark.exhaustive
def test_any_optimiser_descends(hinged):
    free = rest_to_rest(
        hinged, goal=nc.goal.Goal(), cost=nc.cost.Terminal(lambda s: (s.coordinates[0] - 1.0) ** 2)
    )
    near = nc.descend(free, iterations=300, optimiser=optax.adam(0.1), progress=False)
    assert near.cost < 1e-4


@pytest.mark.exhaustive
def test_first_order_descent_respects_bounds_of_inputs(hinged):
    problem = rest_to_rest(hinged, 10.0)
    best = solved(problem)
    near = nc.descend(problem, iterations=400, rounds=10, progress=False)
    assert near.ok, near.explain()
    assert float(jnp.max(jnp.abs(near.inputs))) <= 10.0 * (1 + 1e-3)
    assert near.cost == pytest.approx(best.cost, rel=2e-2)
