"""Classes of optimal control problems, each with an answer that is known in closed form.

Answers of continuous time differ from those of steps by some h^2, which the tolerances are made of.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

INERTIA = 2.0
"""Of the disc about its hinge [kg m^2]."""
GRAVITY = 9.81
"""That of `nc.Gravity()` [m/s^2]."""
COORDINATE, REST = nc.goal.Coordinate, nc.goal.Rest


def solved(problem, guess=None, **options):
    solution = nc.optimise(problem, guess, progress=False, **options)
    assert solution.ok, solution.explain()
    return solution


@pytest.fixture(scope="module")
def hinged():
    """A disc on a hinge with a motor."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, INERTIA), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, body, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def on_disc(hinged, goal, *, steps=20, **options):
    """A problem of a second."""
    fields = {"dt": 1.0 / np.sum(steps), "steps": steps, "cost": nc.cost.Effort(), "goal": goal}
    return nc.OptimalControl(*hinged, **(fields | options))


def turned(angle=1.0):
    """At rest at an angle."""
    return COORDINATE("hinge", angle) & REST()


def ballistic():
    """A ball on two slides, free to fly in a plane, without any input."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    carriage = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="carriage"))
    ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name="ball"))
    scene.add(nc.Prismatic(nc.ground, carriage, axis=(1, 0, 0), name="along"))
    scene.add(nc.Prismatic(carriage, ball, axis=(0, 0, 1), name="up"))
    return scene.compile()


def pendulum():
    """A bob of 1 kg on a rod of 1 m, without any input."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    bob = scene.add(nc.RigidBody(mass=1.0, inertia=(1e-9, 1e-9, 1e-9), com=(0, 0, -1), name="bob"))
    scene.add(nc.Revolute(nc.ground, bob, axis=(0, 1, 0), name="hinge"))
    return scene.compile()


# --- the start is free, and nothing else ------------------------------------------------------------------


@pytest.mark.exhaustive
def test_a_throw_goes_furthest_at_45_degrees():
    """Speed v, distance v^2 / g: steps of free fall are exact."""
    system, state = ballistic()

    def speed(first, last):
        return system.rate(first, "along") ** 2 + system.rate(first, "up") ** 2 - 100.0

    problem = nc.OptimalControl(
        system,
        state,
        dt=0.1,
        steps=10,
        cost=nc.cost.Terminal(lambda state: -state.coordinates[0]),
        goal=COORDINATE("up", 0.0) & nc.goal.Linked(speed, "speed [m^2/s^2]"),
        free_time=(0.2, 10.0),
        parameters=(nc.InitialRate("along", value=6.0), nc.InitialRate("up", lower=0.0, value=8.0)),
    )
    found = solved(problem)
    along, up = (found.free[f"initial rate 0 of {joint!r} [rad/s or m/s]"] for joint in ("along", "up"))
    assert along == pytest.approx(math.sqrt(50.0), rel=1e-6) and up == pytest.approx(along, rel=1e-6)
    assert -found.cost == pytest.approx(100.0 / GRAVITY, rel=1e-8)
    assert found.inputs.shape == (10, 0)
    report = nc.check(found, refine=False)
    assert report.kind == "minimum" and report.direction.shape == (3,)
    assert max(abs(x) for x in found.missing.values()) < 1e-9


def arithmetic_geometric_mean(a, b):
    while abs(a - b) > 1e-15:
        a, b = 0.5 * (a + b), math.sqrt(a * b)
    return a


