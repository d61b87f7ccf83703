"""Derivatives of rollouts: every mode, with respect to every kind of number, against differences.

A rollout is a scan, so every derivative here is taken through `lax.scan`. Derivatives are judged by the
shape of the difference errors (`differences`), by each other, and by exact ones where there are any.
"""

import time
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.stepping.backward import Backward
from natcoord_jax.stepping.derivative import Rule, run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.slot_chunks import CHUNK
from natcoord_jax.stepping.step import advance

STEPS = 12


NUMBERS = {
    "inputs": np.random.default_rng(0).normal(size=(STEPS, 1)),
    "mass": 1.3,
    "inertia": (0.20, 0.12, 0.25),
    "joint position": (0.1, 0.9, -0.2),
    "axis": (0.2, 0.1, 1.0),
    "stiffness": 8.0,
    "coil": 1.5,
    "damping": 0.3,
    "gravity": (0.3, -0.2, -9.81),
    "initial spin": 1.1,
    "dt": 0.06,
}


def numbers():
    """Everything that can be differentiated, as one tree."""
    return {name: jnp.array(x) for name, x in NUMBERS.items()}


def built(p):
    """Two links on the ground with springs, damper and motor, built from (traced) numbers."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=p["gravity"]))
    first = nc.RigidBody(mass=2.0, inertia=(0.3, 0.4, 0.5), com=(0.1, 0.3, 0.0), name="first")
    second = nc.RigidBody(mass=p["mass"], inertia=p["inertia"], position=(0.2, 1.3, -0.1), name="second")
    one, two = scene.add(first), scene.add(second)
    scene.add(nc.Spherical(nc.ground, one, point=(0.0, 0.0, 0.0)))
    hinge = scene.add(nc.Revolute(one, two, point=p["joint position"], axis=p["axis"], name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    scene.add(nc.JointSpring(hinge, stiffness=p["coil"], rest=0.5))
    scene.add(nc.JointDamper(hinge, damping=p["damping"]))
    ends = nc.Point(nc.ground, (1.0, 1.0, 0.5)), nc.Point(two, (0.3, 1.5, 0.1))
    scene.add(nc.Spring(ends, stiffness=p["stiffness"], length=0.4))
    system, state = scene.compile()
    axis = p["axis"] / jnp.sqrt(jnp.sum(p["axis"] ** 2))
    # the second link turns about the hinge, the first rests
    arm = jnp.array([0.2, 1.3, -0.1]) - p["joint position"]
    spin = p["initial spin"] * axis
    rows = state.q[4 * system.body_index("second") :][1:4]
    turning = jnp.concatenate([jnp.cross(spin, arm)[None], jnp.cross(spin[None], rows)])
    v = state.v.at[4 * system.body_index("second") :].set(turning)
    return system, eqx.tree_at(lambda s: s.v, state, v)


def few():
    """Numbers of the small problem, on which second derivatives and batches are taken."""
    names = "inputs", "mass", "stiffness", "gravity", "initial spin", "dt"
    return {name: numbers()[name] for name in names}


def small(p):
    """One link on a hinge with spring and motor: the same paths through the code, compiled sooner."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=p["gravity"]))
    axis = jnp.array([0.0, 0.6, 0.8])
    spin = p["initial spin"] * axis
    link = scene.add(nc.RigidBody(mass=p["mass"], inertia=(0.3, 0.4, 0.5), com=(0.3, 0.1, 0.0)))
    scene.add(nc.JointTorque(scene.add(nc.Revolute(nc.ground, link, point=(0.0, 0.0, 0.0), axis=axis))))
    ends = nc.Point(nc.ground, (1.0, 1.0, 0.5)), nc.Point(link, (0.3, 0.5, 0.1))
    scene.add(nc.Spring(ends, stiffness=p["stiffness"], length=0.4))
    system, state = scene.compile()
    return system, eqx.tree_at(lambda s: s.v, state, state.v.at[1:].set(jnp.cross(spin[None], state.q[1:])))


