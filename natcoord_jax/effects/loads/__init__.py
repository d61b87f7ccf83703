"""Gravity, forces and torques given by the user."""

from natcoord_jax.effects.loads.curved_pressure import FacePressure6 as FacePressure6
from natcoord_jax.effects.loads.curved_pressure import FacePressure8 as FacePressure8
from natcoord_jax.effects.loads.curved_pressure import FacePressure9 as FacePressure9
from natcoord_jax.effects.loads.edges import EdgeSegment as EdgeSegment
from natcoord_jax.effects.loads.gas import EnclosedGas as EnclosedGas
from natcoord_jax.effects.loads.gravity import Gravity as Gravity
from natcoord_jax.effects.loads.point_loads import (
    BodyTorque as BodyTorque,
)
from natcoord_jax.effects.loads.point_loads import (
    PairTorque as PairTorque,
)
from natcoord_jax.effects.loads.point_loads import (
    PointForce as PointForce,
)
from natcoord_jax.effects.loads.pressure import FacePressure as FacePressure
