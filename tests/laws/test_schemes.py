"""What each scheme does of its own: symplectic form, damping by frequency, options; and its derivatives."""

import dataclasses
import json
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from law_cases import DISSIPATIVE, SCHEMES, VARIATIONAL, lane

import natcoord_jax as nc
from natcoord_jax import cli, gallery

# --- the symplectic form ----------------------------------------------------------------------------------


def chain(bodies: int):
    """Unsymmetric bodies on a universal joint and a hinge, with springs and a rotor on the last."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    last = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.25, 0.2), com=(0.25, 0, 0.1), name="one"))
    joint = scene.add(
        nc.Universal(nc.ground, last, point=(0, 0, 0), axis=(0, 0, 1), second=(0, 1, 0), name="first")
    )
    scene.add(nc.JointSpring(joint, stiffness=2.0, rest=0.3))
    if bodies == 2:
        place = (0.5, 0, 0)
        two = nc.RigidBody(mass=0.7, inertia=(0.1, 0.2, 0.28), com=(0.2, 0.1, 0), position=place, name="two")
        one, last = last, scene.add(two)
        joint = scene.add(nc.Revolute(one, last, point=place, axis=(0.0, 0.6, 0.8), name="second"))
    scene.add(nc.Armature(joint, inertia=0.05, coordinate=2 - bodies))
    scene.add(nc.Spring((nc.Point(nc.ground, (0, 0.3, -0.4)), nc.Point(last, (0.8, 0, 0))), stiffness=20.0))
    return scene.compile()


def form(system, one, other):
    """dq ^ M dv of two variations, of bodies and of the rotor on the last coordinate."""

    def pairing(a, b):
        return jnp.einsum("kab,kac,kbc->", system.mass, a.reshape(-1, 4, 3), b.reshape(-1, 4, 3))

    rotor = 0.05 * (one.coordinates[-1] * other.rates[0] - other.coordinates[-1] * one.rates[0])
    return pairing(one.q, other.v) - pairing(other.q, one.v) + rotor


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("scheme", "symplectic", "bodies"), [(VARIATIONAL, True, 2), (nc.EnergyMomentum(), False, 1)]
)
def test_the_canonical_form(scheme, symplectic, bodies):
    """On all pairs of variations of minimal coordinates and their rates, over one large step."""
    system, state = chain(bodies)
    coordinates = (("first", 0), ("first", 1), ("second", 0))[: bodies + 1]

    def start(x):
        result = state
        for k, (joint, index) in enumerate(coordinates):
            result = system.with_coordinate(result, joint, x[2 * k], rate=x[2 * k + 1], index=index)
        return dataclasses.replace(result, rates=x[-1:])

    def before_and_after(x):
        before = start(x)
        return before, nc.step(system, before, None, 0.1, scheme=scheme)

    x = jnp.array([0.3, 2.0, -0.4, 1.0, 0.5, -3.0])[: 2 * len(coordinates)]
    before, after = jax.jit(jax.jacfwd(before_and_after))(x)

    @jax.jit
    def on_pairs(variations):
        columns = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), variations)
        each = jax.vmap(partial(form, system), in_axes=(0, None))
        return jax.vmap(each, in_axes=(None, 0))(columns, columns)

    result = [np.asarray(on_pairs(variations)) for variations in (before, after)]
    change, scale = np.max(np.abs(result[1] - result[0])), np.max(np.abs(result[0]))
    assert scale > 0.1
    assert (change <= 1e-10 * scale) if symplectic else (change >= 1e-5 * scale)


# --- dissipation ------------------------------------------------------------------------------------------


@cache
def oscillator():
    """A mass of one on a spring along a slide."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="body"))
    slide = scene.add(nc.Prismatic(nc.ground, body, axis=(0.6, 0.0, 0.8), name="slide"))
    scene.add(nc.JointSpring(slide, stiffness=1.0, name="spring"))
    return scene.compile()


