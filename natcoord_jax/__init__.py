"""natcoord_jax: differentiable simulation of flexible multibody systems in natural coordinates."""

import gc
from typing import TYPE_CHECKING, Any

# What is imported stays: to look through all of it for garbage meanwhile takes a quarter of the time.
_collecting = gc.isenabled()
gc.disable()

from natcoord_jax import mesh
from natcoord_jax.analysis import (
    Accuracy,
    Balance,
    Contacts,
    Equilibrium,
    Growth,
    Modes,
    Phases,
    accuracy,
    balance,
    contacts,
    equilibrium,
    load_path,
    modes,
    tangent_growth,
)
from natcoord_jax.bodies import (
    Beam,
    BeamHandle,
    Box,
    Capsule,
    CircularSection,
    Contact,
    Cylinder,
    DirectorInterpolation,
    Edge,
    EdgeLoad,
    Ellipsoid,
    Fold,
    Gas,
    LineLoad,
    MeshHandle,
    Nodes,
    Plane,
    PointMass,
    Pressure,
    RectangularSection,
    RelativeMotion,
    RigidBody,
    Section,
    Shell,
    Solid,
    Sphere,
    Surface,
    Tie,
    TubularSection,
)
from natcoord_jax.core.bodies import NodeKind
from natcoord_jax.core.constraint import Constraint, VelocityConstraint
from natcoord_jax.core.force import Field, Force, Load
from natcoord_jax.core.handles import ground
from natcoord_jax.core.jit import jit, keep_programs, set_effort
from natcoord_jax.core.joint import Frame, Joint
from natcoord_jax.core.markers import Attachment, Direction, Point
from natcoord_jax.core.mixed_potential import MixedPotential
from natcoord_jax.core.nodes import Clamp
from natcoord_jax.core.potential import Potential
from natcoord_jax.core.results import DerivativeError, Result, SimulationError
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.effects.actuators import (
    AffineActuator,
    BodyForceInput,
    BodyTorqueInput,
    JointForce,
    JointTorque,
    SphericalTorque,
    WrenchInput,
)
from natcoord_jax.effects.beams import (
    BeamDamping,
    BeamElement,
    DirectorDamping,
    DirectorElement,
    NonlinearBeamElement,
)
from natcoord_jax.effects.constraints import PointOnLine, PointOnPlane, PointOnPoint, PointSum, Rod, Rolling
from natcoord_jax.effects.contact import (
    CapsuleContacts,
    CapsuleOnCapsule,
    CornersOnBox,
    DiscOnPlane,
    DiscreteGap,
    EdgesOnEdges,
    EllipsoidOnPlane,
    FrictionalGapPotential,
    FrictionalNodeOnFacets,
    Gap,
    GapConstraint,
    GapPotential,
    MortarGap,
    NodeOnFacets,
    SphereOnBox,
    SphereOnPlane,
    SphereOnSphere,
)
from natcoord_jax.effects.fibres import TransverselyIsotropic
from natcoord_jax.effects.hyperelastic import Hyperelastic
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
from natcoord_jax.effects.laminates import Laminate, Orthotropic
from natcoord_jax.effects.loads import (
    BodyTorque,
    EdgeSegment,
    EnclosedGas,
    FacePressure,
    FacePressure6,
    FacePressure8,
    FacePressure9,
    Gravity,
    PairTorque,
    PointForce,
)
from natcoord_jax.effects.materials import Elastic
from natcoord_jax.effects.rubber import CompressibleMooneyRivlin, MooneyRivlin, NeoHooke, Ogden
from natcoord_jax.effects.shells import MembraneElement, MembraneTriangle, ShellElement, ShellTriangle
from natcoord_jax.effects.solids import (
    Brick,
    Hexahedron8,
    Hexahedron20,
    Hexahedron27,
    Hexahedron27P1,
    Tetrahedron10,
    Tetrahedron10P0,
)
from natcoord_jax.effects.springs import (
    Armature,
    Damper,
    JointDamper,
    JointFriction,
    JointPotential,
    JointSpring,
    JointStops,
    NonlinearSpring,
    QuadraticSpring,
    SphericalDamper,
    SphericalSpring,
    Spring,
)
from natcoord_jax.reading.set_coordinates import random_state
from natcoord_jax.reading.transfer import transfer
from natcoord_jax.scene import Scene
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.stepping.dissipative import Dissipative
from natcoord_jax.stepping.one_step import linearise, step
from natcoord_jax.stepping.room import Steps
from natcoord_jax.stepping.scheme import EnergyMomentum
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.stepping.variational import VariationalMidpoint
from natcoord_jax.storage import load, save
from natcoord_jax.sweeps import Sweep, sweep
from natcoord_jax.system import System

if TYPE_CHECKING:
    __version__: str
    from natcoord_jax import io, testing
    from natcoord_jax.control import (
        Check,
        ComputedTorque,
        Continuation,
        Feedback,
        Guess,
        NonlinearProgram,
        Optima,
        OptimalControl,
        Outcome,
        Parameter,
        Solution,
        bounds,
        check,
        computed_torque,
        continuation,
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
        to_nlp,
    )
    from natcoord_jax.viz import animate, plot, view

if _collecting:
    gc.enable()

