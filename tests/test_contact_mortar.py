"""Contact of surfaces by mortar integrals: contract of the gap, areas, patch test, impacts, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.effects.contact.segments import segment
from natcoord_jax.maths.rotations import from_rotation_vector

RUBBER = nc.Elastic(E=1e4, nu=0.3, density=1.0)
FINE, COARSE = nc.mesh.rectangle((1.0, 1.0), (2, 2)), nc.mesh.rectangle((1.5, 1.3), (2, 2))
NODES = len(FINE.nodes)


def places(random):
    """Nodes of a surface that lies turned round on another one, both warped, with a little overlap."""
    above = np.asarray(FINE.nodes) + (0.3, 0.2, -0.03)
    return np.concatenate([above, np.asarray(COARSE.nodes)]) + 0.02 * random.normal(size=(2 * NODES, 3))


def gap_at(node, x, **options):
    """The mean gap at a node of the upper surface, and all nodes, this one first."""
    order = [node, *(k for k in range(2 * NODES) if k != node)]
    facets = np.array([[order.index(k) for k in cell[::-1]] for cell in FINE.cells if node in cell])
    others = np.array([[order.index(k + NODES) for k in cell] for cell in COARSE.cells])
    given = {"facets": facets, "others": others, "stiffness": 100.0}
    x = np.asarray(x)[order]
    return nc.MortarGap(tuple(nc.Point(nc.ground, p) for p in x), **given | options), x


@pytest.mark.parametrize("node", [pytest.param(0, marks=pytest.mark.slow), 4])
def test_contract_of_a_gap(node):
    """Frame-indifferent; a lever without sum and moment that does the work of the gap in a large step."""
    random = np.random.default_rng(1)
    contact, x = gap_at(node, places(random), thickness=0.01)
    turn, shift = np.asarray(from_rotation_vector(jnp.asarray(random.normal(size=3)))), random.normal(size=3)
    gap = jax.jit(lambda x: contact.gap(x))
    assert abs(gap(x @ turn.T + shift) - gap(x)) <= 1e-13
    moved = 0.05 * random.normal(size=x.shape) + np.cross([0.5, 0.6, 0.6], x)
    middle = x + 0.5 * moved
    assert abs(gap(middle)) > 1e-3
    given = jnp.asarray(x), middle[None], moved[None], jnp.ones(1)
    begun, ended, found = jax.jit(lambda *x: contact._discrete(*x))(*given)
    assert abs(jnp.vdot(found[0], moved) - (ended.gap - begun.gap)) <= 1e-13
    for lever in (jax.jit(lambda x: contact.measured(x))(middle).lever, found[0]):
        assert np.abs(jnp.sum(lever, axis=0)).max() <= 1e-13
        assert np.abs(np.sum(np.cross(middle, lever), axis=0)).max() <= 1e-13


@pytest.mark.slow
def test_derivatives_of_the_gap():
    """Nothing is held in the second ones; those in Newton's method are nearly these."""
    random = np.random.default_rng(2)
    contact, x = gap_at(4, places(random))
    lever = jax.jit(lambda x: contact.measured(x).lever)
    x, direction = jnp.asarray(x), jnp.asarray(random.normal(size=x.shape))
    along = jax.jvp(lever, (x,), (direction,))[1]
    assert_v_shaped(lever, x, direction, along)
    nearly = jnp.tensordot(jax.jit(lambda x: contact.turned(x))(x), direction, 2)
    assert np.linalg.norm(nearly - along) <= 0.1 * np.linalg.norm(along)


@pytest.mark.parametrize("node", [0, 4])
def test_all_of_the_force_is_shown_at_the_node(node):
    """Of a flat surface that is covered: along its normal, whole, though the node has a part of it only."""
    above = np.asarray(FINE.nodes) + (0.3, 0.05, -0.01)
    contact, x = gap_at(node, np.concatenate([above, np.asarray(COARSE.nodes)]))
    weights = np.tile(np.eye(4)[0], (len(x), 1))
    rows = np.concatenate([x[:, None], np.tile(np.eye(3), (len(x), 1, 1))], axis=1)
    place, push = eager_numpy(lambda w, rows: contact.touch(w, rows))(weights, rows)
    np.testing.assert_array_equal(place, x[0])
    np.testing.assert_allclose(push, [0, 0, 1], atol=1e-12)


