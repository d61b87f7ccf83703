"""Masses, moments and resultants: of sections, lumps and loads, against integrals that are exact.

Could go wrong: width for height, diameter for radius, data on the wrong axis, offsets of the mass counted
twice, loads whose resultant or work is another, following loads that do not turn.
"""

import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from flexible_scenes import (
    CUTS,
    DENSITY,
    ELEMENTS,
    LAWS,
    LINE,
    NUMBERS,
    distorted,
    grows,
    place_of,
    rod,
    spun,
    with_rows,
)
from scipy.spatial.transform import Rotation

import natcoord_jax as nc

METAL = nc.Elastic(E=2e5, nu=0.3, density=1200.0)
RUBBER = nc.Elastic(E=2e6, density=1000.0)

# --- sections -----------------------------------------------------------------------------------------------


def diagonal(section):
    return np.asarray(section.stiffness).diagonal()


def test_tubes():
    """Cowper (1966): 2 (1 + nu) / (4 + 3 nu) of a thin wall; a full circle where the wall is the radius."""
    young, nu, density = 2e11, 0.3, 7800.0
    rigidity, (outer, inner) = young / (2 * (1 + nu)), (0.05, 0.04)
    numbers = {"E": young, "nu": nu, "density": density}
    tube = nc.TubularSection(radius=outer, thickness=outer - inner, **numbers)
    area, polar = np.pi * (outer**2 - inner**2), 0.5 * np.pi * (outer**4 - inner**4)
    wanted = [young * area, 0.5 * young * polar, 0.5 * young * polar, rigidity * polar]
    np.testing.assert_allclose(diagonal(tube)[2:], wanted, rtol=tol.SOME_ROUNDINGS)
    inertia = density * np.array([area, 0.5 * polar, 0.5 * polar])
    np.testing.assert_allclose(tube.inertia, np.diag(inertia), rtol=tol.SOME_ROUNDINGS, atol=0)
    thin = diagonal(nc.TubularSection(radius=1.0, thickness=1e-5, **numbers))
    cowper = 2 * (1 + nu) / (4 + 3 * nu)
    np.testing.assert_allclose(thin[:2], cowper * thin[2] * rigidity / young, rtol=1e-9)
    full = nc.TubularSection(radius=0.02, thickness=0.02, **numbers)
    circle = nc.CircularSection(radius=0.02, **numbers)
    np.testing.assert_allclose(full.stiffness, circle.stiffness, rtol=tol.SOME_ROUNDINGS)


TORSION = {1.0: 0.1406, 1.2: 0.166, 1.5: 0.196, 2.0: 0.229, 2.5: 0.249, 3.0: 0.263, 4.0: 0.281, 10.0: 0.312}
"""J / (a b^3) by a / b, by Timoshenko & Goodier."""


def test_rectangles():
    """Torsion by the table, shear by Cowper's coefficient."""
    young, nu, thin, close = 3.0, 0.25, 0.1, {"rtol": tol.SOME_ROUNDINGS}
    rigidity = young / (2 * (1 + nu))
    for ratio, factor in TORSION.items():
        sides = {"E": young, "nu": nu, "density": 5.0}
        upright, lying = (
            nc.RectangularSection(width=w, height=h, **sides)
            for w, h in ((thin, thin * ratio), (thin * ratio, thin))
        )
        area, stiff = thin**2 * ratio, diagonal(upright)
        # The table has three digits, four of the square.
        digits = 6e-5 if ratio == 1 else 6e-4
        assert stiff[5] / (rigidity * thin**4 * ratio) == pytest.approx(factor, abs=digits), ratio
        strong, weak = thin**4 * ratio**3 / 12, thin**4 * ratio / 12
        np.testing.assert_allclose(stiff[2:5], young * np.array([area, strong, weak]), **close)
        shear = 10 * (1 + nu) / (12 + 11 * nu) * rigidity * area
        np.testing.assert_allclose(stiff[:2], [shear, shear], **close)
        np.testing.assert_allclose(diagonal(lying), stiff[[1, 0, 2, 4, 3, 5]], **close)
        # The second moment of theta^1 is the inertia about d_2.
        wanted = 5.0 * np.array([area, weak, strong])
        np.testing.assert_allclose(np.diag(upright.inertia), wanted, **close)


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
    energy = ours @ np.asarray(coupled) @ ours
    assert energy == pytest.approx(np.sum((root.T @ theirs) ** 2), rel=tol.SOME_ROUNDINGS)


# --- curves -------------------------------------------------------------------------------------------------


