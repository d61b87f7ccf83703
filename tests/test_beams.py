"""Beams at rest: strains, equilibria against exact solutions and reference values, modes, derivatives.

Cases B01, B02 and B05 of the collected reference values: pure bending (exact), the 45 degree bend (Bathe &
Bolourchi 1979; boundary-value solution with the stiffnesses given here) and the cantilever of Nachbagauer
(2011) as Exudyn's test models have it.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from scipy.linalg import expm

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.effects.beams.relative_motion import relative_motion, strains_of
from natcoord_jax.maths.rotations import from_rotation_vector

ROUNDING = 1e-13
"""Of what is exact in exact arithmetic, relative to its size: some hundred roundings."""

NUMBERS = {"EA": 1e4, "GA": 5e3, "EI": (1.0, 2.0), "GJ": 1.5, "density": 2.0, "rotary": 0.01}


def cantilever(section, curve, elements, *, load=None, torque=None, following=False, **options):
    """A beam clamped at its start with a force and a torque at its end, both times the load parameter."""
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, curve, elements=elements, start=nc.ground, name="beam", **options))
    axes = tuple(nc.Direction(beam.end, e) for e in np.eye(3))
    if load is not None:
        end = curve(jnp.asarray(options["length"])) if callable(curve) else curve[-1]
        markers = (nc.Point(beam.end, end), *(axes if following else ()))
        scene.add(nc.PointForce(markers, force=lambda t: jnp.asarray(load) * t, following=following))
    if torque is not None:
        scene.add(nc.BodyTorque(axes, torque=lambda t: jnp.asarray(torque) * t))
    return *scene.compile(), beam


def tip(system, state, beam):
    return np.asarray(system.sense(state, beam.end).position)


def frames_along(strain, length):
    """Point and directors at both ends of a piece of constant strain: the exponential of its twist."""
    gamma, curvature = strain[:3] + np.array([0, 0, 1.0]), strain[3:]
    twist = np.zeros((4, 4))
    k = curvature
    twist[:3, :3] = [[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]]
    twist[:3, 3] = gamma
    motion = expm(length * twist)
    end = np.concatenate([motion[:3, 3][None], motion[:3, :3].T])
    return jnp.asarray(np.stack([np.concatenate([np.zeros((1, 3)), np.eye(3)]), end]))


@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.3, 2.0])
def test_constant_strains_are_exact(size):
    """Every state of constant strain, shear and torsion included, is seen as what it is."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        strain, length = size * rng.normal(size=6) / np.sqrt(6), 0.7
        found = strains_of(relative_motion(frames_along(strain, length)), jnp.asarray(length))
        assert np.allclose(found - jnp.array([0, 0, 1.0, 0, 0, 0]), strain, rtol=1e-12, atol=1e-15 / length)


def test_rigid_motions_do_not_strain():
    """Objectivity: strains of a bent piece are those of the piece turned and moved by anything."""
    rng = np.random.default_rng(1)
    x = frames_along(rng.normal(size=6), 0.7)
    before = strains_of(relative_motion(x), jnp.asarray(0.7))
    for _ in range(5):
        turn = from_rotation_vector(jnp.asarray(3 * rng.normal(size=3)))
        moved = (x @ turn.T).at[:, 0].add(jnp.asarray(rng.normal(size=3)))
        found = strains_of(relative_motion(moved), jnp.asarray(0.7))
        np.testing.assert_allclose(found, before, rtol=0, atol=ROUNDING * np.abs(before).max())


def test_pure_bending_rolls_up_to_a_circle():
    """B01: with three elements, to round-off, all the way."""
    length, bending = 10.0, 86900.0
    section = nc.Section.of_numbers(
        EA=1.77e6, GA=1.77e6, EI=(bending, 215000.0), GJ=8160.0, density=1.0, rotary=1.0
    )
    moment = 2 * np.pi * bending / length
    # d_1 along y: bending about d_1 takes the beam from x to z.
    options = {"torque": (0.0, -moment, 0.0), "second": (0.0, 1.0, 0.0)}
    system, state, beam = cantilever(section, [(0, 0, 0), (length, 0, 0)], 3, **options)
    found = nc.equilibrium(system, state, steps=8)
    angle = 2 * np.pi * np.asarray(found.states.t)
    exact = length * np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1) / angle[:, None]
    np.testing.assert_allclose(tip(system, found.states, beam), exact, rtol=0, atol=ROUNDING * length)


