"""Masses, inertias and units of very different sizes, and moved frames.

What could go wrong: a tolerance that is not scaled with the terms of its own equation lets the light body
drift or never stops on the heavy one; metres are written into a guess, a probe or a norm; the world axes or
the resting frame are preferred somewhere.
"""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from motions import SECOND_AND_FOURTH, one_body, simulate
from scenes import JOINTS, with_multipliers

import natcoord_jax as nc
from natcoord_jax import gallery
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.maths.rotations import from_axis_angle

LINKS = 5


class Looped(with_multipliers(nc.Revolute)):
    """A hinge with multipliers."""


@cache
def ladder(ratio: float, joint: type = nc.Revolute):
    """A chain whose masses and inertias grow by one factor, from link to link, to `ratio` at the end."""
    example = gallery.load("mass_ladder", ratio=ratio, links=LINKS, joint=joint)
    return example.system, example.state


RATIOS = [1e-8, 1e-4, 1.0, 1e4, 1e8]
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("order", "form", "ratio"),
    [
        (order, form, ratio)
        for order in (2, 4)
        for form in ("tree", "multipliers")
        for ratio in RATIOS
        if ratio != 1.0 or (order, form) == (2, "tree")
    ],
)
def test_mass_ratios(order, form, ratio):
    """Masses from 1 to 1e8 or 1e-8 along five links. Could go wrong: constraints of the heaviest body are
    swamped by what is little for those of the lightest.

    Multipliers of the heaviest are rounded to what is much for the lightest, which kicks feel twice a stage.
    """
    system, state = ladder(ratio, nc.Revolute if form == "tree" else Looped)
    found = account(system, simulate(system, state, order=order, dt=0.005, steps=200, extra_substeps=200))
    rounded = 100.0 if (order, form) == (4, "multipliers") and ratio in (1e-8, 1e8) else 1.0
    assert found.turned >= 1.0
    assert found.energy_error <= rounded * tol.ENERGY
    assert max(found.directors, found.joints) <= rounded * tol.CONSTRAINT


def test_what_is_light_pulls_in_proportion():
    """Links lighter by 1e-4, 1e-6 and 1e-8 each: the first one moves as if alone, up to their mass."""
    firsts = []
    for link in (1e-4, 1e-6, 1e-8):
        system, state = ladder(link ** (LINKS - 1))
        firsts.append(rows(simulate(system, state, dt=0.005, steps=100).q)[:, 0])
    assert 1e-6 <= np.max(np.abs(firsts[0] - firsts[1])) <= 1e-3
    assert 1e-8 <= np.max(np.abs(firsts[1] - firsts[2])) <= 1e-5


# --- thin rods, point masses ------------------------------------------------------------------------------


THIN = [
    *((order, thickness) for order in (2, 4) for thickness in (1e-3, 1e-6)),
    (2, 1e-9),
    (4, 1e-9),
]


@pytest.mark.parametrize(("order", "thickness"), THIN)
def test_thin_rods(order, thickness):
    """A rod on a ball joint whose inertia about itself is next to nothing.

    Rounding of the other terms of its balance, over that inertia, is a noise in its spin: 1e-7 of it at an
    inertia of 1e-9. Newton's iteration stalls there, in steps that are then repeated in substeps.
    """
    rod = nc.RigidBody(
        mass=1.0,
        inertia=(thickness, 1.0, 1.0),
        com=(1.0, 0.0, 0.0),
        angular_velocity=(1.0, 0.5, 1.0),
        name="rod",
    )
    system, state = one_body(rod)
    found = account(system, simulate(system, state, order=order, dt=0.01, steps=300, extra_substeps=1000))
    assert found.turned >= 1.0
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert found.directors <= tol.CONSTRAINT


@cache
def beads(ratio: float):
    """Point masses on strings: no inertia at all, and constraints only of lengths."""
    scene = nc.Scene()
    scene.add(nc.Gravity())
    carrier, place = nc.ground, np.zeros(3)
    for k in range(3):
        following = place + np.array([0.5, 0.1 * k, -0.1])
        bead = nc.PointMass(mass=ratio ** (k / 2), position=following, name=f"bead {k}")
        body = scene.add(bead)
        string = nc.Distance(carrier, body, point=following, parent_point=place, name=f"string {k}")
        scene.add(string)
        carrier, place = body, following
    return scene.compile()