def test_twist_turns_the_frames():
    """Could go wrong: the sense of the turn, degrees, a function of the fraction in place of arc length."""
    angle, long = 0.7, [(0, 0, 0), (2, 0, 0)]
    section, scene = nc.Section.of_numbers(**NUMBERS), nc.Scene()
    beam, other = (
        scene.add(nc.Beam(section, long, elements=4, second=(0, 1, 0), twist=twist))
        for twist in (angle, lambda s: 0.5 * angle * s)
    )
    for place, a, b in zip(beam.fractions, beam.attachments, other.attachments):
        c, s = np.cos(angle * place), np.sin(angle * place)
        turned = [[0, c, s], [0, -s, c], [1, 0, 0]]
        np.testing.assert_allclose(np.asarray(a.axes).T, turned, rtol=0, atol=1e-15)
        np.testing.assert_allclose(b.axes, a.axes, rtol=0, atol=1e-15)


def test_lines_with_a_corner():
    """Could go wrong: fractions of points in place of those of length, tangents at the end and the corner."""
    section, corner = nc.Section.of_numbers(**NUMBERS), [(0, 0, 0), (0.6, 0, 0), (0.6, 0.0, 1.8)]
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, corner, elements=8, second=(0, 1, 0)))
    arc = 2.4 * np.linspace(0, 1, 9)
    wanted = np.stack([np.minimum(arc, 0.6), 0 * arc, np.maximum(arc - 0.6, 0.0)], axis=1)
    points = np.stack([np.asarray(a.point) for a in beam.attachments])
    np.testing.assert_allclose(points, wanted, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.sum(beam.shares), 2.4, rtol=tol.SOME_ROUNDINGS)
    axes, mean = np.stack([np.asarray(a.axes) for a in beam.attachments]), np.sqrt(0.5)
    tangents = [[1, 0, 0], [1, 0, 0], [mean, 0, mean], [0, 0, 1], [0, 0, 1]]
    np.testing.assert_allclose(axes[[0, 1, 2, 3, 8], :, 2], tangents, rtol=0, atol=1e-15)
    # The corner is in the plane of d_3 and d_2, which turns with it; d_1 is the axis of the turn.
    np.testing.assert_allclose(axes[:, :, 0], np.broadcast_to([0, 1, 0], (9, 3)), rtol=0, atol=1e-15)
    system, state = scene.compile()
    assert float(system.energy(state).total) == pytest.approx(0.0, abs=1e-20)


# --- masses -------------------------------------------------------------------------------------------------


def test_a_centre_of_mass_beside_the_axis():
    """Could go wrong: an offset along the wrong director, its inertia missing or counted twice.

    A clamped rod turned about its axis has the angular momentum of m e^2 and of its inertia.
    """
    aside, rate = 0.02, 3.0
    system, state, beam = rod(nc.Section.of_numbers(**NUMBERS, centre=(aside, 0.0)))
    np.testing.assert_allclose(system.sense(state, beam.end).com, [1, aside, 0], atol=1e-15)
    rates = np.cross([rate, 0, 0], np.asarray(state.rows))
    rates[:, 0] = 0.0
    turning = with_rows(state, rates=rates)
    # Half of the first element's mass is that of the clamped node.
    free = 1 - 0.5 * CUTS[1]
    about = NUMBERS["density"] * aside**2 + sum(NUMBERS["rotary"])
    momentum = np.asarray(system.angular_momentum(turning))[0]
    assert momentum == pytest.approx(rate * about * free, rel=tol.SOME_ROUNDINGS)
    pushed = rate * aside * NUMBERS["density"] * free
    np.testing.assert_allclose(system.momentum(turning), [0, 0, pushed], rtol=0, atol=1e-13 * pushed)


