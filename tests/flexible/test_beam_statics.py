"""Equilibria of beams that are exact or published: bent, twisted, pushed, in frames, and beyond limit points.

Could go wrong: data of a section that end up on the wrong axis, section forces that are not those of statics,
shear that cannot vanish in bending, meshes that do not converge to Reissner's equations. Cases B01, B02 and
B05 of the references: pure bending, the 45 degree bend (Bathe & Bolourchi 1979) and the cantilever of
Nachbagauer (2011) as Exudyn's test models have it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import (
    AXES,
    BOTH,
    CUTS,
    LINE,
    NUMBERS,
    RAMP,
    grows,
    odd,
    place_of,
    push,
    richardson,
    rod,
    solved,
    turn_of,
    with_rows,
)
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import natcoord_jax as nc

# --- a rod with loads at its end, one program ---------------------------------------------------------------


def test_pure_bending_rolls_up_to_a_circle():
    """B01, to round-off, with K_1 = M / EI_1 in all elements, at turns of three radians and of six."""
    moment = 2 * np.pi * NUMBERS["EI"][0]
    system, states, beam = solved(torque=(0, -moment, 0), loads=RAMP)
    angle = 2 * np.pi * RAMP
    exact = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1) / angle[:, None]
    np.testing.assert_allclose(place_of(system, states, beam.end), exact, rtol=0, atol=tol.EXACT_STATICS)
    bent = system.sense(states, beam.elements)
    wanted = np.zeros((2, 4, 6))
    wanted[..., 3] = -RAMP[:, None] * moment
    # Roundings of places are stretched by EA.
    np.testing.assert_allclose(bent.resultant, wanted, rtol=0, atol=tol.EXACT_STATICS * NUMBERS["EA"])
    curvature = wanted[..., 3] / NUMBERS["EI"][0]
    np.testing.assert_allclose(bent.strain[..., 3], curvature, rtol=0, atol=tol.EXACT_STATICS)


def test_section_forces_are_those_of_statics():
    """Could go wrong: axes, signs and lengths of what the sensor of an element shows.

    N and M of a cantilever with a force and a torque at its end; the mid-point moment is exact in each
    element. Their energies add to what is stored, half of the load's work (Clapeyron).
    """
    force, torque = np.array([3e-4, 2e-4, -1e-4]), np.array([1e-4, -2e-4, 3e-4])
    system, states, beam = solved(force=force, torque=torque)
    sensed = system.sense(states, beam.elements)
    arm = 1 - 0.5 * (CUTS[1:] + CUTS[:-1])
    fx, fy, fz = force
    normal = np.broadcast_to([fy, fz, fx], (4, 3))
    moments = [torque[1] - arm * fz, torque[2] + arm * fy, torque[0] + 0 * arm]
    wanted = np.concatenate([normal, np.stack(moments, axis=1)], axis=1)
    scale = np.repeat([np.abs(force).max(), np.abs(torque).max()], 3)
    np.testing.assert_allclose(odd(sensed.resultant) / scale, wanted / scale, rtol=0, atol=tol.FIRST_ORDER)
    stiffness = np.array([*NUMBERS["GA"], NUMBERS["EA"], *NUMBERS["EI"], NUMBERS["GJ"]])
    linear = stiffness * np.asarray(sensed.strain)
    np.testing.assert_allclose(sensed.resultant, linear, rtol=tol.SOME_ROUNDINGS)
    stored = np.sum(np.asarray(sensed.energy), axis=1)
    # Roundings of places of a metre are 1e-12 of strains like these.
    np.testing.assert_allclose(stored, system.energy(states).total, rtol=1e-10)
    tip = system.sense(states, beam.end)
    work = 0.5 * (force @ odd(tip.position) + torque @ odd(turn_of(tip.rotation)))
    assert np.mean(stored) == pytest.approx(work, rel=tol.FIRST_ORDER)
    # One element alone: the same without the axis of the elements.
    alone = system.sense(states, beam.elements[2])
    np.testing.assert_array_equal(alone.resultant, sensed.resultant[:, 2])


def test_a_wrench_bends_uneven_elements_to_a_helix():
    """Could go wrong: strains that are coupled in the element.

    A wrench along the axis of the screw of which a strain e is the twist, f = (n, m) with n = a K and
    m = a (Gamma + e_3) + b K, is in equilibrium with e everywhere; with a stiffness of C e = f, uneven
    elements find the end of the helix to round-off.
    """
    gamma, curvature = np.array([0.15, -0.1, 0.05]), np.array([0.9, -0.7, 0.5])
    strain, shape = np.concatenate([gamma, curvature]), gamma + [0, 0, 1.0]
    wrench = np.concatenate([2.0 * curvature, 2.0 * shape + 3.0 * curvature])
    assert wrench @ strain > 0
    plain = np.diag([50.0, 40.0, 100.0, 2.0, 3.0, 2.5])
    pull = plain @ strain
    stiffness = plain - np.outer(pull, pull) / (strain @ pull) + np.outer(wrench, wrench) / (wrench @ strain)
    section = nc.Section(jnp.asarray(stiffness), nc.Section.of_numbers(**NUMBERS).inertia)
    end = expm(screw(strain))
    rotation = AXES @ end[:3, :3]
    loads = {"force": rotation @ wrench[:3], "torque": rotation @ wrench[3:]}
    system, states, beam = solved(section, loads=RAMP, **loads)
    sensed, place = system.sense(states, beam.end), AXES @ end[:3, 3]
    np.testing.assert_allclose(sensed.position[1], place, rtol=0, atol=tol.EXACT_STATICS)
    np.testing.assert_allclose(sensed.rotation[1], rotation, rtol=0, atol=tol.EXACT_STATICS)
    strains = np.asarray(system.sense(states, beam.elements).strain)[1]
    np.testing.assert_allclose(strains, np.broadcast_to(strain, (4, 6)), rtol=0, atol=tol.EXACT_STATICS)


def screw(strain):
    """The twist per length (4, 4) of a constant strain."""
    twist, k = np.zeros((4, 4)), strain[3:]
    twist[:3, :3] = [[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]]
    twist[:3, 3] = strain[:3] + [0, 0, 1.0]
    return twist


@pytest.mark.exhaustive
def test_stretch_and_torsion_are_exact():
    line = [(0, 0, 0), (0, 0, 1.0)]
    more = {"elements": 3, "stations": (0.2, 0.35), "loads": [0.0, 1.0]}
    system, states, beam = solved(curve=line, force=(0, 0, 30.0), torque=(0, 0, 0.9), **more)
    sensed = system.sense(states, beam.end)
    np.testing.assert_allclose(sensed.position[1], [0, 0, 1.003], rtol=0, atol=tol.SOME_ROUNDINGS)
    turned = Rotation.from_rotvec([0, 0, 0.6]).as_matrix() @ np.asarray(sensed.rotation[0])
    np.testing.assert_allclose(sensed.rotation[1], turned, rtol=0, atol=tol.SOME_ROUNDINGS)


@pytest.mark.exhaustive
def test_equilibria_do_not_depend_on_the_path():
    """Bent by a radian, from the straight rod or from what the opposite load makes of it."""
    system, state, beam = rod(force=(0.5, 2.0, 1.0))
    direct, around = (nc.equilibrium(system, state, jnp.asarray(x)).state for x in (RAMP, [-1.0, 1.0]))
    np.testing.assert_allclose(direct.q, around.q, rtol=0, atol=tol.EXACT_STATICS)
    assert abs(place_of(system, direct, beam.end)[1]) > 0.2


WAYS = [
    nc.RelativeMotion(),
    pytest.param(nc.DirectorInterpolation(order=1), marks=pytest.mark.exhaustive),
]


@pytest.mark.parametrize("interpolation", WAYS)
def test_slender_beams_do_not_lock(interpolation):
    """Could go wrong: shear that cannot vanish in bending. Error of the tip by GA L^2 / EI from 1e2 to 1e10:

    that of the mid-point rule for the moment, sum of l^3 / 12 of P L^3 / 3 EI, and no more for any of them.
    """
    load, bending, ratios = 0.02, NUMBERS["EI"][0], 10.0 ** np.arange(2, 11, 2)
    sags = []
    for stiff in ratios * bending:  # other numbers, the same program
        section = nc.Section.of_numbers(**NUMBERS | {"GA": stiff, "EA": stiff})
        system, states, beam = solved(section, force=(0, 0, load), interpolation=interpolation)
        sags.append(odd(place_of(system, states, beam.end))[2])
    wanted = load * ((1 / 3 - np.sum(np.diff(CUTS) ** 3) / 12) / bending + 1 / (ratios * bending))
    # The tip turns by a hundredth: its square over some ten is beyond first order.
    np.testing.assert_allclose(sags, wanted, rtol=2e-4)


@pytest.mark.exhaustive
def test_a_centre_of_mass_beside_the_axis_twists():
    """Under its weight q = m g a horizontal rod with centres of mass at e beside it twists by

    q e L^2 / (2 GJ), exactly with any mesh.
    """
    aside, gravity = 0.02, 1e-4
    section = nc.Section.of_numbers(**NUMBERS, centre=(aside, 0.0))
    system, states, beam = solved(section, gravity=(0, 0, -gravity))
    twisted = turn_of(system.sense(states, beam.end).rotation)[0, 0]
    weight = NUMBERS["density"] * gravity
    assert twisted == pytest.approx(-weight * aside / (2 * NUMBERS["GJ"]), rel=tol.FIRST_ORDER)


@pytest.mark.exhaustive
def test_a_twisted_strip_bends_about_its_turned_axes():
    """Could go wrong: twist of the frames only. Tip of a cantilever with axes that turn by a right angle:

    kappa = R(s) diag(1/EI_1, 1/EI_2) R(s)^T M(s), integrated twice; the force across also moves it sideways.
    """
    angle, load = 0.5 * np.pi, np.array([0.0, 0.0, 1e-4])
    section = nc.Section.of_numbers(**NUMBERS | {"EI": (0.2, 2.0), "GA": 5e3})
    tips = []
    for elements in (4, 8):
        system, states, beam = solved(section, elements=elements, twist=angle, force=load)
        tips.append(odd(place_of(system, states, beam.end)))
    x, weights = np.polynomial.legendre.leggauss(40)
    moved = np.array([0.0, load[2] / 5e3])
    for s, w in zip(0.5 + 0.5 * x, 0.5 * weights):
        c, n = np.cos(angle * s), np.sin(angle * s)
        turned = np.array([[c, -n], [n, c]])
        # Moments and curvatures about y and z; turning about y lowers the tip, about z moves it to y.
        curvature = turned @ np.diag([1 / 0.2, 1 / 2.0]) @ turned.T @ np.array([-(1 - s) * load[2], 0.0])
        moved += w * (1 - s) * np.array([curvature[1], -curvature[0]])
    assert abs(moved[0]) > 0.1 * moved[1]
    np.testing.assert_allclose(richardson(*tips)[1:], moved, rtol=0, atol=2e-3 * moved[1])


@pytest.mark.exhaustive
def test_a_force_that_follows_the_tip():
    """Could go wrong: components along the axes of the first pose. A cantilever under a force along its d_2:

    from the tip, where section forces are known, Reissner's equations are integrated back to the clamp.
    """
    load, bending, shear, stretch = 2.0, 1.0, 5e3, 1e4
    tips = []
    for elements in (4, 8):
        section = nc.Section.of_numbers(**NUMBERS | {"GA": shear})
        system, states, beam = solved(section, elements=elements, following=(0, load, 0), loads=RAMP)
        tips.append(place_of(system, states, beam.end)[1])

    def back(_, y):
        # Position and angle in the frame of the tip, where the force is (0, load); moment about y.
        angle, moment = y[2:]
        c, s = np.cos(angle), np.sin(angle)
        along, across = load * s / stretch, load * c / shear
        tangent = np.array([(1 + along) * c - across * s, (1 + along) * s + across * c])
        return [-tangent[0], -tangent[1], -moment / bending, load * tangent[0]]

    x, z, angle, _ = solve_ivp(back, (0, 1), [0, 0, 0, 0], rtol=1e-11, atol=1e-12).y[:, -1]
    # The clamp is at (x, z) and at this angle seen from the tip: turned so that it is at rest.
    c, s = np.cos(-angle), np.sin(-angle)
    wanted = -np.array([c * x - s * z, 0.0, s * x + c * z])
    assert abs(angle) > 0.9
    np.testing.assert_allclose(richardson(*tips), wanted, rtol=0, atol=5e-4)


HALF = {"EA": 5e3, "GA": (2.5e3, 2e3), "EI": (0.5, 1.0), "GJ": 0.75}
WEIGHTS = (2.5e3, 2e3, 5e3, 0.5, 1.0, 0.75)


def quadratic(strains):
    """The other half of the energy of `NUMBERS`, as a law [J/m]."""
    return 0.5 * jnp.sum(jnp.asarray(WEIGHTS) * strains**2)


@pytest.mark.exhaustive
def test_a_quadratic_law_is_linear_elasticity():
    """Could go wrong: a law in place of the section's energy, per element instead of per length."""
    load = {"force": (-2.0, 1.0, 2.0), "torque": (0.5, 0, 0), "loads": RAMP}
    sections = nc.Section.of_numbers(**NUMBERS), nc.Section.of_numbers(**NUMBERS | HALF)
    pairs = list(zip(sections, (None, quadratic)))
    bent = [solved(section, law=law, **load)[1].q[1] for section, law in pairs]
    assert np.abs(bent[0][-4] - np.array([1, 0, 0])).max() > 0.3
    np.testing.assert_allclose(bent[1], bent[0], rtol=0, atol=10 * tol.EXACT_STATICS)
    moved = []
    for section, law in pairs:
        system, state, _ = rod(section, law=law, gravity=(0, 2.0, -9.81))
        moved.append(nc.simulate(system, state, dt=0.02, steps=20).q)
    assert np.abs(moved[0][-1] - moved[0][0]).max() > 0.3
    np.testing.assert_allclose(moved[1], moved[0], rtol=0, atol=tol.SAME_TRAJECTORY)


