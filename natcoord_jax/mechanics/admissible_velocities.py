"""Velocities that obey the constraints, nearest to others in the metric of the mass."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.equations_of_motion import rotors_of
from natcoord_jax.mechanics.projection import (
    SLACK,
    Projection,
    constraints,
    coordinate_matrix,
    fills,
    gap_rates,
    mobility,
    moving,
    twists_of,
)
from natcoord_jax.mechanics.tangent_space import rotor_inertias
from natcoord_jax.mechanics.violations import (
    GAP,
    constrained,
    coordinate_sizes,
    largest,
    rate_size,
    relative,
    violation_rates_of,
)
from natcoord_jax.model.model import Model

DAMPING = 1e-11
"""See `Projection`; what it leaves is projected again. Far above rounding, whose inverse would have no digits
where rows depend on each other, and far below `SLACK`, the share of what moves no mass."""

PASSES = 5
"""Projections with one inverse."""

ENOUGH = 1e3 * GAP
"""Rates of constraints, relative, up to which velocities obey them: near singular positions no projection
leaves less."""


def with_admissible_velocities(
    system: Model, state: State, rates: Array | None = None
) -> tuple[State, Array]:
    """State whose velocities, projected in the metric of the mass, obey the constraints; a result code.

    Args:
        system: compiled system.
        state: its positions obey the constraints.
        rates: of all joint coordinates, kept where `state.held` says so and had by rotors; None: those of the
            state.
    """
    twists = twists_of(system, state)
    rates = state_rates(system, state) if rates is None else rates
    found = moving(state, _admissible_twists(system, state, twists, None, rates))
    groups, sizes = constrained(system), coordinate_sizes(system)

    def missed(state: State) -> Array:
        return largest(relative(system, groups, violation_rates_of(system, groups, state)))

    # What was there before tells the size of velocities that nothing is left of.
    allowed = ENOUGH * (rate_size(system, state) + missed(state) + rate_size(system, found))
    if state.held is not None:
        holding = moving(state, _admissible_twists(system, state, twists, state.held[1], rates))
        allowed = allowed + ENOUGH * _most(rates / sizes)
        lost = state.held[1] * (state_rates(system, holding) - rates) / sizes
        held = (missed(holding) <= allowed) & (_most(lost) <= allowed)
        found = jax.tree.map(lambda x, y: jnp.where(held, x, y), holding, found)
    code = jnp.where(missed(found) <= allowed, int(Result.SUCCESSFUL), int(Result.SINGULAR))
    return replace_fields(found, rates=rotor_rates(system, found)), code


def _most(x: Array) -> Array:
    return jnp.max(jnp.abs(x), initial=0.0)


def rotor_rates(system: Model, state: State) -> Array:
    """Rates of the joint coordinates that carry rotors."""
    if not state.rates.shape[0]:
        return state.rates
    every, rates = state_rates(system, state), state.rates
    for group in system.effects:
        if group.effect.rotors:
            rates = rates.at[group.rotors[:, 0]].set(every[group.coordinates[:, 0]])
    return rates


def _admissible_twists(
    system: Model,
    state: State,
    twists: Float[Array, "bodies 6"],
    held: Float[Array, " coordinates"] | None,
    rates: Float[Array, " coordinates"],
) -> Float[Array, "bodies 6"]:
    """Twists that obey the constraints, nearest to the given ones in the metric of the mass, rotors included.

    A rotor is one more body with the rate of its coordinate. What makes the inertias regular weighs changes
    from one pass to the next only, and is gone in the end.

    Args:
        system: compiled system.
        state: its positions obey the constraints.
        twists: of the bodies, before.
        held: 1 for coordinates that keep their rates; None: none do.
        rates: of all coordinates, before: those to keep, and those of rotors.
    """
    start, count = moving(state, twists), twists.size
    matrix, wanted = constraints(system, state, held), [gap_rates(system, start)]
    now = state_rates(system, start)
    wanted += [] if held is None else [held * (now - rates)]
    turning = [group.coordinates[:, 0] for group in rotors_of(system)]
    if turning:
        index, roots = jnp.concatenate(turning), jnp.sqrt(rotor_inertias(system))
        rotors = roots[:, None] * coordinate_matrix(system, state)[index]
        matrix = jnp.pad(matrix, ((0, 0), (0, len(roots))))
        matrix = jnp.concatenate([matrix, jnp.concatenate([rotors, -jnp.eye(len(roots))], axis=1)])
        wanted.append(roots * (now - rates)[index])
    fill = fills(system, SLACK)
    moved_by = mobility(system, state.rows, fill)

    def answer(impulses: Array) -> Array:
        return jnp.concatenate([moved_by(impulses[:count]), impulses[count:]])

    linear = Projection.scaled(matrix, answer(matrix.T))
    missing = jnp.concatenate(wanted) / linear.scale
    inverse = definite_inverse(linear.damped(DAMPING))
    slack = jnp.pad(fill.reshape(-1), (0, matrix.shape[1] - count))
    change, multipliers = jnp.zeros(matrix.shape[1], missing.dtype), jnp.zeros_like(missing)
    for _ in range(PASSES):
        kept = answer(slack * change)
        multipliers = multipliers - inverse @ (
            missing + linear.matrix @ (kept + linear.impulses @ multipliers)
        )
        change = kept + linear.impulses @ multipliers
    return twists + change[:count].reshape(twists.shape)
