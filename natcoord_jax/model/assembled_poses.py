"""Where bodies and joints are in the assembled scene, and rows, velocities and masses of the bodies."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import TRIAD, NodeKind
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.handles import ground as ground_handle
from natcoord_jax.core.joint import Frame, Joint
from natcoord_jax.core.kinds import short
from natcoord_jax.core.markers import Attachment, Interpolated, Marker
from natcoord_jax.maths.rotations import frame_from_axis
from natcoord_jax.model.bodies import Bodies, joined
from natcoord_jax.model.graph import Edge
from natcoord_jax.model.rows import row_rates
from natcoord_jax.xla.tracing import at_top_level

SAME = 1e-9
"""Part of its distance up to which a point is in the place of another."""


class Poses:
    """Assembled poses of all bodies and the ground, in scene order."""

    def __init__(self, bodies: Bodies):
        self.names, self._bodies = bodies.names, bodies
        ground = as_array(np.zeros((1, 3))), as_array(np.eye(3)[None])
        given = bodies.every("position"), bodies.every("rotation")
        self.position, self.rotation = (joined(x, y) for x, y in zip(given, ground))

    def of(self, handle: Handle) -> int:
        """Number of a body; the number of bodies for the ground.

        Raises:
            ValueError: for a node that is clamped to one.
        """
        if handle.name in self._bodies.owners:
            owner = self._bodies.owners[handle.name]
            raise ValueError(
                f"node {handle.name!r} is clamped to {owner.name!r}; join that to others instead"
            )
        return len(self.names) if handle == ground_handle else self.names.index(handle.name)

    def carrier(self, handle: Handle) -> int:
        """Number of a body, or of that which a node is clamped to."""
        return self.of(self._bodies.owners.get(handle.name, handle))

    def held(self, handle: Handle) -> Float[Array, "4 4"] | None:
        """Rows of a clamped node as weights of those of the body that it is clamped to; None of others."""
        if handle.name not in self._bodies.owners:
            return None
        body = self.carrier(handle)
        return _attachment_weights(self.position[body], self.rotation[body], *self._bodies.pose(handle.name))

    def weights(self, marker: Marker | Attachment) -> Float[Array, "*m w"]:
        """Weights of a marker: (4,) of a point or a direction, (4, 4) of an attachment.

        Of a marker between nodes there are four for each of them.
        """
        if isinstance(marker, Interpolated):
            row = np.eye(4)[0 if marker.is_point else 1]
            own = as_array(np.kron(np.asarray(marker.vector), row))
        elif isinstance(marker, Attachment):
            point, axes = as_array(marker.point, float), as_array(marker.axes, float)
            own = _attachment_weights(*self._pose(marker), point, axes)
        else:
            own = _marker_weights(*self._pose(marker), as_array(marker.vector, float), marker.is_point)
        self._check(marker, own)
        handles = marker.handles if isinstance(marker, Marker) else (marker.body,)
        held = [self.held(handle) for handle in handles]
        if all(rows is None for rows in held):
            return own
        parts = zip(np.split(np.asarray(own), len(held), axis=-1), held)
        return as_array(
            np.concatenate([x if rows is None else x @ np.asarray(rows) for x, rows in parts], -1)
        )

    def _check(self, marker: Marker | Attachment, own: Array) -> None:
        """Refuse what a node does not carry along: points have no directions, directors one.

        Raises:
            ValueError: naming the node, and what it carries.
        """
        kind = self._bodies.kind_of(marker.body)
        beyond = np.asarray(own).reshape(-1, 4)[:, kind.rows :] if at_top_level(own) else np.zeros((0, 0))
        if beyond.size and np.abs(beyond).max() > SAME * np.abs(np.asarray(own)).max():
            name = marker.body.name
            carried = ("itself", "itself and its director", "itself and two directors")[kind.rows - 1]
            raise ValueError(
                f"{short(marker)}: {name!r} is a {kind.name} and carries {carried} only; pass "
                f"nc.Point({name}) or join a rigid body to it"
            )

    def _pose(self, marker: Marker | Attachment) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Pose of the frame that the vectors of a marker are given relative to."""
        if not marker.local and marker.body.name in self._bodies.owners:
            return self._bodies.pose(marker.body.name)
        body = len(self.names) if marker.local else self.of(marker.body)
        return self.position[body], self.rotation[body]


def _weights(
    position: Float[Array, "3"], rotation: Float[Array, "3 3"], vector: Float[Array, "3"], is_point: bool
) -> Float[Array, "4"]:
    """Weights of the material point at a world position, or of the direction along a world vector."""
    local = rotation.T @ (vector - position if is_point else vector)
    return jnp.concatenate([jnp.full(1, 1.0 if is_point else 0.0), local])


def _pose_weights(position, rotation, point: Array, triad: Array) -> Float[Array, "4 4"]:
    """Weights of a point and of three directions, one a row."""
    directions = [_weights(position, rotation, axis, False) for axis in triad]
    return jnp.stack([_weights(position, rotation, point, True), *directions])


_marker_weights = eager_numpy(_weights)


@eager_numpy
def _attachment_weights(position, rotation, point: Array, axes: Float[Array, "3 3"]) -> Float[Array, "4 4"]:
    return _pose_weights(position, rotation, point, axes.T)


@eager_numpy
def _joint_weights(joint: Joint, positions, rotations, points, triad) -> Float[Array, "2 4 4"]:
    turned, shift = joint.zeroed(triad)
    given = zip(positions, rotations, (points[0] + shift, points[1]), (turned, triad))
    return jnp.stack([_pose_weights(*pose) for pose in given])