def loss(p, problem=built, **options):
    """A smooth function of the last state that all numbers move."""
    system, state = problem(p)
    trajectory = nc.simulate(system, state, dt=p["dt"], inputs=p["inputs"], **options)
    last = jax.tree.map(lambda x: x[-1], trajectory.states)
    weights = jnp.cos(jnp.arange(last.q.size)).reshape(last.q.shape)
    coordinates = jnp.sum(jnp.sin(last.coordinates)) + 0.1 * jnp.sum(last.work)
    return jnp.sum(weights * last.q) + 0.2 * jnp.sum(weights[::-1] * last.v) + coordinates


def along(f):
    """Derivative of a function along a direction, forward."""
    return lambda p, d: jax.jvp(f, (p,), (d,))[1]


small_loss = partial(loss, problem=small)
value, small_value = jax.jit(loss), jax.jit(small_loss)
gradient, small_gradient = jax.jit(jax.grad(loss)), jax.jit(jax.grad(small_loss))
tangent, small_tangent = jax.jit(along(loss)), jax.jit(along(small_loss))


def direction(*names, seed=1):
    """A random direction along the named numbers; others stay."""
    rng = np.random.default_rng(seed)
    scale = {"dt": 0.02, "mass": 0.5, "initial spin": 0.5}
    found = {k: jnp.asarray(rng.normal(size=x.shape)) * scale.get(k, 0.3) for k, x in numbers().items()}
    return {k: x if k in names else jnp.zeros_like(x) for k, x in found.items()}


def small_direction(seed=1):
    """A random direction along all numbers of the small problem."""
    return {k: x for k, x in direction(*few(), seed=seed).items() if k in few()}


def total(gradient, d):
    return sum(jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (gradient, d)), strict=True))


# --- first derivatives ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NUMBERS)
def test_jvp_and_gradient_against_differences(name):
    p, d = numbers(), direction(name)
    ahead = tangent(p, d)
    assert_v_shaped(value, p, d, ahead)
    assert abs(total(gradient(p), d) - ahead) <= tol.SAME_GRADIENT * abs(ahead)


@pytest.mark.slow
def test_initial_state():
    """With respect to positions, velocities, coordinates: along motions that the joints allow."""
    p = few()
    system, state = small(p)

    def f(rates):
        moved = nc.simulate(system, state, dt=0.3 * rates[0] ** 2 + 1e-3, steps=1)  # an admissible state
        start = jax.tree.map(lambda x: x[-1], moved.states)
        return jnp.sum(nc.simulate(system, start, dt=0.06, inputs=p["inputs"]).q[-1] ** 3)

    x, d = jnp.array([0.7]), jnp.array([1.0])
    ahead = jax.jvp(f, (x,), (d,))[1]
    assert_v_shaped(f, x, d, ahead)
    assert abs(jax.grad(f)(x) @ d - ahead) <= tol.SAME_GRADIENT * abs(ahead)


@pytest.mark.slow
def test_geometry_through_assembly():
    """A joint's place moved in the compiled system, the state assembled anew, then a rollout."""
    p = few()
    system, state = small(p)
    hinge = 0

    @jax.jit
    def f(shift):
        moved = eqx.tree_at(lambda s: s.frames, system, system.frames.at[hinge, 0, 0, 1:].add(shift))
        start = nc.assemble(moved, state)
        return jnp.sum(nc.simulate(moved, start, dt=0.06, inputs=p["inputs"]).q[-1] ** 3)

    x, d = jnp.array([0.02, -0.01, 0.03]), jnp.array([0.3, 0.5, -0.4])
    ahead = jax.jit(lambda x, d: jax.jvp(f, (x,), (d,))[1])(x, d)
    assert_v_shaped(f, x, d, ahead)
    assert abs(jax.jit(jax.grad(f))(x) @ d - ahead) <= tol.SAME_GRADIENT * abs(ahead)


@pytest.mark.slow
def test_checkpointed_gradient_is_the_same():
    p, d = few(), small_direction()
    found = total(jax.jit(jax.grad(partial(small_loss, checkpoint=True)))(p), d)
    assert abs(found - total(small_gradient(p), d)) <= tol.SAME_GRADIENT * abs(found)


# --- second derivatives -----------------------------------------------------------------------------------

