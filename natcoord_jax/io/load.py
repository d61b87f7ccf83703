"""Reading a robot, and what is drawn of its links: shapes and meshes as points and faces."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from natcoord_jax.bodies.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere, Surface
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.kinds import FLAG, Anything, Choice, Several
from natcoord_jax.io.actuation import input_index, read_actuators
from natcoord_jax.io.description import UNBOUNDED, ActuatorData, Description, JointData, Keyframe, LinkData
from natcoord_jax.io.links import Poses, body_name, read_links
from natcoord_jax.io.notes import Notes, mujoco
from natcoord_jax.io.relations import list_the_rest, read_equalities
from natcoord_jax.io.robot import Robot
from natcoord_jax.io.source import Source, read


class LinkSurface(eqx.Module):
    """Everything that is drawn of a link.

    Attributes:
        points: in the frame of the link [m].
        corners: numbers of the points around all faces, one face after the other.
        starts: where each face starts among the corners, and their number.
        colours: red, green, blue, opaqueness of each face, 0 to 1.
    """

    points: Float[np.ndarray, "n 3"]
    corners: Int[np.ndarray, " c"]
    starts: Int[np.ndarray, " faces_and_one"]
    colours: Float[np.ndarray, "faces 4"]

    def surface(self) -> Surface:
        """Points from the reference point of the body [m], and faces."""
        corners, starts = np.asarray(self.corners, int), np.asarray(self.starts, int)
        return np.asarray(self.points), np.split(corners, starts[1:-1])


def read_surfaces(model: Any, poses: Poses, notes: Notes) -> dict[int, LinkSurface]:
    """Surfaces of the links, by their number."""
    pieces: dict[int, list[tuple[np.ndarray, list[np.ndarray], np.ndarray]]] = {}
    for geom in _drawn(model, poses):
        body = int(model.geom_bodyid[geom])
        surface = _surface(model, geom)
        if surface is None:
            kind = mujoco().mjtGeom(int(model.geom_type[geom])).name.rpartition("_")[2].lower()
            notes.left_out(model.geom(geom).name or f"a {kind}", f"what has the shape {kind} is not drawn")
            continue
        turned = np.zeros(9)
        mujoco().mju_quat2Mat(turned, model.geom_quat[geom])
        frame = poses.in_body(body, model.geom_pos[geom], turned.reshape(3, 3))
        points = frame.position + surface[0] @ frame.rotation.T
        pieces.setdefault(frame.link, []).append((points, surface[1], _colour(model, geom)))
    return {link: _joined(parts) for link, parts in pieces.items()}


def _drawn(model: Any, poses: Poses) -> list[int]:
    """Of each link the geoms that are only seen, or if there are none those that collide."""
    seen = (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    links = np.array([poses.link_of[body] for body in model.geom_bodyid], int)
    has = {int(link) for link, only in zip(links, seen) if only}
    return [g for g in range(model.ngeom) if links[g] >= 0 and (seen[g] or int(links[g]) not in has)]


def _colour(model: Any, geom: int) -> np.ndarray:
    material = int(model.geom_matid[geom])
    plain = np.allclose(model.geom_rgba[geom], (0.5, 0.5, 0.5, 1.0))
    return np.array(model.mat_rgba[material] if material >= 0 and plain else model.geom_rgba[geom], float)


SHAPES = {
    "mjGEOM_BOX": lambda *halves: Box(2 * np.array(halves)),
    "mjGEOM_SPHERE": lambda radius, *_: Sphere(radius),
    "mjGEOM_ELLIPSOID": lambda *semi_axes: Ellipsoid(np.array(semi_axes)),
    "mjGEOM_CYLINDER": lambda radius, half, _: Cylinder(radius, 2 * half),
    "mjGEOM_CAPSULE": lambda radius, half, _: Capsule(radius, 2 * half),
}
"""By MuJoCo's kind of a geom, from its sizes."""


