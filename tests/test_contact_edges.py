"""Sharp edges of solids in contact: gaps beside them, which edges are sharp, blocks of other meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import natcoord_jax as nc
from natcoord_jax.bodies.sharp_edges import sharp_edges


def test_the_gap_beside_a_box_is_its_distance():
    """Outside, inside, beside its edges and corners, of nodes that know of all its faces."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    box = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (2, 2, 1)), material=rubber, name="box"))
    given = {"material": rubber, "name": "other", "position": (0, 0, 1.1)}
    other = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), **given))
    scene.add(nc.Contact(other.face(), box.face()))
    system, state = scene.compile()
    group = system.effects[-1]
    contact = jax.tree.map(lambda x: x[0], group.effect)
    x = state.rows[np.asarray(group.bodies)[0], 0]
    at = np.random.default_rng(6).uniform(-0.3, 1.3, (2000, 3))
    gaps = jax.jit(jax.vmap(lambda node: contact.gap(x.at[0].set(node))))(jnp.asarray(at))
    beyond = np.abs(at - 0.5) - 0.5
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    np.testing.assert_allclose(gaps, outside + np.minimum(beyond.max(axis=1), 0.0), atol=1e-14)


@pytest.mark.parametrize("sides", [4, 5, 6, 8])
def test_sharp_edges_are_those_of_few_sides(sides):
    """Of a prism, whose ends are patches in any case, and of whose sides six or more are one patch."""
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    places = np.concatenate([ring, ring + (0, 0, 1.0)])
    k = np.arange(sides)
    facets = np.stack([k, np.roll(k, -1), np.roll(k, -1) + sides, k + sides], axis=1)
    ends = [(0, j, j - 1, j - 2) for j in range(3, sides, 2)]
    if sides % 2:
        ends.append((0, sides - 1, sides - 1, sides - 2))
    lids = [tuple(np.array(end[::-1]) + sides) for end in ends]
    sharp, patch = sharp_edges(np.concatenate([facets, ends, lids]), places)
    assert sharp[:sides, [0, 2]].all() and sharp[:sides, [1, 3]].all() == (sides < 6)
    assert len(np.unique(patch)) == (sides + 2 if sides < 6 else 3)


def test_an_edge_that_is_hollow_is_not_sharp():
    """That of a step, beneath which a node is inside."""
    places = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (1, 1, 1.0)])
    sharp, patch = sharp_edges(np.array([(0, 1, 2, 3), (1, 4, 5, 2)]), places)
    assert not sharp.any() and not patch.any()


@pytest.mark.exhaustive
@pytest.mark.parametrize(("dt", "steps"), [(4e-3, 60), (12e-3, 500)])
def test_blocks_of_other_meshes_collide_by_all_their_faces(dt, steps):
    """Corners slide over edges of each other; by two faces alone their run ends in its sixth step."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    spin, middle = np.array([0.0, 0.3, 0.8]), np.array([1.0, 1.0, 0.3])
    place = {"position": (0.02, 0.2, 0.19), "orientation": ((1.0, 0.6, 0.0), 0.29)}
    given = {"material": rubber, "velocity": (1.0, 0.5, -4.0), **place}
    one = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (2, 2, 1)), **given))
    given = {"position": (-0.55, -0.45, -0.65), "velocity": np.array([0, 0, 2.0]) - np.cross(spin, middle)}
    given |= {"material": rubber, "angular_velocity": spin}
    other = scene.add(nc.Solid(nc.mesh.box((2, 2, 0.6), (3, 3, 1)), **given))
    scene.add(nc.Contact(one.face(), other.face(), name="impact", candidates=30))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=dt, steps=steps)
    found = nc.balance(system, trajectory)
    for drift in (found.energy, found.momentum, found.angular_momentum):
        assert drift.max() <= 1e-12
    stores = system.energy(trajectory).stores["impact"]
    assert float(stores.max()) >= 0.05 * float(system.energy(trajectory).kinetic[0])
    assert float(stores[-1]) == 0.0