def radii_of(scheme, frequencies):
    """Spectral radii of one step of length one, in position and velocity over the frequency; in lanes."""
    system, state = oscillator()

    def column(frequency, x, v):
        stiff = system.set("spring", stiffness=frequency**2)
        start = stiff.with_coordinate(state, "slide", x, rate=frequency * v)
        end = nc.step(stiff, start, None, 1.0, scheme=scheme)
        return jnp.stack([stiff.coordinate(end, "slide"), stiff.rate(end, "slide") / frequency])

    columns = jax.jit(jax.vmap(jax.vmap(column, (None, 0, 0)), (0, None, None)))
    result = columns(jnp.asarray(frequencies), jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    return np.max(np.abs(np.linalg.eigvals(np.swapaxes(np.asarray(result), 1, 2))), axis=1)


@pytest.mark.parametrize("radius", [lane((r,), set(), {(0.5,)}) for r in (0.0, 0.5, 0.8, 1.0)])
def test_spectral_radius(radius):
    result = radii_of(nc.Dissipative(spectral_radius=radius), [0.1, 1.0, 10.0, 100.0, 1e4, 0.2])
    radii, slow = result[:5], result[[5, 0]]
    assert radii[-1] == pytest.approx(radius, abs=2e-4)
    assert np.all(np.diff(radii) < 0) if radius < 1 else np.allclose(radii, 1.0, atol=1e-12)
    if radius < 1:
        # Damping of third order: eight times less per unit of time at half the step, sixteen times per step.
        losses = 1 - slow
        assert losses[0] < 1e-4
        assert np.log2(losses[0] / losses[1]) == pytest.approx(4.0, abs=0.1)


@cache
def stiff():
    """A body that swings on a spring, built outside of whatever is being traced."""
    with jax.ensure_compile_time_eval():
        scene = nc.Scene()
        scene.add(nc.Gravity())
        moving = {"velocity": (0, 1.0, 0), "angular_velocity": (1.0, 0, 2.0)}
        numbers = {"mass": 1.0, "inertia": (0.1, 0.2, 0.15), "com": (0.1, 0, 0), "position": (0.5, 0, 0)}
        body = scene.add(nc.RigidBody(**numbers, **moving, name="body"))
        ends = (nc.Point(nc.ground), nc.Point(body, (0.5, 0, 0)))
        scene.add(nc.Spring(ends, stiffness=1.0, length=0.45, name="stiff"))
        return scene.compile()


def test_energy_decays_on_stiff_springs():
    """A body that swings on a stiff spring far from its length, at all products of frequency and step."""
    system, state = stiff()
    for product in (1.0, 30.0, 1e3):
        changed = system.set("stiff", stiffness=(product / 0.01) ** 2)
        trajectory = nc.simulate(changed, state, dt=0.01, steps=300, scheme=DISSIPATIVE, extra_substeps=300)
        energies = changed.energy(trajectory)
        energy, stored = np.asarray(energies.total), np.asarray(energies.stores["stiff"])
        result = account(changed, trajectory)
        assert result.turned >= 0.5, product
        assert np.max(np.diff(energy)) <= tol.STEP_BALANCE * result.energy_scale, product
        assert result.energy_error <= tol.ENERGY, product
        assert result.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM, product
        if product >= 30.0:
            assert stored[-1] <= 1e-3 * stored[0], "the fast oscillation is still there"


@pytest.mark.exhaustive
def test_rigid_motion_is_not_damped():
    """A stretched spring that turns with its ends in balance loses nothing, however stiff it is."""
    scene, stiffness, rate = nc.Scene(), 1e6, 20.0
    ends = []
    for side in (-1.0, 1.0):
        ball = nc.PointMass(mass=1.0, position=(side, 0, 0), velocity=(0, side * rate, 0), name=f"{side}")
        ends.append(nc.Point(scene.add(ball), (side, 0, 0)))
    # They circle the middle at one metre; the step turns them by another angle, at the same tension.
    scene.add(nc.Spring(tuple(ends), stiffness=stiffness, length=2.0 - rate**2 / stiffness, name="rod"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.05, steps=50, scheme=nc.Dissipative(spectral_radius=0.0))
    kinetic = np.asarray(system.energy(trajectory).kinetic)
    assert np.ptp(kinetic) <= tol.ENERGY * kinetic[0]
    lost = trajectory.states.dissipated
    assert lost is not None and 0 <= float(lost[-1]) <= 1e-12 * rate**2


# --- derivatives ------------------------------------------------------------------------------------------

AT, STEP, DT = 8.0, 2e-3, 0.05


@cache
def swing():
    """A pendulum with a coil, a tether of large strain, a damper and a motor."""
    with jax.ensure_compile_time_eval():
        scene = nc.Scene()
        scene.add(nc.Gravity())
        numbers = {"mass": 1.0, "inertia": (0.1, 0.2, 0.3), "com": (0.5, 0.0, 0.0)}
        arm = scene.add(nc.RigidBody(**numbers, angular_velocity=(0.0, 1.0, 0.0), name="arm"))
        hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0.0, 1.0, 0.0), name="hinge"))
        scene.add(nc.JointSpring(hinge, stiffness=AT, rest=1.0, name="coil"))
        tether = (nc.Point(nc.ground, (0, 0.3, -0.4)), nc.Point(arm, (0.8, 0, 0)))
        scene.add(nc.Spring(tether, stiffness=5.0 * AT, length=0.1, name="tether"))
        scene.add(nc.JointDamper(hinge, damping=0.1, name="damper"))
        scene.add(nc.JointTorque(hinge, name="motor"))
        return scene.compile()


