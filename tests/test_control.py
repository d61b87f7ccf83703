"""Optimal control: what is known of solutions, conditions of optimality, feedback, bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import natcoord_jax as nc
from natcoord_jax.control import improvement, line_search, proposal, sequential
from natcoord_jax.control.costates import Multipliers
from natcoord_jax.control.guess import unknowns_of
from natcoord_jax.control.inputs import Spline
from natcoord_jax.control.iterate import Model, Options
from natcoord_jax.control.problem import numeric
from natcoord_jax.control.riccati import Right, Weighted, factored, solve
from natcoord_jax.control.transcription import Unknowns, roll, simulated
from natcoord_jax.gallery import manoeuvres

FOUR_DIGITS = 1e-4


def solved(problem, guess=None, **options):
    solution = nc.optimise(problem, guess, progress=False, **options)
    assert solution.ok, solution.explain()
    return solution


def extrapolated(coarse, fine):
    """Cost at vanishing step from two solutions, the second with twice the steps."""
    return (4.0 * fine.cost - coarse.cost) / 3.0


@pytest.fixture(scope="module")
def hinged():
    """A disc on a hinge with a motor: 12 I^2 angle^2 / T^3."""
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def rest_to_rest(hinged, steps=20, angle=1.0, **options):
    system, state = hinged
    goal = nc.goal.Coordinate("hinge", angle) & nc.goal.Rest()
    given = {"dt": 1.0 / max(steps, 1), "steps": steps, "cost": nc.cost.Effort(), "goal": goal} | options
    return nc.OptimalControl(system, state, **given)


@pytest.fixture(scope="module")
def solution(hinged):
    return solved(rest_to_rest(hinged))


# What a user gets


def test_solution_reports_what_it_is(solution):
    assert solution.inputs.shape == (20, 1)
    # 12 I^2 angle^2 / T^3 for vanishing steps; held inputs and angles by tangents add some h^2 to it.
    assert solution.cost == pytest.approx(48.0, rel=2 * 0.05**2)
    assert max(abs(x) for x in solution.missing.values()) < 1e-10
    assert solution.history[-1].stationarity < 1e-8
    assert set(solution.multipliers) == set(solution.missing)
    assert "optimal after" in solution.explain() and "shooting" in solution.method
    assert float(solution.trajectory.states.coordinates[-1, 0]) == pytest.approx(1.0, abs=1e-10)


def test_multiplier_of_the_goal_is_the_price_of_the_angle(solution):
    # d cost / d angle = 24 I^2 angle / T^3 with the discrete T^3; the multiplier is its opposite.
    price = 2.0 * solution.cost
    assert solution.multipliers["coordinate 0 of 'hinge' [rad or m]"] == pytest.approx(-price, rel=5e-3)


def test_check_finds_a_constant_hamiltonian(solution):
    found = nc.check(solution, refine=False)
    assert found.stationarity < 1e-8
    assert found.angular_momentum is None or found.angular_momentum < 1e-10
    assert found.energy < 1e-10
    assert found.hamiltonian_spread < 0.02
    assert "Hamiltonian" in str(found)


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


def test_a_changed_number_does_not_compile_anew(solution, hinged, monkeypatch):
    other = rest_to_rest(hinged, angle=2.0)
    traced = []
    monkeypatch.setattr(proposal, "model", lambda *given: traced.append(given))
    found = nc.optimise(other, solution.inputs, progress=False)
    assert found.cost == pytest.approx(4.0 * solution.cost, rel=1e-2)
    assert not traced


def test_limits_of_iterations_and_time(solution):
    few = {"method": "shooting", "max_iterations": 1, "tol": 1e-300}
    stopped = nc.optimise(solution.problem, progress=False, **few)
    assert stopped.outcome is nc.Outcome.MAX_ITERATIONS and "more iterations" in stopped.explain()
    late = nc.optimise(solution.problem, progress=False, time_limit=0.0)
    assert late.outcome is nc.Outcome.TIME_LIMIT and late.inputs.shape == (20, 1)


def test_interruption_returns_what_was_reached(solution, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sequential, "step", interrupted)
    stopped = nc.optimise(solution.problem, progress=False)
    assert stopped.outcome is nc.Outcome.STOPPED and not stopped.ok


def test_progress_names_the_worst_condition(solution, capsys):
    nc.optimise(solution.problem)
    shown = capsys.readouterr().err
    assert "violation" in shown and "hinge" in shown


@pytest.mark.slow
def test_contradictory_goal_is_reported_by_name(hinged):
    goal = nc.goal.Coordinate("hinge", 1.0) & nc.goal.Coordinate("hinge", 2.0) & nc.goal.Rest()
    found = nc.optimise(rest_to_rest(hinged, goal=goal), progress=False)
    assert found.outcome is nc.Outcome.UNREACHABLE
    assert "hinge" in found.explain() and "contradict" in found.explain()


# Bad input


def test_a_start_outside_of_a_limit_is_found_before_the_first_iteration(hinged):
    bounds = nc.bounds.Coordinate(0.5, 2.0, joint="hinge") & nc.bounds.Input(-1.0, 1.0)
    found = nc.optimise(rest_to_rest(hinged, bounds=bounds), progress=False)
    assert found.outcome is nc.Outcome.INFEASIBLE_START and not found.history
    assert "'hinge'" in found.explain() and "missed by 0.67 of half the range" in found.explain()


def test_bad_problems_are_refused(hinged):
    system, state = hinged
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


# Parts


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("every", [1, 4])
def test_register_of_a_spline_gives_its_inputs(degree, every):
    spline, steps = Spline(degree=degree, every=every), 13
    matrix, machine = spline.matrix(steps), spline.shaping(steps)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-14)
    values = np.random.default_rng(0).normal(size=spline.coefficients(steps))
    register, entered = machine.start @ values[:degree], degree
    for k in range(steps):
        w = 0.0
        if machine.enters[k]:
            w, entered = values[entered], entered + 1
        u = machine.read[k] @ register + machine.direct[k] * w
        assert u == pytest.approx(matrix[k] @ values, abs=1e-14)
        register = machine.shift[k] @ register + machine.load[k] * w
    assert entered == values.size


def test_range_keeps_its_structure_when_traced():
    bound = nc.bounds.Input(-1.0, np.inf)
    assert bound.limited == ((True,), (False,))
    traced = jax.eval_shape(lambda b: b, bound)
    assert traced.limited == bound.limited


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
        problem = numeric(rest_to_rest((heavier, state), angle=scale))
        return problem.goal.residual(problem.system, problem.state)

    np.testing.assert_allclose(jax.jit(jax.vmap(missing))(jnp.array([1.0, 2.0])), [[-1.0, 0.0], [-2.0, 0.0]])


def test_inverse_dynamics_reproduces_the_path():
    example = nc_gallery("double_pendulum_motors")
    system, state = example
    steps, dt = 30, 0.02
    s = np.linspace(0.0, 1.0, steps + 1)[1:, None]
    path = jnp.asarray(
        np.asarray(state.coordinates) + (10 * s**3 - 15 * s**4 + 6 * s**5) * np.array([1.5, -2.0])
    )
    inputs, states = nc.inverse_dynamics(system, state, path, dt=dt)
    trajectory = nc.simulate(system, state, dt=dt, inputs=inputs)
    assert float(jnp.abs(trajectory.states.coordinates[1:] - path).max()) < 1e-11
    np.testing.assert_allclose(states.q[-1], trajectory.q[-1], atol=1e-11)
    with pytest.raises(ValueError, match="shape"):
        nc.inverse_dynamics(system, state, path[:, :1], dt=dt)


def nc_gallery(name):
    """Two rods on motor-driven hinges under gravity."""
    assert name == "double_pendulum_motors"
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    carrier = nc.ground
    for k in range(2):
        place = (float(k), 0.0, 0.0)
        rod = nc.RigidBody(mass=1.0, inertia=(0.01, 1 / 12, 1 / 12), com=(0.5, 0, 0), position=place)
        rod = scene.add(rod)
        hinge = scene.add(nc.Revolute(carrier, rod, point=place, axis=(0, 1, 0), name=f"hinge {k + 1}"))
        scene.add(nc.JointTorque(hinge, name=f"motor {k + 1}"))
        carrier = rod
    return scene.compile()


# The solver's derivatives


@pytest.mark.exhaustive
def test_shooting_converges_quadratically_at_coarse_steps():
    """A double pendulum, a quarter of a radian a step: the curvature of projected steps is far off."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, -9.81, 0.0)))
    moments = (0.1, 0.1, 0.1)
    upper = scene.add(nc.RigidBody(mass=1.0, inertia=moments, com=(0.5, 0.0, 0.0), name="upper"))
    lower = nc.RigidBody(
        mass=0.5, inertia=moments, com=(0.3, 0.0, 0.0), position=(1.0, 0.0, 0.0), name="lower"
    )
    lower = scene.add(lower)
    joints = [nc.Revolute(nc.ground, upper, axis=(0.0, 0.0, 1.0), name="shoulder")]
    joints += [nc.Revolute(upper, lower, point=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="elbow")]
    for joint in joints:
        scene.add(nc.JointTorque(scene.add(joint)))
    system, state = scene.compile()
    there = nc.goal.Coordinate("shoulder", 0.5) & nc.goal.Rate("shoulder")
    there = there & nc.goal.Coordinate("elbow", -0.5) & nc.goal.Rate("elbow")
    cost = nc.cost.Effort() + nc.cost.Missed(there, weight=20.0)
    problem = nc.OptimalControl(system, state, dt=0.05, steps=20, cost=cost)
    guess = 2.0 * np.random.default_rng(0).normal(size=(20, 2))
    found = solved(problem, guess, method="shooting")
    errors = [row.stationarity for row in found.history]
    assert len(errors) <= 40
    assert errors[-1] < 0.1 * errors[-2] < 0.01 * errors[-3], errors


