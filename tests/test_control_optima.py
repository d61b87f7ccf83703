"""Optimal control beyond a disc on a hinge: published optima, saddles and minima, feedback, swing-ups."""

import dataclasses
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.gallery import manoeuvres

FOUR_DIGITS = 1e-4


def solved(problem, guess=None, **options):
    solution = nc.optimise(problem, guess, progress=False, **options)
    assert solution.ok, solution.explain()
    return solution


def extrapolated(coarse, fine):
    """Cost at vanishing step from two solutions, the second with twice the steps."""
    return (4.0 * fine.cost - coarse.cost) / 3.0


# --- known optima -----------------------------------------------------------------------------------------


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
    target = nc.goal.Coordinate("shoulder", 0.5) & nc.goal.Rate("shoulder")
    target = target & nc.goal.Coordinate("elbow", -0.5) & nc.goal.Rate("elbow")
    cost = nc.cost.Effort() + nc.cost.Missed(target, weight=20.0)
    problem = nc.OptimalControl(system, state, dt=0.05, steps=20, cost=cost)
    guess = 2.0 * np.random.default_rng(0).normal(size=(20, 2))
    best = solved(problem, guess, method="shooting")
    errors = [row.stationarity for row in best.history]
    assert len(errors) <= 40
    assert errors[-1] < 0.1 * errors[-2] < 0.01 * errors[-3], errors


@pytest.mark.exhaustive
def test_least_effort_about_a_principal_axis():
    pair = [solved(manoeuvres.turn(n, axis=(0, 0, 1), angle=1.0)) for n in (10, 20)]
    assert extrapolated(*pair) == pytest.approx(12 * 9.0, rel=FOUR_DIGITS)


@pytest.mark.parametrize(
    ("wheels", "least"),
    [
        pytest.param(False, 120.852118, marks=pytest.mark.exhaustive),
        pytest.param(True, 129.028096, marks=pytest.mark.benchmark),
    ],
)
def test_least_effort_about_a_skew_axis(wheels, least):
    pair = [solved(manoeuvres.turn(n, wheels=wheels)) for n in (20, 40)]
    assert extrapolated(*pair) == pytest.approx(least, rel=FOUR_DIGITS)
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
    near = [s for s in coarse if abs(s.cost - 13.0) < 0.5]
    assert near, [s.cost for s in coarse]
    fine = solved(manoeuvres.point_pendulum(120), near[0])
    assert extrapolated(near[0], fine) == pytest.approx(12.8738850, rel=FOUR_DIGITS)


@pytest.mark.benchmark
def test_cart_pole_swing_up():
    """Many starts in coarse steps, the best of them refined once; `benchmarks/control.py` goes further."""
    optima = nc.multi_start(manoeuvres.cart_pole(50), starts=16, rates=3.0, spread=5.0, method="lifted")
    assert optima[0].ok
    fine = solved(manoeuvres.cart_pole(100), optima[0])
    assert extrapolated(optima[0], fine) == pytest.approx(57.9448, rel=FOUR_DIGITS)


class Thrust(nc.cost.Cost):
    """Sum of the inputs."""

    def running(self, system, state, u, t):
        """Rate of the propellant."""
        return jnp.sum(u)


@pytest.mark.exhaustive
def test_flying_robot():
    """Y. Sakawa, Optimal Control Applications and Methods 20 (1999) 235-248: a cost linear in the inputs.

    IPOPT on the same 40 steps ends at 7.953951 from constant rates; continuous time has 7.91.
    """
    scene, half = nc.Scene(), np.sqrt(0.5)
    place = (-10.0, -10.0, 0.0)
    robot = nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=place, orientation=(half, 0, 0, half))
    robot = scene.add(robot)
    scene.add(nc.Planar(nc.ground, robot, point=place, axis=(0, 0, 1)))
    markers = nc.Point(robot), *(nc.Direction(robot, axis, local=True) for axis in np.eye(3))
    for force, torque in ((1.0, 0.2), (-1.0, -0.2), (1.0, -0.2), (-1.0, 0.2)):
        scene.add(nc.WrenchInput(markers, force=(force, 0, 0), torque=(0, 0, torque)))
    system, state = scene.compile()
    pairs = nc.bounds.Path(lambda state, u, t: u[::2] + u[1::2] - 1.0, "both jets of a side", count=2)
    goal = nc.goal.Position(robot, (0, 0, 0)) & nc.goal.Attitude(robot, np.eye(3)) & nc.goal.Rest()
    shared = {"cost": Thrust(), "goal": goal, "bounds": nc.bounds.Input(0.0, 1.0) & pairs}
    found = nc.optimise(nc.OptimalControl(system, state, dt=0.3, steps=40, **shared), progress=False)
    assert found.ok and found.cost <= 7.953952
    # Only bounds bend such a cost, and at a corner of theirs every change presses some.
    verdict = nc.check(found, refine=False)
    assert verdict.kind == "minimum" and verdict.curvature < 1e9


@pytest.fixture(scope="module")
def reoriented():
    return solved(manoeuvres.reorientation(100))


@pytest.mark.exhaustive
def test_reorientation_of_the_spacecraft(reoriented):
    assert len(reoriented.history) <= 30
    assert max(abs(x) for x in reoriented.missing.values()) < 1e-10
    assert reoriented.history[-1].stationarity < 1e-8
    verdict = nc.check(reoriented, refine=False)
    assert verdict.angular_momentum < 1e-9
    assert verdict.hamiltonian_spread < 0.02


