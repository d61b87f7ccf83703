"""Gravity, forces and torques given by the user."""

from natcoord_jax.effects.loads.gravity import Gravity as Gravity
from natcoord_jax.effects.loads.point_loads import (
    BodyTorque as BodyTorque,
    PairTorque as PairTorque,
    PointForce as PointForce,
)
