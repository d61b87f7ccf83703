"""Derivatives of rollouts: every mode, with respect to every kind of number, against differences.

A table of scenes and modes; one program for each serves every kind of number. A rollout is a scan, so every
derivative here is taken through `lax.scan`. Derivatives are judged by the shape of the difference errors
(`differences`), by each other, and by exact ones where there are any. What changes suddenly: `test_hunt`.
"""

import time
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery

STEPS = 12


def numbers():
    """All that can be differentiated, as one tree."""
    rng = np.random.default_rng(0)
    return {
        "inputs": jnp.asarray(rng.normal(size=(STEPS, 1))),
        "mass": jnp.array(1.3),
        "inertia": jnp.array([0.20, 0.12, 0.25]),
        "joint position": jnp.array([0.1, 0.9, -0.2]),
        "axis": jnp.array([0.2, 0.1, 1.0]),
        "stiffness": jnp.array(8.0),
        "coil": jnp.array(1.5),
        "damping": jnp.array(0.3),
        "gravity": jnp.array([0.3, -0.2, -9.81]),
        "initial angle": jnp.array(0.2),
        "initial rate": jnp.array(1.1),
        "dt": jnp.array(0.06),
    }


def linked(p, scene, carrier):
    """A link on a hinge with springs, damper and motor, made of (traced) numbers, under gravity."""
    scene.add(nc.Gravity(vector=p["gravity"]))
    link = scene.add(nc.RigidBody(mass=p["mass"], inertia=p["inertia"], position=(0.2, 1.3, -0.1)))
    hinge = nc.Revolute(carrier, link, point=p["joint position"], axis=p["axis"], name="hinge")
    hinge = scene.add(hinge)
    scene.add(nc.JointTorque(hinge, name="motor"))
    scene.add(nc.JointSpring(hinge, stiffness=p["coil"], rest=0.5))
    scene.add(nc.JointDamper(hinge, damping=p["damping"]))
    ends = nc.Point(nc.ground, (1.0, 1.0, 0.5)), nc.Point(link, (0.3, 1.5, 0.1))
    scene.add(nc.Spring(ends, stiffness=p["stiffness"], length=0.4))
    system, state = scene.compile()
    return system, system.with_coordinate(state, "hinge", p["initial angle"], rate=p["initial rate"])


def one_link(p):
    return linked(p, nc.Scene(), nc.ground)


def two_links(p):
    scene = nc.Scene()
    upper = nc.RigidBody(mass=2.0, inertia=(0.3, 0.4, 0.5), com=(0.1, 0.3, 0.0), name="upper")
    upper = scene.add(upper)
    scene.add(nc.Spherical(nc.ground, upper, point=(0.0, 0.0, 0.0)))
    return linked(p, scene, upper)


SCENES = {"one link": one_link, "two links": two_links}
LANES = pytest.mark.parametrize(
    "scene",
    [
        pytest.param("one link", marks=pytest.mark.slow),
        pytest.param("two links", marks=pytest.mark.exhaustive),
    ],
)


def loss_of(scene):
    """A smooth function of the last state that all numbers move."""

    def loss(p):
        system, state = SCENES[scene](p)
        trajectory = nc.simulate(system, state, dt=p["dt"], inputs=p["inputs"])
        last = jax.tree.map(lambda x: x[-1], trajectory.states)
        weights = jnp.cos(jnp.arange(last.q.size)).reshape(last.q.shape)
        coordinates = jnp.sum(jnp.sin(last.coordinates)) + 0.1 * jnp.sum(last.work)
        return jnp.sum(weights * last.q) + 0.2 * jnp.sum(weights[::-1] * last.v) + coordinates

    return loss


def along(f):
    """Derivative of a function along a direction, forward."""
    return lambda p, d: jax.jvp(f, (p,), (d,))[1]