__all__ = [
    "Accuracy",
    "AffineActuator",
    "Armature",
    "Attachment",
    "Balance",
    "Beam",
    "BeamDamping",
    "BeamElement",
    "BeamHandle",
    "BodyForceInput",
    "BodyTorque",
    "BodyTorqueInput",
    "Box",
    "Check",
    "Brick",
    "Tetrahedron10P0",
    "Tetrahedron10",
    "Hexahedron27P1",
    "Hexahedron27",
    "Hexahedron20",
    "Hexahedron8",
    "Hyperelastic",
    "TransverselyIsotropic",
    "Ogden",
    "NeoHooke",
    "MooneyRivlin",
    "CompressibleMooneyRivlin",
    "Capsule",
    "CapsuleOnCapsule",
    "CircularSection",
    "Clamp",
    "ComputedTorque",
    "Constraint",
    "Contact",
    "Contacts",
    "Continuation",
    "CornersOnBox",
    "Coupling",
    "Cylinder",
    "Cylindrical",
    "Damper",
    "DerivativeError",
    "Direction",
    "DirectorDamping",
    "DirectorElement",
    "DirectorInterpolation",
    "DiscOnPlane",
    "DiscreteGap",
    "Dissipative",
    "Distance",
    "Drive",
    "Edge",
    "EdgeLoad",
    "EdgeSegment",
    "EdgesOnEdges",
    "Elastic",
    "Ellipsoid",
    "EllipsoidOnPlane",
    "EnclosedGas",
    "EnergyMomentum",
    "Equilibrium",
    "FacePressure",
    "FacePressure6",
    "FacePressure8",
    "FacePressure9",
    "Feedback",
    "Field",
    "Fixed",
    "Fold",
    "Force",
    "Frame",
    "FrictionalGapPotential",
    "FrictionalNodeOnFacets",
    "Gap",
    "GapConstraint",
    "GapPotential",
    "Gas",
    "Gravity",
    "Growth",
    "Guess",
    "Joint",
    "JointDamper",
    "JointForce",
    "JointFriction",
    "JointPotential",
    "JointSpring",
    "JointStops",
    "JointTorque",
    "Laminate",
    "LineLoad",
    "Load",
    "MembraneElement",
    "MembraneTriangle",
    "MeshHandle",
    "MixedPotential",
    "Modes",
    "NodeKind",
    "Nodes",
    "MortarGap",
    "NodeOnFacets",
    "NonlinearBeamElement",
    "NonlinearProgram",
    "NonlinearSpring",
    "Optima",
    "OptimalControl",
    "Orthotropic",
    "Outcome",
    "PairTorque",
    "Parameter",
    "Phases",
    "Planar",
    "Plane",
    "Point",
    "PointForce",
    "PointMass",
    "PointOnLine",
    "PointOnPlane",
    "PointOnPoint",
    "PointSum",
    "Potential",
    "Pressure",
    "Prismatic",
    "QuadraticSpring",
    "RectangularSection",
    "RelativeMotion",
    "Result",
    "Revolute",
    "RigidBody",
    "Rod",
    "Rolling",
    "Scene",
    "Screw",
    "Section",
    "Shell",
    "SimulationError",
    "ShellElement",
    "ShellTriangle",
    "Solid",
    "Solution",
    "Sphere",
    "SphereOnBox",
    "SphereOnPlane",
    "SphereOnSphere",
    "CapsuleContacts",
    "Spherical",
    "SphericalDamper",
    "SphericalSpring",
    "SphericalTorque",
    "Spring",
    "State",
    "Steps",
    "Surface",
    "Sweep",
    "System",
    "Tie",
    "Trajectory",
    "TubularSection",
    "Universal",
    "VariationalMidpoint",
    "VelocityConstraint",
    "WrenchInput",
    "accuracy",
    "animate",
    "assemble",
    "balance",
    "contacts",
    "bounds",
    "check",
    "computed_torque",
    "continuation",
    "cost",
    "descend",
    "equilibrium",
    "goal",
    "ground",
    "inputs",
    "inverse_dynamics",
    "io",
    "jit",
    "keep_programs",
    "linearise",
    "load",
    "load_guess",
    "load_path",
    "mesh",
    "modes",
    "multi_start",
    "optimise",
    "optimise_jit",
    "optimum",
    "plot",
    "random_state",
    "receding_horizon",
    "regulator",
    "save",
    "set_effort",
    "simulate",
    "step",
    "sweep",
    "tangent_growth",
    "testing",
    "to_nlp",
    "transfer",
    "view",
]


def __getattr__(name: str) -> Any:
    """Control, pictures and readers of files are loaded when first asked for; the version is looked up."""
    if name == "__version__":
        from importlib.metadata import version

        return version("natcoord_jax")
    from importlib import import_module

    if name in ("control", "io", "testing"):
        return import_module(f"natcoord_jax.{name}")
    if name in ("animate", "plot", "view"):
        return getattr(import_module("natcoord_jax.viz"), name)
    if name in __all__:
        return getattr(import_module("natcoord_jax.control"), name)
    from difflib import get_close_matches

    near = get_close_matches(name, __all__)
    meant = f"; did you mean {' or '.join(near)}?" if near else ""
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{meant}")