def _surface(model: Any, geom: int) -> Surface | None:
    """Points and faces in the frame of the geom."""
    kind, size = mujoco().mjtGeom(int(model.geom_type[geom])), np.array(model.geom_size[geom])
    if kind.name == "mjGEOM_MESH":
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        points = np.array(model.mesh_vert[first : first + count], float)
        return points, list(np.array(model.mesh_face[start : start + faces], int))
    return SHAPES[kind.name](*size).surface() if kind.name in SHAPES else None


def _joined(pieces: list[tuple[np.ndarray, list[np.ndarray], np.ndarray]]) -> LinkSurface:
    """Several surfaces as one."""
    points, corners, lengths, colours, before = [], [], [0], [], 0
    for own, faces, colour in pieces:
        points.append(own)
        corners += [np.asarray(face, int) + before for face in faces]
        lengths += [len(face) for face in faces]
        colours += [colour] * len(faces)
        before += len(own)
    return LinkSurface(np.concatenate(points), np.concatenate(corners), np.cumsum(lengths), np.array(colours))


PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.001"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
"""A small MJCF text, for examples."""

LEFT_OUT = Choice(("limits", "friction", "equalities", "gravity", "visuals"))


@checked("nc.io.load", source=Anything(), leave_out=Several(LEFT_OUT), floating=FLAG, motors=FLAG)
def load(
    source: Any, *, leave_out: Sequence[str] = (), floating: bool = False, motors: bool | None = None
) -> Robot:
    """Read a robot from URDF or MJCF.

    MuJoCo's parser and compiler read both. Links that fixed joints join become one body; several joints of a
    body become a chain of bodies without mass, so that each has a handle. What cannot be mapped is listed by
    name with the reason, see `Robot.notes` and `print`. The first robot of a scene brings the gravity of its
    file, unless the scene has one.

    Args:
        source: path of a .urdf or .xml file, the text of one, or a `mujoco.MjSpec`, which is not changed.
        leave_out: some of "limits", "friction" (dry), "equalities", "gravity" and "visuals" (shapes and
            meshes, which take time to read).
        floating: let the root link of a URDF move freely; by itself it is fixed to the world.
        motors: give each hinge and slide a motor, an input [N m or N] by the name of the joint. Default: of
            a URDF, which says nothing of actuators, all that follow no other joint.

    Returns:
        The robot, for `Scene.add`.

    Raises:
        ImportError: without MuJoCo, with the line that installs it.
        FileNotFoundError: for a path where nothing is.
        ValueError: for something else than these, or a file that MuJoCo refuses, with its words.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> robot = nc.io.load(nc.io.PENDULUM)
        >>> print(robot)
        robot 'pendulum': 1 bodies, 1 joints, 1 inputs
        bodies      rod
        joints      hinge (hinge)
        inputs      motor
        >>> scene = nc.Scene()
        >>> left = scene.add(robot, name="left")
        >>> right = scene.add(robot, name="right", position=(1, 0, 0))
        >>> system, state = scene.compile()
        >>> system.structure.inputs
        ('left/motor', 'right/motor')
        >>> trajectory = nc.simulate(system, state, dt=0.01, steps=10)
        >>> system.coordinate(trajectory, right.joints["hinge"]).shape
        (11,)
    """
    found = read(source, visuals="visuals" not in leave_out, floating=floating)
    return Robot(described(found, set(leave_out), motors))


