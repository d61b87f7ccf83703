"""Optimal control with steps of order four and above: how fast costs converge, and what holds exactly."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import natcoord_jax as nc

HELD, LINEAR, CUBIC = nc.inputs.held(), nc.inputs.piecewise_linear(), nc.inputs.cubic(1)
FOURTH = nc.EnergyMomentum(order=4)
LIGHT = nc.EnergyMomentum(order=4, kick=False)


@cache
def pendulum():
    """A rod on a hinge with a motor, whose rotor is stored apart."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.01), com=(0, 0, -0.5), name="rod"))
    hinge = scene.add(nc.Revolute(nc.ground, rod, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    scene.add(nc.Armature(hinge, inertia=0.05, name="rotor"))
    return scene.compile()


def raised(steps, scheme, inputs, *, scene=pendulum, **options):
    """A turn of 2 rad in a second, from rest to rest."""
    fields = {"dt": 1.0 / np.sum(steps), "steps": steps, "cost": nc.cost.Effort()}
    fields["goal"] = nc.goal.Coordinate("hinge", 2.0) & nc.goal.Rest()
    return nc.OptimalControl(*scene(), scheme=scheme, inputs=inputs, **(fields | options))


@cache
def least_effort():
    """Least integral of the squared torque in continuous time, by Pontryagin's conditions.

    I a'' = u - m g l sin a with the costates p of a and a': u = -p_2 / (2 I).
    """
    inertia, weight = 0.1 + 0.25 + 0.05, 0.5 * 9.81

    def slopes(t, x):
        a, rate, p, q = x
        torque = -q / (2 * inertia)
        return np.array([rate, (torque - weight * np.sin(a)) / inertia, q * weight * np.cos(a) / inertia, -p])

    def missing(start, end):
        return np.array([start[0], start[1], end[0] - 2.0, end[1]])

    t = np.linspace(0.0, 1.0, 50)
    first = np.stack([2 * t**2 * (3 - 2 * t), 12 * t * (1 - t), 0 * t, -2 * inertia * weight * np.sin(2 * t)])
    found = scipy.integrate.solve_bvp(slopes, missing, t, first, tol=1e-9, max_nodes=20_000)
    assert found.success, found.message
    t = np.linspace(0.0, 1.0, 2001)
    return scipy.integrate.simpson((found.sol(t)[3] / (2 * inertia)) ** 2, x=t)


def solved(problem, **options):
    """Its solution."""
    found = nc.optimise(problem, progress=False, **options)
    assert found.ok, found
    return found


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("scheme", "inputs", "order"),
    [
        (FOURTH, HELD, 2),
        (FOURTH, LINEAR, 4),
        (LIGHT, LINEAR, 4),
        (nc.EnergyMomentum(order=6), CUBIC, 6),
    ],
    ids=str,
)
def test_costs_converge_with_the_order(scheme, inputs, order):
    costs = [solved(raised(steps, scheme, inputs), method="lifted").cost for steps in (6, 12, 24)]
    first, second = -np.diff(costs)
    assert costs[-1] == pytest.approx(least_effort(), rel=1e-2 if order == 2 else 5e-5)
    assert np.log2(first / second) == pytest.approx(order, abs=0.35)


@pytest.mark.exhaustive
def test_methods_agree_on_a_motion_of_order_four():
    """What is found is the simulated motion, and its work, taken by the stages, nearly its energy."""

    def power(state, u, t):
        return u[0] * system.rate(state, "hinge")

    system, state = pendulum()
    spent = nc.goal.Within(nc.goal.Integral(power, name="work [J]"), upper=100.0)
    goal = nc.goal.Coordinate("hinge", 2.0) & nc.goal.Rest() & spent
    problem = raised(10, LIGHT, LINEAR, goal=goal)
    found = solved(problem, method="lifted")
    trajectory = nc.simulate(system, state, dt=0.1, inputs=found.inputs, scheme=LIGHT)
    assert found.inputs.shape == (10, 2, 1)
    np.testing.assert_allclose(
        found.iterate.path.nodes.x[-1, : state.q.size], trajectory.q[-1].ravel(), atol=1e-9
    )
    gained = np.diff(np.asarray(system.energy(trajectory).total)[[0, -1]])[0]
    assert float(found.iterate.path.nodes.memory[-1, 0]) == pytest.approx(float(gained), rel=3e-4)
    checked = nc.check(found)
    assert checked.kind == "minimum" and checked.order == pytest.approx(4.0, abs=0.3)
    assert len(checked.costs) == 3 and checked.extrapolated == pytest.approx(least_effort(), rel=1e-6)
    for method in ("shooting", "ipopt"):
        if method == "ipopt":
            pytest.importorskip("casadi")
        assert solved(problem, method=method).cost == pytest.approx(found.cost, rel=1e-8)
    again = solved(problem, guess=found)
    first = again.history[0]
    assert max(first.stationarity, first.violation) < 1e-9


@pytest.mark.exhaustive
def test_bounds_hold_at_the_stages():
    """Inputs, their rates and a peak, over steps of two lengths, the time of which is free."""
    problem = raised(
        (8, 8),
        LIGHT,
        LINEAR,
        dt=[0.05, 0.08],
        cost=nc.cost.Duration() + nc.cost.Peak(lambda state, u, t: 0.01 * u[0] ** 2, name="peak"),
        bounds=nc.bounds.Input(-12.0, 12.0) & nc.bounds.InputRate(-60.0, 60.0, before=0.0),
        free_time=(0.1, 5.0),
    )
    found = solved(problem)
    u, t = np.asarray(found.inputs)[:, :, 0], np.asarray(found.trajectory.t)
    times = t[:-1, None] + np.diff(t)[:, None] * np.array(LIGHT.tableau.c)
    assert np.max(np.abs(u)) <= 12.0 + 1e-6
    assert found.free["peak"] == pytest.approx(0.01 * np.max(u**2), rel=1e-4)
    rates = (u[1:] - u[:-1, -1:]) / (times[1:] - times[:-1, -1:])
    assert 59.7 < np.max(np.abs(rates)) <= 60.0 + 1e-3


@pytest.mark.exhaustive
def test_rates_of_inputs_are_those_between_stages():
    """Also from a step to one of another length, against differences of a given history."""
    phases, size = (2, 2), (0.1, 0.3)
    bounds = nc.bounds.InputRate(upper=1.0, lower=-np.inf)
    problem = raised(phases, LIGHT, HELD, dt=list(size), bounds=bounds)
    u = np.array([1.0, 4.0, -2.0, 3.0])
    program = nc.to_nlp(problem, nc.Guess(u[:, None]))
    known = zip(program.names, np.asarray(program.constraints(program.start)))
    excess = np.array([value for name, value in known if name.startswith("rate of input")]).reshape(4, 2)
    lengths, parts = np.repeat(size, phases), np.array(LIGHT.tableau.c)
    times = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])[:, None] + lengths[:, None] * parts
    rates = (u[1:] - u[:-1])[:, None] / (times[1:] - times[:-1, -1:])
    np.testing.assert_allclose(excess[1:] + 1.0, rates, rtol=1e-12)


