"""Actuators: input channels."""

from natcoord_jax.effects.actuators.motors import (
    BodyForceInput as BodyForceInput,
    BodyTorqueInput as BodyTorqueInput,
    JointForce as JointForce,
    JointTorque as JointTorque,
)