def directions():
    """A random direction along each kind of number; the others stay."""
    rng = np.random.default_rng(1)
    scale = {"dt": 0.02, "mass": 0.5, "initial rate": 0.5}
    changes = {k: jnp.asarray(rng.normal(size=x.shape)) * scale.get(k, 0.3) for k, x in numbers().items()}
    return {name: {k: x if k == name else 0 * x for k, x in changes.items()} for name in changes}


def stacked(trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def total(gradient, d):
    return sum(jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (gradient, d)), strict=True))


PROGRAMS = {
    "value": lambda f: f,
    "forward": along,
    "reverse": jax.grad,
    # As many directions as unknowns share Jacobians of all steps; fewer are followed one by one.
    "forward, many at once": lambda f: jax.vmap(along(f), (None, 0)),
    "forward over reverse": lambda f: along(jax.grad(f)),
    "forward over forward": lambda f: lambda p, d, e: along(lambda x: along(f)(x, d))(p, e),
    "reverse over forward": lambda f: lambda p, d: jax.grad(lambda x: along(f)(x, d))(p),
    "reverse over reverse": lambda f: lambda p, d: jax.grad(lambda x: total(jax.grad(f)(x), d))(p),
}


@cache
def program(scene, mode):
    """Of one mode, for every kind of number."""
    return jax.jit(PROGRAMS[mode](loss_of(scene)))


# --- first derivatives ------------------------------------------------------------------------------------


@cache
def slopes(scene, mode):
    """Derivatives by every kind of number."""
    p, d, run = numbers(), directions(), program(scene, mode)
    if mode == "forward, many at once":
        return np.asarray(run(p, stacked(d.values())))
    if mode == "reverse":
        gradient = run(p)
        return np.array([total(gradient, x) for x in d.values()])
    return np.array([run(p, x) for x in d.values()])


@LANES
def test_derivatives_by_every_number_forward_and_reverse(scene):
    forward = slopes(scene, "forward")
    for (name, d), slope in zip(directions().items(), forward):
        try:
            assert_v_shaped(program(scene, "value"), numbers(), d, slope)
        except AssertionError as error:
            raise AssertionError(f"derivative by {name}: {error}") from error
    np.testing.assert_allclose(slopes(scene, "reverse"), forward, rtol=tol.SAME_GRADIENT)


@pytest.mark.exhaustive
@pytest.mark.parametrize("scene", SCENES)
def test_many_directions_at_once_are_those_of_single_ones(scene):
    many = slopes(scene, "forward, many at once")
    np.testing.assert_allclose(many, slopes(scene, "forward"), rtol=tol.SAME_GRADIENT)


# --- second derivatives -----------------------------------------------------------------------------------


@cache
def curvatures(scene, mode):
    """Second derivatives by every pair of kinds."""
    p, run, each = numbers(), program(scene, mode), directions().values()
    if mode == "forward over forward":
        return np.array([[run(p, d, e) for e in each] for d in each])
    return np.array([[total(slope, e) for e in each] for slope in (run(p, d) for d in each)])


@pytest.mark.exhaustive
@pytest.mark.parametrize("scene", SCENES)
def test_second_derivatives_are_symmetric_and_those_of_differences(scene):
    hessian = curvatures(scene, "forward over reverse")
    assert np.max(np.abs(hessian - hessian.T)) <= tol.SAME_GRADIENT * np.max(np.abs(hessian))
    all_numbers = jax.tree.map(lambda x: jnp.sum(x, axis=0), stacked(directions().values()))
    slope = program(scene, "forward")
    assert_v_shaped(lambda p: slope(p, all_numbers), numbers(), all_numbers, hessian.sum())


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("scene", "mode"),
    [
        ("one link", "forward over forward"),
        ("one link", "reverse over forward"),
        ("one link", "reverse over reverse"),
        ("two links", "forward over forward"),
        ("two links", "reverse over forward"),
    ],
)
def test_other_modes_of_second_order_agree_or_are_refused(scene, mode):
    exact = curvatures(scene, "forward over reverse")
    try:
        hessian = curvatures(scene, mode)
    except (TypeError, ValueError, NotImplementedError):
        assert mode == "reverse over reverse", "only this one may be refused"
        return
    assert np.max(np.abs(hessian - exact)) <= tol.SAME_GRADIENT * np.max(np.abs(exact))


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", ["reverse", "forward over reverse"])
def test_a_batch_has_the_derivatives_of_its_members(mode):
    points = [jax.tree.map(lambda x, k=k: x * (1 + 0.05 * k), numbers()) for k in range(3)]
    d = jax.tree.map(lambda x: jnp.sum(x, axis=0), stacked(directions().values()))
    run = program("one link", mode)
    single = run if mode == "reverse" else lambda p: run(p, d)
    loop = stacked([single(p) for p in points])
    batch = jax.jit(jax.vmap(single))(stacked(points))
    for name, members in loop.items():
        assert np.ptp(members, axis=0).max() > 0, name
        np.testing.assert_allclose(
            batch[name], members, rtol=0, atol=tol.SAME_GRADIENT * np.max(np.abs(members)), err_msg=name
        )


