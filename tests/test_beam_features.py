"""What beams can be made of and what they tell: sections, twist, laws, sensors, locking, frequencies.

Could go wrong: data of a section that end up on the wrong axis, a mesh that is too stiff for slender beams,
section forces that are not those of statics, centrifugal forces that stiffen nothing.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account
from differences import assert_v_shaped
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm
from scipy.optimize import fsolve

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.effects.beams.directors import director_strains
from natcoord_jax.maths.lagrange import gauss_legendre, lagrange, lobatto
from natcoord_jax.maths.rotations import from_rotation_vector

ROUNDING = 1e-13
"""Of what is exact in exact arithmetic, relative to its size: some hundred roundings."""

LINEAR = 1e-6
"""Of what theory of first order says, for loads that turn a section by some 1e-4 radians."""

NUMBERS = {"EA": 1e4, "GA": (5e3, 4e3), "EI": (1.0, 2.0), "GJ": 1.5, "density": 2.0, "rotary": (0.01, 0.02)}
LINE = [(0, 0, 0), (1, 0, 0)]
BOTH = np.array([1.0, -1.0])
RAMP = np.array([0.5, 1.0])
CUTS = np.array([0.0, 0.2, 0.2 + 0.8 / 3, 0.2 + 1.6 / 3, 1.0])
"""Nodes of a rod of four elements: they are uneven, lest an error of the lengths cancels."""


class Grows(eqx.Module):
    """A load in proportion to the load parameter; numbers change without another program."""

    value: Float[Array, "3"]

    def __call__(self, t):
        return self.value * t


def grows(value):
    return Grows(jnp.asarray(value, float))


NONE = (0.0, 0.0, 0.0)


def rod(section=None, curve=LINE, *, force=NONE, following=NONE, torque=NONE, gravity=NONE, **options):
    """A metre along x, clamped at its start, d_1 along y, with every load that there is at its end.

    All loads are there, as zeros, so that the tests below share programs.
    """
    section = nc.Section.of_numbers(**NUMBERS) if section is None else section
    scene, given = nc.Scene(), {"elements": 4, "stations": (0.2,), "second": (0, 1, 0)} | options
    beam = scene.add(nc.Beam(section, curve, start=nc.ground, name="rod", **given))
    last = beam.attachments[-1]
    point, axes = (
        nc.Point(beam.end, last.point),
        [nc.Direction(beam.end, d) for d in jnp.asarray(last.axes).T],
    )
    scene.add(nc.PointForce((point,), force=grows(force), name="dead"))
    scene.add(nc.PointForce((point, *axes), force=grows(following), following=True, name="following"))
    scene.add(nc.BodyTorque((axes[0],), torque=grows(torque), name="torque"))
    scene.add(nc.Gravity(vector=gravity))
    return *scene.compile(), beam


def solved(*args, loads=BOTH, **options):
    """System, beam and equilibria of a rod."""
    system, state, beam = rod(*args, **options)
    return system, nc.equilibrium(system, state, jnp.asarray(loads)).states, beam


def odd(values):
    """Linear part of what was found under a load and its opposite: even terms cancel."""
    values = np.asarray(values)
    return 0.5 * (values[0] - values[1])


def tip(system, states, beam):
    return np.asarray(system.sense(states, beam.end).position)


def turn_of(rotations):
    """Small rotation vectors that take the first pose of a rod to these."""
    r = np.asarray(rotations) @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    return 0.5 * np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
    )


def richardson(coarse, fine):
    """From results of order two at h and h/2."""
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


# --- sections ---------------------------------------------------------------------------------------------


def diagonal(section):
    return np.asarray(section.stiffness).diagonal()


def test_tubes():
    """Could go wrong: diameter for radius, the inner circle added.

    Cowper (1966): 2 (1 + nu) / (4 + 3 nu) of a thin wall; a full circle where the wall is the radius.
    """
    young, nu, density = 2e11, 0.3, 7800.0
    rigidity, (outer, inner) = young / (2 * (1 + nu)), (0.05, 0.04)
    tube = nc.TubularSection(radius=outer, thickness=outer - inner, E=young, nu=nu, density=density)
    area, polar = np.pi * (outer**2 - inner**2), 0.5 * np.pi * (outer**4 - inner**4)
    found = diagonal(tube)
    np.testing.assert_allclose(found[2], young * area, rtol=ROUNDING)
    np.testing.assert_allclose(
        found[3:], [0.5 * young * polar, 0.5 * young * polar, rigidity * polar], rtol=ROUNDING
    )
    inertia = density * np.array([area, 0.5 * polar, 0.5 * polar])
    np.testing.assert_allclose(tube.inertia, np.diag(inertia), rtol=ROUNDING, atol=0)
    thin = nc.TubularSection(radius=1.0, thickness=1e-5, E=young, nu=nu, density=density)
    cowper = 2 * (1 + nu) / (4 + 3 * nu)
    np.testing.assert_allclose(diagonal(thin)[:2], cowper * diagonal(thin)[2] * rigidity / young, rtol=1e-9)
    full = nc.TubularSection(radius=0.02, thickness=0.02, E=young, nu=nu, density=density)
    circle = nc.CircularSection(radius=0.02, E=young, nu=nu, density=density)
    np.testing.assert_allclose(full.stiffness, circle.stiffness, rtol=ROUNDING)
    with pytest.raises(ValueError, match="thickness"):
        nc.TubularSection(radius=0.02, thickness=0.03, E=young, density=density)


def test_rectangles():
    """Could go wrong: width for height. Timoshenko & Goodier's table of J / (a b^3), Cowper's coefficient."""
    table = {1.0: 0.1406, 1.2: 0.166, 1.5: 0.196, 2.0: 0.229, 2.5: 0.249, 3.0: 0.263, 4.0: 0.281, 10.0: 0.312}
    young, nu, thin = 3.0, 0.25, 0.1
    rigidity = young / (2 * (1 + nu))
    for ratio, factor in table.items():
        sides = {"E": young, "nu": nu, "density": 5.0}
        upright, lying = (
            nc.RectangularSection(width=w, height=h, **sides)
            for w, h in ((thin, thin * ratio), (thin * ratio, thin))
        )
        area = thin**2 * ratio
        found = diagonal(upright)
        # The table has three digits, four of the square.
        assert found[5] / (rigidity * thin**4 * ratio) == pytest.approx(
            factor, abs=6e-5 if ratio == 1 else 6e-4
        )
        strong, weak = thin**4 * ratio**3 / 12, thin**4 * ratio / 12
        np.testing.assert_allclose(found[2:5], young * np.array([area, strong, weak]), rtol=ROUNDING)
        shear = 10 * (1 + nu) / (12 + 11 * nu) * rigidity * area
        np.testing.assert_allclose(found[:2], [shear, shear], rtol=ROUNDING)
        np.testing.assert_allclose(diagonal(lying), found[[1, 0, 2, 4, 3, 5]], rtol=ROUNDING)
        # The second moment of theta^1 is the inertia about d_2.
        wanted = 5.0 * np.array([area, weak, strong])
        np.testing.assert_allclose(np.diag(upright.inertia), wanted, rtol=ROUNDING)


def test_data_with_the_first_axis_along_the_beam():
    """Could go wrong: an exchange of axes that is not cyclic. Energies of any strain are the same."""
    section = nc.Section.of_numbers(**NUMBERS, centre=(0.03, -0.02))
    (ga1, ga2), ea, (ei1, ei2) = NUMBERS["GA"], NUMBERS["EA"], NUMBERS["EI"]
    other = nc.Section.of_axis_along_first(np.diag([ea, ga1, ga2, NUMBERS["GJ"], ei1, ei2]), section.inertia)
    np.testing.assert_array_equal(other.stiffness, section.stiffness)
    np.testing.assert_array_equal(other.inertia, section.inertia)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    coupled = nc.Section.of_axis_along_first(root @ root.T, section.inertia).stiffness
    stretch, shear, twist, bending = rng.normal(), rng.normal(size=2), rng.normal(), rng.normal(size=2)
    theirs, ours = np.array([stretch, *shear, twist, *bending]), np.array([*shear, stretch, *bending, twist])
    assert ours @ np.asarray(coupled) @ ours == pytest.approx(np.sum((root.T @ theirs) ** 2), rel=ROUNDING)


@pytest.mark.slow
def test_centre_of_mass_beside_the_axis():
    """Could go wrong: an offset along the wrong director, its inertia missing or counted twice.

    Under its weight q = m g a horizontal rod with centres of mass at e beside it twists by q e L^2 / (2 GJ),
    exactly with any mesh; turned about its axis it has the angular momentum of m e^2 and its own inertia.
    """
    aside, gravity = 0.02, 1e-4
    section = nc.Section.of_numbers(**NUMBERS, centre=(aside, 0.0))
    system, states, beam = solved(section, gravity=(0, 0, -gravity))
    twisted = turn_of(system.sense(states, beam.end).rotation)[0, 0]
    weight = NUMBERS["density"] * gravity
    assert twisted == pytest.approx(-weight * aside / (2 * NUMBERS["GJ"]), rel=LINEAR)
    state = jax.tree.map(lambda x: x[0], states)
    rows = rod(section)[1].q
    np.testing.assert_allclose(
        rod(section)[0].sense(replace_fields(state, q=rows), beam.end).com, [1, aside, 0], atol=1e-15
    )
    rate, free = 3.0, 1 - 0.5 * CUTS[1]
    v = np.cross([rate, 0, 0], np.asarray(rows))
    v.reshape(-1, 4, 3)[:, 0] = 0.0
    turning = replace_fields(state, q=rows, v=jnp.asarray(v))
    # Half of the first element's mass is that of the clamped node.
    about = NUMBERS["density"] * aside**2 + sum(NUMBERS["rotary"])
    momentum = np.asarray(system.angular_momentum(turning))[0]
    assert momentum == pytest.approx(rate * about * free, rel=ROUNDING)
    pushed = rate * aside * NUMBERS["density"] * free
    np.testing.assert_allclose(system.momentum(turning), [0, 0, pushed], rtol=0, atol=ROUNDING * pushed)


# --- shapes -----------------------------------------------------------------------------------------------


def test_twist_turns_the_frames():
    """Could go wrong: the sense of the turn, degrees, a function of the fraction in place of arc length."""
    angle, long = 0.7, [(0, 0, 0), (2, 0, 0)]
    section = nc.Section.of_numbers(**NUMBERS)
    beam = nc.Scene().add(nc.Beam(section, long, elements=4, second=(0, 1, 0), twist=angle))
    other = nc.Scene().add(
        nc.Beam(section, long, elements=4, second=(0, 1, 0), twist=lambda s: 0.5 * angle * s)
    )
    for place, a, b in zip(beam.fractions, beam.attachments, other.attachments):
        c, s = np.cos(angle * place), np.sin(angle * place)
        np.testing.assert_allclose(
            np.asarray(a.axes).T, [[0, c, s], [0, -s, c], [1, 0, 0]], rtol=0, atol=1e-15
        )
        np.testing.assert_allclose(b.axes, a.axes, rtol=0, atol=1e-15)


def test_a_twisted_strip_bends_about_its_turned_axes():
    """Could go wrong: twist of the frames only. Tip of a cantilever with axes that turn by a right angle:

    kappa = R(s) diag(1/EI_1, 1/EI_2) R(s)^T M(s), integrated twice; the force across also moves it sideways.
    """
    angle, load = 0.5 * np.pi, np.array([0.0, 0.0, 1e-4])
    section = nc.Section.of_numbers(**NUMBERS | {"EI": (0.2, 2.0), "GA": 5e3})
    found = []
    for elements in (4, 8):
        system, states, beam = solved(section, elements=elements, twist=angle, force=load)
        found.append(odd(tip(system, states, beam)))
    x, weights = gauss_legendre(40)
    moved = np.array([0.0, load[2] / 5e3])
    for s, w in zip(x, weights):
        c, n = np.cos(angle * s), np.sin(angle * s)
        turned = np.array([[c, -n], [n, c]])
        # Moments and curvatures about y and z; turning about y lowers the tip, about z moves it to y.
        curvature = turned @ np.diag([1 / 0.2, 1 / 2.0]) @ turned.T @ np.array([-(1 - s) * load[2], 0.0])
        moved += w * (1 - s) * np.array([curvature[1], -curvature[0]])
    assert abs(moved[0]) > 0.1 * moved[1]
    np.testing.assert_allclose(richardson(*found)[1:], moved, rtol=0, atol=2e-3 * moved[1])


def test_lines_with_a_corner():
    """Could go wrong: fractions of points in place of those of length, tangents at the end and the corner."""
    section = nc.Section.of_numbers(**NUMBERS)
    corner = [(0, 0, 0), (0.6, 0, 0), (0.6, 0.0, 1.8)]
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, corner, elements=8, second=(0, 1, 0)))
    arc = 2.4 * np.linspace(0, 1, 9)
    wanted = np.stack([np.minimum(arc, 0.6), 0 * arc, np.maximum(arc - 0.6, 0.0)], axis=1)
    points = np.stack([np.asarray(a.point) for a in beam.attachments])
    np.testing.assert_allclose(points, wanted, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.sum(beam.shares), 2.4, rtol=ROUNDING)
    tangents = np.stack([np.asarray(a.axes)[:, 2] for a in beam.attachments])
    mean = np.sqrt(0.5)
    np.testing.assert_allclose(
        tangents[[0, 1, 2, 3, 8]],
        [[1, 0, 0], [1, 0, 0], [mean, 0, mean], [0, 0, 1], [0, 0, 1]],
        rtol=0,
        atol=1e-15,
    )
    # The corner is in the plane of d_3 and d_2, which turns with it; d_1 is the axis of the turn.
    first = np.stack([np.asarray(a.axes)[:, 0] for a in beam.attachments])
    np.testing.assert_allclose(first, np.broadcast_to([0, 1, 0], first.shape), rtol=0, atol=1e-15)
    system, state = scene.compile()
    assert float(system.energy(state).total) == pytest.approx(0.0, abs=1e-20)


# --- sensors ----------------------------------------------------------------------------------------------


def test_section_forces_are_those_of_statics():
    """Could go wrong: axes, signs and lengths of what the sensor of an element shows.

    N and M of a cantilever with a force and a torque at its end; the mid-point moment is exact in each
    element. Their energies add to what is stored, half of the load's work (Clapeyron).
    """
    force, torque = np.array([3e-4, 2e-4, -1e-4]), np.array([1e-4, -2e-4, 3e-4])
    system, states, beam = solved(force=force, torque=torque)
    found = system.sense(states, beam.elements)
    arm = 1 - 0.5 * (CUTS[1:] + CUTS[:-1])
    fx, fy, fz = force
    normal = np.broadcast_to([fy, fz, fx], (4, 3))
    moments = [torque[1] - arm * fz, torque[2] + arm * fy, torque[0] + 0 * arm]
    wanted = np.concatenate([normal, np.stack(moments, axis=1)], axis=1)
    scale = np.repeat([np.abs(force).max(), np.abs(torque).max()], 3)
    np.testing.assert_allclose(odd(found.resultant) / scale, wanted / scale, rtol=0, atol=LINEAR)
    stiffness = np.array([*NUMBERS["GA"], NUMBERS["EA"], *NUMBERS["EI"], NUMBERS["GJ"]])
    np.testing.assert_allclose(found.resultant, stiffness * np.asarray(found.strain), rtol=ROUNDING)
    stored = np.sum(np.asarray(found.energy), axis=1)
    # Roundings of places of a metre are 1e-12 of strains like these.
    np.testing.assert_allclose(stored, system.energy(states).total, rtol=1e-10)
    moved, turned = odd(tip(system, states, beam)), odd(turn_of(system.sense(states, beam.end).rotation))
    assert np.mean(stored) == pytest.approx(0.5 * (force @ moved + torque @ turned), rel=LINEAR)
    # One element alone: the same without the axis of the elements.
    alone = system.sense(states, beam.elements[2])
    np.testing.assert_array_equal(alone.resultant, found.resultant[:, 2])


def test_curvature_of_a_rolled_up_beam():
    """Could go wrong: strains of first order only. K_1 = M / EI_1 in all elements, at a turn of 3 radians."""
    moment = 3.0 * NUMBERS["EI"][0]
    system, states, beam = solved(torque=(0, moment, 0), loads=RAMP)
    found = system.sense(states, beam.elements)
    wanted = np.zeros((2, 4, 6))
    wanted[..., 3] = RAMP[:, None] * moment
    np.testing.assert_allclose(found.resultant, wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.strain[..., 3], wanted[..., 3] / NUMBERS["EI"][0], rtol=0, atol=1e-12)


# --- patch test, objectivity, locking ---------------------------------------------------------------------


def test_patch_of_bending_shear_twist_and_stretch():
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
    twist = np.zeros((4, 4))
    k = curvature
    twist[:3, :3] = [[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]]
    twist[:3, 3] = shape
    end = expm(twist)
    # From the axes of the section at the clamp to the world's: d_1, d_2, d_3 along y, z, x.
    frame = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    rotation = frame @ end[:3, :3]
    loads = {"force": rotation @ wrench[:3], "torque": rotation @ wrench[3:]}
    system, states, beam = solved(section, loads=RAMP, **loads)
    sensed = system.sense(states, beam.end)
    np.testing.assert_allclose(sensed.position[1], frame @ end[:3, 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(sensed.rotation[1], rotation, rtol=0, atol=1e-12)
    strains = np.asarray(system.sense(states, beam.elements).strain)[1]
    np.testing.assert_allclose(strains, np.broadcast_to(strain, (4, 6)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("interpolation", [nc.RelativeMotion(), nc.DirectorInterpolation(order=1)])
def test_no_locking(interpolation):
    """Could go wrong: shear that cannot vanish in bending. Error of the tip by GA L^2 / EI from 1e2 to 1e10:

    that of the mid-point rule for the moment, sum of l^3 / 12 of P L^3 / 3 EI, and no more for any of them.
    """
    load, bending = 0.02, NUMBERS["EI"][0]
    for ratio in (1e2, 1e4, 1e6, 1e8, 1e10):
        section = nc.Section.of_numbers(**NUMBERS | {"GA": ratio * bending, "EA": ratio * bending})
        system, states, beam = solved(section, force=(0, 0, load), interpolation=interpolation)
        sum_of_cubes = np.sum(np.diff(CUTS) ** 3)
        wanted = load * ((1 / 3 - sum_of_cubes / 12) / bending + 1 / (ratio * bending))
        # The tip turns by a hundredth: its square over some ten is beyond first order.
        assert odd(tip(system, states, beam))[2] == pytest.approx(wanted, rel=2e-4), ratio


def test_a_force_that_follows_the_tip():
    """Could go wrong: components along the axes of the first pose. A cantilever under a force along its d_2:

    from the tip, where section forces are known, Reissner's equations are integrated back to the clamp.
    """
    load, bending, shear, stretch = 2.0, 1.0, 5e3, 1e4
    found = []
    for elements in (4, 8):
        section = nc.Section.of_numbers(**NUMBERS | {"GA": shear})
        system, states, beam = solved(section, elements=elements, following=(0, load, 0), loads=RAMP)
        found.append(tip(system, states, beam)[1])

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
    np.testing.assert_allclose(richardson(*found), wanted, rtol=0, atol=5e-4)


# --- other energies and shapes of elements ----------------------------------------------------------------

HALF = {"EA": 5e3, "GA": (2.5e3, 2e3), "EI": (0.5, 1.0), "GJ": 0.75}
WEIGHTS = (2.5e3, 2e3, 5e3, 0.5, 1.0, 0.75)


def quadratic(strains):
    """The other half of the energy of `NUMBERS`, as a law [J/m]."""
    return 0.5 * jnp.sum(jnp.asarray(WEIGHTS) * strains**2)


def test_a_law_needs_two_node_elements():
    section = nc.Section.of_numbers(**NUMBERS)
    directors = {"law": quadratic, "interpolation": nc.DirectorInterpolation(order=1)}
    with pytest.raises(ValueError, match="law= needs interpolation"):
        nc.Scene().add(nc.Beam(section, LINE, elements=2, **directors))


@pytest.mark.exhaustive
def test_a_quadratic_law_is_linear_elasticity():
    """Could go wrong: a law in place of the section's energy, per element instead of per length."""
    load = {"force": (-2.0, 1.0, 2.0), "torque": (0.5, 0, 0)}
    both = nc.Section.of_numbers(**NUMBERS), nc.Section.of_numbers(**NUMBERS | HALF)
    bent = [
        solved(section, loads=RAMP, law=law, **load)[1].q[1] for section, law in zip(both, (None, quadratic))
    ]
    assert np.abs(bent[0][-4] - np.array([1, 0, 0])).max() > 0.3
    np.testing.assert_allclose(bent[1], bent[0], rtol=0, atol=1e-11)
    moved = []
    for section, law in zip(both, (None, quadratic)):
        system, state, _ = rod(section, law=law, gravity=(0, 2.0, -9.81))
        moved.append(nc.simulate(system, state, dt=0.02, steps=20).q)
    assert np.abs(moved[0][-1] - moved[0][0]).max() > 0.3
    np.testing.assert_allclose(moved[1], moved[0], rtol=0, atol=tol.SAME_TRAJECTORY)


