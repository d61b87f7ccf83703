"""Markers: material points and directions x = sum_a w_a q_a with constant weights.

The rows q_a of a body are its reference point and its three directors, so a point has weights
(1, theta^1, theta^2, theta^3) (7) and a direction (0, c^1, c^2, c^3) (46). One effect class therefore
joins whatever has rows: rigid bodies, the ground, nodes of beams. An attachment is a point with a triad.
"""

from typing import Any

import equinox as eqx

from natcoord_jax.core.handles import Handle


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


def Point(body: Handle, position=(0.0, 0.0, 0.0), *, local: bool = False) -> Marker:
    """Material point of a body.

    Args:
        body: handle returned by `Scene.add`, or `ground`.
        position: shape (3,) [m], in world coordinates of the assembled pose.
        local: take `position` in the body's reference frame instead, from its reference point.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.Point(nc.ground, (0, 0, 1)).is_point
        True
    """
    return Marker(body, position, True, local)


def Direction(body: Handle, vector, *, local: bool = False) -> Marker:
    """Direction fixed in a body.

    Args:
        body: handle returned by `Scene.add`, or `ground`.
        vector: shape (3,) [-], in world coordinates of the assembled pose; its length is kept.
        local: take `vector` in the body's reference frame instead.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.Direction(nc.ground, (0, 0, 1)).is_point
        False
    """
    return Marker(body, vector, False, local)


class Attachment(eqx.Module):
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

    body: Handle = eqx.field(static=True)
    point: Any
    axes: Any
    local: bool = eqx.field(static=True, default=False)


def require_markers(kind: str, markers: Any, points: int, directions: int) -> None:
    """Markers are points, then directions.

    Args:
        kind: of the effect, for the message.
        markers: that were given.
        points: number of points.
        directions: number of directions after them.

    Raises:
        ValueError: for others, or another number.
    """
    found = [m.is_point if isinstance(m, Marker) else None for m in markers]
    if found != [True] * points + [False] * directions:
        wanted = " and ".join(
            f"{count} nc.{name}" for count, name in ((points, "Point"), (directions, "Direction")) if count
        )
        raise ValueError(f"{kind}: markers are {markers!r}; pass {wanted}, in a tuple")
