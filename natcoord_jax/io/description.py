"""A robot in numbers: what its file says, in SI units, before it is part of a scene."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from natcoord_jax.io.notes import Note

Range = tuple[float, float]
UNBOUNDED: Range = (-np.inf, np.inf)


@dataclass(frozen=True)
class JointData:
    """A joint between a link and its parent.

    Attributes:
        name: as in the file.
        kind: "hinge", "slide", "ball" or "free".
        point: in the frame of the link [m].
        axis: in the frame of the link [-].
        position_index: first of its numbers among the positions (`qpos` of MuJoCo).
        rate_index: first of its numbers among the rates (`qvel` of MuJoCo).
        zero: coordinate in the pose of the file [rad or m].
        range: lower and upper limit [rad or m].
        stop: stiffness of the elastic stops there [N m/rad or N/m].
        effort: least and largest force of all its actuators [N m or N].
        velocity: largest rate [rad/s or m/s].
        stiffness: of its spring [N m/rad or N/m].
        rest: coordinate at which the spring is not stretched [rad or m]; of a ball in the pose of the file.
        damping: [N m s/rad or N s/m].
        armature: inertia of the rotor, seen by the joint [kg m^2 or kg].
        friction: dry friction [N m or N].
    """

    name: str
    kind: str
    point: np.ndarray
    axis: np.ndarray
    position_index: int
    rate_index: int
    zero: float = 0.0
    range: Range = UNBOUNDED
    stop: float = 0.0
    effort: Range = UNBOUNDED
    velocity: float = np.inf
    stiffness: float = 0.0
    rest: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    friction: float = 0.0

    @property
    def has_coordinate(self) -> bool:
        """Whether it turns or slides along one axis."""
        return self.kind in ("hinge", "slide")


@dataclass(frozen=True)
class LinkData:
    """A rigid body: a link with all links that are fixed to it.

    Attributes:
        name: of the first of them.
        parent: number of the link that its first joint hangs on; -1: the ground.
        position: of its frame in the pose of the file [m].
        rotation: its axes in that pose, as columns [-].
        mass: [kg]; zero for a link between joints.
        com: centre of mass in its frame [m].
        inertia: about the centre of mass, in its axes (3, 3) [kg m^2].
        joints: to the parent, the first of them next to it.
        members: names of the links that it consists of.
        floats: forces against gravity: points in its frame [m] and the masses they lift [kg].
    """

    name: str
    parent: int
    position: np.ndarray
    rotation: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    joints: tuple[JointData, ...]
    members: tuple[str, ...]
    floats: tuple[tuple[np.ndarray, float], ...] = ()
    surface: Any = None


@dataclass(frozen=True)
class FrameData:
    """A frame that is fixed in a link: of a site, or of a link of the file.

    Attributes:
        link: number of the link; -1: the ground.
        position: in the frame of the link [m].
        rotation: in the axes of the link, as columns [-].
    """

    link: int
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class ActuatorData:
    """An actuator: one input.

    Attributes:
        name: of the input.
        kind: "coordinates", "wrench" (at a frame) or "ball".
        joints: names of the joints it acts on.
        gear: length per unit of each coordinate; of a wrench force and torque (6,), of a ball torque (3,).
        gain: see `nc.AffineActuator`.
        bias: likewise.
        range: of the input [-].
        force: of the force [N or N m].
        frame: of a wrench.
        in_parent: whether the gear of a ball is in the axes of the parent.
    """

    name: str
    kind: str
    joints: tuple[str, ...]
    gear: np.ndarray
    gain: np.ndarray
    bias: np.ndarray
    range: Range = UNBOUNDED
    force: Range = UNBOUNDED
    frame: FrameData | None = None
    in_parent: bool = False


@dataclass(frozen=True)
class EqualityData:
    """A constraint beside the joints.

    Attributes:
        name: its name.
        kind: "connect", "weld" or "joint".
        frames: of a connect its two points, of a weld the two frames that coincide.
        joints: of a relation between coordinates.
        factors: of these coordinates.
        offset: right-hand side [rad or m].
    """

    name: str
    kind: str
    frames: tuple[FrameData, ...] = ()
    joints: tuple[str, ...] = ()
    factors: tuple[float, ...] = ()
    offset: float = 0.0


@dataclass(frozen=True)
class Keyframe:
    """A state of the robot by name.

    Attributes:
        positions: of all joints (`qpos` of MuJoCo): angles [rad], displacements [m], of a ball a quaternion
            (w, x, y, z), of a free joint a position [m] and a quaternion.
        rates: of all joints (`qvel` of MuJoCo) [rad/s, m/s].
        inputs: of the actuators that are mapped.
    """

    positions: np.ndarray
    rates: np.ndarray
    inputs: np.ndarray


@dataclass(frozen=True)
class Description:
    """What `nc.io.load` has read."""

    name: str
    links: tuple[LinkData, ...]
    frames: dict[str, FrameData]
    sites: dict[str, FrameData]
    actuators: tuple[ActuatorData, ...]
    equalities: tuple[EqualityData, ...]
    keyframes: dict[str, Keyframe]
    gravity: np.ndarray
    positions: np.ndarray
    rate_count: int
    notes: tuple[Note, ...]
    model: Any = field(repr=False)

    @property
    def joints(self) -> dict[str, JointData]:
        """All joints by name."""
        return {joint.name: joint for link in self.links for joint in link.joints}