# --- loads along beams --------------------------------------------------------------------------------------

PROFILES = [(None, 1 / 8, 1 / 2), (lambda x: 1.0 - x, 1 / 30, 1 / 6), (lambda x: x, 11 / 120, 1 / 3)]


@pytest.mark.exhaustive
def test_deflection_under_loads_along_a_beam():
    """Of a slender cantilever, in q L^4 / (E I), and in q L^2 / (G A)."""
    load, section = -1e-4, nc.Section.of_numbers(**NUMBERS)
    for profile, bent, sheared in PROFILES:
        scene = nc.Scene()
        beam = scene.add(nc.Beam(section, LINE, elements=8, second=(0, 1, 0), start=nc.ground))
        scene.add(nc.LineLoad(beam, force=(0.0, 0.0, load), profile=profile))
        system, state = scene.compile()
        height = place_of(system, nc.equilibrium(system, state).state, beam.end)[2]
        wanted = load * (bent / NUMBERS["EI"][0] + sheared / NUMBERS["GA"][1])
        # An even load is exact, others are to the square of the elements' length.
        off = tol.FIRST_ORDER if profile is None else 2 / 8**2
        assert height == pytest.approx(wanted, rel=off), bent


# --- frames -------------------------------------------------------------------------------------------------

BENDING, SHEAR, STRETCH = 2.0, 5e3, 1e7
SLENDER = {"EA": STRETCH, "GA": SHEAR, "EI": BENDING, "GJ": 1.5, "density": 1.0, "rotary": 0.01}


