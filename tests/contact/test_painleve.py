"""Friction that presses more than it takes: Painleve's rod, whose end sticks at once.

Its end slides such that friction presses it into the floor. Beyond a coefficient, no impulse that opposes
slip keeps the end on the floor; that which stops it does (Moreau's step, an impact without a collision).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

HALF, GRAVITY = 0.5, 9.81
SCHEMES = nc.EnergyMomentum(), nc.EnergyMomentum(max_events=8)


def rod(friction, angle, velocity, rate=0.0, *, slender=1.0, height=0.0, restitution=0.0, feet=False):
    """A rod [1 kg] of a length of 1 m at an angle to the floor, its lower end at the origin [m, m/s, rad/s].

    With feet, two more points that are to touch the floor later.
    """
    scene, cosine, sine = nc.Scene(), jnp.cos(angle), jnp.sin(angle)
    scene.add(nc.Gravity())
    along, spin = jnp.stack([cosine, 0.0 * cosine, sine]), jnp.array([0.0, 1.0, 0.0]) * rate
    frame = jnp.stack([along, jnp.array([0.0, 1.0, 0.0]), jnp.stack([-sine, 0.0 * sine, cosine])], axis=1)
    inertia = HALF**2 / 3 * slender
    body = nc.RigidBody(
        mass=1.0,
        inertia=jnp.stack([1e-2 + 0.0 * inertia, inertia, inertia]),
        position=HALF * along + height * jnp.array([0.0, 0.0, 1.0]),
        orientation=frame,
        velocity=jnp.concatenate([velocity, jnp.zeros(1)]) + jnp.cross(spin, HALF * along),
        angular_velocity=spin,
        name="rod",
    )
    body = scene.add(body)
    floor = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    law = {"restitution": restitution, "friction": friction}
    places = [(-HALF, 0, 0), *((-0.9 * HALF, y, 0) for y in (0.3, -0.3) if feet)]
    for k, place in enumerate(places):
        markers = *floor, nc.Point(body, place, local=True)
        scene.add(nc.GapConstraint(markers, nc.SphereOnPlane(radius=0.0), name=f"end {k}", **law))
    return *scene.compile(), body


@pytest.mark.slow
def test_the_end_of_a_rod_sticks_at_once():
    """Beyond mu = (1 + 3 c^2) / (3 s c) with what it has to lose, turning as its angular momentum asks for.

    Whatever the step. (Just before that it slides to its stop, the faster the nearer.)
    """
    lanes = [(mu, angle, speed, dt)
             for mu, angle in ((1.35, 1.05), (1.5, 1.05), (2.0, 1.05), (5.0, 1.05), (2.0, 1.2))
             for speed in (1.0, 0.1) for dt in (1e-5, 1e-4)]  # fmt: skip

    def moved(lane):
        friction, angle, speed, dt = lane
        system, state, body = rod(friction, angle, jnp.stack([-speed, 0.0 * speed]))
        run = nc.simulate(system, state, dt=dt, steps=3, throw=False)
        end = run.q[:, 0] - HALF * run.q[:, 1]
        spin = system.sense(run, body).angular_velocity[:, 1]
        return run.result, end, spin, system.energy(run).total, sum(system.work(run).values())

    codes, end, spin, energy, work = (np.asarray(x) for x in jax.jit(jax.vmap(moved))(np.array(lanes)))
    _, angle, speed, dt = np.array(lanes).T
    assert not codes.any()
    # It turns about its end, by -3 v s / (4 l), and falls meanwhile.
    turning = -0.75 * speed * np.sin(angle) / HALF
    fallen = 0.75 * GRAVITY * np.cos(angle) / HALF * dt
    assert np.abs(spin[:, 1] - turning - fallen).max() <= 1e-4
    assert np.abs(end).max() <= 1e-8
    # What is left is m l^2 4/3 w^2 / 2.
    lost = 0.5 * speed**2 * (1.0 - 0.75 * np.sin(angle) ** 2)
    assert (np.abs(energy[:, 0] - energy[:, 1] - lost) <= 2e-3 * lost).all()
    assert np.diff(energy, axis=1).max() <= 1e-14
    assert np.abs(energy - energy[:, :1] - work).max() <= tol.STEP_BALANCE


@pytest.mark.exhaustive
@pytest.mark.parametrize("feet", [False, True], ids=["end", "feet"])
@pytest.mark.parametrize("scheme", SCHEMES, ids=["steps", "located"])
def test_rods_stick_slide_and_fall_from_any_start(feet, scheme):
    """Two hundred rods that slide, turn and fall on their ends: all runs end, and none gains energy."""
    random, count = np.random.default_rng(5), 200
    some = random.uniform(size=(4, count)) < 0.5

    def within(low, high, where=True):
        return np.where(where, random.uniform(low, high, count), 0.0)

    lanes = np.stack([within(0.8, 4), within(0.4, 1.4), within(-3, 1), within(-1, 1, some[0]),
                      within(-2, 2, some[1]), within(0.3, 1), within(0, 0.02, some[2]),
                      within(0.5, 0.5, some[3])], axis=1)  # fmt: skip

    def moved(lane):
        friction, angle, along, across, rate, slender, height, restitution = lane
        more = {"slender": slender, "height": height, "restitution": restitution, "feet": feet}
        system, state, _ = rod(friction, angle, jnp.stack([along, across]), rate, **more)
        run = nc.simulate(system, state, dt=2e-3, steps=60, scheme=scheme, throw=False)
        return run.result, system.energy(run).total

    codes, energy = (np.asarray(x) for x in jax.jit(jax.vmap(moved))(lanes))
    assert set(codes) <= {0, int(nc.Result.MAX_SUBSTEPS)}
    assert np.count_nonzero(codes) <= 6, "a few may have more impacts than there is room for"
    assert np.diff(energy[codes == 0], axis=1).max() <= 1e-12
