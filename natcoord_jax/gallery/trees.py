"""Open trees of any size, for measurements of how time grows with the number of bodies, and a robot arm."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import natcoord_jax as nc
from natcoord_jax.core.handles import Handle
from natcoord_jax.gallery.example import Example

LINK = 0.5
"""Length of a link of the chain [m]."""


def _link(scene: nc.Scene, name: str, start: np.ndarray, end: np.ndarray) -> Handle:
    """Link of 1 kg between two points, a rod of the inertia of a sphere: the same in every direction."""
    size = float(np.linalg.norm(end - start))
    inertia = np.full(3, size**2 / 12)
    body = nc.RigidBody(
        mass=1.0,
        inertia=inertia,
        com=0.5 * (end - start),
        shape=nc.Sphere(0.12 * size),  # drawn smaller than its inertia says: that would hide others
        position=start,
        name=name,
    )
    return scene.add(body)


def chain(bodies: int = 8) -> Example:
    """A chain of links on hinges that point across and up in turns, released horizontally.

    Args:
        bodies: number of links.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    carrier, step = nc.ground, np.array([LINK, 0, 0])
    for k in range(bodies):
        body = _link(scene, f"link {k + 1}", k * step, (k + 1) * step)
        axis = (0, 0.8, 0.6) if k % 2 else (0, 0.8, -0.6)
        scene.add(nc.Revolute(carrier, body, point=k * step, axis=axis, name=f"hinge {k + 1}"))
        carrier = body
    end = nc.Point(carrier, step, local=True)
    about = f"a chain of {bodies} links"
    return Example("chain", about, *scene.compile(), 0.005, 200, facts={"dofs": bodies}, traces=(end,))


def binary_tree(bodies: int = 15) -> Example:
    """A binary tree of links on hinges, swinging under gravity.

    Args:
        bodies: number of links; full levels need 2^k - 1.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    handles, ends = [], []
    for k in range(bodies):
        level = int(np.log2(k + 1))
        start = ends[(k - 1) // 2] if k else np.zeros(3)
        side = (1 if k % 2 else -1) * 2.0 ** (-level) if k else 0.0
        sideways = np.array([side, 0, 0]) if level % 2 else np.array([0, side, 0])
        end = start + sideways + np.array([0.2, 0.1, -0.4])
        body = _link(scene, f"link {k + 1}", start, end)
        axis = (1, 0, 0) if level % 2 else (0, 1, 0)
        carrier = handles[(k - 1) // 2] if k else nc.ground
        scene.add(nc.Revolute(carrier, body, point=start, axis=axis, name=f"hinge {k + 1}"))
        handles.append(body)
        ends.append(end)
    return Example(
        "binary_tree", f"a tree of {bodies} links", *scene.compile(), 0.005, 200, facts={"dofs": bodies}
    )


class Swing(eqx.Module):
    """Smooth way to and from `amplitude` [rad] with period `period` [s]; numbers are leaves."""

    amplitude: Array = eqx.field(converter=lambda x: jnp.asarray(x, float))
    period: Array = eqx.field(converter=lambda x: jnp.asarray(x, float))

    def __call__(self, t: Array) -> Array:
        """Angle at time t [s]."""
        return 0.5 * self.amplitude * (1 - jnp.cos(2 * jnp.pi * t / self.period))


# Denavit-Hartenberg rows of the robot of the paper (8.2) at zero angles: alpha [deg], d [m]; all a are zero.
ROBOT = ((90, 0.31), (-90, 0.0), (-90, 0.4), (90, 0.0), (90, 0.39), (-90, 0.0), (0, 0.0))
MASSES = (3.0, 3.0, 2.5, 2.5, 2.0, 1.5, 0.5)
"""Masses of the links [kg]: round numbers of our own, not those of a real robot."""
AMPLITUDES = (1.2, -0.8, 0.9, 1.1, -1.0, 0.7, 1.5)


def robot_arm() -> Example:
    """A robot arm with seven hinges, every angle prescribed; the drives' work is in the balance (8.2)."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    carrier, origin, frame = nc.ground, np.zeros(3), np.eye(3)
    for k, (alpha, d) in enumerate(ROBOT):
        axis = frame[:, 2]
        following = origin + d * axis
        angle = np.deg2rad(alpha)
        turn = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
        link = nc.RigidBody(
            mass=MASSES[k],
            inertia=np.full(3, 0.02 * MASSES[k]),
            com=0.5 * (following - origin),
            shape=nc.Sphere(0.07 - 0.006 * k),  # to be seen; hands and arms are between them
            position=origin,
            name=f"link {k + 1}",
        )
        body = scene.add(link)
        hinge = scene.add(nc.Revolute(carrier, body, point=origin, axis=axis, name=f"hinge {k + 1}"))
        scene.add(nc.Drive(hinge, function=Swing(AMPLITUDES[k], 4.0), name=f"drive {k + 1}"))
        carrier, origin, frame = body, following, frame @ np.array(turn)
    return Example("robot_arm", "seven hinges, all driven", *scene.compile(), 0.01, 400, facts={"dofs": 0})


