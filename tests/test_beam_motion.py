"""Beams in motion: conservation, reference cases, derivatives, and what a coarse mesh must not do."""

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

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields

ROPE = {"radius": 0.01, "E": 1e6, "density": 1000.0}


def rope(elements, *, pinned=True, **options):
    """A soft rope of a metre, released horizontally from a pin."""
    scene = nc.Scene()
    section = nc.CircularSection(**ROPE)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1.0, 0, 0)], elements=elements, name="rope", **options))
    if pinned:
        scene.add(nc.Spherical(nc.ground, beam.start))
    scene.add(nc.Gravity())
    return *scene.compile(), beam


def nodes(system, states, beam):
    """Positions of the nodes [m], shape (..., nodes, 3)."""
    rows = states.q.reshape(*states.q.shape[:-2], -1, 4, 3)[..., 0, :]
    return np.asarray(rows)[..., [system.body_index(node) for node in beam.nodes], :]


def length(points):
    return np.sum(np.linalg.norm(np.diff(points, axis=-2), axis=-1), axis=-1)


@cache
def satellite():
    """A hub with a boom of four elements on a hinge and a tip mass that was hit, free; large strains."""
    scene = nc.Scene()
    spin = np.array([0.3, -0.5, 2.0])
    hub = scene.add(nc.RigidBody(mass=3.0, inertia=(0.3, 0.4, 0.5), angular_velocity=spin))
    section = nc.Section.of_numbers(EA=300.0, GA=200.0, EI=(0.5, 1.0), GJ=0.5, density=1.0, rotary=0.02)
    ends, place = np.array([[0.4, 0, 0], [1.4, 0.2, 0]]), np.array([1.5, 0.2, 0.1])
    hit = np.cross(spin, place) + [0.0, 0.0, 2.0]
    plug = scene.add(
        nc.RigidBody(
            mass=0.7, inertia=(0.02, 0.03, 0.02), position=place, velocity=hit, angular_velocity=spin
        )
    )
    motion = {"angular_velocity": spin, "velocity": np.cross(spin, ends[0])}
    boom = scene.add(nc.Beam(section, ends, elements=4, end=plug, name="boom", **motion))
    scene.add(nc.Revolute(hub, boom.start, point=ends[0], axis=(0, 0, 1)))
    return *scene.compile(), boom


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_conservation(order):
    """Beam, joint and bodies together at steps of 0.07 rad: energy, momenta, constraints."""
    system, state, _ = satellite()
    steps = 1000 if order == 2 else 100
    scheme = nc.EnergyMomentum(order=order)
    trajectory = nc.simulate(system, state, dt=0.035, steps=steps, scheme=scheme, extra_substeps=100)
    found = account(system, trajectory)
    assert found.energy_error <= tol.ENERGY
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT and found.joints <= tol.CONSTRAINT
    assert found.turned > 1.0
    exchanged = found.exchanged()
    assert max(exchanged[name] for name in exchanged if name.startswith("boom")) > 0.2


@pytest.mark.parametrize("elements", [4, pytest.param(32, marks=pytest.mark.slow)])
def test_a_coarse_rope_does_not_stretch(elements):
    """Four elements keep the length of the fine mesh within 3 %, where interpolated directors double it; the
    tip of the fine mesh is where another code has it at half a second."""
    system, state, beam = rope(elements)
    trajectory = nc.simulate(system, state, dt=1e-3, steps=500, save_every=50)
    points = nodes(system, trajectory.states, beam)
    assert abs(length(points)[-1] / 1.0121 - 1) < (0.03 if elements == 4 else 1e-3)
    if elements == 32:
        # Exudyn, 64 elements: (-0.1994, -0.9487); what is left is the mesh.
        np.testing.assert_allclose(points[-1, -1], [-0.1994, 0.0, -0.9487], rtol=0, atol=2e-3)