@pytest.mark.slow
def test_a_slender_rod_in_motion():
    """Could go wrong: Newton's method that stalls, or rounding in the stretch that shows in the energy.

    EA L^2 / EI = GA L^2 / EI = 1e8; a step is a five hundredth of the first period and many periods of the
    stretch of an element. No step has to be made in parts.
    """
    section = nc.Section.of_numbers(**NUMBERS | {"EA": 1e8, "GA": 1e8, "EI": 1.0, "rotary": 1e-4})
    system, state, _ = rod(section, gravity=(0, 0.5, -2.0))
    trajectory = nc.simulate(system, state, dt=5e-3, steps=200)
    assert int(trajectory.steps_rejected) == 0
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY
    points = np.asarray(trajectory.q).reshape(201, -1, 4, 3)[:, :, 0]
    assert np.ptp(points[:, -1, 2]) > 0.5
    chain = np.concatenate([np.zeros((201, 1, 3)), points], axis=1)
    length = np.sum(np.linalg.norm(np.diff(chain, axis=1), axis=2), axis=1)
    # Chords of arcs: four elements share a turn of two radians at the most.
    assert np.all((length > 0.96) & (length < 1 + 1e-6))


def interpolated(order, points, frames, length):
    """Strains at the points of integration of one director element."""
    values, slopes = lagrange(lobatto(order)[0], gauss_legendre(order)[0])
    x = np.concatenate([points[:, None], np.swapaxes(frames, 1, 2)], axis=1)
    return np.asarray(director_strains(jnp.asarray(x), jnp.asarray(values), jnp.asarray(slopes / length)))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_director_elements_of_constant_shear_and_stretch(order):
    """Patch test: uneven pieces of a straight line, sheared and stretched, have that strain at all points."""
    frame = np.asarray(from_rotation_vector(jnp.array([0.4, -1.0, 0.7])))
    strain = np.array([0.1, -0.2, 1.3])
    for start, length in ((0.0, 0.3), (0.3, 0.1), (0.4, 0.6)):
        arc = start + length * lobatto(order)[0]
        points, frames = arc[:, None] * (frame @ strain), np.broadcast_to(frame, (order + 1, 3, 3))
        found = interpolated(order, points, frames, length)
        np.testing.assert_allclose(found[:, :3], np.broadcast_to(strain, (order, 3)), rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(found[:, 3:], 0.0, rtol=0, atol=ROUNDING / length)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_rigid_motions_do_not_strain_director_elements(order):
    """Objectivity: a curved and twisted piece, turned by three radians and moved."""
    rng = np.random.default_rng(order)
    frames = np.stack([from_rotation_vector(jnp.asarray(0.5 * rng.normal(size=3))) for _ in range(order + 1)])
    points, length = np.cumsum(rng.normal(size=(order + 1, 3)), axis=0), 0.7
    before = interpolated(order, points, frames, length)
    turn = np.asarray(from_rotation_vector(jnp.asarray(3.0 * np.array([2, -1, 2]) / 3)))
    after = interpolated(order, points @ turn.T + rng.normal(size=3), turn @ frames, length)
    np.testing.assert_allclose(after, before, rtol=0, atol=ROUNDING * np.abs(before).max())


@pytest.mark.slow
def test_conservation_with_director_elements():
    """Could go wrong: lumps or forces of inner nodes. A free hub with three booms, one of each order."""
    section = nc.Section.of_numbers(EA=300.0, GA=200.0, EI=(1.0, 1.5), GJ=0.8, density=1.0, rotary=0.02)
    spin = (0.3, -0.4, 1.5)
    scene = nc.Scene()
    hub = scene.add(
        nc.RigidBody(mass=2.0, inertia=(0.2, 0.3, 0.4), angular_velocity=spin, velocity=(1, 0.5, 0))
    )
    for order in (1, 2, 3):
        direction = np.eye(3)[order - 1]
        options = {
            "interpolation": nc.DirectorInterpolation(order=order),
            "start": hub,
            "name": f"boom {order}",
        }
        # The booms do not turn along at the start: they are bent by what follows.
        scene.add(nc.Beam(section, [0.2 * direction, direction], elements=2, velocity=(1, 0.5, 0), **options))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.03, steps=150)
    found = account(system, trajectory)
    assert found.energy_error <= tol.ENERGY
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT
    assert found.turned > 1.0
    exchanged = found.exchanged()
    for order in (1, 2, 3):
        assert max(x for name, x in exchanged.items() if name.startswith(f"boom {order}")) > 0.02