@pytest.mark.parametrize("ratio", [1e-8, 1.0, 1e8])
@SECOND_AND_FOURTH
def test_point_masses(order, ratio):
    """Three beads on strings with masses up to 1e8 apart; angular momentum about the vertical is kept.

    The light bead between heavy ones snaps when they pull it straight, the faster the straighter: at 1e4
    rad/s, which substeps of 1/500 see. Its path is chaos, and sooner or later it snaps faster than any number
    of substeps sees: a tenth of a second is before that.
    """
    system, state = beads(ratio)
    steps = 100 if ratio > 1.0 else 1000
    found = account(system, simulate(system, state, order=order, dt=1e-3, steps=steps, extra_substeps=2000))
    assert found.exchanged()["kinetic"] >= 0.2
    assert found.energy_error <= tol.ENERGY
    assert found.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM
    assert found.joints <= tol.CONSTRAINT


# --- units ------------------------------------------------------------------------------------------------


@cache
def measured(unit: float):
    """A pendulum with a loop, a coil and a spring, in metres times `unit`; forces in kg m/s^2 times that."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=unit * np.array([0.0, 0.0, -9.81])))
    arms = []
    for k in range(2):
        arm = nc.RigidBody(
            mass=1.5,
            inertia=unit**2 * np.array([0.02, 0.1, 0.11]),
            com=unit * np.array([0.4, 0.05, 0.0]),
            position=unit * np.array([float(k), 0.0, 0.0]),
            name=f"arm {k}",
        )
        arms.append(scene.add(arm))
    pivot = scene.add(
        nc.Universal(nc.ground, arms[0], point=(0, 0, 0), axis=(0, 1, 0), second=(0, 0, 1), name="pivot")
    )
    scene.add(nc.Spherical(arms[0], arms[1], point=unit * np.array([1.0, 0.0, 0.0]), name="elbow"))
    scene.add(nc.JointSpring(pivot, stiffness=unit**2 * 5.0, rest=0.3, name="coil"))
    string = nc.Distance(
        nc.ground,
        arms[1],
        point=unit * np.array([2.0, 0.0, 0.0]),
        parent_point=unit * np.array([1.5, 0.5, 1.0]),
        name="string",
    )
    scene.add(string)
    ends = (
        nc.Point(nc.ground, unit * np.array([1.0, 1.0, 0.0])),
        nc.Point(arms[0], unit * np.array([1.0, 0, 0])),
    )
    scene.add(nc.Spring(ends, name="spring", stiffness=30.0, length=0.6 * unit))
    return scene.compile()


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@SECOND_AND_FOURTH
def test_units(order, unit):
    """The same scene in kilometres and in millimetres: the same digits and as many iterations, nearly."""
    runs = []
    for scale in (1.0, unit):
        system, state = measured(scale)
        trajectory = simulate(system, state, order=order, dt=0.01, steps=200)
        moved = rows(trajectory.q).copy()
        moved[:, :, 0] /= scale
        runs.append((moved, int(trajectory.iterations)))
    assert np.max(np.abs(runs[0][0] - runs[1][0])) <= tol.SAME_TRAJECTORY
    assert abs(runs[1][1] - runs[0][1]) <= 0.2 * runs[0][1]


# --- frames -----------------------------------------------------------------------------------------------

TURN = from_axis_angle(jnp.array([1.0, 2.0, -0.5]), jnp.array(1.1))
SHIFT, BOOST = jnp.array([3.0, -2.0, 1.0]), jnp.array([1.5, 0.5, -2.0])


def seen_from_elsewhere(state: nc.State) -> nc.State:
    """The state as another observer sees it: turned, displaced and moving along."""
    q, v = state.q.reshape(-1, 4, 3) @ TURN.T, state.v.reshape(-1, 4, 3) @ TURN.T
    q, v = q.at[:, 0].add(SHIFT), v.at[:, 0].add(BOOST)
    return replace_fields(state, q=q.reshape(-1, 3), v=v.reshape(-1, 3))


EVERY_KIND = ("universal", "cylindrical", "screw", "prismatic", "planar", "spherical")


@cache
def limbs(kinds, form: str):
    """A free hub with a limb on a joint of every kind, coils on their coordinates, and springs to the hub."""
    scene = nc.Scene()
    spin, drift = np.array([0.3, -0.2, 0.5]), np.array([0.2, 0.1, -0.1])

    def part(name, place):
        body = nc.RigidBody(
            mass=1.0,
            inertia=(0.2, 0.3, 0.4),
            com=(0.05, -0.03, 0.02),
            position=place,
            velocity=drift + np.cross(spin, place),
            angular_velocity=spin,
            name=name,
        )
        return scene.add(body)

    hub = part("hub", np.zeros(3))
    for number, name in enumerate(kinds):
        angle = 2.0 * np.pi * number / len(EVERY_KIND)
        place = np.array([np.cos(angle), np.sin(angle), 0.3 * np.cos(2.0 * angle)])
        limb = part(f"{name} limb", place)
        kind = JOINTS[name] if form == "tree" else with_multipliers(JOINTS[name])
        more = {"pitch": 0.4} if name == "screw" else {}
        joint = scene.add(
            kind(hub, limb, point=0.6 * place, axis=(1, 2, 2), second=(2, 1, -2), name=name, **more)
        )
        for k in range(len(kind.coordinates)):
            scene.add(
                nc.JointSpring(joint, coordinate=k, stiffness=3.0, rest=0.4, name=f"coil {k} of {name}")
            )
        ends = nc.Point(hub, (0.1, -0.2, 0.3)), nc.Point(limb, place + np.array([0.1, 0.1, 0.1]))
        scene.add(nc.Spring(ends, name=f"spring of {name}", stiffness=20.0, length=0.3))
    return scene.compile()


@pytest.mark.parametrize("form", ["tree", "multipliers"])
@pytest.mark.parametrize(
    ("order", "kinds"), [(2, EVERY_KIND), (4, EVERY_KIND[:1])], ids=["every kind", "order four"]
)
def test_frame_indifference(order, kinds, form):
    """Bodies free in space, with springs: the turned and boosted start gives that trajectory."""
    system, state = limbs(kinds, form)
    one, other = (
        simulate(system, start, order=order, dt=0.02, steps=200)
        for start in (state, seen_from_elsewhere(state))
    )
    found = account(system, one)
    assert found.turned >= 1.0 and found.exchanged()["kinetic"] >= 0.2
    wanted = rows(one.q) @ np.asarray(TURN).T
    wanted[:, :, 0] += np.asarray(SHIFT) + np.asarray(one.t)[:, None, None] * np.asarray(BOOST)
    assert np.max(np.abs(rows(other.q) - wanted)) <= tol.OTHER_AXES
    speeds = rows(one.v) @ np.asarray(TURN).T
    speeds[:, :, 0] += np.asarray(BOOST)
    assert np.max(np.abs(rows(other.v) - speeds)) <= tol.OTHER_AXES


@SECOND_AND_FOURTH
def test_a_grounded_scene_in_other_axes(order):
    """Gravity, joints and springs on the ground turned with the scene: the motion is the turned one."""
    system, state = measured(1.0)
    one = simulate(system, state, order=order, dt=0.01, steps=200)
    turned_system, turned_state = turned_ground(system, state)
    other = simulate(turned_system, turned_state, order=order, dt=0.01, steps=200)
    wanted = rows(one.q) @ np.asarray(TURN).T
    assert np.max(np.abs(rows(other.q) - wanted)) <= tol.SAME_TRAJECTORY


def turned_ground(system, state):
    """The same system with all that is fixed to the ground turned: weights of its frames and markers."""
    bodies = len(system.structure.bodies)
    turn = jnp.eye(4).at[1:, 1:].set(TURN.T)  # world components are weights of the ground's unit axes

    def on_ground(weights, bodies_of):
        grounded = jnp.asarray(bodies_of == bodies)[(..., *(None,) * (weights.ndim - bodies_of.ndim))]
        return jnp.where(grounded, weights @ turn, weights)

    frames = on_ground(system.frames, np.asarray(system.joint_bodies))
    groups = []
    for group in system.effects:
        if group.weights is not None:
            group = eqx.tree_at(
                lambda g: g.weights, group, on_ground(group.weights, np.asarray(group.bodies))
            )
        if isinstance(group.effect, nc.Gravity):
            group = eqx.tree_at(lambda g: g.effect.vector, group, group.effect.vector @ TURN.T)
        groups.append(group)
    system = replace_fields(system, frames=frames, effects=tuple(groups))
    rotated = (state.q @ TURN.T, state.v @ TURN.T)
    return system, replace_fields(state, q=rotated[0], v=rotated[1])