@pytest.mark.slow
def test_costates_are_the_gradient_of_the_simulation():
    problem = numeric(manoeuvres.turn(8))
    coefficients = jnp.asarray(np.random.default_rng(1).normal(size=(8, 3)) * 5.0)
    unknowns, whole, _ = simulated(problem, Unknowns(coefficients, jnp.zeros(0), jnp.zeros((8, 6))))
    assert bool(whole)
    path = roll(problem, unknowns)
    multipliers = Multipliers(jnp.arange(1.0, 10.0), jnp.zeros((8, 0)), jnp.zeros(0))
    iterate = sequential.init(problem, Options(), unknowns)
    slacks = iterate.slacks
    found = sequential.linearised(problem, unknowns, multipliers, slacks, path, jnp.ones(()))

    def lagrangian(c):
        moved, _, _ = simulated(problem, Unknowns(c, jnp.zeros(0), unknowns.y))
        path = roll(problem, moved)
        return path.cost + multipliers.goal @ path.end.missing

    np.testing.assert_allclose(found.by_w, jax.grad(lagrangian)(coefficients), rtol=1e-9, atol=1e-8)


# Known solutions


@pytest.mark.slow
def test_least_effort_about_a_principal_axis():
    pair = [solved(manoeuvres.turn(n, axis=(0, 0, 1), angle=1.0)) for n in (10, 20)]
    assert extrapolated(*pair) == pytest.approx(12 * 9.0, rel=FOUR_DIGITS)


