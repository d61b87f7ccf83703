"""Constraints on markers, and rolling: exact motions, statics, modes and derivatives."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from differences import assert_v_shaped
from scipy.linalg import expm

import natcoord_jax as nc
from natcoord_jax import gallery

TABLE = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))


def pendulum(place=(1.0, 0.0, 0.0), rods=1):
    """A point mass of 2 kg on a rod, or on several that are the same."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=2.0, position=place, name="mass"))
    for k in range(rods):
        scene.add(nc.Rod((nc.Point(nc.ground), nc.Point(mass)), name=f"rod {k + 1}"))
    return scene.compile()


@pytest.mark.exhaustive
def test_a_rod_is_a_distance_joint():
    """Two ways to the same pendulum."""
    system, state = pendulum()
    scene = nc.Scene()
    scene.add(nc.Gravity())
    mass = scene.add(nc.PointMass(mass=2.0, position=(1, 0, 0)))
    scene.add(nc.Distance(nc.ground, mass))
    other = scene.compile()
    one, two = (nc.simulate(*case, dt=0.02, steps=50).q for case in ((system, state), other))
    np.testing.assert_allclose(one[:, 0], two[:, 0], atol=tol.SAME_TRAJECTORY)


@pytest.mark.slow
def test_reactions_statics_and_modes():
    """A mass of 2 kg on a rod of 1 m: it carries the weight at rest, and swings at sqrt(g / l)."""
    system, state = pendulum((0, 0, -1.0))
    instant = system.instant(state)
    np.testing.assert_allclose(instant.multipliers["rod 1"], [-2.0 * 9.81], rtol=1e-12)
    np.testing.assert_allclose(nc.modes(system, state).frequencies, [9.81**0.5] * 2, rtol=1e-9)
    moved = nc.equilibrium(*pendulum((0.6, 0, -0.8))).state
    np.testing.assert_allclose(moved.q[0], (0, 0, -1), atol=tol.EQUILIBRIUM)


@pytest.mark.exhaustive
def test_redundant_constraints_share_the_load():
    system, state = pendulum(rods=2)
    assert system.structure.redundant == ("rod 'rod 2'",) and system.structure.dofs == 2
    trajectory = nc.simulate(system, state, dt=0.02, steps=50)
    np.testing.assert_allclose(
        trajectory.q[:, 0], nc.simulate(*pendulum(), dt=0.02, steps=50).q[:, 0], atol=1e-12
    )
    shares = system.instant(trajectory[-1]).multipliers
    np.testing.assert_allclose(shares["rod 1"], shares["rod 2"], rtol=1e-6)


def test_a_gap_is_told_by_name():
    scene = nc.Scene()
    mass = scene.add(nc.PointMass(mass=1.0, position=(0, 0, 1)))
    scene.add(nc.PointOnPlane((*TABLE, nc.Point(mass)), name="table"))
    with pytest.raises(ValueError, match="violates point on plane 'table' by 1 m.*assemble=True"):
        scene.compile()


class Circle(nc.Constraint):
    """A point on a circle [m] that a direction is normal to."""

    radius: float = 1.0
    multipliers = 2

    def residual(self, x):
        arm = x[2] - x[0]
        return jnp.stack([x[1] @ arm, 0.5 * (arm @ arm - self.radius**2)])


@pytest.mark.exhaustive
def test_derivatives_of_a_constraint_of_ones_own():
    """Of where a bead on a circle ends by its speed, the radius and its place; in a batch of circles, too."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, -9.81, 0)))
    mass = scene.add(nc.PointMass(mass=1.0, position=(1, 0, 0), velocity=(0, 1.0, 0)))
    scene.add(Circle((*TABLE, nc.Point(mass)), name="circle"))
    system, state = scene.compile()

    def end(radius, speed):
        moved = {"q": state.q.at[0, 0].set(radius), "v": state.v.at[0, 1].set(speed)}
        start = dataclasses.replace(state, **moved)
        return nc.simulate(system.set("circle", radius=radius), start, dt=0.02, steps=20).q[
            -1, 0
        ] @ jnp.array([1.0, 2.0, 3.0])

    at, ahead = jnp.array([1.0, 1.0]), jnp.array([0.6, 0.8])

    def loss(x):
        return end(*x)

    slope = jax.jit(jax.grad(loss))(at)
    assert_v_shaped(jax.jit(loss), at, ahead, slope @ ahead)
    np.testing.assert_allclose(jax.jvp(loss, (at,), (ahead,))[1], slope @ ahead, rtol=tol.SAME_GRADIENT)
    many = jax.jit(jax.vmap(loss))(at + jnp.linspace(0.0, 0.2, 3)[:, None] * ahead)
    np.testing.assert_allclose(many[0], loss(at), rtol=1e-12)


@pytest.mark.parametrize(
    "order", [pytest.param(2, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.exhaustive)]
)
def test_a_ball_rolls_down_a_slope(order):
    """With 5/7 of the acceleration of what slides, at its height, without any loss."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(1.0, 0, -9.81)))
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1000.0, position=(0, 0, 0.1), name="ball"))
    scene.add(nc.Rolling((*TABLE, nc.Point(ball)), radius=0.1, name="contact"))
    system, state = scene.compile()
    assert system.structure.dofs == 3
    trajectory = nc.simulate(system, state, dt=0.01, steps=100, scheme=nc.EnergyMomentum(order=order))
    np.testing.assert_allclose(trajectory.q[-1, 0], (5 / 14, 0, 0.1), atol=1e-6 if order == 2 else 1e-11)
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE
    # Friction at the contact: 2/7 of the weight along the slope.
    force = system.instant(state).multipliers["contact"]
    mass = float(system.mass[0, 0, 0])
    np.testing.assert_allclose(force, (-2 / 7 * mass, 0, 9.81 * mass), atol=1e-9 * mass)