SECOND = {
    "forward over reverse": lambda f: lambda p, d: total(jax.jvp(jax.grad(f), (p,), (d,))[1], d),
    "forward over forward": lambda f: lambda p, d: along(lambda x: along(f)(x, d))(p, d),
    "reverse over forward": lambda f: lambda p, d: total(jax.grad(lambda x: along(f)(x, d))(p), d),
}


@cache
def second(mode: str):
    return jax.jit(SECOND[mode](small_loss))


@pytest.mark.slow
@pytest.mark.parametrize("mode", SECOND)
def test_second_derivatives_against_differences(mode):
    p, d = few(), small_direction()
    assert_v_shaped(lambda x: small_tangent(x, d), p, d, second(mode)(p, d))


@pytest.mark.slow
def test_modes_agree():
    p, d = few(), small_direction(seed=2)
    found = [float(second(mode)(p, d)) for mode in SECOND]
    assert np.ptp(found) <= tol.SAME_GRADIENT * abs(found[0])


@pytest.mark.exhaustive
def test_second_derivatives_of_the_large_problem():
    p, d = numbers(), direction(*numbers())
    found = jax.jit(SECOND["forward over reverse"](loss))(p, d)
    assert_v_shaped(lambda x: tangent(x, d), p, d, found)


@pytest.mark.slow
def test_reverse_over_reverse_is_exact_or_refused():
    """Never silently wrong."""
    p, d = few(), small_direction()

    def twice(p):
        return jax.grad(lambda x: total(jax.grad(small_loss)(x), d))(p)

    try:
        found = total(jax.jit(twice)(p), d)
    except (TypeError, ValueError, NotImplementedError):
        return
    assert abs(found - second("forward over reverse")(p, d)) <= tol.SAME_GRADIENT * abs(found)


@pytest.mark.parametrize(
    "mode",
    [
        "value",
        "gradient",
        pytest.param("forward over reverse", marks=pytest.mark.slow),
        pytest.param("forward over forward", marks=pytest.mark.exhaustive),
        pytest.param("reverse over forward", marks=pytest.mark.exhaustive),
    ],
)
def test_batches(mode):
    """vmap of each equals the loop."""
    singles = {
        "value": lambda p, d: small_value(p),
        "tangent": small_tangent,
        "gradient": lambda p, d: total(small_gradient(p), d),
    }
    single = singles.get(mode) or second(mode)
    points = [jax.tree.map(lambda x, k=k: x * (1 + 0.05 * k), few()) for k in range(3)]
    d = small_direction()
    loop = np.array([single(p, d) for p in points])
    batch = jax.vmap(lambda p: single(p, d))(jax.tree.map(lambda *x: jnp.stack(x), *points))
    assert np.ptp(loop) > 0
    assert np.allclose(batch, loop, rtol=tol.SAME_GRADIENT)


# --- a spring at rest -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "law",
    [
        pytest.param("linear", marks=pytest.mark.exhaustive),
        pytest.param("nonlinear", marks=pytest.mark.slow),
    ],
)
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

    rest, d = jnp.zeros(3), jnp.array([0.7, 0.4, -0.3])
    slope = jax.jit(lambda x: jax.grad(f)(x) @ d)
    curvature = jax.jit(lambda x: jax.jvp(jax.grad(f), (x,), (d,))[1] @ d)(rest)
    assert_v_shaped(slope, rest, d, curvature)
    again = jax.jit(lambda x: jax.jvp(lambda y: jax.jvp(f, (y,), (d,))[1], (x,), (d,))[1])(rest)
    assert abs(again - curvature) <= tol.SAME_GRADIENT * abs(curvature)