# --- frequencies ------------------------------------------------------------------------------------------

PIECES = 8


def chain_frequencies(section, n):
    """Frequencies of n half-waves of a chain of elements on hinges about d_1, coupled to torsion.

    Nodal sines of deflection and twist and cosines of the slope solve the chain's equations exactly, with

        K = -2 sin(k l / 2) / l slope,    Gamma = 2 sin(k l / 2) / l deflection - cos(k l / 2) slope.
    """
    (shear, _, _, bending, _, torsion), mass = diagonal(section), np.asarray(section.inertia)
    half = 0.5 * n * np.pi / PIECES
    s, c = 2 * PIECES * np.sin(half), np.cos(half)
    stiffness = np.array(
        [[shear * s * s, -shear * s * c, 0], [-shear * s * c, bending * s * s + shear * c * c, 0]]
    )
    stiffness = np.concatenate([stiffness, [[0, 0, torsion * s * s]]])
    # Along the hinges, d_1, is theta^1: the offset along it couples deflection and twist.
    about_first, about = mass[2, 2], mass[1, 1] + mass[2, 2]
    inertia = np.array([[mass[0, 0], 0, mass[0, 1]], [0, about_first, 0], [mass[0, 1], 0, about]])
    return np.sqrt(eigh(stiffness, inertia, eigvals_only=True))