@pytest.mark.slow
def test_a_coarse_rope_stays_together():
    """Over ten seconds, at 2 ms: the length of four elements stays within 3 % of a fine mesh's longest."""
    fine = 1.0422  # that of 32 elements, which takes minutes
    system, state, beam = rope(4)
    trajectory = nc.simulate(system, state, dt=2e-3, steps=5000, save_every=50, extra_substeps=10000)
    longest = np.max(length(nodes(system, trajectory.states, beam)))
    assert abs(longest / fine - 1) < 0.03
    assert account(system, trajectory).energy_error <= tol.ENERGY


@pytest.mark.slow
def test_start_from_rest_at_zero_strain():
    """Values and derivatives are finite where rotations, strains and velocities are exactly zero."""
    system, state, beam = rope(4)
    body = system.body_index(beam.end)

    def drop(p):
        group = system.effects[0]
        stiffer = replace_fields(group.effect, stiffness=group.effect.stiffness * p)
        changed = replace_fields(system, effects=(replace_fields(group, effect=stiffer), *system.effects[1:]))
        return nc.simulate(changed, state, dt=1e-2, steps=5).q[-1, 4 * body, 2]

    drop = jax.jit(drop)
    one = jnp.ones(())
    slope = jax.grad(drop)(one)
    assert jnp.isfinite(drop(one)) and jnp.isfinite(slope)
    assert_v_shaped(drop, one, one, slope)


class History(eqx.Module):
    """A force through given values [N] at equal times, linear between them."""

    times: Float[Array, " n"]
    values: Float[Array, "n 3"]

    def __call__(self, t):
        return jax.vmap(lambda column: jnp.interp(t, self.times, column), in_axes=1)(self.values)


@pytest.mark.exhaustive
def test_derivatives_of_motion():
    """Of the tip's place with respect to stiffness, length, density, load history and unstressed curvature:
    the scene itself is built from numbers that are differentiated."""
    values = jnp.array([[0.0, 0.0, 0.0], [0.5, 2.0, -1.0], [-1.0, 0.5, 1.0]])

    def place(p):
        curvature = p["curvature"]
        section = nc.Section.of_numbers(
            EA=300.0 * p["stiffness"],
            GA=200.0,
            EI=(p["stiffness"], 2.0 * p["stiffness"]),
            GJ=1.5,
            density=p["density"],
            rotary=0.02 * p["density"],
        )

        def arc(s):
            # A circle through the clamp along x, of any curvature and none.
            turn = curvature * s
            aside = 0.5 * turn * jnp.sinc(turn / (2 * jnp.pi)) ** 2
            return s * jnp.array([jnp.sinc(turn / jnp.pi), aside, 0.0])

        scene = nc.Scene()
        beam = scene.add(
            nc.Beam(section, arc, length=p["length"], elements=4, start=nc.ground, damping=0.01, name="beam")
        )
        load = History(jnp.array([0.0, 0.1, 0.2]), p["load"])
        scene.add(nc.PointForce((nc.Point(beam.end, arc(p["length"])),), force=load))
        system, state = scene.compile()
        trajectory = nc.simulate(system, state, dt=0.01, steps=20)
        return system.sense(trajectory, beam.end).position[-1]

    place = jax.jit(place)
    p = {"stiffness": 1.0, "density": 1.0, "length": 1.0, "curvature": 0.4}
    p = jax.tree.map(jnp.asarray, p) | {"load": values}
    weights = jnp.array([0.3, -0.7, 0.6])
    gradient = jax.jit(jax.grad(lambda p: weights @ place(p)))(p)
    forward = jax.jit(lambda p, d: jax.jvp(place, (p,), (d,))[1])
    steps = 10.0 ** -np.arange(1.5, 8.5, 0.5)
    for name in p:
        direction = jax.tree.map(jnp.zeros_like, p) | {name: jnp.ones_like(p[name])}
        slope = forward(p, direction)
        assert_v_shaped(place, p, direction, slope, steps=steps)
        assert np.isclose(jnp.sum(gradient[name]), weights @ slope, rtol=1e-9), name


