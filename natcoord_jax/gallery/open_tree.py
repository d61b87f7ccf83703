"""An open tree of eight bodies with mixed joints and springs: data (SI units) and scene.

A swinging trunk carries two branches that fork again; 14 degrees of freedom, at rest at t = 0 in the pose
given here. Every vector is written in world axes in that pose, in which the principal axes of every body are
parallel to the world axes. Small motions about it have frequencies up to 2.1 Hz, the angles of the sprung
joints stay below 0.7 rad (the free spin of left_slider reaches 3.3 rad), and the motion is not chaotic.

A body is a dict with the keys

    name, mass [kg], inertia (principal, about the centre of mass) [kg m2], com (centre of mass) [m],
    parent (index into BODIES, None: the ground), joint, point (of the joint) [m],
    axes (unit vectors: revolute, prismatic and cylindrical one, spherical none,
          universal two, the first fixed in the parent and the second in the body),
    stiffness [N m/rad] and damping [N m s/rad] of a revolute joint, its angle zero in this pose.

A point spring joins `point_a` of `body_a` to `point_b` of `body_b` (None: the ground) with a stiffness [N/m],
a rest length [m] and a damping [N s/m]; the points are material points, given where they are in this pose.
"""

from typing import Any

import natcoord_jax as nc
from natcoord_jax.core.handles import Handle
from natcoord_jax.gallery.example import Example

T_END = 2.0  # [s]
GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]
MOTORS = ()  # pairs (body, torque [N m] about its joint axis); none here

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
    where: dict[str, Any] = {"point": data["point"], "name": f"{data['name']} joint"}
    axes = data["axes"]
    match data["joint"]:
        case "spherical":
            scene.add(nc.Spherical(parent, child, **where))
        case "universal":
            scene.add(nc.Universal(parent, child, axis=axes[0], second=axes[1], **where))
        case "prismatic":
            scene.add(nc.Prismatic(parent, child, axis=axes[0], **where))
        case "cylindrical":
            scene.add(nc.Cylindrical(parent, child, axis=axes[0], **where))
        case "revolute":
            hinge = scene.add(nc.Revolute(parent, child, axis=axes[0], **where))
            if data["stiffness"]:
                scene.add(nc.JointSpring(hinge, stiffness=data["stiffness"], name=f"{data['name']} spring"))
            if data["damping"]:
                scene.add(nc.JointDamper(hinge, damping=data["damping"], name=f"{data['name']} damper"))


def open_tree() -> Example:
    """Eight bodies on five kinds of joint with springs and dampers, 14 degrees of freedom."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=GRAVITY))
    bodies: list[Handle] = []
    for data in BODIES:
        body = nc.RigidBody(
            mass=data["mass"], inertia=data["inertia"], position=data["com"], name=data["name"]
        )
        bodies.append(scene.add(body))
        parent = nc.ground if data["parent"] is None else bodies[data["parent"]]
        _joint(scene, data, parent, bodies[-1])
    for number, data in enumerate(POINT_SPRINGS):
        ends = tuple(
            nc.Point(
                nc.ground if data[f"body_{x}"] is None else bodies[data[f"body_{x}"]], data[f"point_{x}"]
            )
            for x in "ab"
        )
        name = f"spring {number + 1}"
        scene.add(nc.Spring(ends, stiffness=data["stiffness"], length=data["length"], name=name))
        if data["damping"]:
            scene.add(nc.Damper(ends, damping=data["damping"], name=f"damper {number + 1}"))
    system, state = scene.compile()
    facts = {"dofs": 14, "energy_start": -291.4831761332036, "energy": -300.25176106157113}
    return Example("open_tree", "eight bodies on mixed joints", system, state, T_END / 200, 200, facts=facts)