@pytest.mark.slow
def test_stretch_and_torsion_are_exact():
    section = nc.Section.of_numbers(**NUMBERS)
    options = {"load": (0, 0, 30.0), "torque": (0, 0, 0.9), "stations": (0.2, 0.35)}
    system, state, beam = cantilever(section, [(0, 0, 0), (0, 0, 1.0)], 3, **options)
    found = nc.equilibrium(system, state, steps=2)
    sensed = system.sense(found.state, beam.end)
    np.testing.assert_allclose(sensed.position, [0, 0, 1.003], rtol=0, atol=ROUNDING)
    turned = from_rotation_vector(jnp.array([0, 0, 0.6]))
    np.testing.assert_allclose(sensed.rotation, turned, rtol=0, atol=ROUNDING)


@cache
def loaded():
    """A cantilever with load enough to bend it by a radian."""
    return cantilever(nc.Section.of_numbers(**NUMBERS), [(0, 0, 0), (1.0, 0, 0)], 4, load=(0.5, 2.0, 1.0))


def test_equilibria_do_not_depend_on_the_path():
    system, state, beam = loaded()
    direct = nc.equilibrium(system, state, steps=2).state
    around = nc.equilibrium(system, state, jnp.array([-1.0, 1.0])).state
    np.testing.assert_allclose(direct.q, around.q, rtol=0, atol=ROUNDING)
    assert abs(tip(system, direct, beam)[1]) > 0.2


@pytest.mark.exhaustive
def test_derivatives_of_equilibria():
    """With respect to stiffness, length, load and unstressed curvature; forward, reverse, second."""
    system, state, beam = loaded()
    body = system.body_index(beam.end)

    def place(p):
        group = system.effects[0]
        effect = group.effect
        changed = replace_fields(
            effect,
            stiffness=effect.stiffness * p[0],
            length=effect.length * p[1],
            reference=effect.reference + p[3] * jnp.array([0, 0, 0, 1.0, 0.5, 0]),
        )
        effects = (replace_fields(group, effect=changed), *system.effects[1:])
        changed_system = replace_fields(system, effects=effects)
        return nc.equilibrium(changed_system, state, p[2] * jnp.array([0.5, 1.0])).state.q[4 * body, 1]

    p = jnp.array([1.0, 1.0, 1.0, 0.1])
    place, h, units = jax.jit(place), 1e-4, jnp.eye(4)
    # One program for both: the derivative of the gradient comes with the gradient.
    both = jax.jit(lambda p: jax.jvp(jax.grad(place), (p,), (units[2],)))
    gradient, curvature = both(p)
    differences = [(place(p + h * e) - place(p - h * e)) / (2 * h) for e in units]
    assert np.allclose(gradient, differences, rtol=1e-6, atol=1e-8)
    assert np.allclose(jax.jvp(place, (p,), (units[1],))[1], gradient[1], rtol=1e-9)
    near = [both(p + s * h * units[2])[0] for s in (1, -1)]
    assert np.allclose(curvature, (near[0] - near[1]) / (2 * h), rtol=1e-5, atol=1e-7)


def richardson(coarse, fine):
    """From results of order two at h and h/2."""
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


