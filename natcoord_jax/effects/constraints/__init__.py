"""Constraints between points and directions, and between their velocities."""

from natcoord_jax.effects.constraints.points import (
    PointOnLine as PointOnLine,
)
from natcoord_jax.effects.constraints.points import (
    PointOnPlane as PointOnPlane,
)
from natcoord_jax.effects.constraints.points import (
    PointOnPoint as PointOnPoint,
)
from natcoord_jax.effects.constraints.points import (
    Rod as Rod,
)
from natcoord_jax.effects.constraints.rolling import (
    Rolling as Rolling,
)
from natcoord_jax.effects.constraints.ties import PointSum as PointSum