def hinged(section):
    """Frequencies of a metre between two hinges about y on the ground: a closed loop with the ground."""
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, LINE, elements=PIECES, second=(0, 1, 0)))
    for end, point in zip((beam.start, beam.end), LINE):
        scene.add(nc.Revolute(nc.ground, end, point=point, axis=(0, 1, 0)))
    return np.asarray(nc.modes(*scene.compile()).frequencies)


@pytest.mark.slow
@pytest.mark.parametrize("aside", [0.0, 0.05])
def test_frequencies_between_hinges(aside):
    """Could go wrong: an offset of the mass that does not couple, constraints of a loop that stiffen.

    Bending is at n^2 pi^2 sqrt(EI / m L^4), and coupled to torsion at the roots of

        (EI k^4 - m w^2) (GJ k^2 - I w^2) = m^2 e^2 w^4,    I = I_c + m e^2,

    up to shear, rotary inertia and the mesh, which the chain's equations contain.
    """
    rotary = (1e-4, 2e-3)
    numbers = {"EA": 1e5, "GA": 1e5, "EI": (1.0, 50.0), "GJ": 1.5, "density": 2.0, "rotary": rotary}
    section = nc.Section.of_numbers(**numbers, centre=(aside, 0.0))
    found = hinged(section)
    for n in (1, 2, 3):
        chain = chain_frequencies(section, n)[:2]
        nearest = found[np.argmin(np.abs(found[:, None] - chain), axis=0)]
        np.testing.assert_allclose(nearest, chain, rtol=1e-8)
        k, m, about = n * np.pi, 2.0, sum(rotary) + 2.0 * aside**2
        product = [m * about - (m * aside) ** 2, -(k**4 * about + 1.5 * k**2 * m), 1.5 * k**6]
        exact = np.sort(np.sqrt(np.roots(product)))
        # Of the chain: (k l)^2 / 24 and its square; shear and rotary inertia are below 2e-3.
        np.testing.assert_allclose(nearest, exact, rtol=1.2 * (k / PIECES) ** 2 / 24 + 2e-3)
    if aside == 0:
        assert found[0] == pytest.approx(np.pi**2 / np.sqrt(2), rel=0.01)


