"""Whether the equilibrium of a rotation is steady: one still when everything has turned on by a radian."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.analysis.static_equations import Static
from natcoord_jax.analysis.static_search import FLOOR, extent_of, largest
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import safe_divide, safe_norm
from natcoord_jax.mechanics import violations
from natcoord_jax.mechanics.admissible_velocities import ENOUGH
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.mechanics.projection import moved
from natcoord_jax.model.groups import Group

BALANCE = 1e-6
"""Largest unbalanced force, relative to the forces that balance each other, of what counts as steady."""


def _turned(static: Static) -> Static:
    """The same when everything has turned on by a radian."""
    state, axis, about = static.state, static.loading.axis, static.loading.about
    assert axis is not None
    arms = state.rows[:, 0] - about
    twists = jnp.concatenate(
        [arms @ from_rotation_vector(axis).T - arms, jnp.broadcast_to(axis, arms.shape)], 1
    )
    increments = state_rates(static.system, static.rotating(state, axis))
    return replace_fields(static, state=moved(static.system, state, twists, increments))


def _openings(static: Static, after: State) -> list[Float[Array, "n m"]]:
    """By how much a turn violates constraints, relative; drives follow it, or do not know of it."""
    system, groups = static.system, violations.constrained(static.system)
    speed = safe_norm(static.loading.rotation)
    later = replace_fields(after, t=after.t + safe_divide(1.0, speed))
    moving = static.rotating(static.state, static.loading.rotation)
    gaps = (violations.violations_of(system, groups, x) for x in (after, later))
    rates = (violations.violation_rates_of(system, groups, moving, passing) for passing in (0.0, 1.0))
    pairs = zip(zip(*gaps), zip(*rates))
    missed = [
        jnp.maximum(jnp.minimum(*map(jnp.abs, gap)), safe_divide(jnp.minimum(*map(jnp.abs, rate)), speed))
        for gap, rate in pairs
    ]
    return violations.relative(system, groups, missed)


def _pulls(static: Static, y: Array) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Torque about the axis [N m] and force along it [N] that nothing balances, and sums of their terms."""
    motions, idle = static.idle(y, jnp.inf)
    terms = jnp.stack(static.terms(y))
    return jnp.where(idle, motions @ jnp.sum(terms, 0), 0.0), jnp.abs(motions) @ jnp.sum(jnp.abs(terms), 0)


def steady_code(static: Static, lam: Array, code: Array) -> Array:
    """Result code of an equilibrium: whether the rotation is steady, if it is one."""
    if static.loading.rotation is None:
        return code
    y, on = jnp.concatenate([jnp.zeros(static.balances), lam]), _turned(static)
    turned = violations.largest(_openings(static, on.state))
    steady = turned <= ENOUGH * violations.position_size(static.system, on.state)
    for each in (static, on):
        pulls, sizes = _pulls(each, y)
        steady = steady & jnp.all(jnp.abs(pulls) <= BALANCE * sizes)
    # Constraints may carry forces that do not turn along; what these move is none.
    change = on.solver(y)[0].solve(jnp.zeros_like(y).at[: on.balances].set(on.forces(y)))
    extent = extent_of(static.system, static.state)
    shares = largest(static.system, change[: on.balances], extent)
    steady = steady & (jnp.maximum(*shares) <= FLOOR) | jnp.all(static.loading.rotation == 0)
    return jnp.where((code == int(Result.SUCCESSFUL)) & ~steady, int(Result.UNSTEADY), code)


def complaint(static: Static) -> str:
    """Why a rotation is not steady: the part that does not turn along, and the remedy."""
    on, groups = _turned(static), violations.constrained(static.system)
    missed = [np.asarray(x) for x in _openings(static, on.state)]
    worst = max(range(len(missed)), key=lambda k: np.max(missed[k]), default=None)
    if worst is not None and np.max(missed[worst]) > ENOUGH:
        group, number = groups[worst], int(np.argmax(np.max(missed[worst], axis=1)))
        return (
            f"{group.effect.kind} {group.names[number]!r} does not let everything turn about this axis at "
            "this rate; pass a point of the axis as about= [m], and give drives its rate"
        )
    part = _not_turning(static, on)
    if part:
        return f"{part} does not turn along; let it act along the axis, or on what turns"
    pulls = np.asarray(_pulls(static, jnp.zeros(static.unknowns))[0])
    said = f"a torque of {pulls[0]:.3g} N m about the axis and a force of {pulls[1]:.3g} N along it"
    return f"{said} are not balanced; give a drive (nc.Drive) the rate of the rotation, or motors inputs"


def _not_turning(static: Static, on: Static) -> str:
    """The effect whose forces turn along least, if any of them do not."""

    def acting(at: Static, group: Group) -> tuple[Array, Array]:
        system, moving = replace_fields(at.system, effects=(group,)), at.loading.turning
        return loads(system, at.state, at.loading.inputs, *moving(at.loading.rotation, at.state.rows))

    back, sizes = from_rotation_vector(static.loading.axis), {}
    for group in static.system.effects:
        pairs = list(zip(acting(static, group), acting(on, group)))
        change = sum(float(jnp.sum((now - then @ back) ** 2)) for now, then in pairs)
        size = sum(float(jnp.sum(now**2)) for now, _ in pairs)
        if change > BALANCE**2 * size:
            sizes[f"{group.effect.kind} {group.labels[0]!r}"] = change
    return max(sizes, key=lambda name: sizes[name], default="")