@pytest.mark.slow
def test_bend_of_45_degrees():
    """B02, with kGA = 4166670 N."""
    radius = 100.0
    section = nc.Section.of_numbers(EA=1e7, GA=4166670.0, EI=833300.0, GJ=833300.0, density=1.0, rotary=1.0)
    length = radius * np.pi / 4

    def curve(s):
        return jnp.stack([radius * jnp.sin(s / radius), radius * (1 - jnp.cos(s / radius)), 0 * s])

    found = []
    for elements in (8, 16):
        system, state, beam = cantilever(section, curve, elements, load=(0, 0, 600.0), length=length)
        state = nc.equilibrium(system, state, steps=6).state
        found.append(tip(system, state, beam) - np.asarray(curve(length)))
    np.testing.assert_allclose(richardson(*found), [-23.5613, -13.60502, 53.47611], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_cantilever_by_number_of_elements():
    """B05: order two, and the converged values of a small load and of a large one.

    Coarse meshes are nearer to them than Exudyn's element of the same number of nodes.
    """
    section = nc.RectangularSection(width=0.1, height=0.5, E=2.07e11, nu=0.3, density=7800.0)
    options = {"load": (0.0, 6.25e7, 0.0), "second": (0.0, 0.0, 1.0)}
    small, large = np.array([-1.88847418e-07, 0.000809900305]), np.array([-0.15097103, 0.71056837])
    exudyn = {1: (-0.07140274, 0.54225823), 2: (-0.12379212, 0.65687111), 4: (-0.14346767, 0.69593561)}
    found = {}
    for elements in (1, 2, 4, 8, 16):
        system, state, beam = cantilever(section, [(0, 0, 0), (2.0, 0, 0)], elements, **options)
        states = nc.equilibrium(system, state, jnp.array([1e-3, 0.2, 0.4, 0.6, 0.8, 1.0])).states
        found[elements] = (tip(system, states, beam)[:, :2] - [2.0, 0])[[0, -1]]
    errors = {n: np.max(np.abs(x[1] - large)) for n, x in found.items()}
    for elements, other in exudyn.items():
        assert errors[elements] < np.max(np.abs(np.array(other) - large)), elements
    assert 3.8 < errors[8] / errors[16] < 4.2
    converged = richardson(found[8], found[16])
    np.testing.assert_allclose(converged[0], small, rtol=1e-5, atol=0)
    np.testing.assert_allclose(converged[1], large, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3])
def test_order_of_director_interpolation(order):
    """Displacements converge with order 2 p."""
    section = nc.Section.of_numbers(**NUMBERS)
    found = []
    for elements in (2, 4, 8):
        options = {"interpolation": nc.DirectorInterpolation(order=order), "load": (0.0, 1.0, 0.5)}
        system, state, beam = cantilever(section, [(0, 0, 0), (1.0, 0, 0)], elements, **options)
        found.append(tip(system, nc.equilibrium(system, state, steps=2).state, beam))
    steps = [np.max(np.abs(a - b)) for a, b in zip(found, found[1:])]
    assert abs(np.log2(steps[0] / steps[1]) - 2 * order) < 0.6


# --- modes ------------------------------------------------------------------------------------------------

STEEL = {"radius": 0.01, "E": 2e11, "density": 7800.0}
ROOTS = {True: (1.87510407, 4.69409113), False: (4.73004074, 7.85320462)}


RADIUS_OF_GYRATION = STEEL["radius"] / 2
"""Of a circle, and of its area: the same number [m]."""


def mean_squares(beta, clamped, order):
    """Mean squares of a derivative of Euler-Bernoulli's shapes over those of the shapes themselves.

    Of the shape cosh - cos - s (sinh - sin) of a clamped end, and with the other signs of a free one, s given
    by no moment at the free end at x = 1.
    """
    x = np.linspace(0.0, 1.0, 20001)
    sign = 1 if clamped else -1
    found = []
    for b in beta:
        weight = (np.cosh(b) + sign * np.cos(b)) / (np.sinh(b) + sign * np.sin(b))
        cos, sin = np.cos(b * x), np.sin(b * x)
        hyperbolic = [np.cosh(b * x) - weight * np.sinh(b * x), np.sinh(b * x) - weight * np.cosh(b * x)]
        turning = [(-cos + weight * sin), (sin + weight * cos), (cos - weight * sin), (-sin - weight * cos)]
        shapes = [hyperbolic[k % 2] + sign * turning[k] for k in range(4)]
        found.append(b ** (2 * order) * np.trapezoid(shapes[order] ** 2, x) / np.trapezoid(shapes[0] ** 2, x))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("clamped", [True, False])