def loss_of(scheme, steps=10):
    """A number of the end, of the work of motor and damper, and of what is dissipated, by the stiffness."""
    system, state = swing()
    torques = jnp.sin(3.0 * scheme.times(DT, steps))[..., None]
    torques = torques[:, 0] if scheme.stages == 1 else torques

    def loss(stiffness):
        changed = system.set("coil", stiffness=stiffness).set("tether", stiffness=5.0 * stiffness)
        end = nc.simulate(changed, state, dt=DT, inputs=torques, scheme=scheme, throw=False)[-1]
        lost = 0.0 if end.dissipated is None else end.dissipated
        return jnp.sum(end.q**3) + 0.1 * jnp.sum(end.v**3) + jnp.sum(end.work) + 10 * lost

    return loss


PLACES = AT + STEP * jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])


def fourth_order(values):
    a, b, _, c, d = np.asarray(values)
    return (8 * (c - b) - (d - a)) / (12 * STEP)


OTHERS = [name for name in SCHEMES if name != "order 2"]


@pytest.mark.parametrize("name", [lane((name,), set(), set()) for name in OTHERS])
def test_gradient_against_differences(name):
    loss = loss_of(SCHEMES[name])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(loss)))(PLACES)
    assert abs(slopes[2]) > 1e-2, "nothing depends on the stiffness: nothing is tested"
    assert float(slopes[2]) == pytest.approx(fourth_order(values), rel=tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["order 4", "variational", "dissipative"])