@pytest.mark.parametrize("heavy", [True, False])
def test_a_mass_on_a_spring_in_rotation(heavy):
    """Could go wrong: half of the centrifugal force, or a Coriolis force of the wrong sign. With W the rate,

        w^2 = k / m - W^2 + 4 W^2 m r^2 / (I + m r^2),

    of a mass on a radial spring, at r on a carrier of inertia I that is free to turn.
    """
    rate, mass, stiffness, radius = 3.0, 0.7, 40.0, 1.2
    about = 1e9 if heavy else 0.5
    spin = (0.0, 0.0, rate)
    scene = nc.Scene()
    carrier = scene.add(nc.RigidBody(mass=1.0, inertia=(about, about, about), angular_velocity=spin))
    slider = scene.add(
        nc.RigidBody(
            mass=mass,
            inertia=(1e-9, 1e-9, 1e-9),
            position=(radius, 0, 0),
            velocity=(0, rate * radius, 0),
            angular_velocity=spin,
        )
    )
    scene.add(nc.Revolute(nc.ground, carrier, axis=(0, 0, 1)))
    scene.add(nc.Prismatic(carrier, slider, axis=(1, 0, 0)))
    ends = (nc.Point(carrier), nc.Point(slider, (radius, 0, 0)))
    scene.add(nc.Spring(ends, stiffness=stiffness, length=radius * (1 - mass * rate**2 / stiffness)))
    found = np.asarray(nc.modes(*scene.compile(), rotation=spin).s)
    square = stiffness / mass - rate**2 + 4 * rate**2 * mass * radius**2 / (about + mass * radius**2)
    swinging = found[np.argmax(np.abs(found.imag))]
    assert abs(swinging.imag) == pytest.approx(np.sqrt(square), rel=1e-7)
    assert abs(swinging.real) < 1e-6


