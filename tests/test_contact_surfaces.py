"""Contact of surfaces of shells and solids, and of beams: conservation, contract of a gap, wrong input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.bodies.contact_sides import MeshSide
from natcoord_jax.bodies.mesh_handle import Surface
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.effects.contact.node_on_facets import nearest_point, shapes
from natcoord_jax.gallery.racket import add_ball
from natcoord_jax.maths.rotations import from_rotation_vector

FLOOR = nc.Plane(normal=(0, 0, 1))
SQUARE = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
FACETS = [(1, 2, 3, 4), (2, 5, 6, 3)]


def node_on_two_facets(**options):
    """A node, and two facets with an edge in common."""
    points = tuple(nc.Point(nc.ground, (k, 0, 0)) for k in range(7))
    ends = [(1, 0, 1, 1), (1, 1, 1, 0)]
    return nc.NodeOnFacets(points, facets=np.array(FACETS), open=np.array(ends), stiffness=2.0, **options)


def places(random, at):
    """A node near the facets, which are warped."""
    corners = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
    return jnp.asarray(np.concatenate([[at], corners + 0.05 * random.normal(size=(6, 3))]))


def test_nearest_points():
    """Against the nearest of many; the normal of a point within goes through the node."""
    random, line = np.random.default_rng(0), np.linspace(-1, 1, 101)
    many = np.array([shapes(np.array([u, v])) for u in line for v in line])
    found = jax.jit(nearest_point)
    for _ in range(30):
        corners = SQUARE + 0.15 * random.normal(size=(4, 3))
        point = random.uniform(-0.3, 1.3, 3) * (1, 1, 0.6)
        near = found(point, corners)
        distance = np.linalg.norm(near.apart)
        least = np.linalg.norm(point - many @ corners, axis=1).min()
        assert least - 0.01 <= distance <= least + 1e-12
        if near.edge < 0:
            assert np.linalg.norm(np.cross(near.apart, near.normal)) <= 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("two_sided", [0.0, 1.0])
@pytest.mark.parametrize(
    "at",
    [
        (0.4, 0.5, 0.05),
        (1.02, 0.5, -0.03),
        *(pytest.param(x, marks=pytest.mark.exhaustive) for x in ((0.97, 0.6, 0.04), (-0.05, 0.5, 0.05))),
    ],
)
def test_contract_of_a_gap(two_sided, at):
    """Frame-indifferent; a lever without sum and moment that is its derivative, within, at edges and ends."""
    random = np.random.default_rng(1)
    contact, x = node_on_two_facets(thickness=0.1, two_sided=two_sided), places(random, at)
    turn, shift = from_rotation_vector(jnp.asarray(random.normal(size=3))), random.normal(size=3)
    measured = contact.measured(x)
    assert abs(contact.gap(x @ turn.T + shift) - measured.gap) <= 1e-13
    assert np.abs(jnp.sum(measured.lever, axis=0)).max() <= 1e-13
    assert np.abs(jnp.sum(jnp.cross(x, measured.lever), axis=0)).max() <= 1e-12
    direction = jnp.asarray(random.normal(size=x.shape))
    assert_v_shaped(contact.gap, x, direction, jnp.vdot(measured.lever, direction))


def test_discrete_derivative():
    """Does the work of the gap at a step of one radian, and has neither sum nor moment in its middle."""
    random = np.random.default_rng(2)
    contact, x = node_on_two_facets(), places(random, (0.9, 0.4, 0.1))
    moved = jnp.asarray(0.3 * random.normal(size=x.shape)) + jnp.cross(jnp.asarray([0.5, 0.6, 0.6]), x)
    middle = x + 0.5 * moved
    begun, ended, found = contact._discrete(x, middle[None], moved[None], jnp.ones(1))
    assert abs(jnp.vdot(found[0], moved) - (ended.gap - begun.gap)) <= 1e-13
    assert np.abs(jnp.sum(found[0], axis=0)).max() <= 1e-13
    assert np.abs(jnp.sum(jnp.cross(middle, found[0]), axis=0)).max() <= 1e-12


@pytest.mark.parametrize(
    "at, two_sided, left",
    [
        ((1.5, 0.5, 0.02), 0.0, False),  # on its facets
        ((2.3, 0.5, 0.3), 0.0, False),  # in front of the others
        ((2.3, 0.5, 0.02), 0.0, True),
        ((2.3, 0.5, -0.3), 0.0, True),
        ((2.3, 0.5, -0.3), 1.0, False),
        ((-0.3, 0.5, -0.1), 0.0, False),  # beyond an end of the surface
        ((7.0, 0.5, -0.1), 0.0, False),  # beyond all of it
    ],
)
def test_a_node_that_leaves_its_facets_is_seen(at, two_sided, left):
    """Where the surface goes on for two metres beyond the last of them."""
    beyond = np.zeros((2, 4))
    beyond[1, 1] = 2.0
    contact = node_on_two_facets(thickness=0.05, two_sided=two_sided, beyond=beyond)
    corners = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
    rows = np.zeros((7, 4, 3))
    rows[:, 0] = np.concatenate([[at], corners])
    (seen,) = contact.uncovered(jnp.asarray(np.eye(4)[np.zeros(7, int)]), jnp.asarray(rows)).values()
    assert bool(seen) == left


@pytest.mark.parametrize("aside", [0.3, 2.0, 30.0])
def test_a_node_beside_its_facets_is_not_behind_them(aside):
    """Far away it crosses their plane, and nothing happens: the gap has no jump there."""
    beyond = np.zeros((2, 4))
    beyond[1, 1] = 2.0
    ends = np.array([(1, 0, 1, 1), (1, 0, 1, 0)])
    contact = dataclasses.replace(node_on_two_facets(beyond=beyond), open=ends)
    corners = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
    above, below = (contact.gap(jnp.asarray([(2.0 + aside, 0.5, z), *corners])) for z in (1e-6, -1e-6))
    assert abs(above - aside) < 1e-9 and abs(below - aside) < 1e-9


def test_a_node_at_the_very_end_counts():
    """Rounding puts one that is level with the end of a surface beyond it, where it would go through."""
    corners = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
    gaps = [node_on_two_facets().gap(jnp.asarray([(x, 0.5, -0.01), *corners])) for x in (2 + 1e-12, 2 + 1e-3)]
    np.testing.assert_allclose(gaps, [-0.01, np.hypot(1e-3, 0.01)], rtol=1e-9)


def test_a_node_that_is_out_on_the_other_side_is_not_behind():
    """Of a body of half a metre: inside it is pushed back, below it is as far as it is."""
    corners = np.concatenate([SQUARE, SQUARE[1:3] + (1.0, 0.0, 0.0)])
    contact = node_on_two_facets(depth=np.array([0.5, 0.5]))
    gaps = [contact.gap(jnp.asarray([(0.9, 0.5, z), *corners])) for z in (-0.4, -0.6)]
    np.testing.assert_allclose(gaps, [-0.4, 0.6], rtol=1e-12)
    block = nc.Scene().add(
        nc.Solid(nc.mesh.box((1, 1, 0.5), (2, 2, 1)), material=nc.Elastic(E=1.0, density=1.0))
    )
    np.testing.assert_allclose(MeshSide(block.nodes[0], Surface, block.face("z1")).depth, 0.5, rtol=1e-12)


def warped_patch(random, warp):
    """Nine facets in a plane but for the warp, each with its corners in turn from any of them on."""
    line = np.linspace(-1.5, 1.5, 4)
    corners = np.array([(x, y, 0.0) for x in line for y in line]) + warp * random.normal(size=(16, 3))
    facets = np.array([(k, k + 4, k + 5, k + 1) for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)])
    facets = np.array([np.roll(facet, random.integers(4)) for facet in facets])
    edges = [frozenset(pair) for facet in facets for pair in zip(facet, np.roll(facet, -1))]
    ends = np.array([edges.count(edge) == 1 for edge in edges], float).reshape(9, 4)
    return corners, {"facets": facets + 1, "open": ends}


@pytest.mark.parametrize("warp", [0.0, 0.01, 0.05])
def test_a_node_far_from_warped_facets(warp):
    """It is as far as their nearest point, in front, beside, or behind all but their ends."""
    random, line = np.random.default_rng(3), np.linspace(-1, 1, 9)
    corners, given = warped_patch(random, warp)
    markers = tuple(nc.Point(nc.ground, (k, 0, 0)) for k in range(17))
    contact = nc.NodeOnFacets(markers, stiffness=1.0, **given)
    inside = np.array([shapes(np.array([u, v])) for u in line for v in line])
    surface = np.einsum("sk,fkx->fsx", inside, corners[given["facets"] - 1]).reshape(-1, 3)
    direction = random.normal(size=(5000, 3)) * (1.0, 1.0, 0.7)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    near = random.uniform(-1.5, 1.5, (5000, 3)) * (1, 1, 0)
    at = near + 10.0 ** random.uniform(0, 2, (5000, 1)) * direction
    apart = np.linalg.norm(at[:, None] - surface, axis=2)
    end = 1.5 - np.abs(surface[apart.argmin(axis=1), :2]).max(axis=1) < 0.3
    out = np.linalg.norm(at[:, :2] - np.clip(at[:, :2], -1.5, 1.5), axis=1)
    ahead = at[:, 2] > np.where(out > 0.5, -0.7 * out, 0.5)
    behind = (at[:, 2] < -0.5) & ~end
    assert ahead.sum() > 1000 and behind.sum() > 100
    gaps = jax.jit(jax.vmap(lambda x: contact.gap(jnp.concatenate([x[None], corners]))))(jnp.asarray(at))
    expected = np.where(behind, -1.0, 1.0) * apart.min(axis=1)
    clear = ahead | behind
    np.testing.assert_allclose(gaps[clear], expected[clear], rtol=0.02)


@pytest.mark.slow
def test_a_body_flies_past_a_surface():
    """Far beside it and across its plane, where a corner that two facets share is nearest: nothing pushes."""
    corners, given = warped_patch(np.random.default_rng(5), 0.05)
    scene, place, velocity = nc.Scene(), (-6.0, 0.6, 1.0), (0.0, 0.0, -2.0)
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), position=place, velocity=velocity))
    markers = nc.Point(body, place), *(nc.Point(nc.ground, x) for x in corners)
    scene.add(nc.NodeOnFacets(markers, stiffness=1e5, **given))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.01, steps=100)
    straight = np.asarray(place) + np.asarray(trajectory.t)[:, None] * velocity
    np.testing.assert_allclose(system.sense(trajectory, body).position, straight, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("sideways", [0.0, 3.0])
def test_a_run_warns_of_a_node_that_leaves_its_facets(sideways, recwarn):
    """A cube that slides along a bar, whose nodes know the facets below them only."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=10.0)
    bar = scene.add(nc.Solid(nc.mesh.box((4, 1, 1), (4, 1, 1)), material=rubber, name="bar"))
    scene.add(nc.Clamp(nc.ground, bar.set("z0")))
    cube = nc.mesh.box((0.9, 0.9, 0.9), (1, 1, 1))
    moving = {"position": (0.05, 0.05, 1.01), "velocity": (sideways, 0.0, -2.0)}
    slider = scene.add(nc.Solid(cube, material=rubber, name="slider", **moving))
    options = {"stiffness": 2e3, "candidates": 1, "one_pass": True, "name": "slide"}
    scene.add(nc.Contact(slider.face("z0"), bar.face("z1"), **options))
    system, state = scene.compile()
    nc.simulate(system, state, dt=4e-3, steps=100)
    said = [str(w.message) for w in recwarn if "has left the facets" in str(w.message)]
    assert bool(said) == (sideways > 0)
    assert all("slide" in text and "slider nodes" in text for text in said)


