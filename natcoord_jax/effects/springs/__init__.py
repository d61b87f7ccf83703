"""Springs, dampers and stops, between points and on joint coordinates."""

from natcoord_jax.effects.springs.joint_springs import (
    Armature as Armature,
    JointDamper as JointDamper,
    JointPotential as JointPotential,
    JointSpring as JointSpring,
    JointStops as JointStops,
)
from natcoord_jax.effects.springs.point_springs import (
    Damper as Damper,
    NonlinearSpring as NonlinearSpring,
    QuadraticSpring as QuadraticSpring,
    Spring as Spring,
)