def test_damping_takes_energy_only_from_strain():
    """A damped boom turning as a rigid body loses nothing; one that is bent comes to rest relative to it."""
    section = nc.Section.of_numbers(EA=300.0, GA=200.0, EI=1.0, GJ=1.0, density=1.0, rotary=0.02)
    spin = (0.0, 0.0, 2.0)
    scene = nc.Scene()
    # About its middle and with no stretch to begin with: the centrifugal stretch starts an oscillation.
    scene.add(
        nc.Beam(
            section,
            [(-0.5, 0, 0), (0.5, 0, 0)],
            elements=4,
            damping=0.05,
            angular_velocity=spin,
            velocity=(0.0, -1.0, 0.0),
            name="boom",
        )
    )
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.02, steps=400)
    found = account(system, trajectory)
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    lost = -sum(found.works.values())
    assert np.all(np.diff(lost) >= -tol.ENERGY * found.energy_scale)
    # It ends in the steady rotation: nothing is lost any more.
    assert lost[-1] > 0 and lost[-1] - lost[-50] < 1e-4 * lost[-1]


@pytest.mark.slow
def test_flying_spaghetti():
    """B17: after the load, momentum (20, 0), constant angular momentum and energy."""
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=100.0, GJ=100.0, density=1.0, rotary=10.0)
    scene = nc.Scene()
    ends = [(0.0, 8.0, 0.0), (6.0, 0.0, 0.0)]
    beam = scene.add(nc.Beam(section, ends, elements=10, second=(0, 0, 1)))

    def on(t):
        return jnp.where(t < 2.5, 1.0, 0.0)

    scene.add(nc.PointForce((nc.Point(beam.end, ends[1]),), force=lambda t: on(t) * jnp.array([8.0, 0, 0])))
    axes = tuple(nc.Direction(beam.end, e) for e in np.eye(3))
    scene.add(nc.BodyTorque(axes, torque=lambda t: on(t) * jnp.array([0, 0, -80.0])))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.1, steps=150)
    after = trajectory.t > 2.55
    momentum = np.asarray(system.momentum(trajectory))[after]
    np.testing.assert_allclose(momentum, np.broadcast_to([20.0, 0, 0], momentum.shape), rtol=0, atol=1e-9)
    turning = np.asarray(system.angular_momentum(trajectory))[after]
    energy = np.asarray(system.energy(trajectory).total)[after]
    assert np.ptp(energy) <= tol.ENERGY * energy[0] and np.ptp(turning[:, 2]) <= 1e-10 * np.abs(turning).max()


@pytest.mark.slow
def test_steady_elongation_of_a_rotating_beam():
    """B13: by the internal damping the spinning beam settles at L (tan kL / kL - 1), k^2 = w^2 rho / EA."""
    total, rate = 10.0, 6.0
    section = nc.Section.of_numbers(EA=2.8e7, GA=1e7, EI=1.4e4, GJ=1.4e4, density=1.2, rotary=6e-4)
    # Lumps at n equal pieces stretch by a part of 1 / 2 n^2 more.
    elements = 25
    scene = nc.Scene()
    hub = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), angular_velocity=(0, 0, rate)))
    scene.add(nc.Revolute(nc.ground, hub, axis=(0, 0, 1), name="hinge"))
    beam = scene.add(
        nc.Beam(
            section,
            [(0, 0, 0), (total, 0, 0)],
            elements=elements,
            start=hub,
            damping=2e-3,
            angular_velocity=(0, 0, rate),
        )
    )
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=1500, save_every=1500)
    hinge = np.asarray(system.sense(trajectory.states, hub).angular_velocity)[-1, 2]
    k = hinge * np.sqrt(1.2 / 2.8e7)
    exact = total * (np.tan(k * total) / (k * total) - 1)
    radius = np.linalg.norm(nodes(system, trajectory.states, beam)[-1, -1])
    assert abs((radius - total) / exact - 1) < 1e-3
