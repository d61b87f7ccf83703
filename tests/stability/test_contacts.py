"""Contacts in hard cases: long steps, masses far apart, many at once, touching at rest, passing by.

What could go wrong: an active set that cycles ends a run; a light body between heavy ones is weighed by the
masses of another scene; redundant contacts share a load by rounding and turn what should not turn; a gap of
exactly zero has no derivative; a node is beyond the next facet before anyone looked; one sick lane takes
the others with it.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

FLOOR = nc.Plane(normal=(0, 0, 1))
BALL = {"shape": nc.Sphere(0.1), "density": 1 / (4 / 3 * np.pi * 1e-3)}  # of 1 kg

pytestmark = pytest.mark.slow


def never_gains(system, trajectory):
    """Energy, and whether it is ever more than rounding above what it was."""
    energy = np.asarray(system.energy(trajectory).total)
    scale = np.abs(np.asarray(system.energy(trajectory).kinetic)).max() + np.abs(energy).max()
    assert np.diff(energy).max() <= 1e-12 * scale
    assert nc.balance(system, trajectory).energy.max() <= tol.ENERGY_OF_A_SMALL_SCENE


@cache
def tower():
    """Three balls, one above the other with gaps, that fall, rub and bounce."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    balls = [
        scene.add(
            nc.RigidBody(
                **BALL,
                position=(0.01 * k, 0, 0.3 + 0.25 * k),
                velocity=(0.2 * k, 0, 0),
                angular_velocity=(1.0, 2.0, 0),
                name=f"ball {k}",
            )
        )
        for k in range(3)
    ]
    for k, ball in enumerate(balls):
        scene.add(nc.Contact(ball, FLOOR, restitution=0.5, friction=0.3, name=f"floor {k}"))
        for j, other in enumerate(balls[:k]):
            scene.add(nc.Contact(other, ball, restitution=0.5, friction=0.3, name=f"pair {j} {k}"))
    return scene.compile()


@pytest.mark.parametrize("dt", [5e-3, 5e-2])
@pytest.mark.parametrize(
    ("masses", "friction"),
    [
        ((1, 1, 1), 0.3),
        ((1e6, 1, 1e-6), 0.3),
        ((1, 1e-3, 1), 0.3),
        ((1, 1e-6, 1), 0.0),
        ((1e-6, 1e6, 1), 0.0),
    ],
)
def test_masses_and_steps(dt, masses, friction):
    """From 1e-6 to 1e6, with steps that are right and ten times too long; masses are set, not compiled.

    (What rubs on two bodies of a million times its mass at once ends a run by name: the second last ones.)
    """
    system, state = tower()
    pairs = [f"pair {j} {k}" for k in range(3) for j in range(k)]
    system = system.set([*(f"floor {k}" for k in range(3)), *pairs], friction=friction)
    for k, mass in enumerate(masses):
        inertia = 0.4 * mass * 0.1**2 * np.eye(3)
        system = system.set(f"ball {k}", mass=float(mass), inertia=inertia)
    trajectory = nc.simulate(system, state, dt=dt, steps=round(1.5 / dt), extra_substeps=200)
    never_gains(system, trajectory)
    assert nc.contacts(system, trajectory).gap.min() >= -1e-9


def test_simultaneous_impacts():
    """Six balls fly into one from all sides at once: nothing turns, what was at rest stays there."""
    scene = nc.Scene()
    middle = scene.add(nc.RigidBody(**BALL))
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        ball = scene.add(nc.RigidBody(**BALL, position=0.5 * axis, velocity=-1.0 * axis))
        scene.add(nc.Contact(middle, ball, restitution=0.7))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=0.07, steps=12)
    never_gains(system, trajectory)
    at = system.sense(trajectory, middle)
    assert np.abs(np.asarray(at.velocity)).max() <= 1e-12
    assert np.abs(np.asarray(at.angular_velocity)).max() <= 1e-12
    speeds = np.linalg.norm(np.asarray(trajectory.v)[-1].reshape(-1, 4, 3)[1:, 0], axis=1)
    np.testing.assert_allclose(speeds, 0.7, rtol=1e-12)


def test_balls_in_a_corner():
    """Eight balls roll into a corner of three planes and pile up: sets of contacts change all the time."""
    scene, random = nc.Scene(), np.random.default_rng(5)
    scene.add(nc.Gravity(vector=(-3.0, -3.0, -9.81)))
    walls = FLOOR, nc.Plane(normal=(1, 0, 0)), nc.Plane(normal=(0, 1, 0))
    balls = []
    for k in range(8):
        place = 0.15 + 0.25 * np.array([k & 1, (k >> 1) & 1, k >> 2]) + 0.02 * random.random(3)
        balls.append(scene.add(nc.RigidBody(**BALL, position=place, velocity=random.normal(size=3))))
        for wall in walls:
            scene.add(nc.Contact(balls[-1], wall, restitution=0.3, friction=0.2))
        for other in balls[:-1]:
            scene.add(nc.Contact(other, balls[-1], restitution=0.3, friction=0.2))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=300, extra_substeps=300)
    never_gains(system, trajectory)
    assert nc.contacts(system, trajectory).gap.min() >= -1e-9


