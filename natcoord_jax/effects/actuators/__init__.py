"""Actuators: input channels."""

from natcoord_jax.effects.actuators.affine import (
    AffineActuator as AffineActuator,
)
from natcoord_jax.effects.actuators.affine import (
    SphericalTorque as SphericalTorque,
)
from natcoord_jax.effects.actuators.affine import (
    WrenchInput as WrenchInput,
)
from natcoord_jax.effects.actuators.motors import (
    BodyForceInput as BodyForceInput,
)
from natcoord_jax.effects.actuators.motors import (
    BodyTorqueInput as BodyTorqueInput,
)
from natcoord_jax.effects.actuators.motors import (
    JointForce as JointForce,
)
from natcoord_jax.effects.actuators.motors import (
    JointTorque as JointTorque,
)