@pytest.mark.exhaustive
def test_a_periodic_pendulum_has_the_amplitude_of_the_elliptic_integral():
    """The period is 2 pi sqrt(l / g) / agm(1, cos(amplitude / 2))."""
    system, state = pendulum()
    start = nc.InitialCoordinate("hinge", lower=0.3, upper=3.0, value=1.0)
    steps, period = 40, 2.2
    problem = nc.OptimalControl(
        system, state, dt=period / steps, steps=steps, goal=nc.goal.Periodic(), parameters=(start,)
    )
    found = solved(problem)
    (amplitude,) = found.free.values()
    exact = 2 * math.pi * math.sqrt(1.0 / GRAVITY) / arithmetic_geometric_mean(1.0, math.cos(amplitude / 2))
    # Steps make it slower by (h omega)^2 / 12, and by a little more of large turns.
    assert period == pytest.approx(exact, rel=(period / steps * math.sqrt(GRAVITY)) ** 2 / 6)
    ends = found.trajectory.states.coordinates[:, 0]
    assert float(ends[-1]) == pytest.approx(float(ends[0]), abs=1e-9)
    assert float(ends[steps // 2]) == pytest.approx(-float(ends[0]), abs=1e-6)
    # One number is free, and the goal tells it.
    assert nc.check(found, refine=False).kind == "minimum"


# --- integrals, waypoints, room, turns --------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_least_effort_for_an_impulse_is_a_constant_torque(hinged, method):
    """Integral of u fixed: u = J / T, at a cost of J^2 / T."""
    impulse = nc.goal.Integral(lambda state, u, t: u[0], 3.0, name="impulse [N m s]")
    found = solved(on_disc(hinged, impulse), method=method)
    np.testing.assert_allclose(found.inputs, 3.0, rtol=1e-9)
    assert found.cost == pytest.approx(9.0, rel=1e-9)
    assert abs(found.missing["impulse [N m s]"]) < 1e-10


@pytest.mark.exhaustive
def test_a_way_through_a_point_is_two_ways(hinged):
    """There and back, at rest half-way by symmetry: twice 12 I^2 angle^2 / (T / 2)^3."""
    goal = nc.goal.At(COORDINATE("hinge", 0.5), step=20) & turned(0.0)
    found = solved(on_disc(hinged, goal, steps=40))
    assert found.cost == pytest.approx(2 * 12 * INERTIA**2 * 0.25 * 8, rel=1e-2)
    assert float(found.trajectory.states.coordinates[20, 0]) == pytest.approx(0.5, abs=1e-9)
    program = nc.to_nlp(found.problem)
    assert "coordinate 0 of 'hinge' [rad or m], after step 20" in program.names


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_a_waypoint_may_have_no_value_at_other_steps(hinged, method):
    def half(state):
        return (state.coordinates - 0.5) * jnp.sqrt(0.51 - state.t)

    goal = nc.goal.At(nc.goal.Equal(half, "half-way"), step=20) & turned(0.0)
    found = solved(on_disc(hinged, goal, steps=40), method=method)
    assert float(found.trajectory.states.coordinates[20, 0]) == pytest.approx(0.5, abs=1e-8)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_a_goal_with_room_ends_at_its_nearer_limit(hinged, method):
    goal = nc.goal.Within(COORDINATE("hinge", 1.0), -0.1, 0.1) & REST()
    found = solved(on_disc(hinged, goal), method=method)
    assert float(found.trajectory.states.coordinates[-1, 0]) == pytest.approx(0.9, abs=1e-6)
    assert found.cost == pytest.approx(12 * INERTIA**2 * 0.81, rel=5e-3)
    checked = nc.check(found, refine=False)
    lower = "coordinate 0 of 'hinge' [rad or m] above its lower limit"
    assert checked.kind == "minimum" and checked.exceeded[lower] == pytest.approx(0.0, abs=1e-6)
    # What a wider limit is worth: the slope of the cost, in half a range.
    assert found.multipliers[lower] == pytest.approx(0.1 * 2 * found.cost / 0.9, rel=1e-2)


@pytest.mark.exhaustive
def test_turns_are_counted(hinged):
    """Twice round, of which an attitude knows nothing: 12 I^2 (4 pi)^2 / T^3."""
    goal = nc.goal.Turned("disc", (0, 0, 2.0), 4 * math.pi) & REST()
    found = solved(on_disc(hinged, goal, steps=80))
    assert found.cost == pytest.approx(12 * INERTIA**2 * (4 * math.pi) ** 2, rel=1e-2)
    assert float(found.trajectory.states.coordinates[-1, 0]) == pytest.approx(4 * math.pi, abs=1e-9)


# --- phases, rates of inputs, peaks -----------------------------------------------------------------------


@pytest.mark.exhaustive
def test_least_time_in_two_phases_slows_down_at_the_waypoint(hinged):
    """|u| <= I: up to v and down to 1/2 at 1 rad, v^2 = 1.125, and the same back."""
    slow = nc.goal.Within(nc.goal.Rate("hinge"), -0.5, 0.5)
    goal = nc.goal.At(COORDINATE("hinge", 1.0) & slow, step=20) & turned(2.0)
    problem = on_disc(
        hinged,
        goal,
        steps=(20, 20),
        dt=0.1,
        cost=nc.cost.Duration(),
        bounds=nc.bounds.Input(-INERTIA, INERTIA),
        free_time=(0.2, 10.0),
    )
    found = solved(problem)
    times = [found.free[f"duration of phase {k} [s]"] for k in (1, 2)]
    assert times[0] == pytest.approx(2 * math.sqrt(1.125) - 0.5, rel=5e-3)
    assert times[1] == pytest.approx(times[0], rel=5e-3)
    states = found.trajectory.states
    assert float(states.coordinates[20, 0]) == pytest.approx(1.0, abs=1e-8)
    assert float(states.t[20]) == pytest.approx(times[0], rel=1e-9)
    assert abs(float(found.system.rate(found.trajectory, "hinge")[20])) < 0.5 + 1e-6


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_steps_of_several_lengths_approach_the_same_cost(hinged, method):
    lengths = np.linspace(1.0, 3.0, 20)
    problem = on_disc(hinged, turned(), dt=lengths / lengths.sum())
    found = solved(problem, method=method)
    assert found.cost == pytest.approx(12 * INERTIA**2, rel=1e-2)
    assert float(found.trajectory.t[-1]) == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(np.diff(found.trajectory.t), lengths / lengths.sum(), rtol=1e-9)


@pytest.mark.exhaustive
def test_inputs_that_change_least_are_a_cubic_in_time(hinged):
    """Both ends free: x^(6) = 0, x''' = 0 at the ends, and an integral of 120 I^2 angle^2 / T^5."""
    found = solved(on_disc(hinged, turned(), steps=40, cost=nc.cost.InputRate()))
    assert found.cost == pytest.approx(120 * INERTIA**2, rel=5e-3)


@pytest.mark.exhaustive
def test_least_time_with_limited_rates_of_inputs_is_a_ramp(hinged):
    """|du/dt| <= r and a free start: u falls at r all the time, and T^3 = 12 I angle / r."""
    problem = on_disc(
        hinged,
        turned(),
        steps=40,
        dt=0.04,
        cost=nc.cost.Duration(),
        bounds=nc.bounds.InputRate(-3.0, 3.0),
        free_time=(0.5, 10.0),
    )
    found = solved(problem)
    assert found.free["final time [s]"] == pytest.approx(2.0, rel=2e-3)
    rates = np.diff(np.asarray(found.inputs)[:, 0]) / found.dt
    np.testing.assert_allclose(rates, -3.0, rtol=1e-4)


@pytest.mark.exhaustive
def test_inputs_may_have_to_change_all_the_time(hinged):
    """At least by 1 N m/s, and not infeasible because inputs that stay would be."""
    rates = nc.bounds.InputRate(1.0, 30.0)
    found = solved(on_disc(hinged, COORDINATE("hinge", 1.0), bounds=rates))
    change = np.diff(np.asarray(found.inputs)[:, 0]) / found.dt
    np.testing.assert_allclose(change, 1.0, rtol=1e-4)


@pytest.mark.exhaustive
def test_the_least_largest_torque_pushes_and_brakes(hinged):
    """Half the time each way: 4 I angle / T^2."""
    cost = nc.cost.Peak(lambda state, u, t: u[0] ** 2, name="largest square [N^2 m^2]")
    found = solved(on_disc(hinged, turned(), cost=cost))
    largest = 4 * INERTIA
    assert found.free["largest square [N^2 m^2]"] == pytest.approx(largest**2, rel=5e-3)
    np.testing.assert_allclose(np.abs(found.inputs), largest, rtol=5e-3)


# --- one input for several systems ------------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_one_input_serves_two_masses(method):
    """Masses 1 and 1.5 on the mean at 1 m: the lighter one goes 1.2 m, at 12 x^2 / T^3."""
    scene = nc.Scene()
    for k, mass in enumerate((1.0, 1.5)):
        body = scene.add(nc.RigidBody(mass=mass, inertia=(1, 1, 1), position=(0, k, 0), name=f"mass {k}"))
        slide = scene.add(nc.Prismatic(nc.ground, body, axis=(1, 0, 0), point=(0, k, 0), name=f"slide {k}"))
        scene.add(nc.JointForce(slide, name=f"push {k}"))
    system, state = scene.compile()
    mean = nc.goal.Equal(lambda state: jnp.sum(state.coordinates) - 2.0, "twice the mean place [m]")
    problem = nc.OptimalControl(
        system,
        state,
        dt=0.05,
        steps=20,
        cost=nc.cost.Effort((1.0, 0.0)),
        goal=mean & REST(),
        inputs=nc.inputs.shared(np.ones((2, 1))),
    )
    found = solved(problem, method=method)
    np.testing.assert_array_equal(found.inputs[:, 0], found.inputs[:, 1])
    assert found.cost == pytest.approx(12 * 1.2**2, rel=5e-3)
    assert float(found.trajectory.states.coordinates[-1, 0]) == pytest.approx(1.2, rel=1e-9)


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, word",
    [
        ({"goal": nc.goal.At(REST(), step=21)}, "step 21"),
        ({"dt": (0.1, 0.1)}, "2 numbers"),
        ({"steps": (10, 10), "free_time": ((1.0, 2.0),)}, "1 phases"),
        ({"inputs": nc.inputs.shared(np.ones((3, 1)))}, "3 rows"),
        ({"cost": nc.cost.Peak(lambda s, u, t: u[0]) + nc.cost.Peak(lambda s, u, t: -u[0])}, "its own"),
        ({"goal": nc.goal.Periodic(("nose",))}, "nose"),
    ],
)
def test_what_cannot_be_posed_is_refused_by_name(hinged, options, word):
    with pytest.raises(ValueError, match=word):
        on_disc(hinged, options.pop("goal", turned()), **options)


def test_a_link_of_end_and_start_is_no_waypoint():
    with pytest.raises(ValueError, match="compares the end with the start"):
        nc.goal.At(nc.goal.Periodic(), step=3)


def test_a_system_without_inputs_needs_something_else_that_is_free():
    with pytest.raises(ValueError, match="nothing else is free"):
        nc.OptimalControl(*pendulum(), dt=0.1, steps=4)


def test_what_is_carried_is_what_is_asked_for(hinged):
    """A vector of constraints of the transcription, for any solver."""
    plain, more = on_disc(hinged, turned()), nc.goal.Integral(lambda state, u, t: u[0], 1.0)
    assert sum(plain.memory_sizes) == 0 and plain.looked_back == 0
    asked = on_disc(hinged, turned() & nc.goal.At(more & REST(), step=3), cost=nc.cost.InputRate())
    assert sum(asked.memory_sizes) == 3 and asked.looked_back == 1


@pytest.mark.exhaustive
def test_a_free_start_is_differentiable():
    system, state = pendulum()
    free = nc.InitialCoordinate("hinge"), nc.InitialRate("hinge")
    problem = nc.OptimalControl(system, state, dt=0.1, steps=2, parameters=free)

    def height(scaled):
        start = problem.start(scaled)
        return start.coordinates[0] + 2.0 * system.rate(start, "hinge") + start.q[3, 0]

    # The third director of the bob, (sin, 0, cos), with its first component cos at an angle of 0.
    slope = jax.jit(jax.grad(height))(jnp.array([0.0, 0.0]))
    np.testing.assert_allclose(slope, [2.0, 2.0], atol=1e-12)


@pytest.mark.exhaustive
def test_a_start_made_by_a_function_is_assembled():
    """The bob is shifted off its hinge, and comes back with its joint."""
    system, state = pendulum()

    def shifted(system, state, way):
        return eqx.tree_at(lambda x: x.q, state, state.q.at[0, 0].add(way))

    shift = nc.InitialState("shift [m]", apply=shifted, value=0.0, upper=1.0)
    problem = nc.OptimalControl(system, state, dt=0.1, steps=2, parameters=(shift,))
    start = nc.jit(problem.start)(jnp.array([0.3]))
    assert float(start.q[0, 0]) < 0.29 and system.constraint_errors(start).position < 1e-12


# --- flexible parts at rest -------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_forces_out_of_balance_are_those_of_gravity():
    """A bob of 1 kg, 1 m below its hinge: m g l sin(angle)."""
    system, state = pendulum()
    balance = nc.jit(nc.goal.Equilibrium().residual)
    for angle in (0.0, 0.4):
        leaning = system.with_coordinate(state, "hinge", angle, rate=0.7)
        np.testing.assert_allclose(balance(system, leaning), [-GRAVITY * math.sin(angle)], atol=1e-12)


def paddle(elements=1):
    """A hub on a hinge with a motor, and a panel on it that bends."""
    scene = nc.Scene()
    hub = scene.add(nc.RigidBody(mass=10.0, inertia=(1.0, 1.0, 1.0), name="hub"))
    hinge = scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1), name="hinge"))
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=20.0, GJ=20.0, density=0.5, rotary=1e-3)
    line = [(0.2, 0, 0), (2.2, 0, 0)]
    panel = scene.add(nc.Beam(section, line, elements=elements, second=(0, 0, 1), start=hub, name="panel"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile(), panel


@pytest.mark.exhaustive
def test_a_hub_stays_where_it_stops_once_its_panel_is_in_balance():
    """At rest alone it swings back by what the panel is bent: measured over 5 s without torques."""
    (system, state), panel = paddle()
    stop, swings = COORDINATE("hinge", 1.0) & REST(), []
    for goal in (stop, stop & nc.goal.Undeformed((panel,)), stop & nc.goal.Equilibrium()):
        problem = nc.OptimalControl(system, state, dt=0.1, steps=40, cost=nc.cost.Effort(), goal=goal)
        found = solved(problem, method="shooting")
        after = nc.simulate(system, found.trajectory[-1], dt=0.02, steps=250)
        swings.append(float(jnp.max(jnp.abs(system.coordinate(after, "hinge") - 1.0))))
    assert swings[0] > 1e-3
    assert swings[1] < 1e-3 * swings[0] and swings[2] < 1e-9


@pytest.mark.exhaustive
def test_what_turns_along_is_not_deformed():
    """A panel turned with its hub; and one whose end is bent by an angle."""
    (system, state), panel = paddle()
    goal = nc.goal.Undeformed((panel,), reference=state)

    @nc.jit
    def strain(state):
        ending = nc.control.goal.Ending(state, state, jnp.zeros(0), {})
        return goal.missing(system, ending)

    turned_along = system.with_coordinate(state, "hinge", 0.5)
    np.testing.assert_allclose(strain(turned_along), 0.0, atol=1e-14)
    c, s = math.cos(0.1), math.sin(0.1)
    turn = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    bent = turned_along.q.at[5:8].set(turned_along.q[5:8] @ turn)
    found = strain(eqx.tree_at(lambda x: x.q, turned_along, bent))
    np.testing.assert_allclose(found, [0.0, 0.0, 0.1], atol=1e-14)
    assert goal.labels(system)[-1] == "'panel/node 1' on 'hub': turn, z [rad]"


# --- all at once ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mixed(hinged):
    """All that can be asked for, in one problem."""
    energy = nc.goal.Integral(lambda state, u, t: u[0] ** 2, name="square of the torque [N^2 m^2 s]")
    goal = (
        nc.goal.At(COORDINATE("hinge", 0.5), step=6)
        & nc.goal.Within(energy, upper=40.0)
        & nc.goal.Linked(lambda first, last: last.coordinates - first.coordinates - 1.1, "way [rad]")
        & REST()
    )
    cost = nc.cost.Duration(10.0) + nc.cost.Effort() + nc.cost.InputRate(1e-3, before=0.0)
    return on_disc(
        hinged,
        goal,
        steps=(6, 6),
        dt=0.1,
        cost=cost + nc.cost.Peak(lambda state, u, t: u[0] ** 2, weight=1e-2),
        bounds=nc.bounds.InputRate(-80.0, 80.0),
        free_time=((0.2, 2.0), (0.2, 3.0)),
        parameters=(nc.InitialCoordinate("hinge", lower=-0.3, upper=0.3, value=0.05),),
    )


@pytest.mark.exhaustive
def test_all_go_together(mixed):
    found = solved(mixed)
    states = found.trajectory.states
    assert float(states.coordinates[-1, 0] - states.coordinates[0, 0]) == pytest.approx(1.1, abs=1e-8)
    assert float(states.coordinates[6, 0]) == pytest.approx(0.5, abs=1e-8)
    lengths = np.diff(np.asarray(states.t))
    squares = np.asarray(found.inputs)[:, 0] ** 2
    assert squares @ lengths < 40.0 + 1e-6
    assert found.free["peak"] == pytest.approx(squares.max(), rel=1e-6)
    assert "duration of phase 2 [s]" in found.free and max(abs(x) for x in found.missing.values()) < 1e-9
    report = nc.check(found, refine=False)
    assert report.kind == "minimum"
    assert report.exceeded["square of the torque [N^2 m^2 s] below its upper limit"] < 1e-8
    several = nc.multi_start(mixed, found, starts=2, spread=0.1)
    assert min(one.cost for one in several) == pytest.approx(found.cost, rel=1e-8)


@pytest.mark.exhaustive
def test_derivatives_of_the_program_are_those_of_its_values(mixed):
    """By differences, at a point that is no motion."""
    program = nc.to_nlp(mixed)
    x = program.start + 0.1 * np.sin(np.arange(program.start.size))
    along, step = np.cos(1.0 + np.arange(x.size)), 1e-6
    ends = [np.append(program.constraints(x + s * along), program.cost(x + s * along)) for s in (step, -step)]
    exact = np.append(program.jacobian(x) @ along, program.gradient(x) @ along)
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), exact, rtol=1e-6, atol=1e-6)
    assert len(program.names) == program.lower.size
    assert len(set(mixed.end_labels)) == len(mixed.end_labels) == 7


@pytest.mark.exhaustive
def test_turns_of_a_guess_that_are_lost_are_told(hinged):
    """A torque that turns the disc once and a sixth; the way to the goal that is taken is the short one."""
    half = 0.5
    there = nc.goal.Attitude("disc", (math.cos(half), 0.0, 0.0, math.sin(half)))
    problem = on_disc(hinged, there & REST())
    # Half of u / I is the angle after a second, nearly: steps turn it a little less.
    once = np.full((20, 1), 2 * INERTIA * (1.0 + 2 * math.pi))
    found = solved(problem, once, method="lifted")
    assert "turns 'disc' by 1.1" in found.note and "(0, 0, 1), and the solution by 0.16" in found.note
    assert "nc.goal.Turned('disc', (0, 0, 1), 7.2832)" in found.explain()
    # What keeps the turn, or says it, hears nothing.
    kept = solved(problem, nc.Guess(rates=(1.0 + 2 * math.pi,)), method="lifted")
    assert float(kept.trajectory.states.coordinates[-1, 0]) == pytest.approx(1.0 + 2 * math.pi)
    assert kept.note == "" and solved(problem, kept, method="lifted").note == ""
    assert solved(problem, nc.Guess(rates=(1.0,)), method="lifted").note == ""
