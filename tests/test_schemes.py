"""The variational and the dissipative scheme: what each keeps, what it loses, and how fast errors fall."""

import json
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from scenes import JOINTS, pair, with_multipliers
from test_constraints import SCHEMES as OF_CONSTRAINTS

import natcoord_jax as nc
from natcoord_jax import cli, gallery
from natcoord_jax.stepping.endpoint import endpoints
from natcoord_jax.stepping.scheme import SCHEME, Scheme

VARIATIONAL = nc.VariationalMidpoint()
DISSIPATIVE = nc.Dissipative(spectral_radius=0.5)
BOTH = pytest.mark.parametrize("scheme", [VARIATIONAL, DISSIPATIVE], ids=["variational", "dissipative"])
USUAL = {("universal", "tree"), ("revolute", "multipliers")}
SCHEMES = {"variational": VARIATIONAL, "dissipative": DISSIPATIVE}
EVERY_PAIR = pytest.mark.parametrize(
    ("joint", "form", "scheme"),
    [
        pytest.param(
            joint,
            form,
            scheme,
            id=f"{joint}-{form}-{name}",
            marks=[] if (joint, form) in USUAL else pytest.mark.slow,
        )
        for joint in JOINTS
        for form in ("tree", "multipliers")
        for name, scheme in SCHEMES.items()
        # Joints and forms meet each other with the energy-momentum step: here each meets each scheme once.
        if (joint, form) in USUAL or (form == "tree") == (name == "variational")
    ],
)


@cache
def compiled(joint: str, form: str, **numbers):
    kind = JOINTS[joint] if form == "tree" else with_multipliers(JOINTS[joint])
    return pair(kind, **numbers)


# --- momenta, constraints, energy -------------------------------------------------------------------------


@EVERY_PAIR
def test_momenta_and_constraints_at_large_steps(joint, form, scheme):
    """Free in space with springs inside, a tenth of a radian and more a step, twice that where energy decays.

    (Like every symplectic method the variational one leaves a motion that steps do not resolve, here by
    another factor of two: then its energy has no bound, and steps fail. Bodies that only a distance holds
    swing round each other fastest; theirs is left at 0.03 s already.)
    """
    system, state = compiled(joint, form, gravity=0.0, hanging=0.0)
    dt = (0.02 if joint == "distance" else 0.05) if scheme is VARIATIONAL else 0.1
    trajectory = nc.simulate(system, state, dt=dt, steps=300, scheme=scheme, extra_substeps=600)
    found = account(system, trajectory)
    assert found.turned >= 1.0
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert max(found.directors, found.joints) <= tol.CONSTRAINT
    if scheme is VARIATIONAL:
        assert float(jnp.max(system.constraint_errors(trajectory).velocity)) <= tol.TANGENT
    else:
        # With what was dissipated among the works, the balance closes to round-off.
        assert found.energy_error <= tol.ENERGY
        energy = np.asarray(system.energy(trajectory).total)
        assert np.max(np.diff(energy)) <= tol.STEP_BALANCE * found.energy_scale


@BOTH
def test_order_of_positions_and_velocities(scheme):
    """By differences of three runs; their limit is that of the energy-momentum step."""
    system, state = compiled("revolute", "tree")
    ends = [endpoints(system, state, scheme=s) for s in (scheme, nc.EnergyMomentum())]
    coarse, middle, fine = (ends[0](1.0 / n, n).state for n in (80, 160, 320))
    other, best = (ends[1](1.0 / n, n).state for n in (160, 320))
    for x in ("q", "v"):
        a, b, c, d, e = (getattr(s, x) for s in (coarse, middle, fine, other, best))
        observed = np.log2(float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b - c))))
        assert observed == pytest.approx(tol.ORDER, abs=tol.ORDER_TOLERANCE), x
        limits = c + (c - b) / 3, e + (e - d) / 3
        assert float(jnp.max(jnp.abs(limits[0] - limits[1]))) <= 0.02 * float(jnp.max(jnp.abs(b - c))), x


