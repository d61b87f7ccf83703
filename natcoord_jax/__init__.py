"""natcoord_jax: differentiable simulation of flexible multibody systems in natural coordinates."""

from typing import TYPE_CHECKING, Any

from natcoord_jax.analysis import Accuracy, Balance, accuracy, balance
from natcoord_jax.assembly.posing import random_state
from natcoord_jax.assembly.system import System
from natcoord_jax.bodies import Box, Cylinder, Ellipsoid, PointMass, RigidBody, Sphere
from natcoord_jax.control import (
    Check,
    Feedback,
    Guess,
    OptimalControl,
    Outcome,
    Parameter,
    Solution,
    bounds,
    check,
    cost,
    descend,
    goal,
    inputs,
    inverse_dynamics,
    load_guess,
    multi_start,
    optimise,
    optimise_jit,
    optimum,
    receding_horizon,
    regulator,
)
from natcoord_jax.core.force import Field, Force, Load
from natcoord_jax.core.handles import ground
from natcoord_jax.core.joint import Frame, Joint
from natcoord_jax.core.markers import Direction, Point
from natcoord_jax.core.potential import Potential
from natcoord_jax.core.results import Result, SimulationError
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.effects.actuators import BodyForceInput, BodyTorqueInput, JointForce, JointTorque
from natcoord_jax.effects.joints import (
    Coupling,
    Cylindrical,
    Distance,
    Drive,
    Fixed,
    Planar,
    Prismatic,
    Revolute,
    Screw,
    Spherical,
    Universal,
)
from natcoord_jax.effects.loads import BodyTorque, Gravity, PairTorque, PointForce
from natcoord_jax.effects.springs import (
    Armature,
    Damper,
    JointDamper,
    JointPotential,
    JointSpring,
    JointStops,
    NonlinearSpring,
    QuadraticSpring,
    Spring,
)
from natcoord_jax.scene import Scene
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.stepping.dissipative import Dissipative
from natcoord_jax.stepping.one_step import linearise, step
from natcoord_jax.stepping.scheme import EnergyMomentum
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.stepping.variational import VariationalMidpoint

if TYPE_CHECKING:
    from natcoord_jax.viz import animate, plot

__all__ = [
    "Accuracy",
    "Armature",
    "Balance",
    "BodyForceInput",
    "BodyTorque",
    "BodyTorqueInput",
    "Box",
    "Check",
    "Coupling",
    "Cylinder",
    "Cylindrical",
    "Damper",
    "Direction",
    "Dissipative",
    "Distance",
    "Drive",
    "Ellipsoid",
    "Feedback",
    "EnergyMomentum",
    "Field",
    "Fixed",
    "Force",
    "Frame",
    "Gravity",
    "Guess",
    "Joint",
    "JointDamper",
    "JointForce",
    "JointPotential",
    "JointSpring",
    "JointStops",
    "JointTorque",
    "Load",
    "NonlinearSpring",
    "OptimalControl",
    "Outcome",
    "PairTorque",
    "Parameter",
    "Planar",
    "Point",
    "PointForce",
    "PointMass",
    "Potential",
    "Prismatic",
    "QuadraticSpring",
    "Result",
    "Revolute",
    "RigidBody",
    "Scene",
    "Screw",
    "SimulationError",
    "Solution",
    "Sphere",
    "Spherical",
    "Spring",
    "State",
    "System",
    "Trajectory",
    "Universal",
    "VariationalMidpoint",
    "accuracy",
    "animate",
    "assemble",
    "balance",
    "bounds",
    "check",
    "cost",
    "descend",
    "goal",
    "ground",
    "inputs",
    "inverse_dynamics",
    "linearise",
    "load_guess",
    "multi_start",
    "optimise",
    "optimise_jit",
    "optimum",
    "plot",
    "random_state",
    "receding_horizon",
    "regulator",
    "simulate",
    "step",
]


def __getattr__(name: str) -> Any:
    """Pictures are loaded when first asked for, and matplotlib with them."""
    if name in ("animate", "plot"):
        from natcoord_jax import viz

        return getattr(viz, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
