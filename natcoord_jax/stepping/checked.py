"""What is given to a rollout, looked at before anything is compiled."""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import TRIAD
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import broadcast
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.numeric import Number, Numbers
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.violations import contacts
from natcoord_jax.stepping.scheme import Scheme
from natcoord_jax.system import System

STEP = Number("positive", instead=" (jax.vmap takes several)")
INPUTS = Numbers(("...", None)) | FunctionOf("(t, state) -> inputs", 2)
"""What arguments may be."""


def checked_step(dt: Any) -> Float[Array, ""]:
    """The step [s] as an array.

    Raises:
        ValueError: unless it is one positive number.
    """
    complaint = STEP.complaint(dt)
    if complaint is not None:
        raise ValueError(f"dt [s] {complaint}; pass {STEP.wanted}")
    return as_array(dt, float)


def checked_inputs(system: System, inputs: Any, steps: int | None, stages: int = 1) -> tuple[Any, int]:
    """Inputs as an array (steps, [stages,] inputs) or a callable, and the number of steps.

    Raises:
        ValueError: for a shape that does not fit.
    """
    names = system.structure.inputs
    if callable(inputs):
        if steps is None:
            raise ValueError("pass steps when inputs is a function of (t, state)")
        return inputs, int(steps)
    if inputs is None:
        if steps is None:
            raise ValueError("pass steps, or inputs of shape (steps, inputs)")
        return as_array(np.zeros((steps, len(names)))), int(steps)
    array = as_array(inputs, float)
    if array.shape == (len(names),) and steps is not None:
        array = broadcast(array, (steps, len(names)))
    counted = array.shape[0] if array.ndim else 0
    shapes = (len(names),), (stages, len(names))
    if array.shape[1:] not in shapes or counted != (steps or counted) or counted == 0:
        first = steps if steps is not None else "steps"
        wanted = f"({first}, {len(names)})" + f" or ({first}, {stages}, {len(names)})" * (stages > 1)
        raise ValueError(
            f"inputs has shape {array.shape}; this system has the input channels {list(names)}: pass shape "
            f"{wanted}, or a function (t, state) -> ({len(names)},)"
        )
    return array, int(array.shape[0])


def check_state(system: System, state: State) -> None:
    """Look whether a state belongs to a system.

    Raises:
        ValueError: if its shape or the precision of its numbers says that it does not.
    """
    expected = TRIAD.rows * len(system.structure.bodies)
    if state.q.shape != (expected, 3) or state.v.shape != (expected, 3):
        raise ValueError(
            f"state.q has shape {state.q.shape}, state.v {state.v.shape}; this system has shape "
            f"({expected}, 3); use the state that `compile` returned with the system, jax.vmap for several"
        )
    single = {str(x.dtype) for x in (system.mass, state.q, state.v) if x.dtype != jnp.float64}
    if single:
        raise ValueError(
            f"system or state has numbers of type {', '.join(sorted(single))}; natcoord_jax needs double "
            "precision: use the system and state that `compile` returned, and cast results instead"
        )


def check_contacts(system: System, tableau: Tableau) -> None:
    """Refuse schemes for which impacts are not defined, and to locate some where there are none.

    Raises:
        ValueError: with a contact, and what to do.
    """
    if tableau.max_events and not any(group.effect.bounces for group in contacts(system)):
        raise ValueError(
            "max_events of the scheme locates impacts, which contacts without a stiffness have; this system "
            "has no such contact; leave it out, or leave out the stiffness of a contact"
        )
    if tableau.stages == 1 and not tableau.variational and not tableau.dissipative:
        return
    for group in contacts(system):
        raise ValueError(
            f"{group.effect.kind} {group.labels[0]!r} is a constraint with impacts, for steps of one stage; "
            "pass scheme=nc.EnergyMomentum(), or give the contact a stiffness, which makes it a potential"
        )


DENSE_LIMIT = 1000
"""Unknowns of a step beyond which a dense solution is worth a warning."""


def warn_of_dense_steps(system: System, scheme: Scheme) -> None:
    """Warn of schemes that solve densely what steps of one stage solve by fronts or along the tree.

    Args:
        system: compiled system.
        scheme: that the run asks for.
    """
    structure, tableau = system.structure, scheme.tableau
    in_null_space = tableau.variational or tableau.dissipative
    sparse = ("sparse", "recursive") if in_null_space else ("sparse",)
    unknowns = tableau.stages * (structure.unknowns + structure.multipliers)
    if structure.solver in sparse and (in_null_space or tableau.stages > 1) and unknowns > DENSE_LIMIT:
        warnings.warn(
            f"{scheme!r} solves the {unknowns} unknowns of a step densely, in a time that grows with the "
            "third power of their number; steps of nc.EnergyMomentum() take hardly more than in proportion",
            stacklevel=4,
        )