@BOTH
@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "bricard"])
def test_loops_and_redundant_constraints(scheme, name):
    example = gallery.load(name)
    trajectory = nc.simulate(example.system, example.state, dt=0.01, steps=100, scheme=scheme)
    errors = example.system.constraint_errors(trajectory)
    assert float(jnp.max(errors.position)) <= tol.CONSTRAINT
    found = account(example.system, trajectory)
    if scheme is VARIATIONAL:
        assert float(jnp.max(errors.velocity)) <= tol.TANGENT
        assert 1e-9 < found.energy_error <= 1e-2
    else:
        assert found.energy_error <= tol.ENERGY


@cache
def driven():
    """A prescribed hinge with a link on a spring, a damper, a motor, a rotor and a load behind it."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.2), com=(0.25, 0, 0.1), name="one"))
    two = scene.add(
        nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.3), com=(0.2, 0, 0), position=(0.5, 0, 0), name="two")
    )
    first = scene.add(nc.Revolute(nc.ground, one, point=(0, 0, 0), axis=(0.0, 1.0, 0.0), name="first"))
    second = scene.add(
        nc.Universal(one, two, point=(0.5, 0, 0), axis=(0, 0, 1), second=(0, 1, 0), name="second")
    )
    scene.add(nc.Drive(first, function=lambda t: 0.7 * (1 - jnp.cos(3.0 * t)), name="drive"))
    scene.add(nc.JointSpring(second, stiffness=20.0))
    scene.add(nc.JointDamper(second, damping=0.1, coordinate=1))
    scene.add(nc.Armature(second, inertia=0.05, coordinate=1))
    scene.add(nc.JointTorque(second, name="motor"))
    scene.add(nc.Spring((nc.Point(nc.ground, (0, 0.3, -0.4)), nc.Point(two, (0.8, 0, 0))), stiffness=50.0))
    scene.add(nc.PointForce((nc.Point(two, (0.9, 0, 0)),), force=lambda t: jnp.stack([0.0 * t, t, 0.0 * t])))
    return scene.compile(assemble=True)


@pytest.mark.slow
@BOTH
def test_work_of_drives_inputs_and_dampers(scheme):
    """The balance closes: exactly, or by the square of the step in a scheme whose energy is not exact."""
    system, state = driven()
    errors = []
    for steps in (50, 100):
        inputs = jnp.full((steps, 1), 0.3)
        trajectory = nc.simulate(system, state, dt=1.0 / steps, inputs=inputs, scheme=scheme)
        found = account(system, trajectory)
        assert abs(found.works["drive"][-1]) > 0.02 * found.energy_scale
        assert found.joints <= tol.CONSTRAINT
        errors.append(found.energy_error)
        if scheme is DISSIPATIVE:
            # Energy never grows by more than the work: what is dissipated in a step is never negative.
            lost = -np.diff(found.works["numerical dissipation"])
            assert np.min(lost) >= -tol.STEP_BALANCE * found.energy_scale and np.sum(lost) > 0
    if scheme is VARIATIONAL:
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)
    else:
        assert max(errors) <= tol.ENERGY


def test_energy_of_the_variational_scheme_has_no_trend():
    """Over ten thousand steps it oscillates about one level."""
    example = gallery.load("heavy_top")
    trajectory = nc.simulate(example.system, example.state, dt=0.004, steps=10_000, scheme=VARIATIONAL)
    energy = np.asarray(example.system.energy(trajectory).total)
    error = energy - energy[0]
    ripple = np.ptp(error[:2000])
    assert ripple > 1e-9 * abs(energy[0]), "energy is exact here: nothing is tested"
    assert np.ptp(error) <= 1.2 * ripple
    slope = np.polyfit(np.linspace(0.0, 1.0, len(error)), error, 1)[0]
    assert abs(slope) <= 0.05 * ripple


# --- the symplectic form ----------------------------------------------------------------------------------


@cache
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
        found = state
        for k, (joint, index) in enumerate(coordinates):
            found = system.with_coordinate(found, joint, x[2 * k], rate=x[2 * k + 1], index=index)
        return eqx.tree_at(lambda s: s.rates, found, x[-1:])

    def both(x):
        before = start(x)
        return before, nc.step(system, before, None, 0.1, scheme=scheme)

    x = jnp.array([0.3, 2.0, -0.4, 1.0, 0.5, -3.0])[: 2 * len(coordinates)]
    before, after = jax.jit(jax.jacfwd(both))(x)

    @jax.jit
    def on_pairs(variations):
        columns = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), variations)
        each = jax.vmap(partial(form, system), in_axes=(0, None))
        return jax.vmap(each, in_axes=(None, 0))(columns, columns)

    found = [np.asarray(on_pairs(variations)) for variations in (before, after)]
    change, scale = np.max(np.abs(found[1] - found[0])), np.max(np.abs(found[0]))
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


def amplification(scheme, frequency):
    """Of position and velocity over the frequency, in one step of length one."""
    system, state = oscillator()
    stiff = eqx.tree_at(lambda s: s.effects[0].effect.stiffness, system, jnp.array([frequency**2]))
    columns = []
    for x, v in ((1.0, 0.0), (0.0, 1.0)):
        start = stiff.with_coordinate(state, "slide", x, rate=frequency * v)
        end = nc.step(stiff, start, None, 1.0, scheme=scheme)
        columns.append([stiff.coordinate(end, "slide"), stiff.rate(end, "slide") / frequency])
    return np.array(columns, float).T


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.8, 1.0])
def test_spectral_radius(radius):
    scheme = nc.Dissipative(spectral_radius=radius)

    def largest(frequency):
        return np.max(np.abs(np.linalg.eigvals(amplification(scheme, frequency))))

    assert largest(1e4) == pytest.approx(radius, abs=2e-4)
    radii = [largest(w) for w in (0.1, 1.0, 10.0, 100.0, 1e4)]
    assert np.all(np.diff(radii) < 0) if radius < 1 else np.allclose(radii, 1.0, atol=1e-12)
    if radius < 1:
        # Damping of third order: eight times less per unit of time at half the step, sixteen times per step.
        losses = [1 - largest(w) for w in (0.2, 0.1)]
        assert losses[0] < 1e-4
        assert np.log2(losses[0] / losses[1]) == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("product", [1.0, 30.0, 1e3])
def test_energy_decays_on_stiff_springs(product):
    """A body that swings on a stiff spring far from its length, at all products of frequency and step."""
    system, state = stiff()
    stiffness = (product / 0.01) ** 2
    system = eqx.tree_at(
        lambda s: next(g.effect.stiffness for g in s.effects if g.names == ("stiff",)),
        system,
        jnp.array([stiffness]),
    )
    trajectory = nc.simulate(system, state, dt=0.01, steps=300, scheme=DISSIPATIVE, extra_substeps=300)
    energies = system.energy(trajectory)
    energy, stored = np.asarray(energies.total), np.asarray(energies.stores["stiff"])
    found = account(system, trajectory)
    assert found.turned >= 0.5
    assert np.max(np.diff(energy)) <= tol.STEP_BALANCE * found.energy_scale
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    if product >= 30.0:
        assert stored[-1] <= 1e-3 * stored[0], "the fast oscillation is still there"


@cache
def stiff():
    """A body that swings on a spring, built outside of whatever is being traced."""
    with jax.ensure_compile_time_eval():
        return _stiff()


def _stiff():
    scene = nc.Scene()
    scene.add(nc.Gravity())
    body = scene.add(
        nc.RigidBody(
            mass=1.0, inertia=(0.1, 0.2, 0.15), com=(0.1, 0, 0), position=(0.5, 0, 0), name="body",
            velocity=(0, 1.0, 0), angular_velocity=(1.0, 0, 2.0),
        )
    )  # fmt: skip
    ends = (nc.Point(nc.ground), nc.Point(body, (0.5, 0, 0)))
    scene.add(nc.Spring(ends, stiffness=1.0, length=0.45, name="stiff"))
    return scene.compile()


def test_rigid_motion_is_not_damped():
    """A stretched spring that turns with its ends in balance loses nothing, however stiff it is."""
    scene, stiffness, rate = nc.Scene(), 1e6, 20.0
    ends = []
    for side in (-1.0, 1.0):
        ball = nc.PointMass(mass=1.0, position=(side, 0, 0), velocity=(0, side * rate, 0), name=f"{side}")
        ends.append(nc.Point(scene.add(ball), (side, 0, 0)))
    # Both circle the middle at one metre; the step turns them by another angle, at the same tension.
    scene.add(nc.Spring(tuple(ends), stiffness=stiffness, length=2.0 - rate**2 / stiffness, name="rod"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.05, steps=50, scheme=nc.Dissipative(spectral_radius=0.0))
    kinetic = np.asarray(system.energy(trajectory).kinetic)
    assert np.ptp(kinetic) <= tol.ENERGY * kinetic[0]
    lost = trajectory.states.dissipated
    assert lost is not None and 0 <= float(lost[-1]) <= 1e-12 * rate**2


@pytest.mark.parametrize("radius", [-0.1, 1.1, float("nan")])
def test_other_radii_are_refused(radius):
    with pytest.raises(ValueError, match="from 0 to 1"):
        nc.Dissipative(spectral_radius=radius)


# --- derivatives, batches, structure ----------------------------------------------------------------------


def swinging(stiffness, scheme, steps=10, **options):
    system, state = stiff()
    system = eqx.tree_at(
        lambda s: next(g.effect.stiffness for g in s.effects if g.names == ("stiff",)),
        system,
        jnp.asarray(stiffness).reshape(1),
    )
    return nc.simulate(system, state, dt=0.05, steps=steps, scheme=scheme, throw=False, **options)


AT, STEP = 80.0, 1e-2


def loss_of(scheme):
    def loss(stiffness):
        found = swinging(stiffness, scheme)
        lost = 0.0 if found.states.dissipated is None else found.states.dissipated[-1]
        return jnp.sum(found.q[-1, 0] ** 2) + 0.1 * jnp.sum(found.v[-1] ** 3) + 10 * lost

    return loss


def fourth_order_difference(f):
    values = [float(f(AT + k * STEP)) for k in (-2, -1, 1, 2)]
    return (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * STEP)


@pytest.mark.slow
@BOTH
def test_gradient_against_differences(scheme):
    loss = loss_of(scheme)
    slope = float(jax.jit(jax.grad(loss))(AT))
    assert abs(slope) > 1e-3, "nothing depends on the stiffness: nothing is tested"
    assert slope == pytest.approx(fourth_order_difference(jax.jit(loss)), rel=tol.DIFFERENCE_BEST)


@pytest.mark.exhaustive
@BOTH
def test_derivatives_in_every_mode(scheme):
    loss = loss_of(scheme)
    places = AT + STEP * jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    # One program for both: the derivative of the gradient comes with the gradient.
    both = jax.jit(jax.vmap(lambda x: jax.jvp(jax.grad(loss), (x,), (1.0,))))
    (a, b, slope, c, d), curvatures = (np.asarray(x) for x in both(places))
    forward = jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,))[1])
    assert float(forward(AT)) == pytest.approx(slope, rel=tol.SAME_GRADIENT)
    differences = (8 * (c - b) - (d - a)) / (12 * STEP)
    assert curvatures[2] == pytest.approx(differences, rel=10 * tol.DIFFERENCE_BEST)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [DISSIPATIVE], ids=["dissipative"])  # whose state has an account more
def test_steps_in_a_scan(scheme):
    """One by one they are those of a rollout, and so are their derivatives."""
    system, state = stiff()
    begin = scheme.started(state)

    def scanned(scale):
        start = eqx.tree_at(lambda s: s.v, begin, scale * begin.v)
        end = jax.lax.scan(
            lambda s, _: (nc.step(system, s, None, 0.05, scheme=scheme), None), start, None, length=5
        )[0]
        return jnp.sum(end.q**3 + end.v**2)

    def rolled(scale):
        start = eqx.tree_at(lambda s: s.v, state, scale * state.v)
        end = nc.simulate(system, start, dt=0.05, steps=5, scheme=scheme, throw=False)
        return jnp.sum(end.q[-1] ** 3 + end.v[-1] ** 2)

    one, other = (jax.jit(jax.value_and_grad(f))(1.0) for f in (scanned, rolled))
    np.testing.assert_allclose(one, other, rtol=tol.SAME_GRADIENT)


@BOTH
def test_a_changed_number_never_retraces(scheme, programs):
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(0.1, 0.2, 0.15), angular_velocity=(1.0, 0, 2.0)))
    scene.add(nc.PointForce((nc.Point(body),), force=(0.1, 0.0, 0.0)))
    system, state = scene.compile()
    nc.simulate(system, state, dt=0.05, steps=3, scheme=scheme)
    assert "jit(simulate)" in programs
    programs.clear()
    moved = eqx.tree_at(lambda s: s.v, state, 2.0 * state.v)
    nc.simulate(system, moved, dt=0.02, steps=3, scheme=eqx.tree_at(lambda s: s, scheme, scheme))
    assert "jit(simulate)" not in programs


@BOTH
def test_error_control(scheme):
    system, state = stiff()
    found = [
        nc.simulate(system, state, dt=0.25, steps=2, scheme=scheme, rtol=rtol, extra_substeps=400)
        for rtol in (1e-3, 1e-4)
    ]
    assert int(found[1].steps_taken) > int(found[0].steps_taken) > 2
    assert account(system, found[1]).spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM


@pytest.mark.filterwarnings("ignore:.*solved densely")
@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("solver", ["recursive", "full"])
def test_the_solver_does_not_matter(scheme, solver):
    """Whatever a system was compiled for, the trajectory is the same."""
    one, other = (pair(nc.Revolute, solver=s) for s in ("reduced", solver))
    a, b = (nc.simulate(*s, dt=0.02, steps=50, scheme=scheme) for s in (one, other))
    order = [one[0].body_index(name) for name in other[0].structure.bodies]
    q = np.asarray(a.q).reshape(51, -1, 4, 3)[:, order]
    assert np.max(np.abs(q - np.asarray(b.q).reshape(q.shape))) <= tol.SAME_TRAJECTORY


# --- command line -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["variational", "dissipative"])
def test_command_line(name, tmp_path, capsys):
    file = tmp_path / "report.json"
    options = ["--scheme", name, "--steps", "20", "--dt", "0.01", "--json", str(file)]
    assert cli.main(["run", "double_pendulum", *options]) == 0
    report = json.loads(file.read_text("utf-8"))
    assert (report["order"], report["result"]) == (2, "successful")
    assert ("dissipated" in capsys.readouterr().out) == (name == "dissipative")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--scheme", "variational", "--order", "4"], "--order"),
        (["--scheme", "dissipative", "--spectral-radius", "2"], "from 0 to 1"),
        (["--spectral-radius", "0.5"], "--scheme dissipative"),
    ],
)
def test_options_that_cannot_be_meant(options, said, capsys):
    assert cli.main(["run", "double_pendulum", *options]) == 2
    assert said in capsys.readouterr().err


def test_every_scheme_is_entered_everywhere():
    """On the command line, in the message that offers schemes, and in the tests that all schemes pass."""
    every = {x for x in vars(nc).values() if isinstance(x, type) and issubclass(x, Scheme)} - {Scheme}
    assert {type(cli.choose_scheme(name, None, None)) for name in cli.SCHEMES} == every
    assert {type(x) for x in (nc.EnergyMomentum(), *SCHEMES.values())} == every
    assert {type(x) for x in OF_CONSTRAINTS.values()} == every
    assert all(f"nc.{x.__name__}(" in SCHEME.wanted for x in every)