def test_frequencies(clamped):
    """Of a slender cantilever and of a free beam, by Richardson's formula, against Euler-Bernoulli's roots.

    Those are corrected for shear and rotary inertia by Rayleigh's quotient with Euler-Bernoulli's shapes phi:

        omega^2 = omega_0^2 (1 - (I / A) int phi'^2 / int phi^2 - (EI / GA) int phi'''^2 / int phi''^2).
    """
    section = nc.CircularSection(**STEEL)
    stiffness, inertia = np.asarray(section.stiffness), np.asarray(section.inertia)
    unit = np.sqrt(float(stiffness[3, 3] / inertia[0, 0]))
    found = []
    for elements in (16, 32):
        scene = nc.Scene()
        start = nc.ground if clamped else None
        scene.add(nc.Beam(section, [(0, 0, 0), (1.0, 0, 0)], elements=elements, start=start))
        system, state = scene.compile()
        frequencies = np.asarray(nc.modes(system, state).frequencies)
        found.append(frequencies[0 if clamped else 6 :: 2][:2])
        if not clamped:
            assert np.all(frequencies[:6] < 1e-3 * frequencies[6])
    beta = np.array(ROOTS[clamped])
    slope, third = (mean_squares(beta, clamped, order) for order in (1, 3))
    lag = RADIUS_OF_GYRATION**2 * slope + stiffness[3, 3] / stiffness[0, 0] * third / beta**4
    expected = unit * beta**2 * np.sqrt(1 - lag)
    assert np.all(lag > 4e-4)  # beyond the tolerance below: it is seen
    np.testing.assert_allclose(richardson(*found), expected, rtol=1e-4)


@pytest.mark.slow
def test_lateral_buckling():
    """A narrow cantilever under a tip load across its strong side gives way at 4.013 sqrt(EI GJ) / L^2."""
    weak, torsion, length = 1.0, 1.5, 1.0
    section = nc.Section.of_numbers(EA=1e7, GA=1e7, EI=(1e4, weak), GJ=torsion, density=1.0, rotary=1e-3)
    critical = 4.013 * np.sqrt(weak * torsion) / length**2
    # d_1 along y: bending about it, in the plane of the load, is stiff.
    options = {"load": (0.0, 0.0, -critical), "second": (0.0, 1.0, 0.0)}
    system, state, _ = cantilever(section, [(0, 0, 0), (length, 0, 0)], 16, **options)
    # Half a per cent to either side; the mesh and the strong side's give, EI / 1e4, make less than 0.15 %.
    found = nc.equilibrium(system, state, jnp.array([0.5, 0.995, 1.005]))
    slowest = [
        nc.modes(system, jax.tree.map(lambda x, k=k: x[k], found.states), count=1).s[0] for k in (1, 2)
    ]
    assert abs(slowest[0].real) < 1e-9 and slowest[0].imag > 0
    assert slowest[1].real > 0


@pytest.mark.slow
def test_buckling_sets_in_in_motion():
    """The same cantilever, touched from the side: below the critical load it swings, above it falls over."""
    weak, torsion = 1.0, 1.5
    section = nc.Section.of_numbers(EA=1e5, GA=1e5, EI=(1e3, weak), GJ=torsion, density=1.0, rotary=1e-2)
    critical = 4.013 * np.sqrt(weak * torsion)
    aside = []
    for part in (0.9, 1.1):
        scene, line = nc.Scene(), [(0, 0, 0), (1, 0, 0)]
        beam = scene.add(nc.Beam(section, line, elements=8, second=(0, 1, 0), start=nc.ground, name="beam"))
        scene.add(nc.PointForce((nc.Point(beam.end, line[1]),), force=(0, 0, -part * critical)))
        system, state = scene.compile()
        state = nc.equilibrium(system, state).state
        row = 4 * system.body_index(beam.end)
        touched = replace_fields(state, v=state.v.at[row, 1].add(1e-3))
        found = nc.simulate(system, touched, dt=0.01, steps=400)
        assert nc.balance(system, found).energy.max() < tol.ENERGY
        aside.append(np.abs(np.asarray(system.sense(found, beam.end).position)[:, 1]).max())
    assert aside[0] < 1e-3 and aside[1] > 0.05, aside


@pytest.mark.slow
def test_snap_through():
    """A shallow arch: the path goes through the limit point and back, symmetric about the flat shape."""
    section = nc.Section.of_numbers(EA=1e4, GA=5e3, EI=1.0, GJ=1.0, density=1.0, rotary=0.01)
    places = np.linspace(0, 1, 9)
    points = np.stack([places - 0.5, 0 * places, 0.1 * np.sin(np.pi * places)], axis=1)
    scene = nc.Scene()
    arch = scene.add(nc.Beam(section, points, elements=8, second=(0, 1, 0)))
    for end, point in ((arch.start, points[0]), (arch.end, points[-1])):
        scene.add(nc.Revolute(nc.ground, end, point=point, axis=(0, 1, 0)))
    top = arch.nodes[4]
    scene.add(nc.PointForce((nc.Point(top, points[4]),), force=lambda t: jnp.array([0, 0, -1.0]) * t))
    system, state = scene.compile()
    # Beyond the limit point, at once: downhill to the shape on the other side.
    through = nc.equilibrium(system, state, 30.0, steps=1)
    assert float(system.sense(through.state, top).position[2]) < -0.1
    path = nc.load_path(system, state, arc=0.05, steps=30, scale=100.0)
    loads, height = np.asarray(path.states.t), np.asarray(system.sense(path.states, top).position[:, 2])
    most = int(np.argmax(loads))
    assert 0 < most < 29 and loads.min() < 0 and np.all(np.diff(height[: most + 3]) < 0)


