"""Bodies that hang on nothing but the ground have tangents of their own, the same as those of all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.mechanics import block_tangent_space
from natcoord_jax.mechanics.block_tangent_space import SeparateTangents, tangents_at
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity


def mixed():
    """Free bodies, a point mass, and bodies on the ground by joints of several kinds, coupled by springs."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    whole = dict(mass=2.0, inertia=(1.0, 1.2, 1.4), com=(0.1, 0.0, 0.05))
    bodies = [
        scene.add(nc.RigidBody(**whole, position=(0.0, 0, 0), angular_velocity=(0.5, -0.3, 0.8))),
        scene.add(nc.RigidBody(**whole, position=(1.0, 0, 0))),
        scene.add(nc.RigidBody(**whole, position=(2.0, 0, 0))),
        scene.add(nc.RigidBody(**whole, position=(3.0, 0, 0))),
        scene.add(nc.PointMass(mass=0.5, position=(4.0, 0.1, 0))),
    ]
    scene.add(nc.Revolute(nc.ground, bodies[1], point=(1.0, 0.5, 0), axis=(0, 0.6, 0.8)))
    scene.add(nc.Spherical(nc.ground, bodies[2], point=(2.0, 0, 0.4)))
    scene.add(nc.Prismatic(nc.ground, bodies[3], point=(3.0, 0, 0), axis=(0, 1, 0)))
    for k, (one, other) in enumerate(zip(bodies, bodies[1:])):
        ends = nc.Point(one, (k + 0.2, 0.1, 0)), nc.Point(other, (k + 1.0, 0.0, 0.2 * (k < 3)))
        if k == 3:
            ends = nc.Point(one, (3.2, 0.1, 0)), nc.Point(other, (4.0, 0.1, 0))
        scene.add(nc.Spring(ends, stiffness=80.0, length=0.7))
    return scene.compile()


def test_tangents_of_single_bodies_are_those_of_all():
    system, start = mixed()
    assert block_tangent_space.separate(system)
    end = jax.tree.map(lambda x: x[-1], nc.simulate(system, start, dt=0.05, steps=6).states)
    rng = np.random.default_rng(0)
    d = Velocity(jnp.asarray(rng.normal(size=(5, 4, 3))), jnp.zeros(0))
    spaces = [[kind.at(system, s) for s in (start, end)] for kind in (TangentSpace, SeparateTangents)]
    (a, b), (p, q) = spaces
    assert isinstance(tangents_at(system, start), SeparateTangents)
    pairs = [
        (a.projected(d), p.projected(d)),
        (b.normal(d), q.normal(d)),
        *zip(a.shares(b, d), p.shares(q, d)),
    ]
    for one, other in pairs:
        np.testing.assert_allclose(one.rows, other.rows, atol=1e-12)
    np.testing.assert_allclose(a.inertia, p.inertia, atol=1e-13)
    np.testing.assert_allclose(a.energy(d), p.energy(d), rtol=1e-14)


def test_what_is_no_set_of_single_bodies():
    assert not block_tangent_space.separate(gallery.load("double_pendulum").system)
    assert not block_tangent_space.separate(gallery.load("four_bar").system)
    assert not block_tangent_space.separate(gallery.load("spacecraft").system)
    scene = nc.Scene()
    one = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
    scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(1.0, 0, 0)))
    assert block_tangent_space.separate(scene.compile()[0])
    hinge = scene.add(nc.Revolute(nc.ground, one, point=(0, 0, 0), axis=(0, 0, 1), name="hinge"))
    assert block_tangent_space.separate(scene.compile()[0])
    scene.add(nc.Drive(hinge, function=lambda t: 0.1 * t))
    assert not block_tangent_space.separate(scene.compile()[0])


@pytest.mark.exhaustive
def test_motion_with_tangents_of_single_bodies(monkeypatch):
    system, state = mixed()
    runs = []
    for apart in (True, False):
        monkeypatch.setattr(block_tangent_space, "separate", lambda system, apart=apart: apart)
        jax.clear_caches()
        runs.append(nc.simulate(system, state, dt=0.03, steps=20, scheme=nc.EnergyMomentum(4)))
    assert jnp.max(jnp.abs(runs[0].q - runs[1].q)) <= tol.SAME_TRAJECTORY
    assert float(np.max(nc.balance(system, runs[0]).energy)) < 1e-13
