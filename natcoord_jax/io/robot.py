"""A robot as a part of a scene, and what refers to it there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.bodies.rigid import orientation as rotation_of
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.markers import Direction, Marker, Point
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.core.state import State
from natcoord_jax.io import building, placing
from natcoord_jax.io.description import Description, FrameData, JointData, Keyframe
from natcoord_jax.io.notes import Note, in_words
from natcoord_jax.system import System


@dataclass(frozen=True)
class Site:
    """A frame that is fixed in a body: a point, and three directions.

    Attributes:
        body: handle of the body.
        point: marker [m].
        axes: three markers [-].
    """

    body: Handle
    point: Marker
    axes: tuple[Marker, Marker, Marker]


@dataclass(frozen=True)
class RobotHandle:
    """What `Scene.add` returns of a robot; all names are those of its file.

    Attributes:
        name: of the robot in the scene.
        bodies: handles of the bodies by the names of the links; several links may be one body, links that are
            fixed to the world are the ground.
        joints: handles of the joints; a joint that leaves a body free has none.
        inputs: handles of the effects behind the inputs.
        frames: of the links, as sites.
        sites: points with axes.
        keyframes: states by name.
        description: all numbers of the file.
        place: where the origin of the file is in the scene [m], and the axes of the file there [-].
    """

    name: str
    bodies: Mapping[str, Handle]
    joints: Mapping[str, Handle]
    inputs: Mapping[str, Handle]
    frames: Mapping[str, Site]
    sites: Mapping[str, Site]
    keyframes: Mapping[str, Keyframe]
    description: Description = field(repr=False)
    place: tuple[np.ndarray, np.ndarray] = field(repr=False)
    parts: Any = field(repr=False)

    def state(self, system: System, state: State, positions: Any = None, rates: Any = None) -> State:
        """A state in which the robot has given positions and rates of its joints, and all else is kept.

        Args:
            system: compiled system.
            state: of which the rest is taken.
            positions: shape (positions,) [rad, m, quaternions (w, x, y, z)], in the layout of MuJoCo's
                `qpos`; default those of the file. A free joint's are in the frame of the file.
            rates: shape (rates,) [rad/s, m/s], in the layout of MuJoCo's `qvel`; default zero.

        Raises:
            ValueError: for a wrong shape, or a system that the robot is not part of.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> scene = nc.Scene()
            >>> arm = scene.add(nc.io.load(nc.io.PENDULUM))
            >>> system, state = scene.compile()
            >>> moved = arm.state(system, state, positions=[0.5])
            >>> round(float(system.coordinate(moved, arm.joints["hinge"])), 12)
            0.5
        """
        return placing.with_positions(self, system, state, positions, rates)


class Robot(Recipe):
    """What `nc.io.load` returns: `print` it, and add it to a scene, as often as there are robots.

    Attributes:
        description: all numbers of the file.
        name: prefix of the names in the scene; None: none.
        position: where the origin of the file is put [m].
        orientation: of the axes of the file: matrix, quaternion (w, x, y, z) or (axis, angle [rad]).
    """

    description: Description = eqx.field(static=True)
    name: str | None = eqx.field(default=None, static=True)
    position: Any = eqx.field(default=(0.0, 0.0, 0.0))
    orientation: Any = eqx.field(default=None)

    kind = "robot"

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return tuple(link.name for link in self.description.links)

    @property
    def joints(self) -> dict[str, JointData]:
        """Numbers of the joints by name: limits, efforts, springs."""
        return self.description.joints

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(actuator.name for actuator in self.description.actuators)

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is left out or otherwise than in the file, by name, with the reason."""
        return self.description.notes

    def at(self, *, name: str | None = None, position: Any = None, orientation: Any = None) -> "Robot":
        """The robot under another name or at another place; see `Scene.add`."""
        given = {"name": name, "position": position, "orientation": orientation}
        return replace_fields(self, **{key: value for key, value in given.items() if value is not None})

    def add_to(self, scene: Builder, name: str) -> RobotHandle:
        """Add bodies, joints and effects, and gravity if the scene has none.

        Raises:
            ValueError: for a name that is taken.
        """
        label = f"robot {name!r}"
        axes = np.asarray(rotation_of(self.orientation, label))
        place = np.asarray(self.position, float), axes
        parts = building.build(self.description, scene, "" if self.name is None else f"{name}/", place)
        frames = {key: _site(frame, parts) for key, frame in self.description.frames.items()}
        return RobotHandle(
            name=name,
            bodies={key: frame.body for key, frame in frames.items()},
            joints=parts.joints,
            inputs=parts.inputs,
            frames=frames,
            sites={key: _site(frame, parts) for key, frame in self.description.sites.items()},
            keyframes=self.description.keyframes,
            description=self.description,
            place=place,
            parts=parts,
        )

    def __str__(self) -> str:
        robot = self.description
        kinds = [f"{joint.name} ({joint.kind})" for joint in robot.joints.values()]
        lines = [
            f"robot {robot.name!r}: {len(robot.links)} bodies, {len(kinds)} joints, "
            f"{len(robot.actuators)} inputs",
            f"bodies      {', '.join(self.bodies) or 'none'}",
            f"joints      {', '.join(kinds) or 'none'}",
            f"inputs      {', '.join(self.inputs) or 'none'}",
        ]
        more = {"sites": robot.sites, "keyframes": robot.keyframes}
        lines += [f"{what:<12}{', '.join(names)}" for what, names in more.items() if names]
        for title, mapped in (("left out", False), ("otherwise", True)):
            words = in_words(robot.notes, mapped)
            lines += [f"{title if not k else '':<12}{line}" for k, line in enumerate(words)]
        return "\n".join(lines)

    __repr__ = __str__


def _site(frame: FrameData, parts: Any) -> Site:
    """Markers of a frame, in the axes of its body; of the ground by its place in the scene."""
    body, point, axes = parts.placed(frame)
    local = frame.link >= 0
    if local:
        point, axes = frame.position, frame.rotation
    first, second, third = (Direction(body, axis, local=local) for axis in axes.T)
    return Site(body, Point(body, point, local=local), (first, second, third))
