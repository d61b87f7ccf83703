"""Velocities that obey the constraints, nearest to others in the metric of the mass."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.linsolve.tree import TreeBlocks, factor, handed_up, passed_down
from natcoord_jax.maths.elimination import definite_inverse, definite_solution
from natcoord_jax.maths.vectors import cross, skew
from natcoord_jax.mechanics.coordinates import coordinate_rates, state_rates
from natcoord_jax.mechanics.equations_of_motion import (
    EquationsOfMotion,
    loops_of,
    relations_of,
    rotors_of,
    with_rest,
)
from natcoord_jax.mechanics.momentum import inertia, spatial_inertia, weighs_only, wrench
from natcoord_jax.mechanics.rates import joint_axes, tree_rates
from natcoord_jax.mechanics.redundancy import RANK
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity
from natcoord_jax.mechanics.violations import (
    GAP,
    constrained,
    coordinate_sizes,
    largest,
    rate_size,
    relative,
    spans,
    violation_rates_of,
)
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import row_rates, rows_with_ground
from natcoord_jax.model.tree import SLOTS, turns

SHIFT = 1e-12
"""Compliance that is added to constraints, relative, and refined away where they are independent. Where they
are not, or close to singular positions (below a millionth of the others), they are left as they are."""
ROUNDS = 4

NO_INERTIA = 1e-15
"""Inertia along a motion, in terms of the largest, that is rounding of none."""

ENOUGH = 1e3 * GAP
"""Rates of constraints, relative, up to which velocities obey them: near singular positions no projection
leaves less."""


def tangent(system: Model, state: State) -> State:
    """One state with velocities that the constraints admit, the nearest in the metric of the mass."""
    return nearest(system, state, state.rates)


def nearest(
    system: Model,
    state: State,
    rotors: Float[Array, " rotors"],
    holding: tuple[Float[Array, " coordinates"], Float[Array, " coordinates"]] | None = None,
) -> State:
    """The state with the nearest of the velocities that the constraints admit.

    Args:
        system: compiled system.
        state: its positions obey the constraints.
        rotors: rates of the rotors, before.
        holding: 1 for the coordinates that keep a rate, and their rates; None: none do.
    """
    if not system.structure.unknowns:
        return replace_fields(state, v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
    before = Velocity(state.row_rates, rotors)
    if holding is None and by_body(system):
        found = _along_the_tree(system, state, before)
    else:
        found = _together(system, state, before, holding)
    return replace_fields(state, v=found.rows.reshape(state.v.shape), rates=found.rotors)


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
    rates = state_rates(system, state) if rates is None else rates
    rotors = jnp.concatenate([rates[:0], *(rates[g.coordinates[:, 0]] for g in rotors_of(system))])
    found = nearest(system, state, rotors)
    groups, sizes = constrained(system), coordinate_sizes(system)

    def missed(state: State) -> Array:
        return largest(relative(system, groups, violation_rates_of(system, groups, state)))

    # What was there before tells the size of velocities that nothing is left of.
    allowed = ENOUGH * (rate_size(system, state) + missed(state) + rate_size(system, found))
    if state.held is not None:
        holding = nearest(system, state, rotors, (state.held[1], rates))
        allowed = allowed + ENOUGH * _most(rates / sizes)
        lost = state.held[1] * (state_rates(system, holding) - rates) / sizes
        held = (missed(holding) <= allowed) & (_most(lost) <= allowed)
        found = jax.tree.map(lambda x, y: jnp.where(held, x, y), holding, found)
    return found, jnp.where(missed(found) <= allowed, int(Result.SUCCESSFUL), int(Result.SINGULAR))


def _most(x: Array) -> Array:
    return jnp.max(jnp.abs(x), initial=0.0)


def by_body(system: Model) -> bool:
    """Whether rates are found from body to body: in trees so large that steps are solved so, too.

    In small ones, and where more than the joints of the tree couples velocities, they are all found together.
    """
    coupled = relations_of(system) or loops_of(system) or rotors_of(system)
    return system.structure.solver == "recursive" and not coupled


def _along_the_tree(system: Model, state: State, v: Velocity) -> Velocity:
    """By elimination from body to body, at a cost in proportion to their number."""
    tree, rows = system.tree, state.rows
    blocks, present = _spatial(system, rows)
    across, own = blocks.spread[:, :, :6], blocks.spread[:, :, 6:]
    places, parent = tree.slot_index[:, np.array(tree.slots, int)], blocks.parent
    w = jnp.where(present, tree_rates(system, state).at[places].get(mode="fill", fill_value=0.0), 0.0)

    def moving(w: Float[Array, "bodies m"]) -> Float[Array, "bodies 4 3"]:
        twists = passed_down(across, jnp.sum(own * w[:, None], axis=2), parent)[:-1]
        return row_rates(rows, twists[:, :3], twists[:, 3:])

    lost = inertia(system, v.rows - moving(w))
    loads = jnp.concatenate([x[0] for x in wrench(lost[None], rows[None, :, 1:])], axis=1)
    upward = jnp.swapaxes(across, 1, 2)
    loads = loads + handed_up(upward, jnp.sum(upward * loads[:, None], axis=2), parent)
    change = factor(blocks)[0].solve(jnp.sum(own * loads[:, :, None], axis=1))
    return Velocity(moving(w + change), v.rotors)


def _spatial(
    system: Model, rows: Float[Array, "bodies 4 3"]
) -> tuple[TreeBlocks, Bool[np.ndarray, "bodies m"]]:
    """Inertia of the free motions by body, from twists of the bodies, and which of the slots a body has."""
    tree, slots = system.tree, np.array(system.tree.slots, int)
    axes, points = joint_axes(system, rows)
    present = tree.slot_index[:, slots] < tree.slot_of.shape[0]
    axis, turning = jnp.where(present[..., None], axes[:, slots], 0.0), turns(slots)
    velocity = jnp.where(turning[:, None], cross(axis, (rows[:, 0] - points)[:, None]), axis)
    own = jnp.concatenate([velocity, jnp.where(turning[:, None], axis, 0.0)], axis=2)
    count, unit = rows.shape[0], jnp.eye(3, dtype=rows.dtype)
    arm = rows[:, 0] - rows_with_ground(rows.reshape(-1, 3))[tree.parent, 0]
    across = jnp.broadcast_to(jnp.eye(6, dtype=rows.dtype), (count, 6, 6)).at[:, :3, 3:].set(-skew(arm))
    # A unit inertia for turns of point masses, which nothing else sees.
    idle = jnp.where(weighs_only(system.mass), 1.0, 0.0)
    masses = spatial_inertia(system.mass, rows[:, 1:], rows[:, 1:])
    masses = masses.at[:, 3:, 3:].add(idle[:, None, None] * unit)
    absent = jnp.where(present, 0.0, 1.0)[:, None] * jnp.eye(slots.size, dtype=rows.dtype)
    rest = jnp.zeros((count, 6 + slots.size, 6 + slots.size), rows.dtype).at[:, 6:, 6:].set(absent)
    spread = jnp.concatenate([across, jnp.swapaxes(own, 1, 2)], axis=2)
    gather = jnp.swapaxes(spread, 1, 2)
    return TreeBlocks(masses, spread, gather, rest, tree.parent, slots.size), present


def _together(system: Model, state: State, v: Velocity, holding: tuple[Array, Array] | None) -> Velocity:
    """A change of the rates of the tree, so that what is admissible stays as it is to the last digits."""
    balances = EquationsOfMotion.at(system, state)
    gains = balances.columns()
    space, matrix = TangentSpace.without_frame(balances, gains)
    w, rows = tree_rates(system, state), gains.constraints.T
    start = space.spread(w)
    impulse = space.pulled(space.impulse(Velocity(v.rows - start.rows, v.rotors - start.rotors)))
    if holding is None and not rows.shape[0]:
        return space.spread(w + definite_solution(matrix, impulse))
    gap = -balances.rates(w).constraints
    spanned = [x.reshape(-1) for x in spans(system, [*relations_of(system), *loops_of(system)])]
    if holding is not None:
        kept = holding[0][:, None] * _coordinate_columns(balances)
        rows, spanned = jnp.concatenate([rows, kept]), [*spanned, coordinate_sizes(system)]
        gap = jnp.concatenate([gap, holding[0] * holding[1] - kept @ w])
    size = jnp.where(turns(system.tree.slot_of % SLOTS), 1.0, system.size)
    span = jnp.concatenate(spanned)
    rows = rows * size / span[:, None]
    change = _constrained(matrix * size * size[:, None], rows, impulse * size, gap / span)
    return space.spread(w + size * change)


def _coordinate_columns(balances: EquationsOfMotion) -> Float[Array, "coordinates u"]:
    """Rates of all joint coordinates per unit rate of each free motion."""
    rows = rows_with_ground(balances.rows.reshape(-1, 3))

    def column(velocity: Array, spin: Array) -> Array:
        velocity, spin = with_rest(velocity), with_rest(spin)
        return coordinate_rates(balances.system, rows, row_rates(rows, velocity, spin), spin)

    return jax.vmap(column, in_axes=1, out_axes=1)(*balances.free)


def _constrained(
    matrix: Float[Array, "u u"],
    rows: Float[Array, "c u"],
    impulse: Float[Array, " u"],
    gap: Float[Array, " c"],
) -> Float[Array, " u"]:
    """Solution x of A x - C^T lambda = impulse, C x = gap, whether or not rows of C depend on each other.

    A is completed by C^T C, which changes no solution: bodies may lack inertia along what only loops forbid.
    All are in terms of the size of the scene, then of the inertias and of the rows.
    """
    inertias = jnp.diagonal(matrix)
    most = jnp.max(inertias)
    unit = jnp.sqrt(jnp.where(inertias > NO_INERTIA * most, inertias, most))
    # What repeats a joint of the tree is rounding, and stays small.
    some = jnp.linalg.norm(rows, axis=1) > RANK
    rows = rows / unit
    size = jnp.where(some, jnp.linalg.norm(rows, axis=1), 1.0 / jnp.min(unit))
    rows, gap, impulse = rows / size[:, None], gap / size, impulse / unit
    inverse = definite_inverse(matrix / unit / unit[:, None] + rows.T @ rows)
    spread = inverse @ rows.T
    shifted = definite_inverse(rows @ spread + SHIFT * jnp.eye(rows.shape[0], dtype=rows.dtype))
    x = inverse @ (impulse + rows.T @ gap)
    for _ in range(ROUNDS):
        x = x + spread @ (shifted @ (gap - rows @ x))
    return x / unit


def rotor_rates(system: Model, state: State) -> Array:
    """Rates of the joint coordinates that carry rotors."""
    if not state.rates.shape[0]:
        return state.rates
    every, rates = state_rates(system, state), state.rates
    for group in rotors_of(system):
        rates = rates.at[group.rotors[:, 0]].set(every[group.coordinates[:, 0]])
    return rates