def test_a_beam_with_a_body_at_its_end():
    """The end of a beam is rigidly part of a body: total mass, centre and inertia are those of both."""
    section, scene = nc.Section.of_numbers(**NUMBERS), nc.Scene()
    place, turn = np.array([1, 0, 0.2]), ((0, 1, 0), 0.4)
    numbers = {"mass": 3.0, "inertia": (0.1, 0.2, 0.25)}
    plug = scene.add(nc.RigidBody(position=place, orientation=turn, **numbers))
    beam = scene.add(nc.Beam(section, LINE, elements=4, second=(0, 1, 0), end=plug))
    system, state = scene.compile()
    assert beam.end == plug
    # Lumps of density 2 kg/m, with rotary inertia 0.02 and 0.01 kg m across and 0.03 kg m along.
    places = np.linspace(0, 1, 5)[:, None] * [1.0, 0, 0]
    shares = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
    across = NUMBERS["rotary"]
    lump = np.diag([sum(across), across[0], across[1]])
    parts = [(2 * w, x, w * lump) for w, x in zip(shares, places)]
    rotation = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()
    parts.append((3.0, place, rotation @ np.diag(numbers["inertia"]) @ rotation.T))
    first = sum(m * x for m, x, _ in parts)
    inertia = sum(m * (x @ x * np.eye(3) - np.outer(x, x)) + about for m, x, about in parts)
    drift, spin = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.7, -0.4])
    moving = spun(state, spin, drift)
    momentum, turning = 5 * drift + np.cross(spin, first), inertia @ spin + np.cross(first, drift)
    close = {"rtol": 0, "atol": 5 * tol.SOME_ROUNDINGS}
    np.testing.assert_allclose(system.momentum(moving), momentum, **close)
    np.testing.assert_allclose(system.angular_momentum(moving), turning, **close)
    kinetic = 2.5 * drift @ drift + drift @ np.cross(spin, first) + 0.5 * spin @ inertia @ spin
    assert float(system.energy(moving).kinetic) == pytest.approx(kinetic, rel=tol.SOME_ROUNDINGS)
    assert float(system.energy(state).kinetic) == 0.0


ROTARY = {"Brick": 3.0, "Hexahedron8": 3.0, "Hexahedron20": 2.2, "Hexahedron27": 1.0, "Tetrahedron10": None}
"""Inertia of a cube of one element, over the exact one."""


@pytest.mark.slow
def test_lumped_masses_of_solids():
    """Mass and centre are exact, and rotary inertia with 27 nodes; others come to it as fast as shapes do.

    No masses that are positive could do better for eight nodes, which have an eighth each, and hardly for
    twenty: twice as much without any at the corners, where as much as is right takes negative ones.
    """
    for element, expected in ROTARY.items():
        ratios = []
        for count in (1, 2):
            mesh = nc.mesh.box((2.0, 2.0, 2.0), (count,) * 3, element=ELEMENTS[element])
            scene = nc.Scene()
            scene.add(nc.Solid(mesh, material=LAWS["elastic"], element=element))
            masses = np.asarray(scene.compile()[0].mass)[:, 0, 0]
            x = mesh.nodes - 1.0
            assert masses.min() > 0, element
            assert masses.sum() == pytest.approx(8 * DENSITY, rel=1e-12), element
            np.testing.assert_allclose(masses @ x, 0.0, atol=1e-9, err_msg=element)
            ratios.append(masses @ np.sum(x[:, :2] ** 2, axis=1) / (16 / 3 * DENSITY))
        if expected is not None:
            assert ratios[0] == pytest.approx(expected, rel=0.02), element
        assert ratios[1] - 1.0 == pytest.approx(0.25 * (ratios[0] - 1.0), abs=1e-9), element


def body(kind, **more):
    """A scene with a shell or a solid of a distorted mesh, free."""
    scene = nc.Scene()
    if kind == "shell":
        mesh = distorted(nc.mesh.rectangle((1.0, 0.5), (4, 3)), 0.03)
        return scene, scene.add(nc.Shell(mesh, thickness=0.02, material=METAL, name="body", **more))
    mesh = distorted(nc.mesh.box((1.0, 0.5, 0.4), (3, 2, 2)), 0.03)
    return scene, scene.add(nc.Solid(mesh, material=METAL, name="body", **more))


@pytest.mark.slow
def test_mass_and_motion_of_what_is_put_somewhere():
    """A rigid body that is turned and spun, not strained."""
    turn, spin = np.array([(0.0, -1, 0), (1, 0, 0), (0, 0, 1)]), np.array([0.2, 0.3, 2.0])
    motion = {"orientation": turn, "velocity": (0.5, 0, 0), "angular_velocity": spin}
    for kind, mass, centre in (("shell", 12.0, (0.5, 0.25, 0.0)), ("solid", 240.0, (0.5, 0.25, 0.2))):
        system, state = body(kind, position=(1, 2, 3), **motion)[0].compile()
        assert float(system.mass[:, 0, 0].sum()) == pytest.approx(mass, rel=1e-12), kind
        drift = (0.5, 0, 0) + np.cross(spin, turn @ centre)
        np.testing.assert_allclose(system.momentum(state) / mass, drift, atol=1e-2)
        assert float(system.energy(state).stores["body"]) < 1e-20, kind


