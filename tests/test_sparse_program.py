"""The nonlinear program with states: the same problem as the one without, with matrices that are sparse."""

import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc

pytestmark = pytest.mark.exhaustive

REST, COORDINATE = nc.goal.Rest, nc.goal.Coordinate


def disc(motor=True):
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
    hinge = scene.add(nc.Revolute(nc.ground, body, name="hinge"))
    if motor:
        scene.add(nc.JointTorque(hinge, name="motor"))
    return scene.compile()


def turn(steps=20):
    """By a radian, by a torque that is at its limits for most of the time."""
    fields = {"cost": nc.cost.Effort(), "bounds": nc.bounds.Input(-9.0, 9.0)}
    return nc.OptimalControl(
        *disc(), dt=1.0 / steps, steps=steps, goal=COORDINATE("hinge", 1.0) & REST(), **fields
    )


def many_things():
    """Phases of free length, what is carried along, free numbers, limits at the end."""
    energy = nc.goal.Integral(lambda state, u, t: u[0] ** 2, name="square of the torque")
    goal = nc.goal.At(COORDINATE("hinge", 0.5), step=3) & nc.goal.Within(energy, upper=40.0)
    goal = (
        goal & nc.goal.Linked(lambda first, last: last.coordinates - first.coordinates - 1.1, "way") & REST()
    )
    cost = nc.cost.Duration(10.0) + nc.cost.InputRate(1e-3, before=0.0)
    return nc.OptimalControl(
        *disc(),
        dt=0.1,
        steps=(3, 4),
        cost=cost + nc.cost.Peak(lambda state, u, t: u[0] ** 2, weight=1e-2),
        goal=goal,
        bounds=nc.bounds.InputRate(-80.0, 80.0),
        free_time=((0.2, 2.0), (0.2, 3.0)),
        parameters=(nc.InitialCoordinate("hinge", lower=-0.3, upper=0.3, value=0.05),),
    )


def splines():
    """Inputs that are linear over two steps, in steps of several lengths."""
    fields = {"cost": nc.cost.Effort(), "goal": COORDINATE("hinge", 1.0) & REST(), "free_time": (0.5, 2.0)}
    return nc.OptimalControl(*disc(), dt=0.2, steps=5, inputs=nc.inputs.piecewise_linear(2), **fields)


