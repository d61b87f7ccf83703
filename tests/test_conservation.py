"""Conservation: energy, momentum, angular momentum and constraints, for every joint and every store.

Each scene is made to move energy between all its stores and to turn; a scene at rest conserves anything.
"""

from functools import cache

import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from differences import alternation
from scenes import JOINTS, pair, with_multipliers

import natcoord_jax as nc
from natcoord_jax.mechanics.coordinates import coordinate_values
from natcoord_jax.model.rows import rows_with_ground

STEPS, DT = 1000, 0.02
FORMS = ("tree", "multipliers")
EXCHANGED = 0.2
EVERY_JOINT = pytest.mark.parametrize("joint", JOINTS)
EVERY_FORM = pytest.mark.parametrize("form", FORMS)


def compiled(joint: str, form: str, **numbers):
    kind = JOINTS[joint] if form == "tree" else kept(joint)
    return pair(kind, **numbers)


@cache
def kept(joint: str) -> type:
    return with_multipliers(JOINTS[joint])


@cache
def hung(joint: str, form: str):
    """Hung by a spring under gravity, with springs inside."""
    system, state = compiled(joint, form)
    return system, nc.simulate(system, state, dt=DT, steps=STEPS)


@cache
def free(joint: str, form: str):
    """The same without gravity and suspension: free in space, springs inside."""
    system, state = compiled(joint, form, gravity=0.0, hanging=0.0)
    return system, nc.simulate(system, state, dt=DT, steps=STEPS)


@EVERY_FORM
@EVERY_JOINT
def test_hung_pair(joint, form):
    found = account(*hung(joint, form))
    still = {"between"} if joint == "fixed" else set()
    idle = {
        name: share
        for name, share in found.exchanged().items()
        if share < EXCHANGED and name not in still and not name.startswith("coil")
    }
    assert not idle, "these stores exchange too little energy for the test to mean anything"
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT
    assert found.joints <= tol.CONSTRAINT


@EVERY_FORM
@EVERY_JOINT
def test_free_pair(joint, form):
    found = account(*free(joint, form))
    assert joint == "fixed" or found.exchanged()["between"] >= EXCHANGED
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.momentum_error() <= tol.MOMENTUM
    assert found.spin_error() <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT
    assert found.joints <= tol.CONSTRAINT


@pytest.mark.parametrize("dt", [0.1, 0.2])
@EVERY_JOINT
def test_big_steps(joint, dt):
    """Half a radian and more per step: conservation is no matter of accuracy."""
    system, state = compiled(joint, "tree")
    found = account(system, nc.simulate(system, state, dt=dt, steps=STEPS, extra_substeps=3 * STEPS))
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert max(found.directors, found.joints) <= tol.CONSTRAINT


@EVERY_JOINT
def test_forms_give_one_trajectory(joint):
    """What is solved for does not change the motion."""
    ones, others = hung(joint, "tree"), hung(joint, "multipliers")
    order = [ones[0].body_index(name) for name in others[0].structure.bodies]
    early = rows(ones[1].q)[:100, order] - rows(others[1].q)[:100]
    assert np.max(np.abs(early)) <= tol.SAME_TRAJECTORY


@EVERY_FORM
@EVERY_JOINT
def test_what_is_read_does_not_alternate(joint, form):
    """And obeys the constraints, though the velocities that the step carries on do neither."""
    system, state = compiled(joint, form)
    trajectory = nc.simulate(system, state, dt=DT / 4, steps=STEPS)
    pair = [system.sense(trajectory, name) for name in ("first", "second")]
    read = [pair[0].angular_velocity, pair[1].angular_velocity, system.sense(trajectory, "joint").rates]
    assert alternation(np.concatenate([np.asarray(x) for x in read], axis=1)) <= tol.ALTERNATION
    assert alternation(np.concatenate([np.asarray(x.velocity) for x in pair], axis=1)) <= tol.ALTERNATION
    assert np.max(system.constraint_errors(trajectory).velocity) <= tol.TANGENT
    assert np.max(system.constraint_errors(trajectory.states).velocity) > tol.TANGENT


@EVERY_JOINT
def test_coordinates_agree_with_frames(joint):
    """Coordinates are summed up over the steps; at the end they must be those of the positions."""
    system, trajectory = hung(joint, "tree")
    summed = trajectory.states.coordinates[-1]
    first, last = (coordinate_values(system, rows_with_ground(trajectory.q[k])) for k in (0, -1))
    difference = np.array(summed - (last if joint == "distance" else last - first))
    angles = [g.index for g in system.coordinates if g.axis.unit == "rad"]
    for index in angles:
        difference[index] = np.remainder(difference[index] + np.pi, 2 * np.pi) - np.pi
    assert np.all(np.abs(difference) <= tol.CONSTRAINT * 10)


def test_the_library_keeps_the_same_accounts():
    system, trajectory = hung("universal", "tree")
    found = account(system, trajectory)
    energy = system.energy(trajectory)
    assert np.allclose(energy.kinetic, found.kinetic, rtol=1e-12)
    assert np.allclose(energy.total, found.kinetic + sum(found.stores.values()), rtol=1e-12)
    assert np.allclose(system.momentum(trajectory), found.momenta.sum(1), atol=1e-12)
    assert np.allclose(system.angular_momentum(trajectory), found.spins.sum(1), atol=1e-12)
    q = rows(trajectory.q)
    mass = np.asarray(system.mass)
    height = np.einsum("ka,tka->t", mass[:, 0], q[..., 2])
    assert np.allclose(energy.stores["gravity"], 9.81 * height, rtol=1e-12)
