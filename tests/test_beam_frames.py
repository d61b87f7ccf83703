"""Several beams with joints, springs and rigid bodies between them: frames, loops, things in the middle.

Could go wrong: corners that are soft or forget their moment, forces of a station that act at the wrong node,
loops of beams that gain energy or momentum.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from test_beam_features import grows, odd

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields

LINEAR = 1e-6
"""Of what theory of first order says, for loads that turn a section by some 1e-4 radians."""
BENDING, SHEAR, STRETCH = 2.0, 5e3, 1e7
BOTH = np.array([1.0, -1.0])


def section(**numbers):
    given = {"EA": STRETCH, "GA": SHEAR, "EI": BENDING, "GJ": 1.5, "density": 1.0, "rotary": 0.01}
    return nc.Section.of_numbers(**given | numbers)


def flexibility(first, second, cuts):
    """Deflection at one place of a cantilever under a unit force at another, textbook's and that of the mesh.

    The textbook has a^2 (3 b - a) / 6 EI + a / GA for a <= b. Elements hold the moment of their mid-points,
    so that the integral of the product of moments is that of the mid-point rule.
    """
    a, b = sorted((first, second))
    middles, lengths = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
    mesh = np.sum(lengths * np.maximum(a - middles, 0) * np.maximum(b - middles, 0)) / BENDING
    return a**2 * (3 * b - a) / (6 * BENDING) + a / SHEAR, mesh + a / SHEAR


@pytest.mark.slow
def test_a_portal_with_a_rigid_corner_and_a_hinge():
    """Could go wrong: a corner that two beams share carries no moment, a hinge does.

    A clamped column of height h and a girder of length l, rigid between them, with a column on hinges under
    the girder's end. A force H along the girder moves the corner by H h^3 / 3 EI - Y l h^2 / 2 EI, where
    Y = H l h^2 / 2 / (l^3 / 3 + l^2 h) pushes up from the column on hinges.
    """
    height, span, load, pieces = 1.0, 1.5, 2e-4, 3
    scene = nc.Scene()
    top, far, foot = (0, 0, height), (span, 0, height), (span, 0, 0)
    column = scene.add(
        nc.Beam(
            section(), [(0, 0, 0), top], elements=pieces, second=(0, 1, 0), start=nc.ground, name="column"
        )
    )
    girder = scene.add(
        nc.Beam(section(), [top, far], elements=pieces, second=(0, 1, 0), start=column.end, name="girder")
    )
    prop = scene.add(nc.Beam(section(), [foot, far], elements=1, second=(0, 1, 0), name="prop"))
    scene.add(nc.Revolute(nc.ground, prop.start, point=foot, axis=(0, 1, 0)))
    scene.add(nc.Revolute(girder.end, prop.end, point=far, axis=(0, 1, 0), name="hinge"))
    scene.add(nc.PointForce((nc.Point(column.end, top),), force=grows((load, 0, 0))))
    system, state = scene.compile()
    assert girder.start == column.end
    states = nc.equilibrium(system, state, BOTH).states
    moved = odd(system.sense(states, column.end).position)[0]
    pushed = odd(system.sense(states, prop.elements[0]).resultant)[2]

    def sway(midpoint):
        """By the force method; integrals of squares of arms by the rule of the mesh, or exactly."""
        square = (1 - midpoint / (4 * pieces**2)) / 3
        up = span**3 * square + span**2 * height + BENDING * (span / SHEAR + 2 * height / STRETCH)
        force = load * span * height**2 / 2 / up
        return load * (height**3 * square / BENDING + height / SHEAR) - force * span * height**2 / (
            2 * BENDING
        ), force

    wanted, force = sway(1.0)
    assert moved == pytest.approx(wanted, rel=2 * LINEAR)
    # Places of a metre are rounded by 1e-16, and EA is 1e7 N.
    assert pushed == pytest.approx(-force, abs=1e-15 * STRETCH)
    assert moved == pytest.approx(sway(0.0)[0], rel=3 / (4 * pieces**2))
    # Moments of the corner, from the elements at both sides, by their arms.
    inner = [odd(system.sense(states, x).resultant)[3] for x in (column.elements[-1], girder.elements[0])]
    arm = 0.5 / pieces
    corner = force * span
    assert abs(inner[1]) == pytest.approx(corner * (1 - arm), rel=1e-5)
    assert abs(inner[0]) == pytest.approx(abs(corner - load * height * arm), rel=1e-5)


@pytest.fixture(scope="module")
def hung():
    """A cantilever with a rigid body on a joint at three tenths of it and a spring at six tenths."""
    load, spring = 2e-4, 30.0
    scene = nc.Scene()
    beam = scene.add(
        nc.Beam(
            section(),
            [(0, 0, 0), (1, 0, 0)],
            elements=10,
            stations=(0.3, 0.6),
            second=(0, 1, 0),
            start=nc.ground,
            name="beam",
        )
    )
    place, above = (0.3, 0, 0), (0.6, 0, 1.0)
    weight = scene.add(
        nc.RigidBody(mass=1.0, inertia=(0.01, 0.01, 0.01), position=(0.3, 0, -0.2), name="weight")
    )
    scene.add(nc.Spherical(beam.at(0.3), weight, point=place, name="hook"))
    ends = (nc.Point(nc.ground, above), nc.Point(beam.at(0.6), (0.6, 0, 0)))
    scene.add(nc.Spring(ends, stiffness=spring, length=1.0, name="spring"))
    scene.add(nc.PointForce((nc.Point(weight, (0.3, 0, -0.2)),), force=grows((0, 0, -load)), name="load"))
    system, state = scene.compile()
    return system, nc.equilibrium(system, state, jnp.array([0.5, 1.0])).states, beam, load, spring


def test_what_is_attached_in_the_middle(hung):
    """Could go wrong: a station at the nearest node instead of its own, reactions that act at the tip.

    Deflections of textbooks at both stations: the load through the joint at a, the spring at b against it.
    """
    system, states, beam, load, spring = hung
    assert beam.fractions[3] == pytest.approx(0.3) and len(beam.elements) == 10
    cuts = np.array(beam.fractions)
    found = [np.asarray(system.sense(states, beam.at(x)).position)[1] for x in (0.3, 0.6)]
    for number, off in ((1, 5 * LINEAR), (0, 0.04)):
        own, across, other = (flexibility(*x, cuts)[number] for x in ((0.3, 0.3), (0.3, 0.6), (0.6, 0.6)))
        held = -across * load / (1 + spring * other)
        wanted = -(own * load + spring * held * across)
        assert found[1][2] == pytest.approx(held, rel=off)
        assert found[0][2] == pytest.approx(wanted, rel=off)
    # Sensors: a point of the node, the shear at both sides of a station.
    marked = system.sense(states, nc.Point(beam.at(0.3), (0, 0, 0), local=True)).position
    np.testing.assert_allclose(marked[1], found[0], rtol=0, atol=1e-15)
    shear = np.asarray(system.sense(states, beam.elements).resultant)[1, :, 1]
    pull = -spring * found[1][2]
    wanted = np.repeat([pull - load, pull, 0.0], [3, 3, 4])
    np.testing.assert_allclose(shear, wanted, rtol=0, atol=20 * LINEAR * load)
    assert float(system.sense(jax.tree.map(lambda x: x[1], states), "hook").force[2]) == pytest.approx(load)


def loop():
    """A four-bar in flight: two rigid bodies and two beams with hinges at all corners; the beams were hit."""
    spin = np.array([0.2, -0.3, 1.5])
    corners = np.array([[0, 0, 0], [1, 0, 0], [1.2, 0.8, 0], [0, 0.8, 0]], float)
    scene, bodies, links = nc.Scene(), [], []
    for number, (a, b) in enumerate(((0, 1), (2, 3))):
        middle = 0.5 * (corners[a] + corners[b])
        motion = {"position": middle, "velocity": np.cross(spin, middle), "angular_velocity": spin}
        bodies.append(scene.add(nc.RigidBody(mass=1.0 + number, inertia=(0.1, 0.2, 0.25), **motion)))
    soft = section(EA=400.0, GA=300.0, EI=(1.0, 0.8), GJ=0.6, rotary=0.02)
    for (a, b), (first, second) in zip(((1, 2), (3, 0)), (bodies, bodies[::-1])):
        motion = {"velocity": np.cross(spin, corners[a]), "angular_velocity": spin, "name": f"link {a}"}
        link = scene.add(nc.Beam(soft, corners[[a, b]], elements=2, second=(0, 0, 1), **motion))
        scene.add(nc.Revolute(first, link.start, point=corners[a], axis=(0, 0, 1)))
        scene.add(nc.Revolute(link.end, second, point=corners[b], axis=(0, 0, 1)))
        links.append(link)
    system, state = scene.compile()
    v = state.v
    for link, hit in zip(links, ((1.0, 0.0, 2.0), (-0.5, 0.5, 1.0))):
        v = v.at[4 * system.body_index(link.nodes[1])].add(jnp.asarray(hit))
    return system, replace_fields(state, v=v)


@pytest.mark.slow
def test_a_loop_of_beams_and_bodies_in_flight():
    """Could go wrong: a cut of the loop that works, elements between joints. All balances over 300 steps."""
    system, state = loop()
    trajectory = nc.simulate(system, state, dt=0.02, steps=300)
    found = nc.balance(system, trajectory)
    assert found.directions == 3 and found.axes == 3
    assert found.energy.max() <= tol.ENERGY
    assert found.momentum.max() <= tol.MOMENTUM
    assert found.angular_momentum.max() <= tol.ANGULAR_MOMENTUM
    assert float(jnp.max(system.constraint_errors(trajectory).joints)) <= tol.CONSTRAINT
    energy = system.energy(trajectory)
    strained = sum(np.asarray(x) for name, x in energy.stores.items() if name.startswith("link"))
    assert strained.max() > 0.1 * float(energy.total[0])