@pytest.mark.parametrize("law", ["linear", "hertz"])
def test_mean_force(law):
    """Differences of the energy over those of the gap, without cancelling where the gap hardly changes."""
    contact = node_on_two_facets(law=law)
    for before, after in ((-0.3, -0.1), (0.2, -0.1), (-0.1, 0.3), (0.1, 0.2)):
        work = contact.stored_at(after) - contact.stored_at(before)
        force = contact.mean_force(jnp.asarray(before), jnp.asarray(after))
        assert float(force * (before - after)) == pytest.approx(float(work), abs=1e-15)
    near = contact.mean_force(jnp.asarray(-0.2), jnp.asarray(-0.2 * (1 + 1e-13)))
    assert float(near) == pytest.approx(float(contact.readings_at(jnp.asarray(-0.2)).force), rel=1e-12)


def assert_kept(system, trajectory, *, momentum=True):
    found = nc.balance(system, trajectory)
    assert found.energy.max() <= 1e-12
    if momentum:
        assert found.momentum.max() <= 1e-12
        assert found.angular_momentum.max() <= 1e-12


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [4e-3, 12e-3])
def test_blocks_collide_and_fly_on(dt):
    """Five hundred steps, some longer than a wave takes: they turn over, and nodes are behind each other."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    spin, middle = np.array([0.0, 0.3, 0.8]), np.array([1.0, 1.0, 0.3])
    given = {
        "position": (0.02, 0.2, 0.19),
        "orientation": ((1.0, 0.6, 0.0), 0.29),
        "velocity": (1.0, 0.5, -4.0),
    }
    one = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (2, 2, 1)), material=rubber, **given))
    given = {"position": (-0.55, -0.45, -0.65), "velocity": np.array([0, 0, 2.0]) - np.cross(spin, middle)}
    given |= {"angular_velocity": spin}
    other = scene.add(nc.Solid(nc.mesh.box((2, 2, 0.6), (2, 2, 1)), material=rubber, **given))
    scene.add(nc.Contact(one.face("z0"), other.face("z1"), name="impact"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=dt, steps=500)
    assert_kept(system, trajectory)
    stores = system.energy(trajectory).stores["impact"]
    assert float(stores.max()) >= 0.2 * float(system.energy(trajectory).kinetic[0])
    assert float(stores[-1]) == 0.0


@pytest.mark.slow
def test_blocks_collide():
    """At half the time of a wave through a block: a third of the energy is stored, and all is kept."""
    example = gallery.load("colliding_blocks")
    trajectory = example.simulate()
    assert_kept(example.system, trajectory)
    energy = example.system.energy(trajectory)
    assert float(energy.stores["impact"].max()) >= 0.1 * float(energy.kinetic[0])
    assert float(energy.stores["impact"][-1]) == 0.0


def soft_squares(**options):
    """Two pieces of rubber of one element each that hit each other face to face, all numbers at hand."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=10.0)
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    one = scene.add(nc.Solid(mesh, material=rubber, name="one"))
    place = {"position": (0.2, 0.1, 1.01), "velocity": (0.0, 0.0, -2.0)}
    other = scene.add(nc.Solid(mesh, material=rubber, name="other", **place))
    scene.add(nc.Contact(one.face("z1"), other.face("z0"), name="impact", **options))
    return scene.compile()


