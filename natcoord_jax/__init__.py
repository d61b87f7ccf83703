"""natcoord_jax: differentiable simulation of flexible multibody systems in natural coordinates."""

import gc
from typing import TYPE_CHECKING, Any

# What is imported stays: to look through all of it for garbage meanwhile takes a quarter of the time.
_collecting = gc.isenabled()
gc.disable()

from natcoord_jax import bodies, effects, mesh, storage
from natcoord_jax.bodies import *
from natcoord_jax.core.bodies import NodeKind
from natcoord_jax.core.constraint import Constraint, VelocityConstraint
from natcoord_jax.core.force import Field, Force, Load
from natcoord_jax.core.handles import ground
from natcoord_jax.core.jit import jit, keep_programs, native_threads, set_effort
from natcoord_jax.core.joint import Frame, Joint
from natcoord_jax.core.markers import Attachment, Direction, Point
from natcoord_jax.core.mixed_potential import MixedPotential
from natcoord_jax.core.nodes import Clamp
from natcoord_jax.core.potential import Potential
from natcoord_jax.core.results import DerivativeError, Result, SimulationError
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.effects import *
from natcoord_jax.reading.set_coordinates import random_state
from natcoord_jax.reading.transfer import transfer
from natcoord_jax.scene import Scene
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.stepping.one_step import linearise, step
from natcoord_jax.stepping.room import Steps
from natcoord_jax.stepping.scheme import Dissipative, EnergyMomentum, VariationalMidpoint
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.storage import *
from natcoord_jax.system import System

if TYPE_CHECKING:
    __version__: str
    from natcoord_jax import io, testing
    from natcoord_jax.analysis import *
    from natcoord_jax.control import *
    from natcoord_jax.sweeps import *
    from natcoord_jax.viz import animate, plot, view

if _collecting:
    if not gc.get_freeze_count():  # What was made is old at once: else the first look goes through all.
        gc.freeze()
        gc.unfreeze()
    gc.enable()

__all__ = [
    "Accuracy",
    "Attachment",
    "Balance",
    "Check",
    "Clamp",
    "ComputedTorque",
    "Constraint",
    "Contacts",
    "Continuation",
    "DerivativeError",
    "Direction",
    "Dissipative",
    "EnergyMomentum",
    "Equilibrium",
    "Feedback",
    "Field",
    "Force",
    "Frame",
    "Growth",
    "Guess",
    "Horizons",
    "Identified",
    "InitialCoordinate",
    "InitialRate",
    "InitialState",
    "Joint",
    "Load",
    "MixedPotential",
    "Modes",
    "NodeKind",
    "NonlinearProgram",
    "Optima",
    "OptimalControl",
    "Outcome",
    "Parameter",
    "Phases",
    "Point",
    "Potential",
    "Refinement",
    "Result",
    "Scene",
    "SimulationError",
    "Solution",
    "State",
    "Steps",
    "Sweep",
    "System",
    "Trajectory",
    "VariationalMidpoint",
    "VelocityConstraint",
    "accuracy",
    "animate",
    "assemble",
    "balance",
    "bounds",
    "check",
    "computed_torque",
    "contacts",
    "continuation",
    "cost",
    "descend",
    "equilibrium",
    "goal",
    "ground",
    "identify",
    "inputs",
    "inverse_dynamics",
    "io",
    "jit",
    "keep_programs",
    "linearise",
    "load_guess",
    "load_path",
    "mesh",
    "modes",
    "multi_start",
    "native_threads",
    "optimise",
    "optimise_jit",
    "optimum",
    "plot",
    "random_state",
    "receding_horizon",
    "refine",
    "regulator",
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
__all__ += bodies.__all__
__all__ += effects.__all__
__all__ += storage.__all__


def __getattr__(name: str) -> Any:
    """Analysis, control, sweeps, pictures and readers of files are loaded when first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        return version("natcoord_jax")
    from importlib import import_module

    if name in ("analysis", "control", "io", "sweeps", "testing"):
        return import_module(f"natcoord_jax.{name}")
    if name in ("animate", "plot", "view"):
        return getattr(import_module("natcoord_jax.viz"), name)
    if name in __all__:
        parts = (import_module(f"natcoord_jax.{part}") for part in ("analysis", "sweeps", "control"))
        return next(getattr(part, name) for part in parts if name in vars(part))
    from difflib import get_close_matches

    near = get_close_matches(name, __all__)
    meant = f"; did you mean {' or '.join(near)}?" if near else ""
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{meant}")
