"""Markers: material points and directions x = sum_a w_a q_a with constant weights.

The rows q_a of a body are its reference point and its three directors, so a point has weights
(1, theta^1, theta^2, theta^3) (7) and a direction (0, c^1, c^2, c^3) (46). One effect class therefore
joins whatever has rows: rigid bodies, the ground, nodes of beams. An attachment is a point with a triad.
"""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.core.arguments import Part, checked, is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, FLAG, Anything, Kind, described, is_other, of, short
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Directions, Rotations, array_of, values_of


class Marker(eqx.Module):
    """A point or a direction of a body, given in the assembled pose.

    Attributes:
        body: handle of the body.
        vector: shape (3,), position [m] or direction [-].
        is_point: point or direction.
        local: components in the body's reference frame instead of the world's.
    """

    body: Handle = eqx.field(static=True)
    vector: Any
    is_point: bool = eqx.field(static=True)
    local: bool = eqx.field(static=True, default=False)

    @property
    def handles(self) -> tuple[Handle, ...]:
        """Bodies that it moves with."""
        return (self.body,)


class Interpolated(Marker):
    """A point, or a director, that is a sum of those of several nodes with constant weights.

    Attributes:
        bodies: handles of the nodes; `body` is the first of them, and `vector` their weights.
    """

    bodies: tuple[Handle, ...] = eqx.field(static=True, default=())

    @property
    def handles(self) -> tuple[Handle, ...]:
        """All of them."""
        return self.bodies


@described.register
def _(value: Marker) -> str:
    if len(value.handles) > 1:
        return f"a {'point' if value.is_point else 'direction'} between {len(value.handles)} nodes"
    return f"a {'point' if value.is_point else 'direction'} of {short(value.body)}"


NODES = BODY | of("some nodes of a set, as nodes[[3, 4]]", NodeSet)


def _numbers(what: str, kind: Kind, value: Any) -> Any:
    """A value, if it is one of a kind."""
    complaint = kind.complaint(value)
    if complaint is not None:
        raise ValueError(f"{what} {complaint}; pass {kind.wanted}")
    return kind.masked(value)


def _between(nodes: NodeSet, weights: Any, is_point: bool) -> Marker:
    """A marker between nodes."""
    given = values_of(array_of(weights))
    if given is None or given.shape != (len(nodes),) or not np.isfinite(given).all():
        kind = "Point" if is_point else "Direction"
        raise ValueError(f"{kind}: weights [-] {is_other(weights)}; pass {len(nodes)} numbers for {nodes!r}")
    if is_point and abs(given.sum() - 1.0) > 1e-9:
        raise ValueError(f"Point: weights [-] add up to {given.sum():g}; those of a point add up to 1")
    handles = tuple(nodes)
    return Interpolated(handles[0], given.astype(float), is_point, False, handles)


@checked(body=NODES, position=Anything(), local=FLAG)
def Point(body: Handle | NodeSet, position: Any = None, *, local: bool = False) -> Marker:
    """Material point of a body, or between nodes.

    Args:
        body: handle returned by `Scene.add`, or `ground`; or some nodes of a set.
        position: shape (3,) [m], in world coordinates of the assembled pose; default the body's reference
            point. Of nodes their weights [-], which add up to 1.
        local: take `position` in the body's reference frame instead, from its reference point.

    Raises:
        ValueError: for something else than a body and numbers, or weights that are no mean.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.Point(nc.ground, (0, 0, 1)).is_point
        True
    """
    if isinstance(body, NodeSet):
        return _between(body, position, True)
    if position is None:
        return Marker(body, (0.0, 0.0, 0.0), True, True)
    return Marker(body, _numbers("Point: position [m]", COMPONENTS, position), True, local)


@checked(body=NODES, vector=Anything(), local=FLAG)
def Direction(body: Handle | NodeSet, vector: Any, *, local: bool = False) -> Marker:
    """Direction fixed in a body, or a mean of the directors of nodes.

    Args:
        body: handle returned by `Scene.add`, or `ground`; or some nodes of a set that have directors.
        vector: shape (3,) [-], in world coordinates of the assembled pose. Its length is kept for effects of
            one's own; the library's, and all gaps, take only where it points. Of nodes their weights [-].
        local: take `vector` in the body's reference frame instead.

    Raises:
        ValueError: for something else than a body and a direction.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.Direction(nc.ground, (0, 0, 1)).is_point
        False
    """
    if isinstance(body, NodeSet):
        return _between(body, vector, False)
    return Marker(body, _numbers("Direction: vector [-]", Directions(), vector), False, local)


class Attachment(Part):
    """A point with a triad, both fixed in a body, given in the assembled pose: four vectors in one marker.

    Attributes:
        body: handle of the body.
        point: shape (3,) [m].
        axes: shape (3, 3) [-], the triad as columns: a rotation matrix.
        local: both in the body's reference frame instead of the world's.

    Example:
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> clamp = nc.Attachment(nc.ground, (0, 0, 1), np.eye(3))
    """

    body: Handle = eqx.field(static=True, metadata=is_a(BODY))
    point: Any = eqx.field(metadata=is_a(COMPONENTS))
    axes: Any = eqx.field(metadata=is_a(Rotations()))
    local: bool = eqx.field(static=True, default=False, kw_only=True, metadata=is_a(FLAG))


@dataclasses.dataclass(frozen=True)
class Markers(Kind):
    """Points and directions in a tuple.

    Attributes:
        points: number of points; None: any markers at all.
        directions: number of directions after them.
        more: whether others may follow.
        attachments: number of attachments, instead of points and directions; None: none; zero: any number.
    """

    points: int | None = None
    directions: int = 0
    more: bool = False
    attachments: int | None = None

    @property
    def wanted(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """How many of what."""
        if self.attachments is not None:
            return f"{self.attachments or 'several'} nc.Attachment, in a tuple"
        if self.points is None:
            return "nc.Point and nc.Direction, or nc.Attachment, in a tuple"
        parts = ((self.points, "Point"), (self.directions, "Direction"))
        return " and ".join(f"{count} nc.{name}" for count, name in parts if count) + ", in a tuple"

    def complaint(self, value: Any) -> str | None:
        """Whether they are these."""
        if not isinstance(value, tuple | list):
            return is_other(value)
        described = f"is ({', '.join(short(x) for x in value)})"
        found = [m.is_point if isinstance(m, Marker) else None for m in value]
        attached = [isinstance(m, Attachment) for m in value]
        if self.attachments is not None:
            enough = len(value) == self.attachments or (self.attachments == 0 and value)
            return None if all(attached) and enough else described
        if self.points is None:
            return None if all(attached) or None not in found else described
        wanted = [True] * self.points + [False] * self.directions
        fits = found[: len(wanted)] == wanted if self.more else found == wanted
        return None if fits and None not in found else described