def crossing(offset):
    """Two capsules that meet with their middles, square to each other."""
    scene, shape = nc.Scene(), nc.Capsule(radius=0.05, length=0.6)
    one = scene.add(nc.RigidBody(shape=shape, density=500.0, orientation=((0, 1, 0), np.pi / 2)))
    turn = (1, 0, 0), np.pi / 2
    place = {"position": (0, 0, 0.1 + offset), "velocity": (0, 0, -1.0)}
    other = scene.add(nc.RigidBody(shape=shape, density=500.0, orientation=turn, **place))
    scene.add(nc.Contact(one, other, name="cross"))
    return *scene.compile(), other


@pytest.mark.parametrize("offset", [0.0, 0.01])
def test_edge_on_edge(offset):
    """From exactly zero gap, and from a distance: the second stops and the first goes on, as points would."""
    system, state, other = crossing(offset)
    trajectory = nc.simulate(system, state, dt=3e-3, steps=20)
    never_gains(system, trajectory)
    assert np.abs(np.asarray(system.sense(trajectory, other).velocity)[-1]).max() <= 1e-12


@pytest.mark.parametrize("contact", [{"restitution": 0.5, "friction": 0.3}, {"stiffness": 1e5}])
def test_touching_at_rest(contact):
    """A gap of exactly zero without a load: nothing moves, and derivatives are numbers in both modes."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.1)))
    scene.add(nc.Contact(ball, FLOOR, name="touch", **contact))
    system, state = scene.compile()

    def end(x):
        moved = eqx.tree_at(lambda s: s.v, state, state.v.at[0, 2].add(x))
        return nc.simulate(system, moved, dt=0.01, steps=5, throw=False).q[-1, 0, 2]

    assert float(end(0.0)) == 0.1
    assert np.isfinite(jax.grad(end)(0.0)) and np.isfinite(jax.jvp(end, (0.0,), (1.0,))[1])
    found = nc.contacts(system, nc.simulate(system, state, dt=0.01, steps=5))
    assert any(note.startswith("grazing: touch") for note in found.notes)


def test_start_in_penetration():
    """Refused by name without a stiffness, whoever moved it there; with one it is energy in the books."""
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.1)))
    scene.add(nc.Contact(ball, FLOOR, name="bounce"))
    system, state = scene.compile()
    lower = eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].add(-0.02))
    with pytest.raises(ValueError, match="'bounce' overlap by 0.02 m"):
        nc.simulate(system, lower, dt=0.01, steps=5)
    scene = nc.Scene()
    ball = scene.add(nc.RigidBody(**BALL, position=(0, 0, 0.08)))
    scene.add(nc.Contact(ball, FLOOR, stiffness=1e4, friction=0.1, name="bounce"))
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=1e-3, steps=50)
    never_gains(system, trajectory)
    assert float(system.energy(trajectory).total[0]) == pytest.approx(0.5 * 1e4 * 0.02**2)


def test_facets_passed_in_one_step():
    """A point slides over a strip of ten facets, one and a half of them a step, and bounces as on a plane."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    point = scene.add(nc.PointMass(mass=1.0, position=(-0.25, 0, 0.02), velocity=(30.0, 0, 0), name="point"))
    corners = [nc.Point(nc.ground, (0.1 * k, y, 0)) for k in range(-5, 12) for y in (-0.5, 0.5)]
    facets = np.array([(1 + 2 * k, 3 + 2 * k, 4 + 2 * k, 2 + 2 * k) for k in range(16)])
    inner = np.ones((16, 4))
    inner[1:, 3] = inner[:-1, 1] = 0.0
    strip = nc.NodeOnFacets(
        (nc.Point(point), *corners), facets=facets, open=inner, stiffness=1e5, name="strip"
    )
    scene.add(strip)
    system, state = scene.compile()
    trajectory = nc.simulate(system, state, dt=5e-3, steps=7)
    never_gains(system, trajectory)
    assert np.asarray(trajectory.q)[:, 0, 2].min() > -0.02
    np.testing.assert_allclose(np.asarray(trajectory.v)[:, 0, 0], 30.0, rtol=1e-9)


def test_one_sick_lane():
    """A lane that starts with what is no number fails by its code; the others are what they are alone."""
    system, state = tower()
    run = jax.jit(lambda z: nc.simulate(
        system, eqx.tree_at(lambda s: s.q, state, state.q.at[0, 2].add(z)), dt=5e-3, steps=100, throw=False
    ))  # fmt: skip
    shifts = jnp.array([0.0, jnp.nan, 0.03, 0.05])
    together = jax.vmap(run)(shifts)
    assert np.asarray(together.result).tolist()[0::2] == [0, 0]
    assert int(together.result[1]) == int(nc.Result.NONFINITE)
    for k in (0, 2, 3):
        alone = run(shifts[k])
        np.testing.assert_allclose(np.asarray(together.q)[k], np.asarray(alone.q), atol=1e-9)
