"""Gravity, forces and torques given by the user."""

from natcoord_jax.effects.loads.gas import EnclosedGas
from natcoord_jax.effects.loads.point_loads import BodyTorque, EdgeSegment, Gravity, PairTorque, PointForce
from natcoord_jax.effects.loads.pressure import FacePressure, FacePressure6, FacePressure8, FacePressure9

__all__ = [
    "BodyTorque",
    "EdgeSegment",
    "EnclosedGas",
    "FacePressure",
    "FacePressure6",
    "FacePressure8",
    "FacePressure9",
    "Gravity",
    "PairTorque",
    "PointForce",
]
