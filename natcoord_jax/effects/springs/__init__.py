"""Springs, dampers and stops, between points and on joint coordinates."""

from natcoord_jax.effects.springs.joint_friction import (
    JointFriction as JointFriction,
)
from natcoord_jax.effects.springs.joint_friction import (
    SphericalDamper as SphericalDamper,
)
from natcoord_jax.effects.springs.joint_springs import (
    Armature as Armature,
)
from natcoord_jax.effects.springs.joint_springs import (
    JointDamper as JointDamper,
)
from natcoord_jax.effects.springs.joint_springs import (
    JointPotential as JointPotential,
)
from natcoord_jax.effects.springs.joint_springs import (
    JointSpring as JointSpring,
)
from natcoord_jax.effects.springs.joint_springs import (
    JointStops as JointStops,
)
from natcoord_jax.effects.springs.point_springs import (
    Damper as Damper,
)
from natcoord_jax.effects.springs.point_springs import (
    NonlinearSpring as NonlinearSpring,
)
from natcoord_jax.effects.springs.point_springs import (
    QuadraticSpring as QuadraticSpring,
)
from natcoord_jax.effects.springs.point_springs import (
    Spring as Spring,
)
from natcoord_jax.effects.springs.spherical_spring import (
    SphericalSpring as SphericalSpring,
)