# --- loads along beams ------------------------------------------------------------------------------------


def straight(elements=8, *, interpolation=None, start=nc.ground, **load):
    """A metre of beam along x with a load along it."""
    scene, section = nc.Scene(), nc.Section.of_numbers(**NUMBERS)
    given = {} if interpolation is None else {"interpolation": interpolation}
    beam = scene.add(
        nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=elements, second=(0, 1, 0), start=start, **given)
    )
    if load:
        scene.add(nc.LineLoad(beam, **load))
    else:
        scene.add(nc.Gravity())
    return *scene.compile(), beam


@pytest.mark.slow
@pytest.mark.parametrize("interpolation", [None, nc.DirectorInterpolation(order=2)])
def test_a_load_along_a_beam_can_be_its_weight(interpolation):
    weight = (0.0, 0.0, -9.81 * NUMBERS["density"])
    found = []
    for load in ({}, {"force": weight}, {"force": lambda t: jnp.asarray(weight)}):
        system, state, _ = straight(interpolation=interpolation, **load)
        found.append(nc.simulate(system, state, dt=0.01, steps=10).q)
    assert float(jnp.max(jnp.abs(found[0] - found[0][0]))) > 0.01
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=0, atol=tol.SAME_TRAJECTORY)


@pytest.mark.parametrize(
    ("profile", "deflection"), [(None, 1 / 8), (lambda x: 1.0 - x, 1 / 30), (lambda x: x, 11 / 120)]
)
def test_deflection_under_a_load_along_the_beam(profile, deflection):
    """Of a slender cantilever, in q L^4 / (E I)."""
    load = {"force": (0.0, 0.0, -1e-4), "profile": profile}
    system, state, beam = straight(**load)
    height = tip(system, nc.equilibrium(system, state).state, beam)[2]
    shear = {1 / 8: 1 / 2, 1 / 30: 1 / 6, 11 / 120: 1 / 3}[deflection] / NUMBERS["GA"]
    bending = NUMBERS["EI"][0]
    # An even load is exact, others are to the square of the elements' length.
    wanted, off = -1e-4 * (deflection / bending + shear), 1e-6 if profile is None else 2 / 8**2
    assert height == pytest.approx(wanted, rel=off)


def test_a_following_load_turns_with_the_beam():
    """A rod that spins and is pushed along itself: its momentum is the integral of the turning force."""
    rate, push, twist = 2.0, 3.0, 0.5
    scene, section = nc.Scene(), nc.Section.of_numbers(**(NUMBERS | {"EI": 1e4, "GA": 1e5, "EA": 1e6}))
    spin = {"angular_velocity": (0, 0, rate), "velocity": (0, -0.5 * rate, 0)}
    rod = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, second=(0, 0, 1), **spin))
    scene.add(nc.LineLoad(rod, force=(0, 0, push), moment=lambda t: jnp.array([twist, 0, 0]), following=True))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=200)
    t = np.asarray(trajectory.t)
    turning = np.asarray(system.angular_momentum(trajectory))[:, 2]
    inertia = turning[0] / rate
    # The moment about d_1, which is z, speeds it up.
    angle = rate * t + 0.5 * twist / inertia * t**2
    steps = 0.5 * (np.exp(1j * angle[1:]) + np.exp(1j * angle[:-1])) * 1e-3 * push
    momentum = np.asarray(system.momentum(trajectory))
    wanted = np.cumsum(steps)
    off = momentum[1:, 0] + 1j * momentum[1:, 1] - wanted
    assert np.abs(off).max() < 2e-3 * abs(wanted[-1])