@pytest.mark.exhaustive
def test_modes_of_what_rolls():
    """A ball on a spring carries its spin along: 7/5 of its mass swings."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=1000.0, position=(0, 0, 0.1), name="ball"))
    scene.add(nc.Rolling((*TABLE, nc.Point(ball)), radius=0.1))
    scene.add(nc.Spring((nc.Point(nc.ground, (0, 0, 0.1)), nc.Point(ball)), stiffness=100.0))
    system, state = scene.compile()
    result = np.asarray(nc.modes(system, state).frequencies)
    expected = (100.0 / (1.4 * float(system.mass[0, 0, 0]))) ** 0.5
    np.testing.assert_allclose(result, [0.0, expected, expected], atol=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("part", [0.2, 0.5])  # numbers: one program
def test_a_coin_stays_upright_when_it_is_fast(part):
    """A thin disc leans as Routh's linear equation says: 5/4 lean'' = (g / r - 3 spin^2) lean.

    Upright it is stable from v^2 = g r / 3 on (E. J. Routh, Advanced Rigid Dynamics, 1884, article 244).
    """
    radius, mass, gravity, rate = 0.1, 2.0, 9.81, 1e-3
    spin, tilt = math.sqrt(part * gravity / radius), ((1, 0, 0), math.pi / 2)
    inertia = mass * radius**2 * np.array([0.25, 0.25, 0.5])
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -gravity)))
    place, moving = (0, 0, radius), (spin * radius, -rate * radius, 0)
    motion: Any = {"position": place, "orientation": tilt, "velocity": moving}
    coin = scene.add(nc.RigidBody(mass=mass, inertia=inertia, angular_velocity=(rate, spin, 0), **motion))
    axis = nc.Direction(coin, (0, 0, 1), local=True)
    scene.add(nc.Rolling((*TABLE, nc.Point(coin), axis), radius=radius))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=2.5e-3, steps=200)
    lean = np.abs(np.asarray(trajectory.q).reshape(-1, 4, 3)[:, 3, 2])
    square, times = (3 * spin**2 - gravity / radius) / 1.25, 2.5e-3 * np.arange(201)
    root = math.sqrt(abs(square))
    assert (square > 0) == (part > 1 / 3)
    expected = np.abs((np.sin if square > 0 else np.sinh)(root * times)) * rate / root
    np.testing.assert_allclose(lean, expected, atol=5e-3 * expected.max())
    energy = np.asarray(system.energy(trajectory).total)
    assert np.ptp(energy) <= tol.ENERGY * energy[0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("speed", [3.5, 5.0, 7.0])
def test_bicycle(speed):
    """Lean and steer are those of the published linear equations, at stable speeds and at others."""
    example = gallery.load("bicycle", speed=speed, lean_rate=0.01)
    system, facts = example.system, {k: np.array(x) for k, x in example.facts.items()}
    trajectory = example.simulate(steps=400)
    rows = np.asarray(trajectory.q).reshape(401, -1, 4, 3)[:, system.body_index("frame")]
    lean, steer = np.arcsin(rows[:, 2, 2]), np.asarray(system.sense(trajectory, "head").angle)
    stiffness = 9.81 * facts["gravity"] + speed**2 * facts["speed"]
    lower = -np.linalg.solve(facts["mass"], np.hstack([stiffness, speed * facts["damping"]]))
    matrix = np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), lower])
    low, high = facts["stable speeds"]
    assert (np.linalg.eigvals(matrix).real.max() < 0) == (low < speed < high)
    times = np.arange(401) * example.dt
    linear = np.stack([expm(t * matrix) @ np.array([0, 0, 0.01, 0]) for t in times])
    np.testing.assert_allclose(lean, linear[:, 0], atol=5e-3 * np.abs(linear[:, 0]).max())
    np.testing.assert_allclose(steer, linear[:, 1], atol=5e-3 * np.abs(linear[:, 1]).max())
    energy = np.asarray(system.energy(trajectory).total)
    assert np.abs(energy - energy[0]).max() <= tol.ENERGY * energy[0]