@pytest.mark.exhaustive
def test_costs_are_integrals_of_what_is_between_the_stages():
    """Three stages integrate the square of inputs that are linear within steps exactly."""
    scheme, ends = nc.EnergyMomentum(order=6, kick=False), np.array([1.0, 4.0, -2.0, 3.0])
    parts = np.array(scheme.tableau.c)
    u = ends[:-1, None] + parts * np.diff(ends)[:, None]
    program = nc.to_nlp(raised(3, scheme, LINEAR), nc.Guess(u[:, :, None]))
    first, last = ends[:-1], ends[1:]
    exact = np.sum(first**2 + first * last + last**2) / 3 / 3
    assert float(program.cost(program.start)) == pytest.approx(exact, rel=1e-12)


@pytest.mark.exhaustive
def test_meshes_follow_errors_of_fifth_order():
    """Of steps with kicks; without them velocities normal to the constraints count, of third order."""
    found = nc.refine(raised(10, FOURTH, LINEAR), 2e-6, method="lifted", progress=False)
    assert found.ok and 12 <= found.solution.problem.steps <= 30
    first, last = found.rounds[0], found.rounds[-1]
    assert last.cost == pytest.approx(least_effort(), rel=1e-5)
    assert abs(first.cost - last.cost) > 1e-4


def test_what_has_order_two_only_says_so():
    problem = raised(4, LIGHT, LINEAR)
    with pytest.raises(ValueError, match="order two"):
        nc.descend(problem)
    with pytest.raises(ValueError, match="order two"):
        nc.receding_horizon(raised(4, LIGHT, HELD), pendulum()[0], updates=2)
    with pytest.raises(ValueError, match="max_events"):
        raised(4, nc.EnergyMomentum(max_events=2), HELD)
    with pytest.raises(ValueError, match="scheme is an object of type VariationalMidpoint"):
        raised(4, nc.VariationalMidpoint(), HELD)
    with pytest.raises(ValueError, match=r"inputs has shape \(4, 3, 1\)"):
        nc.optimise(problem, nc.Guess(jnp.zeros((4, 3, 1))), progress=False)