@pytest.mark.parametrize(
    ("wheels", "known"),
    [
        pytest.param(False, 120.852118, marks=pytest.mark.exhaustive),
        pytest.param(True, 129.028096, marks=pytest.mark.benchmark),
    ],
)
def test_least_effort_about_a_skew_axis(wheels, known):
    pair = [solved(manoeuvres.turn(n, wheels=wheels)) for n in (20, 40)]
    assert extrapolated(*pair) == pytest.approx(known, rel=FOUR_DIGITS)
    assert all(len(s.history) <= 30 for s in pair)


@pytest.mark.benchmark
def test_beanie():
    pair = [solved(manoeuvres.beanie(n)) for n in (10, 20)]
    assert extrapolated(*pair) == pytest.approx(12 * (3 / 4) ** 2, rel=FOUR_DIGITS)


@pytest.mark.benchmark
def test_two_masses_on_a_spring():
    pair = [solved(manoeuvres.two_masses(n)) for n in (40, 80)]
    assert extrapolated(*pair) == pytest.approx(0.2271424, rel=FOUR_DIGITS)
    fast = solved(manoeuvres.two_masses(160, fastest=True))
    assert fast.cost == pytest.approx(4.21786651, rel=2e-4)
    assert fast.free["final time [s]"] == pytest.approx(fast.cost)
    u, dt = np.asarray(fast.inputs)[:, 0], fast.dt
    # A switch within a step shows as a mean between the bounds.
    ends = np.concatenate([[0.0], np.cumsum(u) * dt])
    assert np.all(np.abs(u) <= 1.0 + 1e-9)
    turns = np.flatnonzero(np.abs(np.diff(np.sign(u))) > 0) * dt + dt
    np.testing.assert_allclose(turns, [1.00268, 2.10893, 3.21519], atol=1.5 * dt)
    assert ends[0] == 0.0


