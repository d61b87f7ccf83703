"""Actuators: input channels."""

from natcoord_jax.effects.actuators.motors import (
    AffineActuator,
    BodyForceInput,
    BodyTorqueInput,
    JointForce,
    JointTorque,
    SphericalTorque,
    WrenchInput,
)

__all__ = [
    "AffineActuator",
    "BodyForceInput",
    "BodyTorqueInput",
    "JointForce",
    "JointTorque",
    "SphericalTorque",
    "WrenchInput",
]