@pytest.mark.slow
def test_a_portal_with_a_rigid_corner_and_a_hinge():
    """Could go wrong: a corner that two beams share carries no moment, a hinge does.

    A clamped column of height h and a girder of length l, rigid between them, with a column on hinges under
    the girder's end. A force H along the girder moves the corner by H h^3 / 3 EI - Y l h^2 / 2 EI, where
    Y = H l h^2 / 2 / (l^3 / 3 + l^2 h) pushes up from the column on hinges.
    """
    height, span, load, pieces = 1.0, 1.5, 2e-4, 3
    scene, section = nc.Scene(), nc.Section.of_numbers(**SLENDER)
    top, far, foot = (0, 0, height), (span, 0, height), (span, 0, 0)
    more = {"elements": pieces, "second": (0, 1, 0)}
    column = scene.add(nc.Beam(section, [(0, 0, 0), top], start=nc.ground, name="column", **more))
    girder = scene.add(nc.Beam(section, [top, far], start=column.end, name="girder", **more))
    prop = scene.add(nc.Beam(section, [foot, far], elements=1, second=(0, 1, 0), name="prop"))
    scene.add(nc.Revolute(nc.ground, prop.start, point=foot, axis=(0, 1, 0)))
    scene.add(nc.Revolute(girder.end, prop.end, point=far, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.PointForce((nc.Point(column.end, top),), force=grows((load, 0, 0))))
    system, state = scene.compile()
    assert girder.start == column.end
    states = nc.equilibrium(system, state, jnp.asarray(BOTH)).states
    moved = odd(system.sense(states, column.end).position)[0]
    pushed = odd(system.sense(states, prop.elements[0]).resultant)[2]

    def sway(midpoint):
        """By the force method; integrals of squares of arms by the rule of the mesh, or exactly."""
        square = (1 - midpoint / (4 * pieces**2)) / 3
        up = span**3 * square + span**2 * height + BENDING * (span / SHEAR + 2 * height / STRETCH)
        force = load * span * height**2 / 2 / up
        back = force * span * height**2 / (2 * BENDING)
        return load * (height**3 * square / BENDING + height / SHEAR) - back, force

    wanted, force = sway(1.0)
    assert moved == pytest.approx(wanted, rel=2 * tol.FIRST_ORDER)
    # Places of a metre are rounded by 1e-16, and EA is 1e7 N.
    assert pushed == pytest.approx(-force, abs=1e-15 * STRETCH)
    assert moved == pytest.approx(sway(0.0)[0], rel=3 / (4 * pieces**2))
    # Moments of the corner, from the elements at both sides, by their arms.
    inner = [odd(system.sense(states, x).resultant)[3] for x in (column.elements[-1], girder.elements[0])]
    arm = 0.5 / pieces
    corner = force * span
    assert abs(inner[1]) == pytest.approx(corner * (1 - arm), rel=1e-5)
    assert abs(inner[0]) == pytest.approx(abs(corner - load * height * arm), rel=1e-5)


def flexibility(first, second, cuts):
    """Deflection at one place of a cantilever under a unit force at another, textbook's and that of the mesh.

    The textbook has a^2 (3 b - a) / 6 EI + a / GA for a <= b. Elements hold the moment of their mid-points,
    so that the integral of the product of moments is that of the mid-point rule.
    """
    a, b = sorted((first, second))
    middles, lengths = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
    mesh = np.sum(lengths * np.maximum(a - middles, 0) * np.maximum(b - middles, 0)) / BENDING
    return a**2 * (3 * b - a) / (6 * BENDING) + a / SHEAR, mesh + a / SHEAR


@pytest.mark.exhaustive
def test_what_is_attached_in_the_middle_of_a_beam():
    """Could go wrong: a station at the nearest node instead of its own, reactions that act at the tip.

    A rigid body on a joint at three tenths, a spring at six tenths: deflections of textbooks at both.
    """
    load, spring, section = 2e-4, 30.0, nc.Section.of_numbers(**SLENDER)
    scene, more = nc.Scene(), {"elements": 10, "stations": (0.3, 0.6), "second": (0, 1, 0)}
    beam = scene.add(nc.Beam(section, LINE, start=nc.ground, name="beam", **more))
    place, above, low = (0.3, 0, 0), (0.6, 0, 1.0), (0.3, 0, -0.2)
    weight = scene.add(nc.RigidBody(mass=1.0, inertia=(0.01, 0.01, 0.01), position=low, name="weight"))
    scene.add(nc.Spherical(beam.at(0.3), weight, point=place, name="hook"))
    ends = (nc.Point(nc.ground, above), nc.Point(beam.at(0.6), (0.6, 0, 0)))
    scene.add(nc.Spring(ends, stiffness=spring, length=1.0, name="spring"))
    scene.add(nc.PointForce((nc.Point(weight, low),), force=grows((0, 0, -load)), name="load"))
    system, state = scene.compile()
    states = nc.equilibrium(system, state, jnp.asarray(RAMP)).states
    assert beam.fractions[3] == pytest.approx(0.3) and len(beam.elements) == 10
    cuts = np.array(beam.fractions)
    moved = [place_of(system, states, beam.at(x))[1] for x in (0.3, 0.6)]
    for number, off in ((1, 5 * tol.FIRST_ORDER), (0, 0.04)):
        near, across, far = (flexibility(*x, cuts)[number] for x in ((0.3, 0.3), (0.3, 0.6), (0.6, 0.6)))
        lift = -across * load / (1 + spring * far)
        assert moved[1][2] == pytest.approx(lift, rel=off)
        assert moved[0][2] == pytest.approx(-(near * load + spring * lift * across), rel=off)
    # Sensors: a point of the node, the shear at both sides of a station.
    marked = system.sense(states, nc.Point(beam.at(0.3), (0, 0, 0), local=True)).position
    np.testing.assert_allclose(marked[1], moved[0], rtol=0, atol=1e-15)
    shear = np.asarray(system.sense(states, beam.elements).resultant)[1, :, 1]
    pull = -spring * moved[1][2]
    wanted = np.repeat([pull - load, pull, 0.0], [3, 3, 4])
    np.testing.assert_allclose(shear, wanted, rtol=0, atol=20 * tol.FIRST_ORDER * load)
    assert float(system.sense(jax.tree.map(lambda x: x[1], states), "hook").force[2]) == pytest.approx(load)


# --- published ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_bend_of_45_degrees():
    """B02, with kGA = 4166670 N."""
    radius = 100.0
    section = nc.Section.of_numbers(EA=1e7, GA=4166670.0, EI=833300.0, GJ=833300.0, density=1.0, rotary=1.0)
    length = radius * np.pi / 4

    def curve(s):
        return jnp.stack([radius * jnp.sin(s / radius), radius * (1 - jnp.cos(s / radius)), 0 * s])

    moved = []
    for elements in (8, 16):
        scene = nc.Scene()
        beam = scene.add(nc.Beam(section, curve, elements=elements, length=length, start=nc.ground))
        end = np.asarray(curve(length))
        scene.add(nc.PointForce((nc.Point(beam.end, end),), force=grows((0, 0, 600.0))))
        system, state = scene.compile()
        moved.append(place_of(system, nc.equilibrium(system, state, steps=6).state, beam.end) - end)
    exact = [-23.5613, -13.60502, 53.47611]
    np.testing.assert_allclose(richardson(*moved), exact, rtol=0, atol=tol.FOUR_DIGITS)


@pytest.mark.exhaustive
def test_a_cantilever_by_number_of_elements():
    """B05: order two, and the converged values of a small load and of a large one.

    Coarse meshes are nearer to them than Exudyn's element of the same number of nodes.
    """
    section = nc.RectangularSection(width=0.1, height=0.5, E=2.07e11, nu=0.3, density=7800.0)
    small, large = np.array([-1.88847418e-07, 0.000809900305]), np.array([-0.15097103, 0.71056837])
    exudyn = {1: (-0.07140274, 0.54225823), 2: (-0.12379212, 0.65687111), 4: (-0.14346767, 0.69593561)}
    tips = {}
    for elements in (1, 2, 4, 8, 16):
        more = {"elements": elements, "stations": (), "second": (0, 0, 1)}
        loads = jnp.array([1e-3, 0.2, 0.4, 0.6, 0.8, 1.0])
        line, force = [(0, 0, 0), (2.0, 0, 0)], (0.0, 6.25e7, 0.0)
        system, states, beam = solved(section, line, loads=loads, force=force, **more)
        tips[elements] = (place_of(system, states, beam.end)[:, :2] - [2.0, 0])[[0, -1]]
    errors = {n: np.max(np.abs(x[1] - large)) for n, x in tips.items()}
    for elements, other in exudyn.items():
        assert errors[elements] < np.max(np.abs(np.array(other) - large)), elements
    assert 3.8 < errors[8] / errors[16] < 4.2
    converged = richardson(tips[8], tips[16])
    np.testing.assert_allclose(converged[0], small, rtol=1e-5, atol=0)
    np.testing.assert_allclose(converged[1], large, rtol=0, atol=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [1, 2, 3])
def test_order_of_director_interpolation(order):
    """Displacements converge with order 2 p."""
    tips = []
    for elements in (2, 4, 8):
        way = nc.DirectorInterpolation(order=order)
        more = {"elements": elements, "stations": (), "interpolation": way, "loads": RAMP}
        system, states, beam = solved(force=(0.0, 1.0, 0.5), **more)
        tips.append(place_of(system, states, beam.end)[1])
    steps = [np.max(np.abs(a - b)) for a, b in zip(tips, tips[1:])]
    assert abs(np.log2(steps[0] / steps[1]) - 2 * order) < 0.6


# --- limit points -------------------------------------------------------------------------------------------

ARCH = {"EA": 1e4, "GA": 5e3, "EI": 1.0, "GJ": 1.0, "density": 1.0, "rotary": 0.01}
RISE = 0.3
"""Half of the angle of the arch [rad]."""


def shallow_arch(elements):
    """A circular arch of a metre's length on hinges, with a load at its top."""

    def circle(s):
        angle, radius = RISE * (1 - 2 * s), 0.5 / RISE
        return radius * jnp.stack([-jnp.sin(angle), 0 * s, jnp.cos(angle) - np.cos(RISE)])

    scene = nc.Scene()
    more = {"length": 1.0, "second": (0, 1, 0), "name": "arch"}
    arch = scene.add(nc.Beam(nc.Section.of_numbers(**ARCH), circle, elements=elements, **more))
    for end, at in ((arch.start, arch.attachments[0]), (arch.end, arch.attachments[-1])):
        scene.add(nc.Revolute(nc.ground, end, point=at.point, axis=(0, 1, 0)))
    top = arch.attachments[elements // 2]
    scene.add(nc.PointForce((nc.Point(top.body, top.point),), force=grows((0, 0, -1.0))))
    return *scene.compile(), arch, top.body


def largest_load(heights, loads):
    """Of a quartic through the five points about the largest load."""
    most = int(np.argmax(loads))
    near = slice(most - 2, most + 3)
    x = heights[near] - heights[most]
    fit = np.polynomial.Polynomial.fit(x, loads[near], 4)
    return fit(np.linspace(x.min(), x.max(), 2001)).max()


def limit_load():
    """Half of the arch by Reissner's equations: shooting for the load at given heights of the top."""

    def half(unknown):
        tilt, along_x, load = unknown

        def along(_, y):
            c, s = np.cos(y[2]), np.sin(y[2])
            stretch = 1 + (along_x * c - 0.5 * load * s) / ARCH["EA"]
            shear = (-along_x * s - 0.5 * load * c) / ARCH["GA"]
            x, z = stretch * c - shear * s, stretch * s + shear * c
            return [x, z, y[3] / ARCH["EI"] - 2 * RISE, 0.5 * load * x + along_x * z]

        radius = 0.5 / RISE
        start = [-radius * np.sin(RISE), 0.0, tilt, 0.0]
        return solve_ivp(along, (0, 0.5), start, rtol=1e-10, atol=1e-12).y[:, -1]

    heights = 0.5 / RISE * (1 - np.cos(RISE)) * np.linspace(0.95, 0.3, 27)
    loads, unknown = [], np.array([RISE, 0.0, 1.0])
    for height in heights:
        unknown = fsolve(lambda u, h=height: half(u)[:3] - [0, h, 0], unknown, xtol=1e-10)
        loads.append(unknown[2])
    return largest_load(heights, np.array(loads))


@pytest.mark.exhaustive
def test_limit_load_of_an_arch():
    """Could go wrong: a path that leaves the branch, meshes that do not converge to Reissner's equations."""
    limits = []
    for elements in (8, 16):
        system, state, _, top = shallow_arch(elements)
        # Beyond the limit point, at once: downhill to the shape on the other side.
        if elements == 8:
            through = nc.equilibrium(system, state, 30.0, steps=1).state
            assert place_of(system, through, top)[2] < -0.05
        path = nc.load_path(system, state, arc=0.02, steps=20, scale=1e3)
        limits.append(largest_load(place_of(system, path.states, top)[:, 2], np.asarray(path.states.t)))
    exact = limit_load()
    assert 3.7 < (limits[0] - exact) / (limits[1] - exact) < 4.3
    assert richardson(*limits) == pytest.approx(exact, rel=1e-3)


@pytest.mark.exhaustive
def test_lateral_buckling():
    """A narrow cantilever under a tip load across its strong side gives way at 4.013 sqrt(EI GJ) / L^2.

    Below it, touched from the side, it swings in motion, above it falls over.
    """
    weak, torsion = 1.0, 1.5
    section = nc.Section.of_numbers(EA=1e7, GA=1e7, EI=(1e4, weak), GJ=torsion, density=1.0, rotary=1e-3)
    critical = 4.013 * np.sqrt(weak * torsion)
    # d_1 along y: bending about it, in the plane of the load, is stiff.
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, LINE, elements=16, second=(0, 1, 0), start=nc.ground))
    push(scene, beam.end, (0.0, 0.0, -critical))
    system, state = scene.compile()
    # Half a per cent to either side; the mesh and the strong side's give, EI / 1e4, make less than 0.15 %.
    states = nc.equilibrium(system, state, jnp.array([0.5, 0.995, 1.005])).states
    below, above = (nc.modes(system, jax.tree.map(lambda x, k=k: x[k], states), count=1).s[0] for k in (1, 2))
    assert abs(below.real) < 1e-9 and below.imag > 0
    assert above.real > 0


@pytest.mark.exhaustive
def test_buckling_sets_in_in_motion():
    """The same cantilever, softer, touched from the side: below the load it swings, above it falls over."""
    section = nc.Section.of_numbers(EA=1e5, GA=1e5, EI=(1e3, 1.0), GJ=1.5, density=1.0, rotary=1e-2)
    aside = []
    for part in (0.9, 1.1):
        scene = nc.Scene()
        beam = scene.add(nc.Beam(section, LINE, elements=8, second=(0, 1, 0), start=nc.ground, name="beam"))
        push_by = jnp.array([0, 0, -part * 4.013 * np.sqrt(1.5)])
        scene.add(nc.PointForce((nc.Point(beam.end, LINE[1]),), force=push_by))
        system, state = scene.compile()
        state = nc.equilibrium(system, state).state
        rates = np.array(state.row_rates)
        rates[system.body_index(beam.end), 0, 1] += 1e-3
        trajectory = nc.simulate(system, with_rows(state, rates=rates), dt=0.01, steps=400)
        assert nc.balance(system, trajectory).energy.max() < tol.ENERGY
        aside.append(np.abs(place_of(system, trajectory, beam.end)[:, 1]).max())
    assert aside[0] < 1e-3 and aside[1] > 0.05, aside