@pytest.mark.benchmark
def test_pendulum_as_a_point_with_multiplier():
    coarse = nc.multi_start(manoeuvres.point_pendulum(60), starts=12, rates=4.0, spread=10.0, method="lifted")
    known = [s for s in coarse if abs(s.cost - 13.0) < 0.5]
    assert known, [s.cost for s in coarse]
    fine = solved(manoeuvres.point_pendulum(120), known[0])
    assert extrapolated(known[0], fine) == pytest.approx(12.8738850, rel=FOUR_DIGITS)


@pytest.mark.benchmark
def test_cart_pole_swing_up():
    """Many starts in coarse steps, the best of them refined once; `benchmarks/control.py` goes further."""
    found = nc.multi_start(manoeuvres.cart_pole(50), starts=16, rates=3.0, spread=5.0, method="lifted")
    assert found[0].ok and len(found) >= 2
    fine = solved(manoeuvres.cart_pole(100), found[0])
    assert extrapolated(found[0], fine) == pytest.approx(57.9448, rel=FOUR_DIGITS)


@pytest.fixture(scope="module")
def reoriented():
    return solved(manoeuvres.reorientation(100))


@pytest.mark.slow
def test_reorientation_of_the_spacecraft(reoriented):
    assert len(reoriented.history) <= 30
    assert max(abs(x) for x in reoriented.missing.values()) < 1e-10
    assert reoriented.history[-1].stationarity < 1e-8
    found = nc.check(reoriented, refine=False)
    assert found.angular_momentum < 1e-9
    assert found.hamiltonian_spread < 0.02


@pytest.mark.exhaustive
def test_reorientation_with_failed_wheels():
    two = solved(manoeuvres.reorientation(100, working=(1, 2)))
    assert max(abs(x) for x in two.missing.values()) < 1e-10
    one = nc.optimise(manoeuvres.reorientation(100, working=(2,)), progress=False)
    assert one.outcome is nc.Outcome.UNREACHABLE
    assert "attitude of 'base'" in one.explain()


@pytest.mark.slow
def test_feedback_brings_a_disturbed_spacecraft_home(reoriented):
    problem = reoriented.problem
    mass = problem.system.mass.at[0, 1:, 1:].multiply(1.1)
    plant = dataclasses.replace(problem.system, mass=mass)
    still = nc.goal.Attitude("base", problem.goal.parts[0].rotation)

    def missed(trajectory):
        final = jax.tree.map(lambda x: x[-1], trajectory.states)
        return float(jnp.max(jnp.abs(still.residual(plant, final))))

    open_loop = nc.simulate(plant, problem.state, dt=problem.dt, inputs=reoriented.inputs)
    # The attitude of the base matters, not the angles of the wheels that momentum couples to it.
    turning = jnp.where(jnp.arange(9) < 3, 1e4, 0.0)
    weights = {"displacement": turning, "rate": 100.0 * turning, "effort": 1e-3}
    regulator = nc.regulator(reoriented, **weights, limits=(-200.0, 200.0))
    closed = nc.simulate(plant, problem.state, dt=problem.dt, steps=problem.steps, inputs=regulator)
    assert missed(closed) < 0.2 * missed(open_loop)