def held_longer():
    """Inputs held over two steps of an arm that gravity pulls down, and a bound on the way."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = {"mass": 1.0, "inertia": (1 / 12, 1 / 12, 0.001)}
    upper = scene.add(nc.RigidBody(**rod, com=(0, 0, -0.5), name="upper"))
    lower = scene.add(nc.RigidBody(**rod, com=(0, 0, -1.5), name="lower"))
    first = scene.add(nc.Revolute(nc.ground, upper, axis=(0, 1, 0), name="shoulder"))
    second = scene.add(nc.Revolute(upper, lower, point=(0, 0, -1), axis=(0, 1, 0), name="elbow"))
    scene.add(nc.JointTorque(second, name="motor"))
    goal = COORDINATE(first, 0.2) & COORDINATE(second, -1.0)
    bounds = nc.bounds.Coordinate(-1.2, 0.1, joint=second) & nc.bounds.Input(-9.0, 9.0)
    fields = {"cost": nc.cost.Effort(), "goal": goal, "bounds": bounds}
    return nc.OptimalControl(*scene.compile(), dt=0.05, steps=7, inputs=nc.inputs.Spline(every=2), **fields)


def no_inputs():
    """A disc that has to arrive, thrown at a rate that is free."""
    free = (nc.InitialRate("hinge", value=0.5),)
    goal = COORDINATE("hinge", 1.0)
    return nc.OptimalControl(*disc(motor=False), dt=0.1, steps=4, goal=goal, parameters=free)


PROBLEMS = {f.__name__: f for f in (many_things, splines, held_longer, no_inputs)}


@pytest.fixture(scope="module", params=PROBLEMS)
def programs(request):
    """The program with states, and the one without."""
    problem = PROBLEMS[request.param]()
    return nc.to_nlp(problem, states=True), nc.to_nlp(problem)


def full(program, entries, structure, count):
    found = np.zeros((count, program.start.size))
    assert len(set(zip(*structure))) == structure[0].size == np.size(entries), "each place stands there once"
    found[structure] = entries
    return found


def jacobian(program, x):
    return full(program, program.jacobian(x), program.jacobian_structure, program.lower.size)


def hessian(program, x, multipliers):
    rows, columns = program.hessian_structure
    assert np.all(rows >= columns)
    lower = full(program, program.hessian(x, 1.0, multipliers), (rows, columns), x.size)
    return lower + np.tril(lower, -1).T


def places(program):
    """Where coefficients, what is free and unknowns of the steps are in the vector."""
    found = program.unknowns(np.arange(program.start.size, dtype=float))
    parts = (found.coefficients, found.free, found.y)
    return np.concatenate([np.asarray(part, int).ravel() for part in parts])


def close(found, wanted, tolerance=1e-6):
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert np.max(np.abs(found - wanted), initial=0.0) <= tolerance * max(
        1.0, np.max(np.abs(wanted), initial=0.0)
    )


def test_derivatives_are_those_of_the_values(programs):
    """By differences, at a point that is no motion."""
    program, _ = programs
    x = program.start + 0.1 * np.sin(np.arange(program.start.size))
    multipliers, along, step = np.cos(np.arange(program.lower.size)), np.cos(1.0 + np.arange(x.size)), 1e-6

    def difference(function):
        return (np.asarray(function(x + step * along)) - np.asarray(function(x - step * along))) / (2 * step)

    def slope(x):
        return np.asarray(program.gradient(x)) + jacobian(program, x).T @ multipliers

    close(np.asarray(program.gradient(x)) @ along, difference(program.cost))
    close(jacobian(program, x) @ along, difference(program.constraints))
    close(hessian(program, x, multipliers) @ along, difference(slope))


def test_it_starts_as_the_program_without_states_does(programs):
    program, other = programs
    close(program.cost(program.start), other.cost(other.start), 1e-12)
    found = dict(zip(program.names, np.asarray(program.constraints(program.start))))
    assert len(found) == len(program.names) == program.lower.size
    same = dict(zip(other.names, np.asarray(other.constraints(other.start))))
    assert len(same) == len(other.names)
    close([found.pop(name) for name in same], list(same.values()), 1e-12)
    close(list(found.values()), 0.0, 1e-12)
    names, bounded = np.array(program.names), np.isinf(program.lower)
    assert set(names[bounded]) == set(np.array(other.names)[np.isinf(other.lower)])
    assert np.array_equal(program.inputs(program.start), other.inputs(other.start))
    assert program.free(program.start) == other.free(other.start)


def test_without_the_states_it_is_the_program_without(programs):
    """Eliminated by the conditions that determine them, with the multipliers that these imply."""
    program, other = programs
    x, own = program.start, places(program)
    states = np.setdiff1d(np.arange(x.size), own)
    names = list(program.names)
    kept = np.array([names.index(name) for name in other.names])
    conditions = np.setdiff1d(np.arange(len(names)), kept)
    assert states.size == conditions.size
    first = jacobian(program, x)
    follow = -np.linalg.solve(first[np.ix_(conditions, states)], first[np.ix_(conditions, own)])
    into = np.zeros((x.size, own.size))
    into[own], into[states] = np.eye(own.size), follow
    order = np.argsort(places(other))  # (Both are in the order of coefficients, free, unknowns of steps.)
    into = into[:, order]
    close(np.asarray(program.gradient(x)) @ into, other.gradient(other.start), 1e-9)
    close(first[kept] @ into, other.jacobian(other.start), 1e-9)
    multipliers = np.zeros(len(names))
    multipliers[kept] = np.cos(np.arange(kept.size))
    slope = np.asarray(program.gradient(x)) + first.T @ multipliers
    multipliers[conditions] = -np.linalg.solve(first[np.ix_(conditions, states)].T, slope[states])
    wanted = other.hessian(other.start, 1.0, multipliers[kept])
    close(into.T @ hessian(program, x, multipliers) @ into, wanted, 1e-9)
    ours, same = program.multipliers(multipliers), other.multipliers(multipliers[kept])
    for name in ("goal", "path", "end", "motion"):
        close(getattr(ours, name), getattr(same, name), 1e-12)


def test_entries_grow_with_the_steps_and_their_distance_from_the_diagonal_does_not():
    programs = [nc.to_nlp(turn(steps), states=True) for steps in (5, 10, 15)]
    for what in ("jacobian_structure", "hessian_structure"):
        counts = [getattr(program, what)[0].size for program in programs]
        assert counts[2] - counts[1] == counts[1] - counts[0] > 0
        widths = [max(abs(int(a) - int(b)) for a, b in zip(*getattr(p, what))) for p in programs[1:]]
        assert what == "jacobian_structure" or widths[0] == widths[1]


def test_what_is_zero_at_the_start_has_its_place():
    """A bound that bends far from where the motion begins only."""

    def far(state, u, t):
        q = state.coordinates[0]
        return jnp.where(q > 5.0, (q - 5.0) ** 2 * u[0], 0.0)[None] - 1.0

    goal = COORDINATE("hinge", 1.0) & REST()
    fields = {"cost": nc.cost.Effort(), "goal": goal, "bounds": nc.bounds.Path(far, "far", count=1)}
    program = nc.to_nlp(nc.OptimalControl(*disc(), dt=0.1, steps=4, **fields), states=True)
    names = np.array(program.names)
    joint = [k for k in range(program.start.size) if k not in places(program)]
    rows = np.flatnonzero([name.startswith("far") for name in names])
    near = jacobian(program, program.start)[rows]
    assert np.all(near == 0.0)
    x = program.start.copy()
    x[joint] += 7.0
    beyond = jacobian(program, x)[rows]
    step = 1e-6 * np.cos(np.arange(x.size))
    change = np.asarray(program.constraints(x + step)) - np.asarray(program.constraints(x - step))
    close(beyond @ step, 0.5 * change[rows], 1e-9)
    assert np.all(np.any(beyond != 0.0, axis=1))


def test_our_solution_is_stationary_with_our_multipliers():
    found = nc.optimise(turn(), method="lifted", progress=False)
    assert found.ok
    program = nc.to_nlp(found.problem, found.guess(), states=True)
    close(program.cost(program.start), found.cost, 1e-9)
    x, names = program.start, list(program.names)
    first, multipliers = jacobian(program, x), np.zeros(len(names))
    rest = [k for k in range(len(names)) if names[k].startswith(("continuity", "initial", "equation"))]
    known = []
    for name, value in found.multipliers.items():
        every = (
            {name: value} if np.ndim(value) == 0 else {f"{name}, step {k}": x for k, x in enumerate(value)}
        )
        for name, number in every.items():
            known.append(names.index(name))
            multipliers[known[-1]] = number
    assert sorted(rest + known) == list(range(len(names)))
    # What remains are those of the motion: they leave no slope.
    slope = np.asarray(program.gradient(x)) + first.T @ multipliers
    implied = np.linalg.lstsq(first[rest].T, -slope, rcond=None)[0]
    close(slope + first[rest].T @ implied, np.zeros(x.size), 1e-6 * np.max(np.abs(slope)))
    assert np.max(np.abs(slope)) > 1.0


def test_another_solver_finds_the_same_optimum():
    pytest.importorskip("casadi")
    for problem in (turn(), many_things()):
        ours, other = (nc.optimise(problem, method=method, progress=False) for method in ("auto", "ipopt"))
        assert ours.ok and other.ok, other.explain()
        assert "IPOPT" in other.explain() and "IPOPT" not in ours.explain()
        assert other.cost == pytest.approx(ours.cost, rel=1e-7)