@cache
def blade(rate):
    """Frequencies and moves of the tip of a beam with EI = m = L = 1 on a heavy hub that turns about z."""
    pieces, stretch = 16, 1e6
    section = nc.Section.of_numbers(EA=stretch, GA=1e6, EI=1.0, GJ=1e3, density=1.0, rotary=1e-6)
    scene = nc.Scene()
    heavy = 1e7
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
    radii = np.linalg.solve(springs - rate**2 * np.diag(shares[1:]), pull)
    q = np.array(state.q)
    for node, radius in zip(beam.nodes[1:], radii):
        q[4 * system.body_index(node)] = [radius, 0, 0]
    spin = np.array([0, 0, rate])
    steady = replace_fields(state, q=jnp.asarray(q), v=jnp.asarray(np.cross(spin, q)))
    found = nc.modes(system, steady, rotation=spin, damped=True, count=8)
    tips = np.abs(np.asarray(found.shapes)[:, 4 * system.body_index(beam.end)])
    return np.asarray(found.frequencies), tips


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "flap"), [(0.0, (3.5160, 22.0345)), (2.0, (4.1373, 22.6149)), (10.0, (11.2023, 33.6404))]
)
def test_a_rotating_cantilever(rate, flap):
    """Could go wrong: no stiffening by the centrifugal force, or none of its softening in the plane.

    Wright, Smith, Thresher & Wang, Vibration modes of centrifugally stiffened beams (1982), without a hub's
    radius: flap out of the plane of rotation; in it w^2 is less by the square of the rate.
    """
    frequencies, tips = blade(rate)
    out, within = (frequencies[np.argmax(tips, axis=1) == k] for k in (2, 1))
    lag = np.sqrt(np.square(flap) - rate**2)
    np.testing.assert_allclose(out[:2], flap, rtol=5e-3)
    np.testing.assert_allclose(within[within > 0.1][:2], lag, rtol=5e-3)


