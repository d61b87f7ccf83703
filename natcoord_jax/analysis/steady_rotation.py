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
    y = jnp.zeros(static.unknowns)
    for each in (static, on):
        pulls, sizes = (np.asarray(x) for x in _pulls(each, y))
        for pull, size, said in zip(pulls, sizes, ("torque of {:.3g} N m about", "force of {:.3g} N along")):
            if abs(pull) > BALANCE * size:
                said = f"a {said.format(abs(pull))} the axis is not balanced{_not_turning(static, on)}"
                return f"{said}; give it a drive (nc.Drive) at the rate of the rotation, or inputs of a motor"
    return (
        f"what acts changes as everything turns{_not_turning(static, on)}; let it act along the axis, or turn"
    )


def _not_turning(static: Static, on: Static) -> str:
    """The effect whose forces do not turn along most."""

    def acting(at: Static, group: Group) -> tuple[Array, Array]:
        system = replace_fields(at.system, effects=(group,))
        return loads(
            system, at.state, at.loading.inputs, *at.loading.turning(at.loading.rotation, at.state.rows)
        )

    back, extent = from_rotation_vector(static.loading.axis), extent_of(static.system, static.state)
    sizes = {}
    for group in static.system.effects:
        pairs = zip(acting(static, group), acting(on, group), (extent, 1.0))
        change = [jnp.max(jnp.abs(now - then @ back)) * arm for now, then, arm in pairs]
        sizes[f" ({group.effect.kind} {group.labels[0]!r} does not turn along)"] = float(max(change))
    size = max(sizes.values(), default=0.0)
    return max(sizes, key=lambda x: sizes[x]) if size > 0 else ""
