"""Masses, inertias and units of very different sizes, and moved frames.

What could go wrong: a tolerance that is not scaled with the terms of its own equation lets the light body
drift or never stops on the heavy one; metres are written into a guess, a step or a norm; the world axes or
the resting frame are preferred somewhere.
"""

import dataclasses
from functools import cache

import numpy as np
import pytest
import tolerances as tol
from accounts import account, rows
from motions import losses, one_body, orders, simulate
from scenes import JOINTS, with_multipliers
from scipy.spatial.transform import Rotation

import natcoord_jax as nc
from natcoord_jax import gallery

LINKS = 5


class Looped(with_multipliers(nc.Revolute)):
    """A hinge with multipliers."""


@cache
def ladder(ratio: float, joint: type = nc.Revolute):
    """A chain whose masses and inertias grow by one factor, from link to link, to `ratio` at the end."""
    example = gallery.load("mass_ladder", ratio=ratio, links=LINKS, joint=joint)
    return example.system, example.state


@cache
def descent(ratio: float, order: int = 2, joint: type = nc.Revolute, steps: int = 200):
    """The chain falls for a second; one program for all ratios and numbers of steps."""
    return simulate(*ladder(ratio, joint), order=order, dt=0.005, steps=steps, extra_substeps=200)


RATIOS = [1e-8, 1e-4, 1.0, 1e4, 1e8]


@pytest.mark.parametrize(
    ("order", "form"),
    [
        pytest.param(2, "tree"),
        pytest.param(4, "multipliers", marks=pytest.mark.exhaustive),
        pytest.param(4, "tree", marks=pytest.mark.exhaustive),
        pytest.param(2, "multipliers", marks=pytest.mark.exhaustive),
    ],
)
def test_mass_ratios(order, form):
    """Masses from 1 to 1e8 or 1e-8 along five links. Could go wrong: constraints of the heaviest body are
    swamped by what is little for those of the lightest.

    Multipliers of the heaviest are rounded to what is much for the lightest, which kicks feel twice a stage.
    """
    joint, lost = nc.Revolute if form == "tree" else Looped, {}
    for ratio in RATIOS:
        rounded = 100.0 if (order, form) == (4, "multipliers") and ratio in (1e-8, 1e8) else 1.0
        bounds = {"energy": rounded * tol.ENERGY, "constraint": rounded * tol.CONSTRAINT}
        lost[ratio] = losses(account(ladder(ratio, joint)[0], descent(ratio, order, joint)), **bounds)
    assert not any(lost.values()), lost


def test_what_is_light_pulls_in_proportion():
    """Links lighter by 1e-4, 1e-6 and 1e-8 each: the first one moves as if alone, up to their mass."""
    firsts = [rows(descent(link ** (LINKS - 1), steps=100).q)[:, 0] for link in (1e-4, 1e-6, 1e-8)]
    assert 1e-6 <= np.max(np.abs(firsts[0] - firsts[1])) <= 1e-3
    assert 1e-8 <= np.max(np.abs(firsts[1] - firsts[2])) <= 1e-5


# --- thin rods, point masses ------------------------------------------------------------------------------


def rod(thickness: float):
    """A rod on a ball joint whose inertia about itself is next to nothing."""
    part = nc.RigidBody(
        mass=1.0,
        inertia=(thickness, 1.0, 1.0),
        com=(1.0, 0.0, 0.0),
        angular_velocity=(1.0, 0.5, 1.0),
        name="rod",
    )
    return one_body(part)


@orders(fourth="slow")
def test_thin_rods(order):
    """Inertias about themselves of 1e-3 to 1e-9.

    Rounding of the other terms of its balance, over that inertia, is a noise in its spin: 1e-7 of it at an
    inertia of 1e-9. Newton's iteration stalls there, in steps that are then repeated in substeps.
    """
    lost = {}
    for thickness in (1e-3, 1e-6, 1e-9):
        system, state = rod(thickness)
        laws = account(system, simulate(system, state, order=order, dt=0.01, steps=300, extra_substeps=1000))
        lost[thickness] = losses(laws)
        if not laws.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM:
            lost[thickness]["angular momentum"] = laws.spin_error(axes=[2])
    assert not any(lost.values()), lost


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


@orders(second="slow")
def test_point_masses(order):
    """Three beads on strings with masses up to 1e8 apart; angular momentum about the vertical is kept.

    The light bead between heavy ones snaps when they pull it straight, the faster the straighter: at 1e4
    rad/s, which substeps of 1/500 see. Its path is chaos, and sooner or later it snaps faster than any number
    of substeps sees: a tenth of a second is before that.
    """
    lost = {}
    for ratio in (1e-8, 1.0, 1e8):
        system, state = beads(ratio)
        steps = nc.Steps(100 if ratio > 1.0 else 1000, 1000)
        laws = account(
            system, simulate(system, state, order=order, dt=1e-3, steps=steps, extra_substeps=2000)
        )
        lost[ratio] = losses(laws, turned=0.0)
        if not laws.spin_error(axes=[2]) <= tol.ANGULAR_MOMENTUM:
            lost[ratio]["angular momentum"] = laws.spin_error(axes=[2])
        if not laws.exchanged()["kinetic"] >= 0.2:
            lost[ratio]["energy exchanged, so that nothing is tested"] = laws.exchanged()["kinetic"]
    assert not any(lost.values()), lost


