"""Whether the equilibrium of a rotation is steady: one still when everything has turned on by a radian."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from natcoord_jax.analysis.static_equations import BALANCE, Static
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.names import listed
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import safe_divide, safe_norm
from natcoord_jax.mechanics import violations
from natcoord_jax.mechanics.admissible_velocities import ENOUGH
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.model.groups import Group


def turns_along(static: Static) -> Bool[Array, ""]:
    """Whether constraints let everything turn on: drives follow it, or do not know of it."""
    system, groups = static.system, violations.constrained(static.system)
    after, speed = static.turned().state, safe_norm(static.loading.rotation)
    later = replace_fields(after, t=after.t + safe_divide(jnp.ones(()), speed))
    moving = static.rotating(static.state, static.loading.rotation)
    gaps = [violations.violations_of(system, groups, x) for x in (after, later)]
    rates = [violations.violation_rates_of(system, groups, moving, passing) for passing in (0.0, 1.0)]
    sizes = [jnp.minimum(jnp.abs(a), jnp.abs(b)) for a, b in (*zip(*gaps), *zip(*rates))]
    opened, opening = sizes[: len(groups)], [safe_divide(x, speed) for x in sizes[len(groups) :]]
    missed = [violations.largest(violations.relative(system, groups, x)) for x in (opened, opening)]
    return jnp.maximum(*missed) <= ENOUGH * violations.position_size(system, after)


def complaint(static: Static) -> str:
    """Why a rotation is not steady: the part that does not turn along, and the remedy."""
    moving, (pulls, slight), changes = _measures(static)
    worst = violations.worst_violation(static.system, moving, rates=True, allowed=ENOUGH)
    if worst is not None:
        said = f"{worst} does not let everything turn about this axis at this rate [rad/s]"
        missed = f"{worst.size:.3g} {worst.unit} is missing"
        return f"{said}: {missed}; pass a point of the axis as about= [m], and give drives its rate"
    part = int(np.argmax([*map(float, changes), BALANCE]))
    if part < len(changes):
        effect, names = static.system.effects[part].effect, listed(static.system.effects[part].labels)
        said = f"{effect.kind} {' or '.join(map(repr, names))} does not turn along"
        return f"{said}; let it act along the axis, or on what turns"
    if slight:
        return (
            "some of it turns by itself, and its angle is free: join it, or give each part a drive (nc.Drive)"
        )
    said = f"a torque of {pulls[0]:.3g} N m about the axis and a force of {pulls[1]:.3g} N along it"
    return f"{said} are not balanced; give a drive (nc.Drive) the rate of the rotation, or motors inputs"


@eager_numpy
def _measures(static: Static) -> tuple[State, tuple[Array, Array], list[Array]]:
    """Velocities of the rotation; what is not balanced; how far forces of each effect do not turn along."""

    def acting(at: Static, group: Group) -> Array:
        system, moving = replace_fields(at.system, effects=(group,)), at.loading.turning
        return jnp.stack(
            loads(system, at.state, at.loading.inputs, *moving(at.loading.rotation, at.state.rows))
        )

    on, back = static.turned(), from_rotation_vector(static.loading.axis)
    pairs = [(acting(static, group), acting(on, group) @ back) for group in static.system.effects]
    largest = [jnp.max(jnp.abs(jnp.stack([a, a - b])), axis=(1, 2, 3)) for a, b in pairs]
    changes = [safe_divide(change, sum((x[0] for x in largest), jnp.zeros(()))) for _, change in largest]
    pulls = static.pulls(static.wrenches(jnp.zeros(static.unknowns)))
    return static.rotating(static.state, static.loading.rotation), pulls, changes