def described(found: Source, leave_out: set[str], motors: bool | None) -> Description:
    """All that the robot is, in numbers."""
    model, notes = found.model, found.notes
    leave_out = leave_out | _switched_off(model)
    poses = Poses(model)
    links = read_links(found, poses)
    equalities = () if "equalities" in leave_out else read_equalities(model, poses, notes)
    links = tuple(_without(link, leave_out) for link in links)
    joints = {joint.name: joint for link in links for joint in link.joints}
    _list_what_differs(links, joints, notes)
    actuators, numbers = read_actuators(model, poses, joints, notes)
    followers = {equality.joints[0] for equality in equalities if equality.kind == "joint"}
    if motors or (motors is None and found.is_urdf):
        actuators += _motors(joints, followers, {actuator.name for actuator in actuators}, notes)
    list_the_rest(model, notes)
    surfaces = {} if "visuals" in leave_out else read_surfaces(model, poses, notes)
    links = tuple(replace(link, surface=surfaces.get(k)) for k, link in enumerate(links))
    frames = {body_name(model, b): poses.in_body(b, np.zeros(3)) for b in range(1, model.nbody)}
    sites = {model.site(s).name or f"site {s + 1}": poses.site(s) for s in range(model.nsite)}
    gravity = np.zeros(3) if "gravity" in leave_out else np.array(model.opt.gravity)
    return Description(
        # The name of the model is the first of all names.
        name=bytes(model.names).partition(b"\0")[0].decode() or "robot",
        links=links,
        frames=frames,
        sites=sites,
        actuators=actuators,
        equalities=equalities,
        keyframes=_keyframes(model, numbers, len(actuators)),
        gravity=gravity,
        positions=np.array(model.qpos0),
        rate_count=int(model.nv),
        notes=notes.listed(),
        model=model,
    )


def _switched_off(model: Any) -> set[str]:
    """What the flags of a file switch off."""
    flags = mujoco().mjtDisableBit
    names = {
        "GRAVITY": "gravity",
        "LIMIT": "limits",
        "FRICTIONLOSS": "friction",
        "EQUALITY": "equalities",
        "SPRING": "springs",
        "DAMPER": "dampers",
    }
    off = {name for flag, name in names.items() if model.opt.disableflags & getattr(flags, f"mjDSBL_{flag}")}
    if model.opt.disableflags & flags.mjDSBL_CONSTRAINT:
        off |= {"limits", "friction", "equalities"}
    return off


def _list_what_differs(links: Sequence[LinkData], joints: dict[str, JointData], notes: Notes) -> None:
    """What all robots have otherwise than MuJoCo, where they have it."""
    if not links:
        notes.left_out("all bodies", "none can move; a URDF whose root should is read with floating=True")
    if any(joint.stop for joint in joints.values()):
        notes.changed(
            "limits of joints", "elastic stops without damping, at rest as stiff as MuJoCo's limits"
        )
    for joint in joints.values():
        if joint.stop and not joint.range[0] <= joint.zero <= joint.range[1]:
            notes.changed(joint.name, "it starts beyond its limit: pose the robot, see RobotHandle.state")
    if any(joint.friction for joint in joints.values()):
        notes.changed("friction loss", "smooth at rest, see nc.JointFriction: what should stick creeps")


def _without(link: LinkData, leave_out: set[str]) -> LinkData:
    """A link without limits, friction, springs or dampers."""
    fields = {"limits": "stop", "friction": "friction", "springs": "stiffness", "dampers": "damping"}
    gone = {field: 0.0 for name, field in fields.items() if name in leave_out}
    return replace(link, joints=tuple(replace(joint, **gone) for joint in link.joints))


def _motors(
    joints: dict[str, Any], followers: set[str], taken: set[str], notes: Notes
) -> tuple[ActuatorData, ...]:
    """A motor for each joint with a coordinate that follows no other."""
    driven = [j for j in joints.values() if j.has_coordinate and j.name not in followers | taken]
    if any(joint.effort != UNBOUNDED for joint in driven):
        notes.changed("efforts", "listed with the joints; the motors are not cut off at them")
    plain = np.ones(1), np.array([1.0, 0.0, 0.0]), np.zeros(3)
    return tuple(ActuatorData(joint.name, "coordinates", (joint.name,), *plain) for joint in driven)


def _keyframes(model: Any, numbers: list[int], inputs: int) -> dict[str, Keyframe]:
    """All of them by name."""
    found = {}
    for key in range(model.nkey):
        given = np.zeros(inputs)
        for place, number in enumerate(numbers):
            given[place] = model.key_ctrl[key][input_index(model, number)]
            if model.actuator_actadr[number] >= 0:
                given[place] = model.key_act[key][model.actuator_actadr[number]]
        name = model.key(key).name or f"keyframe {key + 1}"
        found[name] = Keyframe(np.array(model.key_qpos[key]), np.array(model.key_qvel[key]), given)
    return found