# --- units and axes ---------------------------------------------------------------------------------------

TURN = Rotation.from_rotvec(1.1 * np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])).as_matrix()
SHIFT, BOOST = np.array([3.0, -2.0, 1.0]), np.array([1.5, 0.5, -2.0])


@cache
def measured(unit: float = 1.0, turned: bool = False):
    """A pendulum with a loop, a coil and a spring, in metres times `unit`; forces in kg m/s^2 times that.

    Args:
        unit: of length.
        turned: by `TURN`, with gravity and all that is on the ground.
    """
    turn, scene = TURN if turned else np.eye(3), nc.Scene()

    def place(*x):
        return unit * turn @ np.array(x, float)

    scene.add(nc.Gravity(vector=place(0.0, 0.0, -9.81)))
    arms = []
    for k in range(2):
        arm = nc.RigidBody(
            mass=1.5,
            inertia=unit**2 * np.array([0.02, 0.1, 0.11]),
            com=unit * np.array([0.4, 0.05, 0.0]),
            position=place(float(k), 0.0, 0.0),
            orientation=turn,
            name=f"arm {k}",
        )
        arms.append(scene.add(arm))
    axes = {"axis": turn[:, 1], "second": turn[:, 2]}
    pivot = scene.add(nc.Universal(nc.ground, arms[0], point=(0, 0, 0), **axes, name="pivot"))
    scene.add(nc.Spherical(arms[0], arms[1], point=place(1, 0, 0), name="elbow"))
    scene.add(nc.JointSpring(pivot, stiffness=unit**2 * 5.0, rest=0.3, name="coil"))
    ends = {"point": place(2, 0, 0), "parent_point": place(1.5, 0.5, 1.0)}
    scene.add(nc.Distance(nc.ground, arms[1], **ends, name="string"))
    across = nc.Point(nc.ground, place(1, 1, 0)), nc.Point(arms[0], place(1, 0, 0))
    scene.add(nc.Spring(across, name="spring", stiffness=30.0, length=0.6 * unit))
    return scene.compile()


@orders()
def test_units_and_axes(order):
    """The same scene in kilometres, in millimetres and in turned axes: the same digits and as many
    iterations, nearly."""
    views = {"metres": {}, "km": {"unit": 1e-3}, "mm": {"unit": 1e3}, "turned": {"turned": True}}
    runs = {
        view: simulate(*measured(**how), order=order, dt=0.01, steps=200, extra_substeps=16)
        for view, how in views.items()
    }
    metres, off = rows(runs["metres"].q), {}
    for view, how in views.items():
        moved = rows(runs[view].q) @ (TURN if how.get("turned") else np.eye(3))
        moved[:, :, 0] /= how.get("unit", 1.0)
        off[view] = np.max(np.abs(moved - metres))
    assert max(off.values()) <= tol.SAME_TRAJECTORY, off
    iterations = {view: int(run.iterations) for view, run in runs.items()}
    assert max(iterations.values()) <= 1.2 * iterations["metres"], iterations
    assert min(iterations.values()) >= 0.8 * iterations["metres"], iterations
    assert np.ptp(metres[:, 1, 0], axis=0).max() >= 0.2, "it hardly moves: nothing is tested"


def seen_from_elsewhere(state: nc.State) -> nc.State:
    """The state as another observer sees it: turned, displaced and moving along."""
    q, v = (np.asarray(x).reshape(-1, 4, 3) @ TURN.T for x in (state.q, state.v))
    q[:, 0] += SHIFT
    v[:, 0] += BOOST
    return dataclasses.replace(state, q=q.reshape(-1, 3), v=v.reshape(-1, 3))


ALL_KINDS = ("universal", "cylindrical", "screw", "prismatic", "planar", "spherical")


@cache
def limbs(kinds, form: str):
    """A free hub with a limb on a joint of each kind, coils on their coordinates, and springs to the hub."""
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
        angle = 2.0 * np.pi * number / len(ALL_KINDS)
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


@pytest.mark.parametrize(
    ("order", "kinds", "form"),
    [
        pytest.param(4, ALL_KINDS[:1], "multipliers", marks=pytest.mark.exhaustive),
        pytest.param(4, ALL_KINDS[:1], "tree", marks=pytest.mark.exhaustive),
        pytest.param(2, ALL_KINDS, "tree", marks=pytest.mark.exhaustive),
        pytest.param(2, ALL_KINDS, "multipliers", marks=pytest.mark.exhaustive),
    ],
)
def test_frame_indifference(order, kinds, form):
    """Bodies free in space, with springs: the turned and boosted start gives that trajectory."""
    system, state = limbs(kinds, form)
    one, other = (
        simulate(system, start, order=order, dt=0.02, steps=200)
        for start in (state, seen_from_elsewhere(state))
    )
    laws = account(system, one)
    assert laws.turned >= 1.0 and laws.exchanged()["kinetic"] >= 0.2
    places, speeds = rows(one.q) @ TURN.T, rows(one.v) @ TURN.T
    places[:, :, 0] += SHIFT + np.asarray(one.t)[:, None, None] * BOOST
    speeds[:, :, 0] += BOOST
    assert np.max(np.abs(rows(other.q) - places)) <= tol.OTHER_AXES
    assert np.max(np.abs(rows(other.v) - speeds)) <= tol.OTHER_AXES