@pytest.mark.exhaustive
def test_receding_horizon_brings_a_disturbed_spacecraft_home():
    example = manoeuvres.spacecraft()
    goal = nc.goal.Attitude("base", (np.cos(0.5), np.sin(0.5), 0.0, 0.0)) & nc.goal.Motion("base")
    fields = {"dt": 2.0, "steps": 30, "cost": nc.cost.Effort(), "goal": goal}
    problem = nc.OptimalControl(example.system, example.state, **fields)
    plant = dataclasses.replace(problem.system, mass=problem.system.mass.at[0, 1:, 1:].multiply(1.1))

    def missed(trajectory):
        final = jax.tree.map(lambda x: x[-1], trajectory.states)
        return float(jnp.max(jnp.abs(goal.parts[0].residual(plant, final))))

    horizons = nc.receding_horizon(problem, plant, updates=6, steps_each=10)
    # The same program solves it once, for the system as it is thought to be.
    known = numeric(problem)
    planned = nc.optimise_jit(known, unknowns_of(known, None, False), Options(False, 50, 1e-6, 1e-8))
    assert int(planned.code) == 0
    open_loop = nc.simulate(plant, problem.state, dt=problem.dt, inputs=planned.unknowns.coefficients)
    assert np.all(np.asarray(horizons.codes) == 0)
    assert missed(horizons.trajectory) < 0.1 * missed(open_loop)


@pytest.mark.exhaustive
def test_derivative_of_the_optimum_by_a_parameter(hinged):
    system, state = hinged

    def make(value):
        heavier = dataclasses.replace(system, mass=system.mass.at[0, 1:3, 1:3].multiply(value))
        return numeric(rest_to_rest((heavier, state), bounds=nc.bounds.Input(-9.0, 9.0)))

    start = unknowns_of(make(1.0), None, False)
    optimum = nc.optimum(make, start)
    one = jnp.ones(())

    def loss(value):
        found = optimum(value)
        return jnp.sum(found.coefficients[:5] ** 3) + found.cost

    slope = jax.grad(loss)(one)
    h = 1e-4
    differences = (loss(one + h) - loss(one - h)) / (2 * h)
    assert float(slope) == pytest.approx(float(differences), rel=1e-5)


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
    problem = rest_to_rest(
        hinged,
        parameters=(parameter,),
        inputs=nc.inputs.cubic(5),
        bounds=nc.bounds.Input(-50.0, 50.0),
    )
    found = solved(problem)
    # Nothing but effort counts: the lightest disc is best.
    assert found.free["scale of inertia"] == pytest.approx(0.2, abs=1e-6)
    assert found.cost == pytest.approx(0.04 * 48.0, rel=2e-2)


@pytest.mark.slow
def test_first_order_descent_comes_near(hinged, solution):
    found = nc.descend(rest_to_rest(hinged), iterations=400, rounds=8, progress=False)
    assert found.ok, found.explain()
    assert found.cost == pytest.approx(solution.cost, rel=2e-2)
    free = rest_to_rest(
        hinged, goal=nc.goal.Goal(), cost=nc.cost.Terminal(lambda s: (s.coordinates[0] - 1.0) ** 2)
    )
    plain = nc.descend(free, iterations=300, optimiser=optax.adam(0.1), progress=False)
    assert plain.cost < 1e-4


@pytest.mark.exhaustive
def test_first_order_descent_respects_bounds_of_inputs(hinged):
    problem = rest_to_rest(hinged, bounds=nc.bounds.Input(-10.0, 10.0))
    known = solved(problem)
    found = nc.descend(problem, iterations=400, rounds=10, progress=False)
    assert found.ok, found.explain()
    assert float(jnp.max(jnp.abs(found.inputs))) <= 10.0 * (1 + 1e-3)
    assert found.cost == pytest.approx(known.cost, rel=2e-2)


@pytest.fixture(scope="module")
def asymmetric():
    """A free body of three different inertias with torques along its axes."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), name="body"))
    scene.add(nc.BodyTorqueInput(tuple(nc.Direction(body, a, local=True) for a in np.eye(3)), name="torque"))
    return scene.compile()


def reduced_eigenvalues(solution):
    """Of the Lagrangian's Hessian in the inputs, where the goal is kept, of the whole simulation."""
    problem, u = solution.problem, jnp.asarray(solution.inputs)
    system, state, dt = problem.system, problem.state, float(problem.dt)
    multipliers = jnp.asarray(list(solution.multipliers.values()))

    def end(u):
        states = nc.simulate(system, state, dt=dt, inputs=u).states
        return problem.goal.residual(system, jax.tree.map(lambda x: x[-1], states))

    def slope(u):
        return jax.grad(lambda u: dt * jnp.sum(u**2) + multipliers @ end(u))(u)

    directions = jnp.eye(u.size).reshape(u.size, *u.shape)
    jacobian = nc.jit(jax.jacrev(end))(u).reshape(-1, u.size)
    slope, size = nc.jit(slope), 1e-4 * float(jnp.max(jnp.abs(u)))
    hessian = np.stack([(slope(u + size * d) - slope(u - size * d)).reshape(-1) for d in directions])
    _, values, rows = np.linalg.svd(jacobian)
    kept = rows[np.sum(values > 1e-9 * values[0]) :]
    return np.linalg.eigvalsh(kept @ (hessian + hessian.T) @ kept.T) / (4 * size)


