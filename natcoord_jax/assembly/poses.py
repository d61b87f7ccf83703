"""Where bodies and joints are in the assembled scene."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import Body
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.joint import Joint
from natcoord_jax.core.markers import Attachment, Marker
from natcoord_jax.maths.rotations import frame_from_axis


class Poses:
    """Assembled poses of all bodies and the ground, in scene order."""

    def __init__(self, bodies: dict[str, Body]):
        self.names = list(bodies)
        self.number = {name: i for i, name in enumerate(self.names)} | {"ground": len(bodies)}
        self.position = [b.position for b in bodies.values()] + [jnp.zeros(3)]
        self.rotation = [b.rotation for b in bodies.values()] + [jnp.eye(3)]

    def of(self, handle: Handle) -> int:
        """Number of a body; the number of bodies for the ground."""
        return self.number[handle.name]

    def point(self, body: int, position: Any) -> Float[Array, "4"]:
        """Weights of the material point at a world position."""
        local = self.rotation[body].T @ (jnp.asarray(position, float) - self.position[body])
        return jnp.concatenate([jnp.ones(1), local])

    def direction(self, body: int, vector: Any) -> Float[Array, "4"]:
        """Weights of the direction along a world vector."""
        return jnp.concatenate([jnp.zeros(1), self.rotation[body].T @ jnp.asarray(vector, float)])

    def weights(self, marker: Marker | Attachment) -> Float[Array, "*m 4"]:
        """Weights of a marker: (4,) of a point or a direction, (4, 4) of an attachment."""
        if isinstance(marker, Attachment):
            point = Marker(marker.body, marker.point, True, marker.local)
            axes = jnp.asarray(marker.axes, float).T
            parts = [point, *(Marker(marker.body, axis, False, marker.local) for axis in axes)]
            return jnp.stack([self.weights(part) for part in parts])
        vector = jnp.asarray(marker.vector, float)
        if marker.local:
            return jnp.concatenate([jnp.array([1.0 if marker.is_point else 0.0]), vector])
        body = self.of(marker.body)
        return self.point(body, vector) if marker.is_point else self.direction(body, vector)


def joint_triad(joint: Joint) -> Float[Array, "3 3"]:
    """The triad of the joint in the assembled pose, one vector a row."""
    return frame_from_axis(joint.axis, joint.second)


def joint_frames(joint: Joint, poses: Poses) -> Float[Array, "2 4 4"]:
    """Weights of point and triad on parent and child (44-47)."""
    parent, child = poses.of(joint.parent), poses.of(joint.child)
    triad = joint_triad(joint)
    at_parent, at_child = joint.anchors()
    at_parent = poses.position[child] if at_parent is None else at_parent
    at_child = poses.position[child] if at_child is None else at_child
    frames = []
    for body, point in ((parent, at_parent), (child, at_child)):
        frames.append(jnp.stack([poses.point(body, point), *(poses.direction(body, a) for a in triad)]))
    return jnp.stack(frames)