@pytest.mark.exhaustive
def test_geometry_through_assembly():
    """A joint's place moved in the compiled system, the state assembled anew, then a rollout."""
    p = numbers()
    system, state = one_link(p)

    @jax.jit
    def f(shift):
        moved = eqx.tree_at(lambda s: s.frames, system, system.frames.at[0, 0, 0, 1:].add(shift))
        start = nc.assemble(moved, state)
        return jnp.sum(nc.simulate(moved, start, dt=0.06, inputs=p["inputs"]).q[-1] ** 3)

    x, d = jnp.array([0.02, -0.01, 0.03]), jnp.array([0.3, 0.5, -0.4])
    ahead = jax.jit(along(f))(x, d)
    assert_v_shaped(f, x, d, ahead)
    assert abs(jax.jit(jax.grad(f))(x) @ d - ahead) <= tol.SAME_GRADIENT * abs(ahead)


# --- a spring at rest -------------------------------------------------------------------------------------


@pytest.mark.exhaustive
@pytest.mark.parametrize("law", ["linear", "nonlinear"])
def test_second_derivative_starting_at_rest(law):
    """At rest the increment of the invariant is zero: a quotient by it would lose the second derivative."""

    def f(x):
        scene = nc.Scene()
        ball = scene.add(nc.PointMass(mass=1.0, position=(1.0, 0.0, 0.0), velocity=x))
        ends = nc.Point(nc.ground), nc.Point(ball, (1.0, 0.0, 0.0))
        if law == "linear":
            scene.add(nc.Spring(ends, stiffness=20.0, length=1.0))
        else:
            scene.add(nc.NonlinearSpring(ends, law=lambda r: 10.0 * (r - 1.0) ** 2 + 30.0 * (r - 1.0) ** 3))
        system, state = scene.compile()
        last = nc.simulate(system, state, dt=0.1, steps=4).q[-1, 0]
        return last @ jnp.array([1.0, 0.5, 0.2]) + jnp.sum(last**3)

    still, d = jnp.zeros(3), jnp.array([0.7, 0.4, -0.3])
    slope = jax.jit(lambda x: jax.grad(f)(x) @ d)
    curvature = jax.jit(lambda x: jax.jvp(jax.grad(f), (x,), (d,))[1] @ d)(still)
    assert_v_shaped(slope, still, d, curvature)
    again = jax.jit(lambda x: jax.jvp(lambda y: jax.jvp(f, (y,), (d,))[1], (x,), (d,))[1])(still)
    assert abs(again - curvature) <= tol.SAME_GRADIENT * abs(curvature)


# --- steps that were retried ------------------------------------------------------------------------------