def turned(asymmetric, axis, degrees):
    """Rest to rest in a second by least effort."""
    unit, half = np.asarray(axis) / np.linalg.norm(axis), np.radians(degrees) / 2
    attitude = (np.cos(half), *np.sin(half) * unit)
    goal = nc.goal.Attitude("body", attitude) & nc.goal.Rest()
    return nc.OptimalControl(*asymmetric, dt=1 / 20, steps=20, cost=nc.cost.Effort(), goal=goal)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", pytest.param("lifted", marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, 1, 0), (1, 2, 3)])
def test_turns_by_any_angle_are_found_from_rest(asymmetric, axis, method):
    """Half turns too; and beyond, the other way round at the same cost."""
    for degrees in (10, 90, 150, 180):
        ways = [turned(asymmetric, axis, angle) for angle in (degrees, 360 - degrees)]
        found = [nc.optimise(problem, method=method, progress=False) for problem in ways]
        assert all(s.ok and len(s.history) <= 40 for s in found), [s.explain() for s in found]
        assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)


@pytest.mark.parametrize("method", ["shooting", pytest.param("lifted", marks=pytest.mark.exhaustive)])
def test_saddles_are_left(asymmetric, method):
    """Turned about the axis of the largest inertia alone the body obeys all conditions, and needs more."""
    for degrees, known, symmetric in ((120, 469.70634, 476.28007), (150, 667.59325, 745.37894)):
        found = nc.optimise(turned(asymmetric, (0, 0, 1), degrees), method=method, progress=False)
        assert found.ok and len(found.history) <= 40, found.explain()
        assert found.cost == pytest.approx(known, rel=1e-7) and found.cost < symmetric


@pytest.mark.exhaustive
def test_check_tells_a_saddle_from_a_minimum(asymmetric, monkeypatch):
    """By the least eigenvalue of the whole Hessian in the inputs that keep the goal."""
    problem = turned(asymmetric, (0, 0, 1), 120)
    found = nc.optimise(problem, method="shooting", progress=False)
    verdict = nc.check(found, refine=False)
    least, most = reduced_eigenvalues(found)[[0, -1]]
    assert verdict.kind == "minimum" and "minimum" in str(verdict)
    assert verdict.curvature * 2 * found.dt == pytest.approx(least, rel=0.02)
    assert np.linalg.norm(verdict.direction) == pytest.approx(1.0)
    monkeypatch.setattr(improvement, "STILL", 0.0)  # nothing is drawn aside
    jax.clear_caches()
    stuck = nc.optimise(problem, method="shooting", progress=False, max_iterations=6)
    assert not stuck.ok and stuck.iterate.errors.stationarity < 1e-2
    verdict, least = nc.check(stuck, refine=False), reduced_eigenvalues(stuck)[0]
    assert verdict.kind == "saddle" and least < 0
    assert verdict.curvature * 2 * stuck.dt == pytest.approx(least, rel=0.02)
    jax.clear_caches()


@pytest.mark.exhaustive
def test_mirror_images_are_two_optima(hinged):
    either = nc.goal.Equal(lambda s: s.coordinates[0] ** 2 - 1.0, "one radian, either way") & nc.goal.Rest()
    problem = rest_to_rest(hinged, steps=10, goal=either)
    found = nc.multi_start(problem, starts=6, rates=2.0, spread=3.0, method="lifted")
    assert [s.outcome for s in found] == [nc.Outcome.OPTIMAL] * 2
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)
    np.testing.assert_allclose(found[0].inputs, -found[1].inputs, atol=1e-6)


