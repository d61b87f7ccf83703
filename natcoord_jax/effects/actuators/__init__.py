"""Actuators: input channels."""

from natcoord_jax.effects.actuators.affine import AffineActuator, SphericalTorque, WrenchInput
from natcoord_jax.effects.actuators.motors import BodyForceInput, BodyTorqueInput, JointForce, JointTorque

__all__ = [
    "AffineActuator",
    "BodyForceInput",
    "BodyTorqueInput",
    "JointForce",
    "JointTorque",
    "SphericalTorque",
    "WrenchInput",
]