def retried(rate, length=0.5, dt=0.5, steps=6, extra=64, order=2):
    """A pendulum that turns by radians in a step that is far too large."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -9.81)))
    body = nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.3), com=(length, 0.0, 0.0), name="body")
    scene.add(nc.Spherical(nc.ground, scene.add(body), point=(0.0, 0.0, 0.0)))
    system, state = scene.compile()
    spin = rate * jnp.array([4.0, 11.0, -6.0])
    state = eqx.tree_at(lambda s: s.v, state, state.v.at[1:].set(jnp.cross(spin[None], state.q[1:])))
    scheme = nc.EnergyMomentum(order)
    return nc.simulate(system, state, dt=dt, steps=steps, extra_substeps=extra, scheme=scheme, throw=False)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("order", "retries"), [(2, True), (2, False), (4, False), (4, True)])
def test_directions_one_by_one_are_those_of_shared_jacobians(order, retries):
    """Corrections with factors of other slots end where Jacobians of all slots lead to."""
    dt, extra = (0.5, 64) if retries else (0.02, 0)

    def end(rate, length):
        run = retried(rate, length, dt, 40, extra, order)
        return run.q[:, 1:], run.v[-1]

    rejected = retried(jnp.array(1.0), 0.5, dt, 40, extra, order).steps_rejected
    assert (int(rejected) > 0) == retries
    at, by = (jnp.array(1.0), jnp.array(0.5)), (jnp.array(0.7), jnp.array(-0.2))
    one = jax.jit(lambda x, d: jax.jvp(end, x, d)[1])(at, by)
    # As many directions as half the unknowns, three of a ball.
    columns = jax.jit(jax.jacfwd(end, (0, 1)))(*at)
    for single, (by_rate, by_length) in zip(one, columns):
        exact = by_rate * by[0] + by_length * by[1]
        assert jnp.all(jnp.abs(single - exact) <= tol.EXACT_GRADIENT * jnp.max(jnp.abs(exact)))


SECOND = (
    lambda f: lambda x, d: jax.jvp(jax.grad(f), (x,), (d,))[1] * d,
    lambda f: lambda x, d: along(lambda x: along(f)(x, d))(x, d),
    lambda f: lambda x, d: jax.grad(lambda x: along(f)(x, d))(x) * d,
)


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt, steps, extra", [(0.5, 6, 64), (0.05, 40, 0)])
def test_second_derivatives_of_many_slots(dt, steps, extra):
    """Attempts that failed, and what fills up the last round of 32 slots, count for nothing in them."""

    def f(x):
        run = retried(x, 0.5 * x, dt, steps, extra)
        return (run.q[-1, 1:] ** 3).sum()

    assert (int(retried(jnp.array(1.0), 0.5, dt, steps, extra).steps_rejected) > 0) == (extra > 0)
    x, d = jnp.array(1.0), jnp.array(1.0)
    slope, modes = jax.jit(along(f)), [jax.jit(mode(f))(x, d) for mode in SECOND]
    assert_v_shaped(lambda x: slope(x, d), x, d, modes[0], steps=10.0 ** -np.arange(3.0, 9.5, 0.5))
    assert np.ptp(modes) <= tol.SAME_GRADIENT * abs(modes[0])


@pytest.mark.benchmark
def test_room_for_retries_costs_a_batch_nothing():
    """A batch whose steps all succeed takes as long with room for repeated steps as without, within 5 %."""
    example = gallery.load("double_pendulum")
    system = example.system
    swing = jax.vmap(
        lambda rate: system.with_coordinate(example.state, system.structure.joints[0], 0.0, rate=rate)
    )
    starts = swing(jnp.linspace(-0.5, 0.5, 256))

    def batch(extra):
        options = dict(dt=example.dt, steps=100, extra_substeps=extra, throw=False)
        return jax.jit(jax.vmap(lambda state: nc.simulate(system, state, **options).v[-1]))

    runs = {extra: batch(extra) for extra in (0, 8)}
    least = dict.fromkeys(runs, np.inf)
    for _ in range(40):
        for extra, run in runs.items():
            begun = time.process_time()
            jax.block_until_ready(run(starts))
            least[extra] = min(least[extra], time.process_time() - begun)
    assert least[8] <= 1.05 * least[0]


# --- exact gradients --------------------------------------------------------------------------------------


def test_free_flight_is_exact():
    """x = v t + F t^2 / 2m, exact for the method too: derivatives by everything, twice by the mass."""

    def place(v, force, mass, dt):
        scene = nc.Scene()
        ball = scene.add(nc.PointMass(mass=mass, velocity=v * jnp.eye(3)[0]))
        scene.add(nc.PointForce((nc.Point(ball),), force=force * jnp.eye(3)[0]))
        system, state = scene.compile()
        return nc.simulate(system, state, dt=dt, steps=10).q[-1, 0, 0]

    by_all = jax.value_and_grad(place, argnums=(0, 1, 2, 3))
    at = v, force, mass, dt = 0.7, 3.0, 1.7, 0.05
    # Along the mass: the value and its slopes, and how these change.
    run = jax.jit(lambda v, force, mass, dt: jax.jvp(lambda m: by_all(v, force, m, dt), (mass,), (1.0,)))
    (value, slopes), (_, changes) = run(*at)
    t = 10 * dt
    assert value == pytest.approx(v * t + force * t**2 / (2 * mass), rel=tol.EXACT_GRADIENT)
    exact = (t, t**2 / (2 * mass), -force * t**2 / (2 * mass**2), 10 * (v + force * t / mass))
    np.testing.assert_allclose(slopes, exact, rtol=tol.EXACT_GRADIENT)
    twice = (0.0, -(t**2) / (2 * mass**2), force * t**2 / mass**3, -10 * force * t / mass**2)
    np.testing.assert_allclose(changes, twice, rtol=tol.EXACT_GRADIENT, atol=tol.EXACT_GRADIENT)


@pytest.mark.exhaustive
def test_torque_on_a_rotor_is_exact():
    """Angular momentum is the sum of the impulses: its derivative by each of them is the step."""
    scene = nc.Scene()
    rotor = scene.add(nc.RigidBody(mass=1.0, inertia=(0.3, 0.3, 0.5)))
    hinge = scene.add(nc.Revolute(nc.ground, rotor, point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)))
    scene.add(nc.JointTorque(hinge))
    system, state = scene.compile()
    dt = 0.1

    def spin(u):
        trajectory = nc.simulate(system, state, dt=dt, inputs=u)
        return system.angular_momentum(jax.tree.map(lambda x: x[-1], trajectory.states))[2]

    u = jnp.asarray(np.random.default_rng(3).normal(size=(15, 1)))
    assert np.allclose(jax.jit(jax.grad(spin))(u), dt, rtol=tol.EXACT_GRADIENT)
    assert np.max(np.abs(jax.jit(jax.hessian(spin))(u))) <= tol.EXACT_GRADIENT


@pytest.mark.exhaustive
def test_linearise_equals_differences():
    """A and B of a step act on small motions as the step does."""
    p = numbers()
    system, state = one_link(p)
    a, b = nc.linearise(system, state, p["inputs"][0], p["dt"])
    step = jax.jit(lambda u: nc.step(system, state, u, p["dt"]))

    def flat(s):
        return jnp.concatenate([s.q.reshape(-1), s.v.reshape(-1), s.coordinates])

    u, d = p["inputs"][0], jnp.ones(1)
    assert_v_shaped(lambda u: flat(step(u)), u, d, b @ d)
    assert a.shape == (flat(state).size,) * 2
    later = jax.jit(lambda h: flat(nc.step(system, nc.step(system, state, u, h), u, p["dt"])))
    moved = jax.jit(lambda h: flat(nc.step(system, state, u, h)))
    h = jnp.array(1e-3)
    start = nc.step(system, state, u, h)
    a, _ = nc.linearise(system, start, u, p["dt"])
    ahead = jax.jvp(moved, (h,), (jnp.ones(()),))[1]
    twice = jax.jvp(later, (h,), (jnp.ones(()),))[1]
    assert np.allclose(a @ ahead, twice, rtol=1e-8, atol=1e-8 * float(jnp.max(jnp.abs(twice))))


@pytest.mark.exhaustive
def test_a_relaxed_spring_carried_along():
    """Lengths equal but for round-off: what the quadrature misses of the energy is noise, not a force."""
    scene = nc.Scene()
    places = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    masses = [scene.add(nc.PointMass(mass=1.0, position=x, velocity=(0.2, 0.0, 0.0))) for x in places]
    ends = tuple(nc.Point(mass, (0.0, 0.0, 0.0), local=True) for mass in masses)
    scene.add(nc.Spring(ends, stiffness=1.0, length=1.0))
    system, state = scene.compile()

    def end(speed):
        start = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 0].set(speed))
        return nc.simulate(system, start, dt=0.1, steps=40, throw=False).v[-1, 0, 0]

    # Two masses: the mean goes on, the difference swings with omega^2 = 2, by the midpoint rule.
    phase = 2 * np.arctan(0.1 * np.sqrt(2.0) / 2)
    exact = 0.5 * (1.0 + np.cos(40 * phase))
    speed = jnp.array(0.2)
    assert float(jax.jit(jax.grad(end))(speed)) == pytest.approx(exact, rel=1e-9)
    assert float(jax.jit(jax.jacfwd(end))(speed)) == pytest.approx(exact, rel=1e-9)


class Swing(eqx.Module):
    """A prescribed angle whose amplitude is a number like any other."""

    amplitude: jax.Array

    def __call__(self, t):
        return self.amplitude * (1 - jnp.cos(3.0 * t))


@pytest.mark.exhaustive
def test_where_drives_prescribe_every_motion():
    """Nothing is left to move freely: what is differentiated are the impulses of the drives."""
    scene, carrier = nc.Scene(), nc.ground
    scene.add(nc.Gravity())
    for k in range(3):
        place = np.array([0.5 * k, 0.0, 0.0])
        inertia = (0.1, 0.2, 0.2)
        link = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=(0.25, 0, 0), position=place))
        hinge = scene.add(
            nc.Revolute(carrier, link, point=place, axis=(0.1, 1.0, 0.2 * k), name=f"hinge {k}")
        )
        scene.add(nc.Drive(hinge, function=Swing(jnp.array(0.7 / (1 + k)))))
        carrier = link
    system, state = scene.compile()
    assert system.structure.dofs == 0
    place = next(k for k, group in enumerate(system.effects) if isinstance(group.effect, nc.Drive))
    drives = system.effects[place]

    def speed(scale):
        changed = eqx.tree_at(lambda g: g.effect.function.amplitude, drives, replace_fn=lambda x: scale * x)
        effects = (*system.effects[:place], changed, *system.effects[place + 1 :])
        moved = eqx.tree_at(lambda s: s.effects, system, effects)
        run = nc.simulate(moved, state, dt=0.05, steps=8, throw=False)
        return jnp.sum(run.v[-1] ** 2)

    speed_and_slope, step = jax.jit(jax.value_and_grad(speed)), 1e-4
    _, slope = speed_and_slope(jnp.array(1.0))
    (above, _), (below, _) = (speed_and_slope(jnp.array(1.0 + x)) for x in (step, -step))
    assert abs(float(slope)) > 0.1
    assert float(slope) == pytest.approx(float(above - below) / (2 * step), rel=tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4])
def test_gradient_of_what_is_kept_is_zero(order):
    """Could go wrong: solutions of transposed systems in which all cancels but rounding: they are never right
    to their own size."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    rod = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.02), position=(0.5, 0.0, 0.0)))
    scene.add(nc.Spherical(nc.ground, rod, point=(0.0, 0.0, 0.0)))
    system, state = scene.compile()

    def length(v):
        start = eqx.tree_at(lambda s: s.v, state, v)
        moved = nc.simulate(system, start, dt=0.02, steps=30, scheme=nc.EnergyMomentum(order))
        return jnp.sum(moved.q[-1] ** 2)

    value, gradient = jax.jit(jax.value_and_grad(length))(state.v)
    assert abs(value - 3.25) < 1e-12 and jnp.max(jnp.abs(gradient)) < 1e-12