T_END = 2.0  # [s]
GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]

# fmt: off


def _body(name, mass, inertia, com, parent, joint, point, axes=(), *, stiffness=0.0, damping=0.0) -> dict:
    """One entry of BODIES."""
    return dict(name=name, mass=mass, inertia=inertia, com=com, parent=parent, joint=joint, point=point,
                axes=axes, stiffness=stiffness, damping=damping)


BODIES = [
    _body("trunk", 20.0, (1.60, 2.40, 1.20), (0.15, 0.0, -0.45), None,
          "revolute", (0.0, 0.0, 0.0), ((0.0, 1.0, 0.0),), stiffness=60.0, damping=2.0),
    _body("right_arm", 6.0, (0.10, 0.36, 0.40), (0.85, 0.10, -0.65), 0,
          "spherical", (0.5, 0.1, -0.6)),
    _body("left_arm", 5.0, (0.30, 0.28, 0.08), (-0.70, -0.20, -0.90), 0,
          "universal", (-0.5, -0.1, -0.6), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    _body("right_hand", 3.0, (0.08, 0.10, 0.04), (1.30, 0.10, -0.90), 1,
          "revolute", (1.2, 0.1, -0.7), ((0.0, 0.6, 0.8),), stiffness=15.0, damping=0.3),
    _body("right_slider", 2.0, (0.02, 0.03, 0.025), (0.80, 0.30, -0.80), 1,
          "prismatic", (0.8, 0.2, -0.65), ((0.6, 0.0, -0.8),)),
    _body("left_slider", 2.5, (0.04, 0.05, 0.03), (-0.85, -0.30, -1.30), 2,
          "cylindrical", (-0.9, -0.3, -1.2), ((0.0, -0.6, -0.8),)),
    _body("left_hand", 3.0, (0.09, 0.06, 0.07), (-0.60, -0.45, -1.20), 2,
          "revolute", (-0.7, -0.25, -1.2), ((1.0, 0.0, 0.0),), stiffness=12.0, damping=0.2),
    _body("right_bob", 1.5, (0.04, 0.05, 0.03), (1.40, 0.20, -1.40), 3,
          "spherical", (1.35, 0.1, -1.1)),
]


def _spring(body_a, point_a, body_b, point_b, stiffness, length, *, damping=0.0) -> dict:
    """One entry of POINT_SPRINGS."""
    return dict(body_a=body_a, point_a=point_a, body_b=body_b, point_b=point_b, stiffness=stiffness,
                length=length, damping=damping)


POINT_SPRINGS = [
    _spring(1, (0.5, 0.25, -0.3), 4, (0.80, 0.30, -0.80), 300.0, 0.45, damping=2.0),
    _spring(2, (-0.9, 0.0, -0.8), 5, (-0.85, -0.30, -1.30), 300.0, 0.45, damping=2.0),
    _spring(6, (-0.60, -0.45, -1.20), 3, (1.30, 0.10, -0.90), 20.0, 1.80),
    _spring(None, (1.0, -0.8, 0.5), 1, (1.1, 0.1, -0.68), 80.0, 1.20),
]
# fmt: on


def _joint(scene: nc.Scene, data: dict[str, Any], parent: Handle, child: Handle) -> None:
    """The joint that carries a body, with its spring and damper."""
    kind, axes = getattr(nc, data["joint"].capitalize()), dict(zip(("axis", "second"), data["axes"]))
    joint = scene.add(kind(parent, child, point=data["point"], **axes, name=f"{data['name']} joint"))
    if data["stiffness"]:
        scene.add(nc.JointSpring(joint, stiffness=data["stiffness"], name=f"{data['name']} spring"))
    if data["damping"]:
        scene.add(nc.JointDamper(joint, damping=data["damping"], name=f"{data['name']} damper"))


def open_tree() -> Example:
    """Eight bodies on five kinds of joint with springs and dampers, 14 degrees of freedom."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=GRAVITY))
    bodies: dict[int | None, Handle] = {None: nc.ground}
    for number, data in enumerate(BODIES):
        given = {key: data[key] for key in ("mass", "inertia", "name")}
        bodies[number] = scene.add(nc.RigidBody(position=data["com"], **given))
        _joint(scene, data, bodies[data["parent"]], bodies[number])
    for number, data in enumerate(POINT_SPRINGS):
        ends = tuple(nc.Point(bodies[data[f"body_{x}"]], data[f"point_{x}"]) for x in "ab")
        name = f"spring {number + 1}"
        scene.add(nc.Spring(ends, stiffness=data["stiffness"], length=data["length"], name=name))
        if data["damping"]:
            scene.add(nc.Damper(ends, damping=data["damping"], name=f"damper {number + 1}"))
    facts = {"dofs": 14, "energy_start": -291.4831761332036, "energy": -300.25176106157113}
    return Example(
        "open_tree", "eight bodies on mixed joints", *scene.compile(), T_END / 200, 200, facts=facts
    )