def test_numbers_follow_those_that_are_set():
    """Stiffness and mass of a thickness, a modulus or a density, of all elements or of each."""
    scene, part = body("shell")
    system, _ = scene.compile()
    thick = system.set(part, thickness=0.04)
    np.testing.assert_allclose(thick.mass[:, 0, 0], 2 * system.mass[:, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(thick.mass[:, 1, 1], 8 * system.mass[:, 1, 1], rtol=1e-12)
    before, after = (np.asarray(s.get(part, "stiffness")) for s in (system, thick))
    np.testing.assert_allclose(after[:, :6, :6], 2 * before[:, :6, :6], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after[:, 6:12, 6:12], 8 * before[:, 6:12, 6:12], rtol=1e-9, atol=1e-9)
    harder = system.set(part, E=4e5)
    np.testing.assert_allclose(harder.get(part, "stiffness"), 2 * before, rtol=1e-12)
    np.testing.assert_allclose(harder.mass, system.mass, rtol=1e-12)
    each = system.set(part, thickness=jnp.linspace(0.01, 0.03, 12), density=1000.0)
    assert each.get(part, "material.density").tolist() == [1000.0] * 12


# --- loads --------------------------------------------------------------------------------------------------


def test_edges_of_a_mesh():
    """Sides of one cell only, in turn round it, of quadrilaterals and of triangles."""
    square = nc.mesh.rectangle((1.0, 1.0), (2, 1))
    assert {tuple(x) for x in square.edges.tolist()} == {(0, 2), (2, 4), (4, 5), (5, 3), (3, 1), (1, 0)}
    halves = nc.mesh.Mesh(square.nodes, [(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)], square.sets)
    assert {tuple(x) for x in halves.edges.tolist()} == {tuple(x) for x in square.edges.tolist()}
    plate = nc.Scene().add(nc.Shell(square, thickness=0.1, material=RUBBER))
    assert plate.edge("right").sides.tolist() == [[4, 5]]


@pytest.mark.exhaustive
@pytest.mark.parametrize("following", [False, True])
def test_resultant_of_an_edge_load(following):
    """Momentum and angular momentum of a free plate grow as force and moment say; work is energy."""
    scene = nc.Scene()
    mesh = nc.mesh.rectangle((1.0, 0.6), (2, 3))
    plate = scene.add(nc.Shell(mesh, thickness=0.05, material=RUBBER, name="plate"))
    # As seen from the edge x = 1: along y, outwards x, normal z.
    axes = np.array([(0, 1, 0), (1, 0, 0), (0, 0, 1)], float)
    force, moment = np.array([3.0, 40.0, 5.0]), np.array([2.0, 1.0, 0.0])
    loads = (force, moment) if following else (force @ axes, moment @ axes)
    edge = plate.edge("right")
    scene.add(nc.EdgeLoad(edge, force=loads[0], moment=loads[1], following=following, name="push"))
    system, state = scene.compile()
    dt = 1e-4
    trajectory = nc.simulate(system, state, dt=dt, steps=2)
    last, resultant = trajectory.states, 0.6 * (force @ axes)
    slack = 0 if following else 1e-9
    np.testing.assert_allclose(system.momentum(last)[-1] / (2 * dt), resultant, rtol=1e-4, atol=slack)
    turning = np.cross((1.0, 0.3, 0.0), resultant) + 0.6 * (moment @ axes)
    np.testing.assert_allclose(system.angular_momentum(last)[-1] / (2 * dt), turning, rtol=1e-3)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    assert float(system.work(trajectory)["push"][-1]) > 0


def strip(count=8):
    """A strip of 1 m x 0.1 m, held at its left end."""
    scene = nc.Scene()
    mesh = nc.mesh.rectangle((1.0, 0.1), (count, 1))
    shell = scene.add(nc.Shell(mesh, thickness=0.01, material=RUBBER, name="strip"))
    scene.add(nc.Clamp(nc.ground, shell.set("left")))
    return scene, shell


def end_of(scene, handle, steps):
    """Where a node comes to rest, along and across [m]."""
    system, state = scene.compile()
    return place_of(system, nc.equilibrium(system, state, steps=steps).state, handle)[[0, 2]]


@pytest.mark.exhaustive
def test_a_strip_rolled_by_a_following_moment():
    """Into half a circle: the moment stays normal to it."""
    scene, shell = strip(16)
    moment = np.pi * float(RUBBER.E) * 0.01**3 / 12
    scene.add(nc.EdgeLoad(shell.edge("right"), moment=lambda t: (-moment * t, 0.0, 0.0), following=True))
    # Directors between nodes are shortened, by the square of a 32nd of pi.
    np.testing.assert_allclose(end_of(scene, shell.set("right")[0], 8), (0.0, 2 / np.pi), atol=0.02)


@pytest.mark.exhaustive
def test_a_strip_bends_as_a_beam_under_a_following_force():
    """That keeps its angle to the end, by far another place than that of a dead force."""
    ends, load = [], 0.03
    for following in (False, True):
        scene, shell = strip()
        push = (0.0, 0.0, 10 * load)
        edge = shell.edge("right")
        scene.add(nc.EdgeLoad(edge, force=lambda t, p=push: tuple(t * x for x in p), following=following))
        ends.append(end_of(scene, shell.set("right")[0], 4))
        scene = nc.Scene()
        section = nc.RectangularSection(width=0.1, height=0.01, E=float(RUBBER.E), nu=0.0, density=1000.0)
        beam = scene.add(nc.Beam(section, LINE, elements=8, start=nc.ground))
        axes = tuple(nc.Direction(beam.end, axis) for axis in np.eye(3))
        markers = (nc.Point(beam.end), *(axes if following else ()))
        scene.add(nc.PointForce(markers, force=grows((0, 0, load)), following=following))
        np.testing.assert_allclose(ends[-1], end_of(scene, beam.end, 4), atol=5e-3)
    assert np.linalg.norm(ends[1] - ends[0]) > 0.05


@pytest.mark.exhaustive
def test_a_pressure_shortens_a_column_and_moves_no_ball():
    """On the end of a solid: along the axis its shortening; on a closed shell there is no resultant."""
    scene, part = body("solid")
    scene.add(nc.Clamp(nc.ground, part.set("x0")))
    scene.add(nc.Pressure(part.face("x1"), lambda t: 1.0 * t, name="push"))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, loads=1.0, steps=1).state
    shortened = [1.0 - float(system.sense(end, h).position[0]) for h in part.set("x1")]
    assert np.mean(shortened) == pytest.approx(1.0 / 2e5, rel=0.05)  # E of the material; the end is clamped
    scene = nc.Scene()
    ball = scene.add(nc.Shell(nc.mesh.sphere(0.1, 3), thickness=2e-3, material=METAL))
    scene.add(nc.Pressure(ball, lambda t: -500.0 * (t < 0.02), name="gas"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=40)
    balance = nc.balance(system, trajectory)
    assert balance.momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert balance.angular_momentum.max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert balance.energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    work = np.asarray(system.work(trajectory)["gas"])
    assert work[20] > 1e-4 and np.ptp(work[20:]) == 0.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("interpolation", [None, nc.DirectorInterpolation(order=2)])
def test_a_load_along_a_beam_can_be_its_weight(interpolation):
    weight, moved = (0.0, 0.0, -9.81 * NUMBERS["density"]), []
    more = {} if interpolation is None else {"interpolation": interpolation}
    for load in ({}, {"force": weight}, {"force": lambda t: jnp.asarray(weight)}):
        scene, section = nc.Scene(), nc.Section.of_numbers(**NUMBERS)
        beam = scene.add(nc.Beam(section, LINE, elements=8, second=(0, 1, 0), start=nc.ground, **more))
        scene.add(nc.LineLoad(beam, **load) if load else nc.Gravity())
        moved.append(nc.simulate(*scene.compile(), dt=0.01, steps=10).q)
    assert float(jnp.max(jnp.abs(moved[0] - moved[0][0]))) > 0.01
    for other in moved[1:]:
        np.testing.assert_allclose(other, moved[0], rtol=0, atol=tol.SAME_TRAJECTORY)


@pytest.mark.slow
def test_a_following_load_turns_with_the_beam():
    """A rod that spins and is pushed along itself: its momentum is the integral of the turning force."""
    rate, push, twist = 2.0, 3.0, 0.5
    scene, section = nc.Scene(), nc.Section.of_numbers(**(NUMBERS | {"EI": 1e4, "GA": 1e5, "EA": 1e6}))
    spin = {"angular_velocity": (0, 0, rate), "velocity": (0, -0.5 * rate, 0)}
    beam = scene.add(nc.Beam(section, LINE, elements=2, second=(0, 0, 1), **spin))
    moment = jnp.array([twist, 0, 0])
    scene.add(nc.LineLoad(beam, force=(0, 0, push), moment=lambda t: moment, following=True))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=200)
    t = np.asarray(trajectory.t)
    turning = np.asarray(system.angular_momentum(trajectory))[:, 2]
    inertia = turning[0] / rate
    # The moment about d_1, which is z, speeds it up.
    angle = rate * t + 0.5 * twist / inertia * t**2
    wanted = np.cumsum(0.5 * (np.exp(1j * angle[1:]) + np.exp(1j * angle[:-1])) * 1e-3 * push)
    momentum = np.asarray(system.momentum(trajectory))
    off = momentum[1:, 0] + 1j * momentum[1:, 1] - wanted
    assert np.abs(off).max() < 2e-3 * abs(wanted[-1])
