"""natcoord_jax: differentiable simulation of flexible multibody systems in natural coordinates."""

from natcoord_jax.bodies import (
    Box as Box, Cylinder as Cylinder, Ellipsoid as Ellipsoid, PointMass as PointMass, RigidBody as RigidBody,
    Sphere as Sphere,
)
from natcoord_jax.core.force import Field as Field, Force as Force, Load as Load
from natcoord_jax.core.handles import ground as ground
from natcoord_jax.core.joint import Joint as Joint
from natcoord_jax.core.markers import Direction as Direction, Point as Point
from natcoord_jax.core.potential import Potential as Potential
from natcoord_jax.effects.actuators import *
from natcoord_jax.effects.joints import *
from natcoord_jax.effects.loads import *
from natcoord_jax.effects.springs import *
from natcoord_jax.scene import Scene as Scene
from natcoord_jax.stepping.assemble import assemble as assemble
from natcoord_jax.stepping.simulate import linearise as linearise, simulate as simulate, step as step