@pytest.mark.slow
def test_gradients_through_a_contact():
    """Of the program, by stiffness and by how fast they meet: V-shaped."""
    system, state = soft_squares(stiffness=2e3)

    weights = jnp.cos(jnp.arange(state.v.size)).reshape(state.v.shape)

    @jax.jit
    def last(x):
        changed = system.set("impact", stiffness=x[0] * 1e3 * jnp.ones(8))
        start = replace_fields(state, v=state.v * x[1])
        return jnp.vdot(nc.simulate(changed, start, dt=4e-3, steps=15).states.v[-1], weights)

    one = jnp.ones(2)
    direction = jnp.asarray([1.0, -0.4])
    assert_v_shaped(last, one, direction, jnp.vdot(jax.grad(last)(one), direction))


@pytest.mark.slow
def test_losses_of_surfaces_are_booked():
    system, state = soft_squares(stiffness=2e3, restitution=0.5, speed=2.0)
    trajectory = nc.simulate(system, state, dt=4e-3, steps=30)
    assert_kept(system, trajectory)
    assert np.diff(np.asarray(system.work(trajectory)["impact"])).max() <= 1e-13
    assert float(system.work(trajectory)["impact"][-1]) < -0.5


@pytest.mark.slow
def test_beam_falls_on_a_beam_and_on_the_floor():
    """Energy is kept; none of them goes through the other."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    section = nc.CircularSection(radius=0.02, E=1e6, density=1000.0)
    one = scene.add(nc.Beam(section, [(-0.5, 0, 0.3), (0.5, 0, 0.3)], elements=3, name="one"))
    two = scene.add(nc.Beam(section, [(0, -0.4, 0.1), (0, 0.4, 0.1)], elements=3, name="two"))
    scene.add(nc.Contact(one, two, stiffness=2e3, name="cross"))
    for beam in (one, two):
        scene.add(nc.Contact(beam, FLOOR, stiffness=2e4))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=250)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE * 10
    stored = sum(np.asarray(x) for name, x in system.energy(trajectory).stores.items() if "cross" in name)
    assert stored.max() > 1e-3
    heights = [np.asarray(system.sense(trajectory, node).position)[:, 2].min() for node in one.nodes]
    assert min(heights) > 0.0


@pytest.mark.exhaustive
def test_ball_on_a_plate():
    """Dropped from 2.54 m (7 m/s), a tennis ball keeps 0.73 to 0.76 of its speed, which its wall damps."""
    scene = nc.Scene()
    ball = add_ball(scene, 4, position=(0, 0, 0.0365), velocity=(0, 0, -7.0))
    scene.add(nc.Contact(ball, FLOOR, name="plate"))
    system, state = scene.compile()
    rest = nc.equilibrium(system, state, steps=1).state
    start = replace_fields(rest, v=state.v, t=state.t)
    trajectory = nc.simulate(system, start, dt=1e-4, steps=100)
    assert nc.balance(system, trajectory).energy.max() <= 1e-12
    momentum = np.asarray(system.momentum(trajectory))[:, 2]
    assert 0.73 <= -momentum[-1] / momentum[0] <= 0.76


def _two(scene, **placing):
    rubber = nc.Elastic(E=1e4, density=1.0)
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    return [scene.add(nc.Solid(mesh, material=rubber, position=p)) for p in ((0, 0, 0), placing["position"])]


def test_wrong_surfaces_are_refused():
    scene = nc.Scene()
    one, two = _two(scene, position=(0.3, 0.2, 0.9))
    with pytest.raises(ValueError, match="'solid 1' would be in contact with itself"):
        scene.add(nc.Contact(one.face("z1"), one.face("z0")))
    with pytest.raises(ValueError, match=r"stiffness.*positive"):
        scene.add(nc.Contact(one, two, stiffness=-1.0))
    with pytest.raises(ValueError, match="no side 'outside'"):
        one.surface("outside")
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1.0, position=(3, 0, 0)))
    with pytest.raises(ValueError, match="no friction .* on nodes of shells and solids"):
        scene.add(nc.Contact(one, ball, friction=0.3))
    with pytest.raises(ValueError, match="a mortar has no friction .*method='nodes'"):
        scene.add(nc.Contact(one.face("z1"), two.face("z0"), friction=0.3, method="mortar"))
    with pytest.raises(ValueError, match="speed .* of contacts with a stiffness"):
        scene.add(nc.Contact(ball, FLOOR, restitution=0.5, speed=1.0))
    scene.add(nc.Contact(one.face("z1"), two.face("z0")))
    with pytest.raises(ValueError, match="starts in penetration"):
        scene.compile()