# --- forward mode -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("order", "retries"),
    [
        pytest.param(2, True, marks=pytest.mark.slow),
        *(pytest.param(*case, marks=pytest.mark.exhaustive) for case in [(2, False), (4, False), (4, True)]),
    ],
)
def test_directions_one_by_one_are_those_of_jacobians(order, retries, monkeypatch):
    """Corrections with factors of other slots end where Jacobians of every slot lead to."""
    dt, extra = (0.5, 64) if retries else (0.02, 0)

    def end(rate, length):
        found = retried(rate, length, dt, 40, extra, order)
        return found.q[:, 1:], found.v[-1]

    rejected = retried(jnp.array(1.0), 0.5, dt, 40, extra, order).steps_rejected
    assert (int(rejected) > 0) == retries
    at, by = (jnp.array(1.0), jnp.array(0.5)), (jnp.array(0.7), jnp.array(-0.2))
    one = jax.jit(lambda x, d: jax.jvp(end, x, d)[1])(at, by)
    monkeypatch.setattr(Rule, "forward", Rule.with_jacobians)
    jax.clear_caches()
    wanted = jax.jit(lambda x, d: jax.jvp(end, x, d)[1])(at, by)
    for found, exact in zip(one, wanted):
        assert jnp.all(jnp.abs(found - exact) <= tol.EXACT_GRADIENT * jnp.max(jnp.abs(exact)))


def test_many_directions_share_jacobians(monkeypatch):
    """As many as half the unknowns; fewer are followed one by one."""
    asked = []
    forward, jacobians = Rule.forward, Rule.with_jacobians
    monkeypatch.setattr(Rule, "forward", lambda *given: asked.append("one") or forward(*given))
    monkeypatch.setattr(Rule, "with_jacobians", lambda *given: asked.append("all") or jacobians(*given))
    jax.clear_caches()

    def end(x):
        return retried(1.0 + x[0], 0.5 + x[1], 0.02, 4, 0).q[-1]

    at = jnp.zeros(2)
    jax.jit(jax.jacfwd(end)).lower(at)
    assert asked == ["all"]
    asked.clear()
    jax.jit(lambda x: jax.jvp(end, (x,), (x,))).lower(at)
    assert asked == ["one"]


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


def test_gradient_through_retried_steps():
    """Fractions are constants of the derivative; differences small enough not to change them agree."""
    f = jax.jit(lambda x: (retried(x).q[-1, 1:] ** 3).sum())
    found = retried(jnp.array(1.0))
    assert int(found.result) == 0
    assert int(found.steps_taken) > 6, "no step was retried: nothing is tested"
    x, d = jnp.array(1.0), jnp.array(1.0)
    ahead = jax.jvp(f, (x,), (d,))[1]
    assert_v_shaped(f, x, d, ahead, steps=10.0 ** -np.arange(3.0, 9.5, 0.5))
    assert abs(jax.grad(f)(x) - ahead) <= tol.SAME_GRADIENT * abs(ahead)


@pytest.mark.parametrize(
    "dt, steps, extra",
    [
        pytest.param(0.5, 6, 64, marks=pytest.mark.exhaustive),
        pytest.param(0.05, 40, 0, marks=pytest.mark.exhaustive),
    ],
)
def test_second_derivatives_of_many_slots(dt, steps, extra):
    """Attempts that failed, and what fills up the last chunk of slots, count for nothing in them."""

    def f(x):
        found = retried(x, 0.5 * x, dt, steps, extra)
        return (found.q[-1, 1:] ** 3).sum()

    assert (int(retried(jnp.array(1.0), 0.5, dt, steps, extra).steps_rejected) > 0) == (extra > 0)
    assert steps + extra > CHUNK and (steps + extra) % CHUNK, "slots fill their chunks"
    x, d = jnp.array(1.0), jnp.array(1.0)
    slope, modes = jax.jit(along(f)), [jax.jit(SECOND[mode](f))(x, d) for mode in SECOND]
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

    @jax.jit
    def place(v, force, mass, dt):
        scene = nc.Scene()
        ball = scene.add(nc.PointMass(mass=mass, velocity=v * jnp.eye(3)[0]))
        scene.add(nc.PointForce((nc.Point(ball),), force=force * jnp.eye(3)[0]))
        system, state = scene.compile()
        return nc.simulate(system, state, dt=dt, steps=10).q[-1, 0, 0]

    v, force, mass, dt = 0.7, 3.0, 1.7, 0.05
    t = 10 * dt
    wanted = v * t + force * t**2 / (2 * mass)
    assert place(v, force, mass, dt) == pytest.approx(wanted, rel=tol.EXACT_GRADIENT)
    exact = (t, t**2 / (2 * mass), -force * t**2 / (2 * mass**2), 10 * (v + force * t / mass))
    found = jax.jit(jax.grad(place, argnums=(0, 1, 2, 3)))(v, force, mass, dt)
    assert np.allclose(found, exact, rtol=tol.EXACT_GRADIENT)
    twice = jax.jit(jax.jacfwd(jax.grad(place, argnums=2), argnums=2))(v, force, mass, dt)
    assert twice == pytest.approx(force * t**2 / mass**3, rel=tol.EXACT_GRADIENT)