_triad = eager_numpy(frame_from_axis)


def joint_triad(joint: Joint) -> Float[Array, "3 3"]:
    """The triad of the joint in the assembled pose, one vector a row."""
    axis, second = (None if x is None else as_array(x, float) for x in (joint.axis, joint.second))
    return _triad(axis, second)


def joint_frames(joint: Joint, poses: Poses) -> Float[Array, "2 4 4"]:
    """Weights of point and triad on parent and child (44-47)."""
    parent, child = poses.of(joint.parent), poses.of(joint.child)
    triad = joint_triad(joint)
    at_parent, at_child = joint.anchors()
    at_parent = poses.position[parent if joint.apart else child] if at_parent is None else at_parent
    at_child = poses.position[child] if at_child is None else at_child
    positions, rotations = zip(*((poses.position[b], poses.rotation[b]) for b in (parent, child)))
    points = as_array(at_parent, float), as_array(at_child, float)
    return _joint_weights(joint, positions, rotations, points, triad)


def check_joint(
    name: str, joint: Joint, kinds: Sequence[NodeKind], place: Float[Array, "2 4 4"], frames: Sequence[Frame]
) -> None:
    """Refuse joints of points and directors that need more than these carry along.

    Args:
        name: of the joint.
        joint: joint.
        kinds: of the nodes of parent and child.
        place: weights of point and triad on both (44-47).
        frames: of both, in the assembled pose.

    Raises:
        ValueError: naming joint and node.
    """
    for side, (handle, kind) in enumerate(zip((joint.parent, joint.child), kinds)):
        if kind is TRIAD:
            continue
        node = f"joint {name!r}: {handle.name!r} has a {kind.name} only, no axes that"
        remedy = "clamp it to a rigid body (nc.Clamp) and join that"
        uses = _uses_axes(joint, frames, side)
        if is_concrete(uses) and bool(uses):
            raise ValueError(f"{node} a {type(joint).__name__} joint could hold; {remedy}")
        # The first row has the point's weights, of the node's own point and of its directors.
        weights = np.asarray(place)[side, 0] if is_concrete(place) else np.zeros(4)
        beside = float(np.linalg.norm(weights[kind.rows :]))
        if beside > SAME * np.linalg.norm(weights):
            raise ValueError(
                f"{node} could carry the point of the joint, which is {beside:.6g} m beside it; give the "
                f"joint the position of the node, or {remedy}"
            )


@eager_numpy
def _uses_axes(joint: Joint, frames: Sequence[Frame], side: int) -> Any:
    """Whether the axes on a side enter the constraints: axes that are no numbers make these none."""
    unknown = Frame(frames[side].point, jnp.full((3, 3), jnp.nan))
    parent, child = (unknown if k == side else frame for k, frame in enumerate(frames))
    return jnp.any(jnp.isnan(joint.residual(parent, child)))


def _stacked(points: Float[Array, "n 3"], rotations: Float[Array, "n 3 3"]) -> Float[Array, "n 4 3"]:
    return jnp.concatenate([points[:, None], rotations.swapaxes(1, 2)], axis=1)


rows_of_poses = eager_numpy(_stacked)


@eager_numpy
def rows_and_velocities(
    points: Array, rotations: Array, velocities: Array, spins: Array
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
    """Of bodies at some places that move."""
    rows = _stacked(points, rotations)
    rates = row_rates(rows, velocities, spins)
    return rows.reshape(-1, 3), rates.reshape(-1, 3)


@eager_numpy
def with_masses(blocks: Array, body: Array, rows: Float[Array, "n 4 4"], own: Float[Array, "n 4 4"]) -> Array:
    """Mass blocks with those of what is clamped to a body, whose rows are weights of its."""
    return blocks.at[body].add(jnp.einsum("nai,nab,nbj->ij", rows, own, rows))


@eager_numpy
def padded(weights: Float[Array, "*m w"], width: int) -> Float[Array, "*m width"]:
    """Weights with zeros behind them."""
    return jnp.concatenate([weights, jnp.zeros((*weights.shape[:-1], width - weights.shape[-1]))], axis=-1)


def edge_of(name: str, joint: Joint, poses: Poses, sets: int) -> Edge:
    """The edge of a joint.

    Raises:
        ValueError: for a joint that is to be free in a tree, which cannot hold it.
    """
    pair = poses.of(joint.parent), poses.of(joint.child)
    # Nodes of sets are free: what joins them keeps its multipliers.
    free = joint.free and min(pair) >= sets
    edge = Edge(*pair, joint.rotations, joint.translations, joint.child_rotation, free)
    if joint.free and not (edge.carries and len(edge.slots) == 6 - joint.multipliers):
        also = " and about the child's first axis" if joint.child_rotation else ""
        raise ValueError(
            f"joint {name!r}: a tree cannot hold a joint of {joint.multipliers} multipliers that turns "
            f"about axes {joint.rotations}{also} and slides along axes {joint.translations}; declare "
            f"`free = False` in {type(joint).__name__}, which keeps its multipliers"
        )
    return edge


def coupled_pairs(effects: dict[str, Effect], poses: Poses, sets: int) -> list[tuple[int, int]]:
    """Pairs of neighbouring bodies of the effects that make neighbours of them, but for nodes of sets."""
    found = []
    for effect in effects.values():
        if effect.couples:
            markers: Any = getattr(effect, "markers", ())
            listed = [poses.carrier(handle) for m in markers for handle in getattr(m, "handles", (m.body,))]
            found += [pair for pair in pairwise(listed) if min(pair) >= sets]
    return found
