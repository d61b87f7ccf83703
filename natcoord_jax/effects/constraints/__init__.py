"""Constraints between points and directions, and between their velocities."""

from natcoord_jax.effects.constraints.points import (
    PointOnLine,
    PointOnPlane,
    PointOnPoint,
    PointSum,
    Rod,
    Rolling,
)

__all__ = [
    "PointOnLine",
    "PointOnPlane",
    "PointOnPoint",
    "PointSum",
    "Rod",
    "Rolling",
]