# --- derivatives and limit points -------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_sag_by_density():
    """Could go wrong: weight that is no function of the section. Small sag is in proportion to density, and

    a large one has the derivative that differences show: the scene is made of the number it is derived by.
    """

    def sag(density, gravity):
        section = nc.Section.of_numbers(**NUMBERS | {"density": density})
        system, state, beam = rod(section, gravity=(0.0, 0.0, -gravity))
        return system.sense(nc.equilibrium(system, state, jnp.asarray(RAMP)).state, beam.end).position[2]

    both = jax.jit(jax.value_and_grad(sag))
    density, small, large = jnp.asarray(2.0), jnp.asarray(1e-4), jnp.asarray(4.0)
    value, slope = (float(x) for x in both(density, small))
    # Four uneven elements: a few per cent off the textbook.
    assert value == pytest.approx(-2e-4 * (1 / (8 * NUMBERS["EI"][0]) + 0.5 / NUMBERS["GA"][1]), rel=0.05)
    assert slope == pytest.approx(value / 2.0, rel=LINEAR)
    value, slope = both(density, large)
    assert value < -0.4
    assert_v_shaped(lambda x: both(x, large)[0], density, jnp.ones(()), slope)


ARCH = {"EA": 1e4, "GA": 5e3, "EI": 1.0, "GJ": 1.0, "density": 1.0, "rotary": 0.01}
RISE = 0.3
"""Half of the angle of the arch [rad]."""


