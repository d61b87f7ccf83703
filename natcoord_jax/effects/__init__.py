"""The effects: one small file each. The core knows their kinds, not their names."""

from natcoord_jax.effects import (
    actuators,
    beams,
    constraints,
    contact,
    joints,
    loads,
    shells,
    solids,
    springs,
)
from natcoord_jax.effects.actuators import *
from natcoord_jax.effects.beams import *
from natcoord_jax.effects.constraints import *
from natcoord_jax.effects.contact import *
from natcoord_jax.effects.hyperelastic import Hyperelastic
from natcoord_jax.effects.joints import *
from natcoord_jax.effects.loads import *
from natcoord_jax.effects.materials import Elastic, Laminate, Orthotropic
from natcoord_jax.effects.rubber import (
    CompressibleMooneyRivlin,
    MooneyRivlin,
    NeoHooke,
    Ogden,
    TransverselyIsotropic,
)
from natcoord_jax.effects.shells import *
from natcoord_jax.effects.solids import *
from natcoord_jax.effects.springs import *

__all__ = [
    "CompressibleMooneyRivlin",
    "Elastic",
    "Hyperelastic",
    "Laminate",
    "MooneyRivlin",
    "NeoHooke",
    "Ogden",
    "Orthotropic",
    "TransverselyIsotropic",
]
__all__ += actuators.__all__
__all__ += beams.__all__
__all__ += constraints.__all__
__all__ += contact.__all__
__all__ += joints.__all__
__all__ += loads.__all__
__all__ += shells.__all__
__all__ += solids.__all__
__all__ += springs.__all__