@pytest.mark.slow
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


@pytest.mark.slow
def test_linearise_equals_differences():
    """A and B of a step act on small motions as the step does."""
    p = few()
    system, state = small(p)
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
    along = jax.jvp(moved, (h,), (jnp.ones(()),))[1]
    whole = jax.jvp(later, (h,), (jnp.ones(()),))[1]
    assert np.allclose(a @ along, whole, rtol=1e-8, atol=1e-8 * float(jnp.max(jnp.abs(whole))))


@pytest.mark.slow
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
    known = 0.5 * (1.0 + np.cos(40 * phase))
    speed = jnp.array(0.2)
    assert float(jax.jit(jax.grad(end))(speed)) == pytest.approx(known, rel=1e-9)
    assert float(jax.jit(jax.jacfwd(end))(speed)) == pytest.approx(known, rel=1e-9)


class Swing(eqx.Module):
    """A prescribed angle whose amplitude is a number like any other."""

    amplitude: jax.Array

    def __call__(self, t):
        return self.amplitude * (1 - jnp.cos(3.0 * t))


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
        found = nc.simulate(moved, state, dt=0.05, steps=8, throw=False)
        return jnp.sum(found.v[-1] ** 2)

    both, step = jax.jit(jax.value_and_grad(speed)), 1e-4
    _, slope = both(jnp.array(1.0))
    (above, _), (below, _) = both(jnp.array(1.0 + step)), both(jnp.array(1.0 - step))
    assert abs(float(slope)) > 0.1
    assert float(slope) == pytest.approx(float(above - below) / (2 * step), rel=tol.DIFFERENCE_BEST)


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


@pytest.mark.parametrize(("order", "stride"), [(2, 2), (4, 1)])
def test_multipliers_of_the_way_back_are_smooth_at_the_stride_of_their_guesses(order, stride):
    # v_1 = 2 V - v_0 alternates across constraints, and so do cotangents, where no kicks hold velocities.
    example = gallery.load("heavy_top")
    system, tableau, steps, dt = example.system, nc.EnergyMomentum(order).tableau, 30, jnp.asarray(example.dt)
    plan = Plan(steps, 4, TOLERANCE, None, None, tableau)
    u = jnp.zeros((steps, len(system.structure.inputs)))
    slots, _ = run_slots(plan, system, example.state, u, dt)
    assert np.sum(slots.accepted[:steps]) == steps and Backward(plan).stride == stride
    rng = np.random.default_rng(0)
    end_bar = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), example.state)

    @jax.jit
    def back(before, y, end_bar):
        def outcome(state, y):
            return advance(system, state, u[0], dt, y, tableau)[:2]

        _, pull = jax.vjp(outcome, before, y)
        matrix = jax.jacfwd(lambda y: outcome(before, y)[0])(y)
        lam = -jnp.linalg.solve(matrix.T, pull((jnp.zeros_like(y), end_bar))[1])
        return lam, pull((lam, end_bar))[0]

    found = []
    for k in range(steps - 1, -1, -1):
        before = example.state if k == 0 else jax.tree.map(lambda x, k=k: x[k - 1], slots.states)
        lam, end_bar = back(before, slots.y[k], end_bar)
        found.append(lam)
    # What a cubic polynomial misses, from every step and from every other one, the first ones apart.
    every, other = np.asarray(found)[2:], np.asarray(found)[2:]
    for _ in range(4):
        every, other = every[1:] - every[:-1], other[2:] - other[:-2]
    best, worse = (other, every) if stride == 2 else (every, other)
    assert 5.0 * np.max(np.abs(best)) < np.max(np.abs(worse))