def shallow_arch(elements):
    """A circular arch of a metre's length on hinges, with a load at its top."""

    def circle(s):
        angle, radius = RISE * (1 - 2 * s), 0.5 / RISE
        return radius * jnp.stack([-jnp.sin(angle), 0 * s, jnp.cos(angle) - np.cos(RISE)])

    scene = nc.Scene()
    options = {"length": 1.0, "second": (0, 1, 0), "name": "arch"}
    arch = scene.add(nc.Beam(nc.Section.of_numbers(**ARCH), circle, elements=elements, **options))
    for end, at in ((arch.start, arch.attachments[0]), (arch.end, arch.attachments[-1])):
        scene.add(nc.Revolute(nc.ground, end, point=at.point, axis=(0, 1, 0)))
    top = arch.attachments[elements // 2]
    scene.add(nc.PointForce((nc.Point(top.body, top.point),), force=grows((0, 0, -1.0))))
    return *scene.compile(), top.body


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
        tilt, push, load = unknown

        def along(_, y):
            c, s = np.cos(y[2]), np.sin(y[2])
            stretch = 1 + (push * c - 0.5 * load * s) / ARCH["EA"]
            shear = (-push * s - 0.5 * load * c) / ARCH["GA"]
            x, z = stretch * c - shear * s, stretch * s + shear * c
            return [x, z, y[3] / ARCH["EI"] - 2 * RISE, 0.5 * load * x + push * z]

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
    found = []
    for elements in (8, 16):
        system, state, top = shallow_arch(elements)
        path = nc.load_path(system, state, arc=0.02, steps=20, scale=1e3)
        heights, loads = np.asarray(system.sense(path.states, top).position[:, 2]), np.asarray(path.states.t)
        found.append(largest_load(heights, loads))
    exact = limit_load()
    assert 3.7 < (found[0] - exact) / (found[1] - exact) < 4.3
    assert richardson(*found) == pytest.approx(exact, rel=1e-3)


@pytest.mark.exhaustive
def test_derivatives_of_a_path():
    """Could go wrong: a rate along the path in place of the derivative at fixed load, which is promised."""
    system, state, top = shallow_arch(4)

    def stiffer(p):
        groups = [
            replace_fields(g, effect=replace_fields(g.effect, stiffness=g.effect.stiffness * p))
            if g.effect.kind == "beam element"
            else g
            for g in system.effects
        ]
        return replace_fields(system, effects=tuple(groups))

    def path(p):
        return nc.load_path(stiffer(p), state, arc=0.05, steps=4, scale=1e3).states

    one = jnp.ones(())
    states, rates = jax.jvp(path, (one,), (one,))
    loads, rows = np.asarray(states.t), 4 * system.body_index(top)
    # Before the limit point and beyond it, where the load has halved again.
    assert np.argmax(loads) == 1 and loads[0] < 0.8 * loads[1] and loads[3] < 0.6 * loads[1]
    h = 1e-4
    for k in (0, 3):
        begin = jax.tree.map(lambda x, k=k: x[k], states)
        near = [nc.equilibrium(stiffer(one + s * h), begin, loads[k : k + 1]).state.q for s in (1, -1)]
        difference = (near[0] - near[1]) / (2 * h)
        assert float(jnp.abs(difference[rows, 2])) > 1e-3
        scale = float(jnp.max(jnp.abs(difference)))
        np.testing.assert_allclose(rates.q[k], difference, rtol=0, atol=1e-6 * scale)
    np.testing.assert_array_equal(rates.t, 0.0)
