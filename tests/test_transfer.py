"""Joints that close and open in the middle of a motion: impacts by the laws of mechanics."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol

import natcoord_jax as nc

ROTOR = 0.3
"""Inertia [kg m^2]."""


@cache
def bodies(joint=None, *, last=True, rotor=False):
    """A hinged pair of unsymmetric bodies that drifts and turns, and a third one that a joint may catch."""
    scene = nc.Scene()
    base = scene.add(
        nc.RigidBody(
            mass=3.0,
            inertia=(0.4, 0.5, 0.6),
            com=(0.1, 0.0, -0.05),
            velocity=(0.3, 0.1, 0.0),
            angular_velocity=(0.2, 0.5, -0.4),
            name="base",
        )
    )
    arm = scene.add(
        nc.RigidBody(
            mass=1.0,
            inertia=(0.02, 0.08, 0.09),
            com=(0.3, 0.0, 0.0),
            position=(0.2, 0.0, 0.1),
            velocity=jnp.array([0.3, 0.1, 0.0])
            + jnp.cross(jnp.array([0.2, 0.5, -0.4]), jnp.array([0.2, 0, 0.1])),
            angular_velocity=(0.2, 0.5, -0.4),
            name="arm",
        )
    )
    hinge = scene.add(nc.Revolute(base, arm, point=(0.2, 0.0, 0.1), axis=(0, 1, 1), name="hinge"))
    scene.add(nc.JointSpring(hinge, stiffness=2.0, rest=0.5, name="coil"))
    scene.add(nc.JointDamper(hinge, damping=0.3, name="damper"))
    if rotor:
        scene.add(nc.Armature(hinge, inertia=ROTOR, name="rotor"))
    caught = nc.RigidBody(
        mass=0.7,
        inertia=(0.03, 0.02, 0.04),
        position=(0.9, 0.2, 0.0),
        velocity=(-0.5, 0.0, 0.3),
        angular_velocity=(1.0, -2.0, 0.5),
        name="caught",
    )
    if last:
        other = scene.add(caught)
        if joint is not None:
            scene.add(joint(arm, other, axis=(0.3, 1.0, 0.2), name="catch"))
    system, state = scene.compile(assemble=True)
    return system, state


def by_body(system, rows):
    """Rows of the bodies in the order of their names: systems number them differently."""
    order = np.argsort(system.structure.bodies)
    return np.asarray(rows).reshape(-1, 4, 3)[order]


def last_of(trajectory):
    return jax.tree.map(lambda x: x[-1], trajectory.states)


@pytest.fixture(scope="module")
def moved():
    system, state = bodies()
    return system, last_of(nc.simulate(system, state, dt=0.01, steps=40))


def assert_caught(before, state, joint):
    """Poses and momenta are kept, the joint holds, and what is lost is the energy of the lost velocities."""
    joined, after = nc.transfer(before, state, bodies(joint)[0])
    scale = float(jnp.linalg.norm(before.angular_momentum(state)))
    np.testing.assert_array_equal(by_body(joined, after.q), by_body(before, state.q))
    for momentum in ("momentum", "angular_momentum"):
        kept, there = (getattr(s, momentum)(x) for s, x in ((joined, after), (before, state)))
        np.testing.assert_allclose(kept, there, atol=tol.STEP_BALANCE * scale)
    errors = joined.constraint_errors(after)
    assert float(errors.position) < tol.CONSTRAINT and float(errors.velocity) < tol.CONSTRAINT
    lost = before.energy(state).kinetic - joined.energy(after).kinetic
    gone = by_body(before, state.v) - by_body(joined, after.v)
    mass = np.asarray(before.mass)[np.argsort(before.structure.bodies)]
    assert float(lost) > 0.05 * float(before.energy(state).kinetic)
    np.testing.assert_allclose(lost, 0.5 * np.einsum("bij,bik,bjk->", mass, gone, gone), rtol=1e-10)
    # (Carnot's theorem.) Bodies that meet at rest lose nothing.
    still = eqx.tree_at(lambda s: s.v, state, jnp.zeros_like(state.v))
    joined, after = nc.transfer(before, still, joined)
    assert float(joined.energy(after).kinetic) == 0.0


@pytest.mark.slow
def test_a_closing_joint_keeps_momenta_and_poses():
    assert_caught(*bodies(), nc.Revolute)


@pytest.mark.exhaustive
@pytest.mark.parametrize("joint", [nc.Fixed, nc.Spherical, nc.Prismatic])
def test_other_joints_keep_momenta_and_poses(moved, joint):
    assert_caught(*moved, joint)


@pytest.mark.slow
def test_accounts_coordinates_and_time_go_on(moved):
    system, before = moved
    joined, after = nc.transfer(system, before, bodies(nc.Revolute)[0])
    assert float(after.t) == float(before.t)
    np.testing.assert_allclose(joined.work(after)["damper"], system.work(before)["damper"], rtol=1e-14)
    assert float(joined.work(after)["damper"]) < 0
    angle = system.coordinate(before, "hinge")
    np.testing.assert_allclose(joined.coordinate(after, "hinge"), angle, rtol=1e-14)
    assert abs(float(joined.coordinate(after, "catch"))) < tol.IDENTITY
    # The stored energy of the coil is a function of that angle.
    np.testing.assert_allclose(joined.energy(after).stores["coil"], system.energy(before).stores["coil"])


@pytest.mark.slow
def test_the_motion_goes_on_and_opening_loses_nothing(moved):
    system, before = moved
    joined, after = nc.transfer(system, before, bodies(nc.Fixed)[0])
    run = nc.simulate(joined, after, dt=0.01, steps=30)
    balance = nc.balance(joined, run)
    assert balance.energy.max() < tol.ENERGY and balance.angular_momentum.max() < tol.ANGULAR_MOMENTUM
    assert float(joined.constraint_errors(run).position.max()) < tol.CONSTRAINT
    end = last_of(run)
    free, opened = nc.transfer(joined, end, system)
    np.testing.assert_array_equal(by_body(free, opened.v), by_body(joined, end.v))
    np.testing.assert_allclose(free.energy(opened).total, joined.energy(end).total, rtol=1e-14)
    # The joint that has closed stays where it was when it is carried over once more.
    again, state = nc.transfer(joined, end, bodies(nc.Fixed)[0])
    np.testing.assert_array_equal(again.frames, joined.frames)
    np.testing.assert_array_equal(state.v, end.v)


@pytest.mark.exhaustive
def test_rotors_take_part_in_the_impact():
    system, state = bodies(rotor=True)
    before = last_of(nc.simulate(system, state, dt=0.01, steps=40))
    joined, after = nc.transfer(system, before, bodies(nc.Fixed, rotor=True)[0])
    np.testing.assert_allclose(after.rates[0], joined.rate(after, "hinge"), atol=tol.CONSTRAINT)
    assert abs(float(after.rates[0] - before.rates[0])) > 1e-2

    # Impulses do no work on the one free motion that the joints leave: turning the hinge.
    angle = joined.coordinate(after, "hinge")
    motions = [joined.with_coordinate(after, "hinge", angle, rate=rate).v for rate in (0.0, 1.0)]
    motion = by_body(joined, motions[1] - motions[0])
    mass = np.asarray(joined.mass)[np.argsort(joined.structure.bodies)]
    jump = by_body(joined, after.v) - by_body(system, before.v)
    power = np.einsum("bij,bik,bjk->", mass, jump, motion)
    assert abs(power) > 1e-3
    np.testing.assert_allclose(power, -ROTOR * float(after.rates[0] - before.rates[0]), rtol=1e-10)


@pytest.mark.exhaustive
def test_derivative_of_a_closing_joint(moved):
    system, before = moved
    into = bodies(nc.Revolute)[0]
    direction = jax.random.normal(jax.random.key(1), before.v.shape)

    @jax.jit
    def outcome(x, joined):
        state = eqx.tree_at(lambda s: (s.q, s.v), before, (before.q, before.v + x * direction))
        state = system.with_coordinate(state, "hinge", x)
        joined, after = nc.transfer(system, state, joined)
        return joined.energy(after).kinetic + joined.frames.sum()

    slope = jax.grad(outcome)(0.1, into)
    h = 1e-4
    differences = (outcome(0.1 + h, into) - outcome(0.1 - h, into)) / (2 * h)
    np.testing.assert_allclose(slope, differences, rtol=1e-6)


@pytest.mark.exhaustive
def test_a_part_comes_into_a_larger_system():
    part, state = bodies(last=False)
    state = last_of(nc.simulate(part, state, dt=0.01, steps=40))
    all_three, start = bodies()
    with pytest.raises(ValueError, match="'caught'.*onto"):
        nc.transfer(part, state, all_three)
    same, after = nc.transfer(part, state, all_three, onto=start)
    for name in ("base", "arm", "caught"):
        source, before = (all_three, start) if name == "caught" else (part, state)
        np.testing.assert_array_equal(same.sense(after, name).position, source.sense(before, name).position)
    np.testing.assert_array_equal(same.coordinate(after, "hinge"), part.coordinate(state, "hinge"))


@pytest.mark.slow
def test_what_cannot_be_carried_over_is_refused():
    system, before = bodies()
    with pytest.raises(ValueError, match="no bodies.*'caught'"):
        nc.transfer(system, before, bodies(last=False)[0])
    scene = nc.Scene()
    made = {
        name: scene.add(nc.RigidBody(mass=1.0, inertia=(1, 1, 1), name=name))
        for name in system.structure.bodies
    }
    scene.add(nc.Revolute(made["base"], made["caught"], name="hinge"))
    with pytest.raises(ValueError, match="'hinge' joins"):
        nc.transfer(system, before, scene.compile()[0])

    def distance(parent, child, axis, name):
        return nc.Distance(parent, child, point=(0.9, 0.2, 0.0), parent_point=(0.2, 0.0, 0.1), name=name)

    with pytest.raises(ValueError, match="'catch' cannot close"):
        nc.transfer(system, before, bodies(distance)[0])