@pytest.mark.slow
def test_piecewise_linear_inputs_hold_the_optimum(hinged, solution):
    # The optimum falls linearly with time: splines of degree one contain it.
    found = solved(rest_to_rest(hinged, inputs=nc.inputs.piecewise_linear(5)))
    assert found.cost == pytest.approx(solution.cost, rel=1e-3)
    slopes = np.diff(np.asarray(found.inputs)[:, 0])
    np.testing.assert_allclose(slopes, slopes.mean(), rtol=0.05)


@pytest.mark.slow
def test_limit_of_a_joint_is_kept_and_felt(hinged):
    system, state = hinged
    # Moving at 3 rad/s at first, it would overshoot what it has to come to rest at.
    rows = state.q.reshape(-1, 4, 3)
    spinning = jnp.concatenate([jnp.zeros((1, 3)), jnp.cross(jnp.array([0.0, 0.0, 3.0]), rows[0, 1:])])
    moving = dataclasses.replace(state, v=spinning)
    free = solved(rest_to_rest((system, moving), angle=0.2))
    limit = nc.bounds.Coordinate(-1.0, 0.35, joint="hinge")
    kept = solved(rest_to_rest((system, moving), angle=0.2, bounds=limit))
    highest = [float(s.trajectory.states.coordinates.max()) for s in (free, kept)]
    assert highest[0] > 0.4
    assert highest[1] == pytest.approx(0.35, abs=1e-5)
    assert kept.cost > 1.05 * free.cost
    pressing = kept.multipliers["coordinate 0 of 'hinge' below its upper bound"]
    assert pressing.max() > 1e-3


@pytest.mark.slow
def test_keep_out_cone_is_gone_around():
    plain = manoeuvres.turn(20, axis=(0, 0, 1))
    sun = np.array([1.0, 1.0, 0.1]) / np.sqrt(2.01)
    cone = nc.bounds.KeepOut("body", axis=(1.0, 0.0, 0.0), cone=sun, angle=0.3)
    fields = {f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}
    found = solved(nc.OptimalControl(**{**fields, "bounds": cone}))
    nearest = np.max(np.asarray(found.trajectory.q)[1:, 1] @ sun)
    assert nearest == pytest.approx(np.cos(0.3), abs=1e-6)
    assert found.cost > 1.05 * 12 * 9.0 * (np.pi / 2) ** 2


@pytest.mark.slow
def test_another_solver_gets_the_same_problem():
    """Derivatives of `nc.to_nlp` against differences; at a solution its constraints hold."""
    problem = manoeuvres.turn(6)
    program = nc.to_nlp(problem)
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
    for exact, found in pairs:
        assert np.max(np.abs(np.asarray(exact) - found)) <= 1e-6 * max(1.0, float(np.max(np.abs(exact))))
    assert len(program.names) == program.lower.size == program.constraints(x).size
    assert np.asarray(program.inputs(x)).shape == (6, 3) and program.free(x) == {}