def test_a_wrong_load_along_a_beam_is_named():
    with pytest.raises(ValueError, match="neither force"):
        straight(following=True)
    with pytest.raises(ValueError, match=r"force.*N/m"):
        straight(force=(1.0, 2.0))
    with pytest.raises(ValueError, match="what scene.add"):
        nc.Scene().add(nc.LineLoad(nc.ground, force=(0, 0, 1)))
    clamp = nc.Attachment(nc.ground, (0, 0, 0), np.eye(3))
    for marker in (clamp, nc.Direction(nc.ground, (0, 0, 1))):
        with pytest.raises(ValueError, match="pass 1 nc.Point"):
            nc.PointForce((marker,), force=(0, 0, 1))
    with pytest.raises(ValueError, match="1 nc.Point and 3 nc.Direction"):
        nc.PointForce((nc.Point(nc.ground),), force=(0, 0, 1), following=True)


# --- errors -----------------------------------------------------------------------------------------------


def test_wrong_input_is_named():
    section = nc.Section.of_numbers(**NUMBERS)
    scene = nc.Scene()
    with pytest.raises(ValueError, match="EA"):
        nc.Section.of_numbers(**NUMBERS | {"EA": -1.0})
    with pytest.raises(ValueError, match=r"curve \[m\] has shape"):
        scene.add(nc.Beam(section, [(0, 0, 0)], elements=2))
    with pytest.raises(ValueError, match="coincide"):
        scene.add(nc.Beam(section, [(0, 0, 0), (0, 0, 0)], elements=2))
    with pytest.raises(ValueError, match="elements is 0"):
        scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=0))
    with pytest.raises(ValueError, match="length"):
        scene.add(nc.Beam(section, lambda s: jnp.stack([s, 0 * s, 0 * s]), elements=2))
    with pytest.raises(ValueError, match="order is 4"):
        nc.DirectorInterpolation(order=4)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, stations=(0.3,)))
    assert beam.at(0.3) in beam.nodes
    with pytest.raises(ValueError, match="stations="):
        beam.at(0.4)
    mass = scene.add(nc.PointMass(mass=1.0))
    with pytest.raises(ValueError, match="which has no orientation"):
        scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, start=mass))


def test_mass_properties_of_a_beam_with_a_body_at_its_end():
    """The end of a beam is rigidly part of a body: total mass, centre and inertia are those of both."""
    section = nc.Section.of_numbers(**NUMBERS)
    scene = nc.Scene()
    turn = (0, 1, 0), 0.4
    plug = scene.add(nc.RigidBody(mass=3.0, inertia=(0.1, 0.2, 0.25), position=(1, 0, 0.2), orientation=turn))
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=4, end=plug))
    system, state = scene.compile()
    assert beam.end == plug and len(system.structure.bodies) == 5
    # Lumps of density 2 kg/m, with rotary inertia 0.01 kg m across and 0.02 kg m along.
    places = np.linspace(0, 1, 5)[:, None] * [1.0, 0, 0]
    shares = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    parts = [(2 * w, x, w * np.diag([0.02, 0.01, 0.01])) for w, x in zip(shares, places)]
    rotation = np.asarray(from_rotation_vector(0.4 * jnp.array([0.0, 1.0, 0.0])))
    parts.append((3.0, np.array([1, 0, 0.2]), rotation @ np.diag([0.1, 0.2, 0.25]) @ rotation.T))
    first = sum(m * x for m, x, _ in parts)
    inertia = sum(m * (x @ x * np.eye(3) - np.outer(x, x)) + own for m, x, own in parts)
    drift, spin = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.7, -0.4])
    rows = np.asarray(state.q).reshape(-1, 4, 3)
    v = np.cross(spin, rows)
    v[:, 0] += drift
    moving = replace_fields(state, v=jnp.asarray(v.reshape(-1, 3)))
    momentum, turning = 5 * drift + np.cross(spin, first), inertia @ spin + np.cross(first, drift)
    np.testing.assert_allclose(system.momentum(moving), momentum, rtol=0, atol=ROUNDING * 5)
    np.testing.assert_allclose(system.angular_momentum(moving), turning, rtol=0, atol=ROUNDING * 5)
    kinetic = 2.5 * drift @ drift + drift @ np.cross(spin, first) + 0.5 * spin @ inertia @ spin
    assert float(system.energy(moving).kinetic) == pytest.approx(kinetic, rel=ROUNDING)
    assert float(system.energy(state).kinetic) == 0.0
