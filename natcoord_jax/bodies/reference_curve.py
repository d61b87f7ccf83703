"""Frames along the unstressed shape of a beam."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import as_array, is_concrete, numbers
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.maths.rotations import frame_from_axis
from natcoord_jax.maths.vectors import cross, dot, unit

Curve = Callable[[Float[Array, ""]], Float[Array, "3"]]


class ReferenceCurve(eqx.Module):
    """Nodes of a curve.

    Attributes:
        arc: arc length of the nodes [m].
        points: their positions [m].
        frames: rotation matrices, columns d_1, d_2, d_3 with d_3 along the tangent.
    """

    arc: Float[Array, " n"]
    points: Float[Array, "n 3"]
    frames: Float[Array, "n 3 3"]


@eager_numpy
def _along_polyline(points: Float[Array, "k 3"], fractions: Any) -> tuple[Array, Array, Array]:
    """Arc lengths, positions and tangents; at a corner the tangent is the mean of both sides."""
    chords = points[1:] - points[:-1]
    lengths = jnp.sqrt(jnp.sum(chords**2, axis=1))
    corners = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
    arc = jnp.asarray(fractions) * corners[-1]
    place = jnp.stack([jnp.interp(arc, corners, points[:, k]) for k in range(3)], axis=1)
    directions = chords / lengths[:, None]
    tiny = 1e-9 * corners[-1]

    def side(shift: Any) -> Array:
        where = jnp.searchsorted(corners, arc + shift) - 1
        return directions[jnp.clip(where, 0, len(directions) - 1)]

    return arc, place, side(-tiny) + side(tiny)


def reference_curve(
    curve: Any, fractions: np.ndarray, length: Any, second: Any, twist: Any, label: str
) -> ReferenceCurve:
    """Nodes at given fractions of the length.

    Args:
        curve: points (k, 3) [m] that a polyline joins, or a function of arc length [m] to position.
        fractions: of the nodes, increasing from 0 to 1.
        length: of the curve [m], for a function.
        second: where d_1 of the first node points, as far as it is perpendicular to the tangent.
        twist: total angle [rad], or function of arc length to the angle, by which the frames are turned
            about the tangent beyond those that do not turn about it.
        label: the part, for messages.

    Raises:
        ValueError: for a curve that is neither, points that coincide, a missing length, or a curve that turns
            back on itself.
    """
    if callable(curve):
        if length is None:
            raise ValueError(f"{label}: a curve given as a function needs its length [m]; pass length=")
        total = numbers(length, (), f"{label}: length", "m")
        arc, points, tangents = _along_function(curve, fractions, total)
    else:
        given = np.shape(curve)
        if len(given) != 2 or given[0] < 2 or given[1] != 3:
            raise ValueError(
                f"{label}: curve [m] has shape {given}; pass at least two points (k, 3) or a function"
            )
        corners = numbers(curve, given, f"{label}: curve", "m")
        if is_concrete(corners) and np.any(np.all(np.diff(np.asarray(corners), axis=0) == 0, axis=1)):
            raise ValueError(
                f"{label}: curve [m] has neighbouring points that coincide; leave one of them out"
            )
        if length is not None:
            raise ValueError(f"{label}: the length [m] of a polyline is its own; leave length= out")
        arc, points, tangents = _along_polyline(corners, fractions)
    second = None if second is None else as_array(second, float)
    twist = twist if callable(twist) else as_array(twist, float)
    frames = _frames(arc, tangents, fractions, second, twist)
    if is_concrete(frames) and not np.all(np.isfinite(np.asarray(frames))):
        raise ValueError(
            f"{label}: curve [m] turns back on itself at a node or between two, or has no tangent there; "
            "pass stations= or more elements, so that neighbours turn by less than half a turn, or smooth it"
        )
    return ReferenceCurve(arc, points, frames)


@eager_numpy
def _along_function(curve: Any, fractions: Any, total: Array) -> tuple[Array, Array, Array]:
    """Arc lengths, positions and tangents."""
    arc = jnp.asarray(fractions) * total
    return arc, jax.vmap(curve)(arc), jax.vmap(jax.jacfwd(curve))(arc)


@eager_numpy
def _frames(arc: Array, tangents: Array, fractions: Any, second: Any, twist: Any) -> Array:
    tangents = unit(tangents)
    turning: Any = twist
    angles = jax.vmap(turning)(arc) if callable(twist) else twist * jnp.asarray(fractions)
    return _turned(_transported(tangents, second), angles)


def _transported(tangents: Float[Array, "n 3"], second: Any) -> Float[Array, "n 3 3"]:
    """Frames (rows d_1, d_2, d_3) that do not turn about the tangent, from one node to the next."""
    first = frame_from_axis(tangents[0], second)[0]

    def carry(across: Array, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        before, after = pair
        # The shortest turn of one tangent into the next, applied to d_1.
        normal = cross(before, after)
        turned = (
            across + cross(normal, across) + cross(normal, cross(normal, across)) / (1 + dot(before, after))
        )
        turned = unit(turned - dot(turned, after) * after)
        return turned, turned

    rest = jax.lax.scan(carry, first, (tangents[:-1], tangents[1:]))[1]
    across = jnp.concatenate([first[None], rest])
    return jnp.stack([across, cross(tangents, across), tangents], axis=1)


def _turned(frames: Float[Array, "n 3 3"], angles: Float[Array, " n"]) -> Float[Array, "n 3 3"]:
    """Frames turned about their third axis, as rotation matrices (directors are columns)."""
    c, s = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    first, second = frames[:, 0], frames[:, 1]
    return jnp.stack([c * first + s * second, c * second - s * first, frames[:, 2]], axis=2)


def node_fractions(elements: int, stations: Sequence[float], label: str) -> np.ndarray:
    """Equal pieces between the ends and the stations, in all at least `elements`.

    Raises:
        ValueError: for a station that is not between the ends.
    """
    inner = np.asarray(stations, float)
    if np.any(inner < 0) or np.any(inner > 1):
        raise ValueError(
            f"{label}: stations [-] are {stations!r}; pass fractions of the length between 0 and 1"
        )
    ends = np.unique(np.concatenate([[0.0, 1.0], inner]))
    pieces = [
        np.linspace(a, b, max(1, round((b - a) * elements)), endpoint=False) for a, b in zip(ends, ends[1:])
    ]
    return np.concatenate([*pieces, [1.0]])
