"""Markers: material points and directions x = sum_a w_a q_a with constant weights.

The rows q_a of a body are its reference point and its three directors, so a point has weights
(1, theta^1, theta^2, theta^3) (7) and a direction (0, c^1, c^2, c^3) (46). One effect class therefore
joins whatever has rows: rigid bodies, the ground, nodes of beams. An attachment is a point with a triad.
"""

import dataclasses
from typing import Any

import equinox as eqx

from natcoord_jax.core.arguments import Part, checked, is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, FLAG, Kind, described, is_other, short
from natcoord_jax.core.numeric import COMPONENTS, Directions, Numbers


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


@described.register
def _(value: Marker) -> str:
    return f"a {'point' if value.is_point else 'direction'} of {short(value.body)}"


@checked(body=BODY, position=COMPONENTS, local=FLAG)
def Point(body: Handle, position: Any = None, *, local: bool = False) -> Marker:
    """Material point of a body.

    Args:
        body: handle returned by `Scene.add`, or `ground`.
        position: shape (3,) [m], in world coordinates of the assembled pose; default the body's reference
            point.
        local: take `position` in the body's reference frame instead, from its reference point.

    Raises:
        ValueError: for something else than a body and numbers.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.Point(nc.ground, (0, 0, 1)).is_point
        True
    """
    return (
        Marker(body, (0.0, 0.0, 0.0), True, True) if position is None else Marker(body, position, True, local)
    )


@checked(body=BODY, vector=Directions(), local=FLAG)
def Direction(body: Handle, vector: Any, *, local: bool = False) -> Marker:
    """Direction fixed in a body.

    Args:
        body: handle returned by `Scene.add`, or `ground`.
        vector: shape (3,) [-], in world coordinates of the assembled pose; its length is kept.
        local: take `vector` in the body's reference frame instead.

    Raises:
        ValueError: for something else than a body and a direction.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> nc.Direction(nc.ground, (0, 0, 1)).is_point
        False
    """
    return Marker(body, vector, False, local)


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
    axes: Any = eqx.field(metadata=is_a(Numbers((3, 3))))
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