@pytest.mark.exhaustive
def test_reorientation_with_failed_wheels():
    two = solved(manoeuvres.reorientation(100, working=(1, 2)))
    assert max(abs(x) for x in two.missing.values()) < 1e-10
    one = nc.optimise(manoeuvres.reorientation(100, working=(2,)), progress=False)
    assert one.outcome is nc.Outcome.UNREACHABLE
    assert "attitude of 'base'" in one.explain()


@pytest.mark.exhaustive
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

    horizons = nc.receding_horizon(
        problem, plant, updates=6, steps_each=5, plant_steps=2, horizon="shrinking"
    )
    # For the system as it is thought to be, and as one program.
    planned = solved(problem, method="shooting", tol=1e-6, goal_tol=1e-8)
    again = nc.optimise_jit(problem, planned.iterate.unknowns)
    assert int(again.code) == 0 and float(again.path.cost) == pytest.approx(planned.cost, rel=1e-6)
    open_loop = nc.simulate(plant, problem.state, dt=problem.dt, inputs=planned.inputs)
    assert np.all(np.asarray(horizons.codes) == 0)
    assert missed(horizons.trajectory) < 0.1 * missed(open_loop)


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


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_turns_by_any_angle_are_found_from_rest(asymmetric, method):
    """Half turns too; and beyond, the other way round at the same cost."""
    for axis, degrees in product(((1, 0, 0), (0, 1, 0), (1, 1, 0), (1, 2, 3)), (10, 90, 150, 180)):
        ways = [turned(asymmetric, axis, angle) for angle in (degrees, 360 - degrees)]
        ends = [nc.optimise(problem, method=method, progress=False) for problem in ways]
        assert all(s.ok and len(s.history) <= 40 for s in ends), (axis, [s.explain() for s in ends])
        assert ends[0].cost == pytest.approx(ends[1].cost, rel=1e-9), (axis, degrees)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
def test_saddles_are_left(asymmetric, method):
    """Turned about the axis of the largest inertia alone the body obeys all conditions, and needs more."""
    for degrees, least, symmetric in ((120, 469.70634, 476.28007), (150, 667.59325, 745.37894)):
        best = nc.optimise(turned(asymmetric, (0, 0, 1), degrees), method=method, progress=False)
        assert best.ok and len(best.history) <= 40, best.explain()
        assert best.cost == pytest.approx(least, rel=1e-7) and best.cost < symmetric


@pytest.mark.exhaustive
def test_check_tells_a_saddle_from_a_minimum(asymmetric):
    """By the least eigenvalue of the whole Hessian in the inputs that keep the goal."""
    problem = turned(asymmetric, (0, 0, 1), 120)
    best = nc.optimise(problem, method="shooting", progress=False)
    verdict = nc.check(best, refine=False)
    least = reduced_eigenvalues(best)[0]
    assert verdict.kind == "minimum" and "minimum" in str(verdict)
    assert verdict.curvature * 2 * best.dt == pytest.approx(least, rel=0.02)
    assert np.linalg.norm(verdict.direction) == pytest.approx(1.0)
    # One step from torques about the axis alone draws nothing aside.
    fall = 6.0 * 3.0 * np.radians(120) * (1.0 - (2.0 * np.arange(20) + 1.0) / 20)
    along = fall[:, None] * np.array([0.0, 0.0, 1.0])
    stuck = nc.optimise(problem, along, method="shooting", progress=False, max_iterations=1)
    assert not stuck.ok and stuck.history[-1].stationarity < 0.05
    verdict, least = nc.check(stuck, refine=False), reduced_eigenvalues(stuck)[0]
    assert verdict.kind == "saddle" and least < 0
    assert verdict.curvature * 2 * stuck.dt == pytest.approx(least, rel=0.02)


@pytest.mark.exhaustive
def test_mirror_images_are_two_optima():
    scene = nc.Scene()
    disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    scene.add(nc.JointTorque(scene.add(nc.Revolute(nc.ground, disc, name="hinge")), name="motor"))
    either = nc.goal.Equal(lambda s: s.coordinates[0] ** 2 - 1.0, "one radian, either way") & nc.goal.Rest()
    problem = nc.OptimalControl(*scene.compile(), dt=0.1, steps=10, cost=nc.cost.Effort(), goal=either)
    optima = nc.multi_start(problem, starts=6, rates=2.0, spread=3.0, method="lifted")
    assert [s.outcome for s in optima] == [nc.Outcome.OPTIMAL] * 2
    assert optima[0].cost == pytest.approx(optima[1].cost, rel=1e-9)
    np.testing.assert_allclose(optima[0].inputs, -optima[1].inputs, atol=1e-6)


@pytest.mark.exhaustive
def test_keep_out_cone_is_gone_around():
    plain = manoeuvres.turn(20, axis=(0, 0, 1))
    sun = np.array([1.0, 1.0, 0.1]) / np.sqrt(2.01)
    cone = nc.bounds.KeepOut("body", axis=(1.0, 0.0, 0.0), cone=sun, angle=0.3)
    fields = {f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}
    best = solved(nc.OptimalControl(**{**fields, "bounds": cone}))
    nearest = np.max(np.asarray(best.trajectory.q)[1:, 1] @ sun)
    assert nearest == pytest.approx(np.cos(0.3), abs=1e-6)
    assert best.cost > 1.05 * 12 * 9.0 * (np.pi / 2) ** 2


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
    best = nc.optimise(problem, progress=False)
    assert best.ok and best.cost == pytest.approx(1.1456818, rel=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", ["shooting", "lifted"])
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
    best = solved(free, np.asarray(along.inputs) * np.array([0.0, 0.0, 1.0]), method=method)
    assert best.cost == pytest.approx(469.71, rel=1e-4)
