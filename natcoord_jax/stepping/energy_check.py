"""A second opinion on a step that Newton's iteration calls solved: the work of what is missing in it.

Corrections are small against the terms of the equations where these are huge: a stage next to a singular
position, of which there are some where steps are far too long, needs enormous forces of constraints, and
rounding of these would be taken for the end of the iteration. Energy tells. It changes in a step by the work
of the effects and by that of the residual, exactly: sum_i b_i w_i . r_i by the stages' rates w_i and balances
r_i (for the step of one stage the work over (57)), and by what multipliers do on rates of constraints that
are not zero. So no energy has to be known for it, and no store of energy asked.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.state import State
from natcoord_jax.mechanics.equations_of_motion import rotors_of
from natcoord_jax.mechanics.momentum import inertia, motion
from natcoord_jax.stepping.newton import RESTING, TOLERANCE
from natcoord_jax.system import System

UNSOUND = 1e-12
"""Work of the residual in terms of the energy of the motion, twice, beyond which a step is refused."""

ROUNDING = 1e-13
"""The same in terms of the forces and of the motion on which they work: a hundred times their rounding."""

PLACES = 1e-11
"""Displacement, relative to the places, that a step may miss whatever work that is: stiff parts feel how
their places are rounded."""

UNFELT = 1e-17
"""Correction, relative to the terms of the equations, that is none: their rounding alone is twenty times
as large. What rests at the origin has neither motion nor a place to compare its corrections with."""


def unbalanced_work(
    equations: Any, y: Float[Array, " unknowns"], residual: Float[Array, " unknowns"]
) -> Float[Array, ""]:
    """Energy that a step makes or loses because its equations are not solved [J], an upper bound of it.

    Args:
        equations: of the step.
        y: unknowns.
        residual: of the equations there.
    """
    by_stage = jnp.sum(equations.by_stage(y) * equations.by_stage(residual), axis=1)
    held = y[equations.balances :] * residual[equations.balances :]
    return jnp.abs(jnp.asarray(equations.tableau.b) @ by_stage) + jnp.sum(jnp.abs(held))


def motion_of(system: System, state: State) -> Float[Array, ""]:
    """Energy of the motion, twice, rotors included, within a small factor [J]."""
    moving = motion(system.mass, state.row_rates)
    for group in rotors_of(system):
        inertias = jax.vmap(lambda effect: effect.inertia_of())(group.effect)
        moving = moving + jnp.sum(inertias * state.rates[group.rotors] ** 2)
    return moving


def sound(
    equations: Any,
    y: Float[Array, " unknowns"],
    residual: Float[Array, " unknowns"],
    size: Float[Array, ""],
    correction: Float[Array, ""],
    after: State,
    tolerance: float,
    grain: Float[Array, ""] | float = 0.0,
) -> Bool[Array, ""]:
    """Whether a step keeps the balance of energy, as far as rounding of forces and of places lets it.

    Args:
        equations: of the step.
        y: its solution.
        residual: of the equations there.
        size: of their terms [sqrt(J)].
        correction: that would follow (energy norm) [sqrt(J)].
        after: state at the end.
        tolerance: of Newton's iteration; a larger one than the default lets energy drift in proportion.
        grain: size of the terms that cancel in the equations [sqrt(J)].
    """
    before, system = equations.state, equations.system
    moving = jnp.maximum(motion_of(system, before), motion_of(system, after))
    # Forces that are large, but at rest, are rounded, too.
    rounding = ROUNDING * size
    allowed = UNSOUND * moving + rounding * (jnp.sqrt(moving) + rounding)
    if tolerance > TOLERANCE:
        allowed = tolerance / TOLERANCE * allowed
    rows = before.rows
    places = jnp.sum(rows * inertia(system, rows))
    near = (equations.h * correction) ** 2 <= PLACES**2 * places
    near = near | (correction <= RESTING * grain + UNFELT * size)
    return near | (unbalanced_work(equations, y, residual) <= allowed)
