"""Friction between surfaces of shells and solids: what slides stops, momenta, losses, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.maths.rotations import from_rotation_vector

RUBBER = nc.Elastic(E=1e6, nu=0.3, density=1000.0)


def node_on_a_facet(height):
    """A node above a warped facet, which it touches with friction, and their places."""
    corners = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.1), (1.1, 1.0, 0.0), (0.0, 0.9, 0.1)])
    markers = tuple(nc.Point(nc.ground, (k, 0, 0)) for k in range(5))
    contact = nc.FrictionalNodeOnFacets(markers, facets=[(1, 2, 3, 4)], stiffness=2.0, friction=0.3)
    return contact, jnp.asarray(np.concatenate([[(0.4, 0.5, height)], corners]))


@pytest.mark.parametrize("height", [0.0, 0.3])
def test_slip(height):
    """None of what moves as a rigid body; impulses against it neither push nor turn, also off the facet."""
    random = np.random.default_rng(1)
    contact, x = node_on_a_facet(height)
    slip = jax.jit(lambda x, v: contact.slip(x, v))
    spin, shift = random.normal(size=3), random.normal(size=3)
    assert np.abs(slip(x, jnp.cross(spin, x) + shift)).max() <= 1e-14
    rates = jnp.asarray(random.normal(size=x.shape))
    found = slip(x, rates)
    turn = np.asarray(from_rotation_vector(jnp.asarray(random.normal(size=3))))
    np.testing.assert_allclose(slip(x @ turn.T + shift, rates @ turn.T), turn @ found, atol=1e-13)
    pulled = jax.vjp(lambda v: slip(x, v), rates)[1](jnp.asarray(random.normal(size=3)))[0]
    assert np.abs(jnp.sum(pulled, axis=0)).max() <= 1e-14
    assert np.abs(jnp.sum(jnp.cross(x, pulled), axis=0)).max() <= 1e-14
    alone = slip(x, jnp.zeros_like(x).at[0].set(jnp.asarray([1.0, 0.0, 0.0])))
    assert abs(float(jnp.linalg.norm(alone)) - 1) <= 0.02  # all but what is along the normal


def assert_lossy(system, trajectory):
    """Energy balances, and no step gains any."""
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    energy = np.asarray(system.energy(trajectory).total)
    assert np.diff(energy).max() <= 1e-13 * np.abs(energy).max()


@pytest.mark.slow
def test_a_block_slides_on_another_and_stops():
    """Where a point does, but for how both give way; then it is at rest but for how they shake."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    table = scene.add(nc.Solid(nc.mesh.box((0.4, 0.2, 0.1), (2, 1, 1)), material=RUBBER))
    scene.add(nc.Clamp(nc.ground, table.set("z0")))
    given = {"material": RUBBER, "position": (0.05, 0.05, 0.1), "velocity": (0.8, 0, 0)}
    block = scene.add(nc.Solid(nc.mesh.box((0.1, 0.1, 0.05), (1, 1, 1)), **given))
    scene.add(nc.Contact(block.face("z0"), table.face("z1"), friction=0.3, one_pass=True))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2e-3, steps=200)
    assert_lossy(system, trajectory)
    # Slip is stopped at the ends of steps; what weight and the ground do is judged by where bodies are.
    found = nc.balance(system, trajectory)
    assert max(found.momentum.max(), found.angular_momentum.max()) <= 1e-12
    places = [np.asarray(system.sense(trajectory, node).position)[:, 0] for node in block.nodes]
    mean = np.mean(places, axis=0)
    assert mean[-1] - mean[0] == pytest.approx(0.8**2 / (2 * 0.3 * 9.81), rel=0.02)
    assert abs(mean[-1] - mean[-40]) / (39 * 2e-3) < 2e-3


def thrown(**options):
    """A block of one element that hits another one in space, off its middle, and slips on it."""
    scene, mesh = nc.Scene(), nc.mesh.box((0.1, 0.1, 0.1), (1, 1, 1))
    one = scene.add(nc.Solid(mesh, material=RUBBER, angular_velocity=(0, 0, 3.0)))
    given = {"material": RUBBER, "position": (0.02, 0.01, 0.101), "velocity": (0.6, 0.2, -1.0)}
    two = scene.add(nc.Solid(mesh, **given))
    scene.add(nc.Contact(two.face("z0"), one.face("z1"), friction=0.4, name="rubs", **options))
    return scene.compile()


@pytest.mark.slow
def test_momenta():
    """Of two blocks that fly and rub: kept, while friction takes some of the energy."""
    system, state = thrown()
    trajectory = nc.simulate(system, state, dt=5e-4, steps=40)
    assert_lossy(system, trajectory)
    for momentum in (system.momentum(trajectory), system.angular_momentum(trajectory)):
        assert np.ptp(np.asarray(momentum), axis=0).max() <= tol.MOMENTUM_OF_A_SMALL_SCENE
    assert float(system.work(trajectory)["rubs"][-1]) < -0.01 * float(system.energy(trajectory).kinetic[0])


@pytest.mark.exhaustive
def test_gradients():
    """By the coefficient and the speed, through a contact with slip: V-shaped."""
    system, state = thrown(stiffness=2e3, one_pass=True)
    weights = jnp.cos(jnp.arange(state.v.size)).reshape(state.v.shape)

    @jax.jit
    def last(x):
        changed = system.set("rubs", friction=0.4 * x[0] * jnp.ones(4))
        start = replace_fields(state, v=state.v * x[1])
        return jnp.vdot(nc.simulate(changed, start, dt=1e-3, steps=8).states.v[-1], weights)

    one, direction = jnp.ones(2), jnp.asarray([1.0, -0.4])
    assert_v_shaped(last, one, direction, jnp.vdot(jax.grad(last)(one), direction))
