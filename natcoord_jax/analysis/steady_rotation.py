"""Whether the equilibrium of a rotation is steady: one still when everything has turned on by a radian."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.analysis.static_equations import BALANCE, Static
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.names import listed
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import safe_divide, safe_norm
from natcoord_jax.mechanics import violations
from natcoord_jax.mechanics.admissible_velocities import ENOUGH
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.model.groups import Group


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


def turns_along(static: Static) -> Bool[Array, ""]:
    """Whether constraints let everything turn, as drives ask for it."""
    after = static.turned().state
    missed = violations.largest(_openings(static, after))
    return missed <= ENOUGH * violations.position_size(static.system, after)


def complaint(static: Static) -> str:
    """Why a rotation is not steady: the part that does not turn along, and the remedy."""
    on, groups = static.turned(), violations.constrained(static.system)
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
    pulls = np.asarray(static.pulls(static.wrenches(jnp.zeros(static.unknowns)))[0])
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
            sizes[f"{group.effect.kind} {listed(group.labels)}"] = change
    return max(sizes, key=lambda name: sizes[name], default="")