def test_areas():
    """Segments of a facet with others that cover it have its area, also where edges are on each other."""
    area = jax.jit(lambda one, other: segment(one, jnp.ones(4), other, jnp.zeros(4))[1])
    for seed in range(10):
        random = np.random.default_rng(seed)
        turn = np.asarray(from_rotation_vector(jnp.asarray(random.normal(size=3))))
        warp = 0.04 * random.normal(size=(9, 3)) * (1, 1, 0) * (seed % 2)
        nodes = (np.asarray(FINE.nodes) + warp) @ turn.T
        facet, below = nodes[FINE.cells[0]], nodes[FINE.cells[:, ::-1]]
        found = sum(float(area(facet, x)) for x in below)
        exact = 0.5 * np.linalg.norm(np.cross(facet[2] - facet[0], facet[3] - facet[1]))
        assert found == pytest.approx(exact, rel=1e-14, abs=0)
    apart = np.asarray(COARSE.nodes)[COARSE.cells[0]]
    assert float(area(apart + (0.0, 0.0, 5.0), apart)) == 0.0  # both look upwards
    for overlap, seen in ((0.1, True), (0.7, False)):  # of its other wall, if a body is as thin as that
        assert bool(area(apart[::-1] - (0.0, 0.0, overlap), apart) > 0) == seen


def test_facets_that_leave_those_that_they_may_touch_are_seen():
    """Where the surface goes on beyond these; at its end they may hang over."""
    x = places(np.random.default_rng(3)) * (1.0, 1.0, 0.1)
    for aside, rims, seen in ((0.0, 1.0, False), (0.6, 1.0, True), (0.6, 0.0, False)):
        rows = np.zeros((2 * NODES, 4, 3))
        contact, rows[:, 0] = gap_at(4, x, rims=np.full(4, rims), thickness=0.1)
        rows[:NODES, 0, 0] += aside
        given = jnp.asarray(np.eye(4)[np.zeros(2 * NODES, int)]), jnp.asarray(rows)
        (found,) = jax.jit(lambda *x, c=contact: c.uncovered(*x))(*given).values()
        assert bool(found) == seen


def pressed(**options):
    """K07: a block of 2 x 2 on one of 3 x 3 elements, pressed on it; error of stresses over the pressure."""
    scene, material = nc.Scene(), nc.Elastic(E=1e5, nu=0.0, density=1.0)
    low = scene.add(nc.Solid(nc.mesh.box((1, 1, 0.5), (3, 3, 1)), material=material, name="low"))
    up = nc.Solid(nc.mesh.box((1, 1, 0.5), (2, 2, 1)), material=material, position=(0, 0, 0.5), name="up")
    up = scene.add(up)
    scene.add(nc.Clamp(nc.ground, low.set("z0")))
    # It must not slide; nothing of its load is along these.
    for k, axis in ((0, 0), (0, 1), (-1, 0)):
        node, place = up.set("z1")[k], up.set("z1").positions[k]
        plane = nc.Point(nc.ground, place), nc.Direction(nc.ground, np.eye(3)[axis])
        scene.add(nc.PointOnPlane((*plane, nc.Point(node, place))))
    scene.add(nc.Pressure(up.face("z1"), pressure=1e4))
    scene.add(nc.Contact(up.face("z0"), low.face("z1"), name="contact", **options))
    system, state = scene.compile()
    end = nc.equilibrium(system, state, steps=1).state
    end = nc.equilibrium(system, end, steps=1).state
    exact = np.diag([0.0, 0.0, -1e4])
    off = [np.abs(np.asarray(system.sense(end, part.name).stress) - exact).max() / 1e4 for part in (low, up)]
    return max(off)


@pytest.mark.slow
def test_patch_of_blocks():
    """A uniform pressure passes exactly; nodes on facets do not hand it on evenly."""
    assert pressed(method="mortar", stiffness=1e7) <= 1e-12