@pytest.mark.exhaustive
def test_least_time_of_a_swing_up_is_found_cold():
    """The cart-pole, |f| <= 10 N: IPOPT finds 1.14568 s on the same equations, from the same start."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    cart = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), name="cart"))
    moment = 0.1 * 0.25 / 12
    pole = nc.RigidBody(mass=0.1, inertia=(moment, moment, 1e-4), com=(0, 0, -0.25), name="pole")
    slide = scene.add(nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="slide"))
    hinge = scene.add(nc.Revolute(cart, scene.add(pole), axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointForce(slide, name="force"))
    system, state = scene.compile()
    problem = nc.OptimalControl(
        system,
        state,
        dt=0.04,
        steps=50,
        cost=nc.cost.Duration(),
        goal=nc.goal.Coordinate(slide, 0.0) & nc.goal.Coordinate(hinge, np.pi) & nc.goal.Rest(),
        bounds=nc.bounds.Input(-10.0, 10.0),
        free_time=(0.5, 6.0),
    )
    found = nc.optimise(problem, progress=False)
    assert found.ok and found.cost == pytest.approx(1.1456818, rel=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_inertia_is_that_of_the_whole_model(seed):
    """A model counts as convex if it is so along changes that keep to the goal; it is solved exactly."""
    rng = np.random.default_rng(seed)
    steps, z, m, c, f, h = 4, 2, 2, 2, 1, 1
    forward = rng.normal(size=(steps, z, z + m))
    hessian = rng.normal(size=(steps, z + m, z + m)) + rng.uniform(0.0, 6.0) * np.eye(z + m)
    hessian = hessian + hessian.transpose(0, 2, 1)
    last = np.diag(rng.uniform(-1.0, 1.0, z))
    goal, first = rng.normal(size=(c, z)), rng.normal(size=(z, f))
    excess, last_excess = np.zeros((steps, h, z + m)), np.zeros((0, z))
    numbers = (forward, hessian, excess, last, goal, last_excess, first, np.array([[rng.uniform(-1, 3)]]))
    found = Model(*(jnp.asarray(x) for x in numbers))
    none = jnp.zeros(0)
    bounds = Weighted(jnp.zeros((steps, h)), jnp.zeros((steps, h)), none, none)
    nothing = jnp.zeros(())
    idle, penalty, held = jnp.zeros((steps, m)), jnp.zeros(c), rng.uniform(0.0, 1.0)
    # Every other one has a goal that may be missed.
    soft = (seed % 2) * rng.uniform(0.1, 1.0, c)
    reach, one = jnp.asarray(1e-12), jnp.ones(())
    given = (found, bounds, idle, nothing, penalty, jnp.asarray(soft), reach, one, jnp.asarray(held))
    factors = jax.jit(factored)(*given)

    # All changes x = (first, w): nodes z_k = Z_k x.
    size = f + steps * m
    node, matrix = np.concatenate([first, np.zeros((z, steps * m))], axis=1), np.zeros((size, size))
    matrix[:f, :f] = numbers[-1] + held
    for k in range(steps):
        w = np.zeros((m, size))
        w[:, f + k * m : f + (k + 1) * m] = np.eye(m)
        both = np.concatenate([node, w])
        matrix += both.T @ hessian[k] @ both
        node = forward[k] @ both
    matrix += node.T @ last @ node
    kept, curved = np.linalg.svd(goal @ node)[2][c:].T, matrix
    if soft.all():
        kept, curved = np.eye(size), matrix + node.T @ goal.T @ np.diag(1.0 / soft) @ goal @ node
    convex = np.linalg.eigvalsh(kept.T @ curved @ kept).min() > 0
    assert bool(factors.convex) == convex

    slope, missing = rng.normal(size=size), rng.normal(size=c)
    gradient = np.zeros((steps, z + m))
    gradient[:, z:] = slope[f:].reshape(steps, m)
    right = Right(*(jnp.asarray(x) for x in (gradient, np.zeros(z), slope[:f], missing)))
    move = jax.jit(solve)(factors, right)
    whole = np.block([[matrix, (goal @ node).T], [goal @ node, -np.diag(soft)]])
    exact = np.linalg.solve(whole, -np.concatenate([slope, missing]))
    found = np.concatenate([move.first, np.ravel(move.w), move.goal])
    assert np.max(np.abs(found - exact)) <= 1e-8 * np.max(np.abs(exact))


@pytest.mark.slow
def test_a_motion_that_is_none_violates_its_equations():
    """The cost may be a number all the same, such as a time: no step may lead there."""
    problem = numeric(manoeuvres.two_masses(4, fastest=True))
    start = unknowns_of(problem, None, True)
    begun = sequential.init(problem, Options(lifted=True), start)
    ill = roll(problem, eqx.tree_at(lambda u: u.y, start, jnp.full_like(start.y, jnp.nan)))
    units, soft = begun.filter.units, begun.softness
    assert np.isfinite(ill.cost) and np.isnan(line_search.violation(units, soft, ill, begun.slacks))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", pytest.param("lifted", marks=pytest.mark.exhaustive)])
def test_a_saddle_is_left_by_a_start_from_it(method):
    """A turn by 120 degrees about a principal axis costs less off it; by a hinge, it costs least along it."""
    scene, angle = nc.Scene(), np.radians(120)
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(hinge, angle) & nc.goal.Rest()
    hinged = nc.OptimalControl(system, state, dt=0.05, steps=20, cost=nc.cost.Effort(), goal=goal)
    along = solved(hinged, method="shooting")
    assert along.cost == pytest.approx(476.28, rel=1e-4)
    free = manoeuvres.turn(20, axis=(0, 0, 1), angle=angle)
    found = solved(free, np.asarray(along.inputs) * np.array([0.0, 0.0, 1.0]), method=method)
    assert found.cost == pytest.approx(469.71, rel=1e-4)