def test_derivatives_in_every_mode(name):
    loss = loss_of(SCHEMES[name])
    # One program for slopes and curvatures: the derivative of the gradient comes with the gradient.
    program = jax.jit(jax.vmap(lambda x: jax.jvp(jax.grad(loss), (x,), (1.0,))))
    slopes, curvatures = (np.asarray(x) for x in program(PLACES))
    forward = jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,))[1])
    assert float(forward(AT)) == pytest.approx(slopes[2], rel=tol.SAME_GRADIENT)
    assert abs(curvatures[2]) > 1e-3
    assert curvatures[2] == pytest.approx(fourth_order(slopes), rel=10 * tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
def test_derivatives_with_loops():
    """Of the loop whose constraints depend on each other, at order four."""
    example = gallery.load("bricard")
    mass = float(example.system.get("rod 4")["mass"])

    def last(scale):
        system = example.system.set("rod 4", mass=scale * mass)
        result = nc.simulate(system, example.state, dt=0.02, steps=10, scheme=SCHEMES["order 4"], throw=False)
        return jnp.sum(result.q[-1] ** 3) + 0.1 * jnp.sum(result.v[-1] ** 2)

    compare(last, 1.0, least=1e-3)


@pytest.mark.exhaustive
def test_derivatives_with_drives():
    """Two driven links carry a free one; the loss has the work of the drives in it."""

    def last(amplitude):
        scene = nc.Scene()
        scene.add(nc.Gravity())
        carrier = nc.ground
        for k in range(3):
            place = np.array([0.5 * k, 0.0, 0.0])
            numbers = {"mass": 1.0, "inertia": (0.1, 0.2, 0.2), "com": (0.25, 0, 0)}
            link = scene.add(nc.RigidBody(**numbers, position=place, name=f"{k}"))
            axis = (0.0, 1.0, 0.2 * k)
            hinge = scene.add(nc.Revolute(carrier, link, point=place, axis=axis, name=f"hinge {k}"))
            if k < 2:
                size = amplitude / (1 + k)
                scene.add(nc.Drive(hinge, function=lambda t, size=size: size * (1 - jnp.cos(3.0 * t))))
            carrier = link
        system, state = scene.compile()
        result = nc.simulate(system, state, dt=0.05, steps=8, scheme=SCHEMES["order 4"], throw=False)
        return jnp.sum(result.q[-1] ** 3) + 0.1 * jnp.sum(result.v[-1] ** 2) + jnp.sum(result.states.work[-1])

    compare(last, 0.7, least=1.0)


def compare(f, at, least):
    """Derivatives forward and in reverse against differences of fourth order."""
    h, value = 1e-3, jax.jit(f)
    values = [float(value(at + k * h)) for k in (-2, -1, 1, 2)]
    difference = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
    assert abs(difference) >= least, "nothing depends on the parameter: nothing is tested"
    for slope in (jax.jit(jax.grad(f)), jax.jit(lambda x: jax.jvp(f, (x,), (1.0,))[1])):
        assert float(slope(at)) == pytest.approx(difference, rel=tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
def test_steps_in_a_scan():
    """One by one they are those of a rollout, and so are their derivatives, with what is dissipated."""
    system, state = stiff()
    system = system.set("stiff", stiffness=80.0)
    begin = DISSIPATIVE.started(state)

    def scanned(scale):
        start = dataclasses.replace(begin, v=scale * begin.v)
        end = jax.lax.scan(
            lambda s, _: (nc.step(system, s, None, DT, scheme=DISSIPATIVE), None), start, None, length=5
        )[0]
        return jnp.sum(end.q**3 + end.v**2)

    def rolled(scale):
        start = dataclasses.replace(state, v=scale * state.v)
        end = nc.simulate(system, start, dt=DT, steps=5, scheme=DISSIPATIVE, throw=False)
        return jnp.sum(end.q[-1] ** 3 + end.v[-1] ** 2)

    one, other = (jax.jit(jax.value_and_grad(f))(1.0) for f in (scanned, rolled))
    np.testing.assert_allclose(one, other, rtol=tol.SAME_GRADIENT)


# --- programs, error control, options ---------------------------------------------------------------------

BOTH = pytest.mark.parametrize("scheme", [VARIATIONAL, DISSIPATIVE], ids=["variational", "dissipative"])


@pytest.mark.exhaustive
@BOTH
def test_a_changed_number_never_retraces(scheme, programs):
    system, state = stiff()
    nc.simulate(system, state, dt=0.05, steps=3, scheme=scheme)
    assert "jit(simulated)" in programs
    programs.clear()
    moved = dataclasses.replace(state, v=2.0 * state.v)
    nc.simulate(system, moved, dt=0.02, steps=3, scheme=dataclasses.replace(scheme))
    assert "jit(simulated)" not in programs


@pytest.mark.exhaustive
@BOTH
def test_error_control(scheme):
    system, state = stiff()
    system = system.set("stiff", stiffness=80.0)
    result = [
        nc.simulate(system, state, dt=0.25, steps=2, scheme=scheme, rtol=rtol, extra_substeps=400)
        for rtol in (1e-3, 1e-4)
    ]
    assert int(result[1].steps_taken) > int(result[0].steps_taken) > 2
    assert account(system, result[1]).spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM


def test_numbers_that_no_scheme_has_are_refused():
    for radius in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="from 0 to 1"):
            nc.Dissipative(spectral_radius=radius)
    for order in (3, 0, 12):
        with pytest.raises(ValueError, match="even number from 2 to 10"):
            nc.EnergyMomentum(order=order)


@pytest.mark.parametrize(
    "name", [lane((n,), set(), {("dissipative",)}) for n in ("variational", "dissipative")]
)
def test_command_line(name, tmp_path, capsys):
    file = tmp_path / "report.json"
    options = ["--scheme", name, "--steps", "20", "--dt", "0.01", "--json", str(file)]
    assert cli.main(["run", "double_pendulum", *options]) == 0
    report = json.loads(file.read_text("utf-8"))
    assert (report["order"], report["result"]) == (2, "successful")
    assert ("dissipated" in capsys.readouterr().out) == (name == "dissipative")


REFUSED = {
    "--order": ["--scheme", "variational", "--order", "4"],
    "from 0 to 1": ["--scheme", "dissipative", "--spectral-radius", "2"],
    "--scheme dissipative": ["--spectral-radius", "0.5"],
}


def test_options_that_cannot_be_meant(capsys):
    for said, options in REFUSED.items():
        assert cli.main(["run", "double_pendulum", *options]) == 2
        assert said in capsys.readouterr().err


def test_every_scheme_is_entered_everywhere():
    """On the command line, in the message that offers schemes, and in the table of the laws."""
    base = nc.EnergyMomentum.__mro__[1]
    classes = {x for x in vars(nc).values() if isinstance(x, type) and issubclass(x, base)}
    assert {type(cli.choose_scheme(name, None, None)) for name in cli.SCHEMES} == classes
    assert {type(x) for x in SCHEMES.values()} == classes
    system, state = oscillator()
    with pytest.raises(ValueError) as refusal:
        nc.simulate(system, state, dt=0.1, steps=1, scheme="another")
    assert all(f"nc.{x.__name__}(" in str(refusal.value) for x in classes)