def blocks(upper, lower, **options):
    """Two rubber blocks that collide face to face, corner first."""
    scene, spin, middle = nc.Scene(), np.array([0.0, 0.3, 0.8]), np.array([1.0, 1.0, 0.3])
    given: dict = {"position": (0.02, 0.2, 0.19), "orientation": ((1.0, 0.6, 0.0), 0.29)}
    given |= {"velocity": (1.0, 0.5, -4.0)}
    one = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), upper), material=RUBBER, name="upper", **given))
    velocity = np.array([0, 0, 2.0]) - np.cross(spin, middle)
    given = {"position": (-0.55, -0.45, -0.65), "velocity": velocity, "angular_velocity": spin}
    other = scene.add(nc.Solid(nc.mesh.box((2, 2, 0.6), lower), material=RUBBER, name="lower", **given))
    scene.add(nc.Contact(one.face("z0"), other.face("z1"), name="impact", method="mortar", **options))
    return scene.compile()


def assert_kept(system, state, *, dt, steps):
    trajectory = nc.simulate(system, state, dt=dt, steps=steps)
    found = nc.balance(system, trajectory)
    for drift in (found.energy, found.momentum, found.angular_momentum):
        assert drift.max() <= 1e-12
    energy = system.energy(trajectory)
    assert float(energy.stores["impact"].max()) >= 0.2 * float(energy.kinetic[0])
    assert float(energy.stores["impact"][-1]) == 0.0


@pytest.mark.exhaustive
def test_blocks_collide():
    """At 12 ms, more than a wave takes through the upper one: two fifths of the energy are stored."""
    assert_kept(*blocks((2, 2, 1), (2, 2, 1)), dt=12e-3, steps=500)


@pytest.mark.exhaustive
def test_gradients_through_a_contact():
    """Of the program, by stiffness and by how fast blocks of one element meet: V-shaped."""
    system, state = blocks((1, 1, 1), (1, 1, 1))
    weights = jnp.cos(jnp.arange(state.v.size)).reshape(state.v.shape)
    stiffness = jnp.asarray(system.effects[-1].effect.stiffness)

    @jax.jit
    def last(x):
        changed = system.set("impact", stiffness=x[0] * stiffness)
        start = replace_fields(state, v=state.v * x[1])
        return jnp.vdot(nc.simulate(changed, start, dt=4e-3, steps=10).states.v[-1], weights)

    one, direction = jnp.ones(2), jnp.asarray([1.0, -0.4])
    assert_v_shaped(last, one, direction, jnp.vdot(jax.grad(last)(one), direction))


def test_wrong_surfaces_are_refused():
    scene = nc.Scene()
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    one, two = (scene.add(nc.Solid(mesh, material=RUBBER, position=(0, 0, z))) for z in (0.0, 1.01))
    with pytest.raises(ValueError, match="mortar has one pass.*leave out one_pass"):
        scene.add(nc.Contact(one.face("z1"), two.face("z0"), method="mortar", one_pass=True))
    with pytest.raises(ValueError, match="method is an option of two surfaces"):
        scene.add(nc.Contact(one, nc.Plane(point=(0, 0, -1)), method="mortar"))
    given = {"thickness": 0.01, "material": RUBBER, "position": (0, 0, 3)}
    plate = scene.add(nc.Shell(nc.mesh.rectangle((1, 1), (1, 1)), **given))
    with pytest.raises(ValueError, match="one side of 'shell 1'.*surface"):
        scene.add(nc.Contact(plate, two.face("z1"), method="mortar"))


@pytest.mark.exhaustive
def test_gaps_of_shells_and_solids():
    """Between the side of a shell, where its thickness ends, and a solid, and between solids."""
    scene = nc.Scene()
    mesh = nc.mesh.box((1, 1, 1), (1, 1, 1))
    one, two = (scene.add(nc.Solid(mesh, material=RUBBER, position=(0, 0, z))) for z in (0.0, 1.01))
    given = {"thickness": 0.01, "material": RUBBER, "position": (0, 0, 3)}
    plate = scene.add(nc.Shell(nc.mesh.rectangle((1, 1), (1, 1)), **given))
    scene.add(nc.Contact(plate.surface("inside"), two.face("z1"), method="mortar", name="above"))
    scene.add(nc.Contact(one.face("z1"), two.face("z0"), method="mortar", name="between"))
    system, state = scene.compile()
    found = system.sense(state, "above")
    np.testing.assert_allclose(found.gap, 0.985, rtol=1e-12)
    np.testing.assert_allclose(system.sense(state, "between").gap, 0.01, rtol=1e-12)
