"""Frequencies and dampings of beams, shells and a drum against exact ones, and their order in the elements.

Could go wrong: masses on the wrong rows, constraints of a loop that stiffen, centrifugal forces that stiffen
nothing, offsets of the mass that do not couple, prestress that is forgotten.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import LINE, DirectorInPlane, hold, richardson, with_rows
from scipy.linalg import eigh

import natcoord_jax as nc

# --- shells: the wave numbers of thin plates ----------------------------------------------------------------

THIN = 0.005
"""Thickness, by the size."""
METAL = nc.Elastic(E=12e6 * (1 - 0.3**2) / THIN**2, nu=0.3, density=1.0)
"""Frequencies are sqrt(1e6) times those of bending stiffness, mass and side of one."""


def strip(count, **more):
    """A strip of 10 m by 1 m, clamped, with a first frequency of 10 Hz."""
    scene, metal = nc.Scene(), nc.Elastic(E=1.2e6, density=3.1314e-4)
    mesh = nc.mesh.rectangle((10.0, 1.0), (count, 1))
    shell = scene.add(nc.Shell(mesh, thickness=0.1, material=metal, name="plate", **more))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    return scene.compile()


@pytest.mark.slow
def test_a_strip_has_the_frequency_of_a_beam_and_its_derivatives():
    """10 Hz; as the thickness, the root of the modulus, and that of one over the density."""
    system, state = strip(4)

    @jax.jit
    def lowest(thickness, E, density):
        changed = system.set("plate", thickness=thickness, E=E, density=density)
        return nc.modes(changed, state, damped=False).frequencies[0]

    numbers = 0.1, 1.2e6, 3.1314e-4
    value, slopes = jax.value_and_grad(lowest, argnums=(0, 1, 2))(*numbers)
    assert float(value) / (2 * np.pi) == pytest.approx(9.834, abs=1.5e-3)
    powers = [float(x * number / value) for x, number in zip(slopes, numbers)]
    np.testing.assert_allclose(powers, (1.0, 0.5, -0.5), atol=2e-3)


@pytest.mark.exhaustive
def test_a_finer_strip_is_nearer_by_order_two():
    coarse, fine = (float(nc.modes(*strip(n)).frequencies[0]) / (2 * np.pi) for n in (4, 8))
    np.testing.assert_allclose((coarse, fine), (9.834, 9.958), atol=1.5e-3)
    assert np.log2((10.0 - coarse) / (10.0 - fine)) == pytest.approx(2.0, abs=0.1)


@pytest.mark.exhaustive
def test_an_offset_changes_nothing_but_where_nodes_are():
    """A strip with its nodes on its lower side has the frequencies of that with them in the middle."""
    middle, side = (nc.modes(*strip(4, **more)).frequencies[:4] for more in ({}, {"offset": 0.05}))
    np.testing.assert_allclose(side, middle, rtol=1e-6)


@pytest.mark.exhaustive
def test_damping_ratios_are_half_the_time_times_the_frequency():
    modes = nc.modes(*strip(4, damping=1e-3))
    np.testing.assert_allclose(modes.damping[:3], 0.5e-3 * np.abs(modes.s[:3]), rtol=1e-4)


def frequencies(shell, mount=lambda scene, shell: None, count=12):
    """Of a scene with one shell [rad/s]."""
    scene = nc.Scene()
    mount(scene, scene.add(shell))
    return np.asarray(nc.modes(*scene.compile(), count=count, damped=False).frequencies)


def square(count):
    return nc.Shell(nc.mesh.rectangle((1.0, 1.0), (count, count)), thickness=THIN, material=METAL)


def simply_supported(scene, shell):
    """Edges stay where they are, and directors there turn about the edge only."""
    for names, across in ((("left", "right"), 1), (("bottom", "top"), 0)):
        for name in names:
            inner = shell.set(name)[1:-1]
            for component in range(3):
                hold(scene, inner, component)
            axis = nc.Direction(nc.ground, np.eye(3)[across])
            for node in inner:
                scene.add(DirectorInPlane((axis, nc.Direction(node, (0, 0, 1)))))
    corners = shell.nodes.where(lambda x: np.all(np.abs(x[:, :2] - 0.5) > 0.5 - 1e-9, axis=1))
    scene.add(nc.Clamp(nc.ground, corners))


@pytest.mark.exhaustive
def test_simply_supported_plate():
    """pi^2 (m^2 + n^2): exact for thin plates."""
    exact = np.pi**2 * np.array([2.0, 5.0, 5.0])
    coarse, fine = (frequencies(square(count), simply_supported, 3) / 1e3 / exact - 1 for count in (4, 8))
    assert np.all(np.abs(fine) < 0.01)
    # Masses and stiffnesses err in opposite ways, and for the others one takes over from the other.
    assert np.log2(coarse[0] / fine[0]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.exhaustive
def test_free_square_plate():
    """13.489, 19.789 and 24.432 by Leissa (J. Sound Vib. 31, 1973); finer series are 0.2 to 1 % below."""
    coarse, fine = (frequencies(square(count)) / 1e3 for count in (4, 8))
    assert np.all(fine[:6] < 1e-3 * fine[6]), "no six rigid motions"
    exact = np.array([13.468, 19.596, 24.270])
    np.testing.assert_allclose(np.log2((coarse[6:9] - exact) / (fine[6:9] - exact)), 2.0, atol=0.3)
    np.testing.assert_allclose(richardson(coarse[6:9], fine[6:9]), exact, rtol=0.015)


@pytest.mark.exhaustive
def test_free_ring():
    """n (n^2 - 1) / sqrt(n^2 + 1): a cylinder that bends without being stretched (Rayleigh)."""
    errors, rubber = [], nc.Elastic(E=12e6 / 0.01**2, density=1.0)
    for count in (16, 32):
        shell = nc.Shell(nc.mesh.cylinder(1.0, 1.0, (count, 1)), thickness=0.01, material=rubber)
        pair = frequencies(shell)[6:8] / 1e3
        assert pair[0] == pytest.approx(pair[1], rel=1e-6)
        errors.append(pair[0] / (6 / np.sqrt(5)) - 1)
    assert abs(errors[1]) < 0.01
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


@pytest.mark.exhaustive
def test_prestress_of_a_drum():
    """Its frequency is exact to order two, and grows with the root of the prestress."""
    foil, tension = nc.Elastic(E=1e7, nu=0.0, density=2.0), np.array([50.0, 50.0, 0.0])
    exact, lowest = np.pi * np.sqrt(2 * 50.0 / (2.0 * 0.01)), []
    for count in (4, 8):
        scene, mesh = nc.Scene(), nc.mesh.rectangle((1.0, 1.0), (count, count))
        more = {"thickness": 0.01, "material": foil, "bending": False, "prestress": tension}
        skin = scene.add(nc.Shell(mesh, **more, name="skin"))
        edge = skin.nodes.where(lambda x: np.any(np.abs(x[:, :2] - 0.5) > 0.5 - 1e-9, axis=1))
        scene.add(nc.Clamp(nc.ground, edge))
        system, state = scene.compile()

        @jax.jit
        def first(factor, system=system, state=state):
            changed = system.set("skin", prestress=factor * tension)
            return nc.modes(changed, state, damped=False).frequencies[0]

        value, slope = jax.value_and_grad(first)(1.0)
        lowest.append(float(value))
        assert float(slope) == pytest.approx(0.5 * float(value), rel=1e-6)
    assert np.log2((lowest[0] - exact) / (lowest[1] - exact)) == pytest.approx(2.0, abs=0.2)
    assert lowest[1] == pytest.approx(exact, rel=0.02)


# --- beams --------------------------------------------------------------------------------------------------

STEEL = {"radius": 0.01, "E": 2e11, "density": 7800.0}
ROOTS = {True: (1.87510407, 4.69409113), False: (4.73004074, 7.85320462)}
RADIUS_OF_GYRATION = STEEL["radius"] / 2
"""Of a circle, and of its area: the same number [m]."""


def mean_squares(beta, clamped, order):
    """Mean squares of a derivative of Euler-Bernoulli's shapes over those of the shapes themselves.

    Of the shape cosh - cos - s (sinh - sin) of a clamped end, and with the other signs of a free one, s given
    by no moment at the free end at x = 1.
    """
    x, sign, quotients = np.linspace(0.0, 1.0, 20001), 1 if clamped else -1, []
    for b in beta:
        weight = (np.cosh(b) + sign * np.cos(b)) / (np.sinh(b) + sign * np.sin(b))
        cos, sin = np.cos(b * x), np.sin(b * x)
        hyperbolic = [np.cosh(b * x) - weight * np.sinh(b * x), np.sinh(b * x) - weight * np.cosh(b * x)]
        turning = [(-cos + weight * sin), (sin + weight * cos), (cos - weight * sin), (-sin - weight * cos)]
        shapes = [hyperbolic[k % 2] + sign * turning[k] for k in range(4)]
        square = np.trapezoid(shapes[order] ** 2, x) / np.trapezoid(shapes[0] ** 2, x)
        quotients.append(b ** (2 * order) * square)
    return np.array(quotients)


@pytest.mark.parametrize(
    "clamped",
    [pytest.param(True, marks=pytest.mark.slow), pytest.param(False, marks=pytest.mark.exhaustive)],
)
def test_slender_beams_have_euler_and_bernoullis_frequencies(clamped):
    """Of a slender cantilever and of a free beam, by Richardson's formula.

    Corrected for shear and rotary inertia by Rayleigh's quotient with Euler-Bernoulli's shapes phi:

        omega^2 = omega_0^2 (1 - (I / A) int phi'^2 / int phi^2 - (EI / GA) int phi'''^2 / int phi''^2).
    """
    section = nc.CircularSection(**STEEL)
    stiffness, inertia = np.asarray(section.stiffness), np.asarray(section.inertia)
    unit, pairs = np.sqrt(float(stiffness[3, 3] / inertia[0, 0])), []
    for elements in (16, 32):
        scene = nc.Scene()
        start = nc.ground if clamped else None
        scene.add(nc.Beam(section, LINE, elements=elements, start=start))
        all_of_them = np.asarray(nc.modes(*scene.compile()).frequencies)
        pairs.append(all_of_them[0 if clamped else 6 :: 2][:2])
        if not clamped:
            assert np.all(all_of_them[:6] < 1e-3 * all_of_them[6])
    beta = np.array(ROOTS[clamped])
    slope, third = (mean_squares(beta, clamped, order) for order in (1, 3))
    lag = RADIUS_OF_GYRATION**2 * slope + stiffness[3, 3] / stiffness[0, 0] * third / beta**4
    assert np.all(lag > 4e-4)  # beyond the tolerance below: it is seen
    np.testing.assert_allclose(richardson(*pairs), unit * beta**2 * np.sqrt(1 - lag), rtol=1e-4)


PIECES = 8


def chain_frequencies(section, n):
    """Frequencies of n half-waves of a chain of elements on hinges about d_1, coupled to torsion.

    Nodal sines of deflection and twist and cosines of the slope solve the chain's equations exactly, with

        K = -2 sin(k l / 2) / l slope,    Gamma = 2 sin(k l / 2) / l deflection - cos(k l / 2) slope.
    """
    (shear, _, _, bending, _, torsion), mass = np.diag(section.stiffness), np.asarray(section.inertia)
    half = 0.5 * n * np.pi / PIECES
    s, c = 2 * PIECES * np.sin(half), np.cos(half)
    across = -shear * s * c
    bent = bending * s * s + shear * c * c
    stiffness = np.array([[shear * s * s, across, 0], [across, bent, 0], [0, 0, torsion * s * s]])
    # Along the hinges, d_1, is theta^1: the offset along it couples deflection and twist.
    about_first, about = mass[2, 2], mass[1, 1] + mass[2, 2]
    inertia = np.array([[mass[0, 0], 0, mass[0, 1]], [0, about_first, 0], [mass[0, 1], 0, about]])
    return np.sqrt(eigh(stiffness, inertia, eigvals_only=True))


@pytest.mark.exhaustive
def test_beams_between_hinges():
    """Could go wrong: an offset of the mass that does not couple, constraints of a loop that stiffen.

    Bending is at n^2 pi^2 sqrt(EI / m L^4), and coupled to torsion at the roots of

        (EI k^4 - m w^2) (GJ k^2 - I w^2) = m^2 e^2 w^4,    I = I_c + m e^2,

    up to shear, rotary inertia and the mesh, which the chain's equations contain.
    """
    rotary = (1e-4, 2e-3)
    numbers = {"EA": 1e5, "GA": 1e5, "EI": (1.0, 50.0), "GJ": 1.5, "density": 2.0, "rotary": rotary}
    for aside in (0.0, 0.05):
        section, scene = nc.Section.of_numbers(**numbers, centre=(aside, 0.0)), nc.Scene()
        beam = scene.add(nc.Beam(section, LINE, elements=PIECES, second=(0, 1, 0)))
        for end, point in zip((beam.start, beam.end), LINE):
            scene.add(nc.Revolute(nc.ground, end, point=point, axis=(0, 1, 0)))
        modes = np.asarray(nc.modes(*scene.compile()).frequencies)
        for n in (1, 2, 3):
            chain = chain_frequencies(section, n)[:2]
            nearest = modes[np.argmin(np.abs(modes[:, None] - chain), axis=0)]
            np.testing.assert_allclose(nearest, chain, rtol=1e-8)
            k, m, about = n * np.pi, 2.0, sum(rotary) + 2.0 * aside**2
            product = [m * about - (m * aside) ** 2, -(k**4 * about + 1.5 * k**2 * m), 1.5 * k**6]
            exact = np.sort(np.sqrt(np.roots(product)))
            # Of the chain: (k l)^2 / 24 and its square; shear and rotary inertia are below 2e-3.
            np.testing.assert_allclose(nearest, exact, rtol=1.2 * (k / PIECES) ** 2 / 24 + 2e-3)
        if aside == 0:
            assert modes[0] == pytest.approx(np.pi**2 / np.sqrt(2), rel=0.01)


# --- in rotation --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_mass_on_a_spring_in_rotation():
    """Could go wrong: half of the centrifugal force, or a Coriolis force of the wrong sign. With W the rate,

        w^2 = k / m - W^2 + 4 W^2 m r^2 / (I + m r^2),

    of a mass on a radial spring, at r on a carrier of inertia I that is free to turn.
    """
    rate, mass, stiffness, radius = 3.0, 0.7, 40.0, 1.2
    for about in (1e9, 0.5):  # other numbers, the same program
        spin, scene = (0.0, 0.0, rate), nc.Scene()
        carrier = scene.add(nc.RigidBody(mass=1.0, inertia=(about, about, about), angular_velocity=spin))
        motion = {"position": (radius, 0, 0), "velocity": (0, rate * radius, 0), "angular_velocity": spin}
        slider = scene.add(nc.RigidBody(mass=mass, inertia=(1e-9, 1e-9, 1e-9), **motion))
        scene.add(nc.Revolute(nc.ground, carrier, axis=(0, 0, 1)))
        scene.add(nc.Prismatic(carrier, slider, axis=(1, 0, 0)))
        ends = (nc.Point(carrier), nc.Point(slider, (radius, 0, 0)))
        scene.add(nc.Spring(ends, stiffness=stiffness, length=radius * (1 - mass * rate**2 / stiffness)))
        roots = np.asarray(nc.modes(*scene.compile(), rotation=spin).s)
        square = stiffness / mass - rate**2 + 4 * rate**2 * mass * radius**2 / (about + mass * radius**2)
        swinging = roots[np.argmax(np.abs(roots.imag))]
        assert abs(swinging.imag) == pytest.approx(np.sqrt(square), rel=1e-7)
        assert abs(swinging.real) < tol.FIRST_ORDER


FLAPS = {0.0: (3.5160, 22.0345), 2.0: (4.1373, 22.6149), 10.0: (11.2023, 33.6404)}


@pytest.mark.exhaustive
def test_a_rotating_cantilever():
    """Could go wrong: no stiffening by the centrifugal force, or none of its softening in the plane.

    Wright, Smith, Thresher & Wang, Vibration modes of centrifugally stiffened beams (1982), without a hub's
    radius: flap out of the plane of rotation; in it w^2 is less by the square of the rate.
    """
    pieces, stretch, heavy = 16, 1e6, 1e7
    section = nc.Section.of_numbers(EA=stretch, GA=1e6, EI=1.0, GJ=1e3, density=1.0, rotary=1e-6)
    scene = nc.Scene()
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(heavy, heavy, heavy)))
    scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1)))
    beam = scene.add(nc.Beam(section, LINE, elements=pieces, start=hub, second=(0, 1, 0)))
    system, state = scene.compile()
    # The steady stretch of a chain of masses on springs, exactly: the beam is straight.
    shares, ties = np.asarray(beam.shares), stretch * pieces
    springs = ties * (2 * np.eye(pieces) - np.eye(pieces, k=1) - np.eye(pieces, k=-1))
    springs[-1, -1] = ties
    pull = np.zeros(pieces)
    pull[-1] = stretch
    for rate, flap in FLAPS.items():
        radii = np.linalg.solve(springs - rate**2 * np.diag(shares[1:]), pull)
        rows, spin = np.array(state.rows), np.array([0, 0, rate])
        for node, radius in zip(beam.nodes[1:], radii):
            rows[system.body_index(node), 0] = [radius, 0, 0]
        steady = with_rows(state, rows, np.cross(spin, rows))
        modes = nc.modes(system, steady, rotation=jnp.asarray(spin), damped=True, count=8)
        tips = np.abs(np.asarray(modes.shapes)[:, 4 * system.body_index(beam.end)])
        out, within = (np.asarray(modes.frequencies)[np.argmax(tips, axis=1) == k] for k in (2, 1))
        lag = np.sqrt(np.square(flap) - rate**2)
        np.testing.assert_allclose(out[:2], flap, rtol=5e-3)
        np.testing.assert_allclose(within[within > 0.1][:2], lag, rtol=5e-3)
