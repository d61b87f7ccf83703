"""Whether what effects of one's own say is quadratic is: steps keep nothing else exactly."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.callables import own_methods
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground

THIRD = 1e-9
"""Third differences, relative to what they are of, that are no rounding."""
SMALL = 1e-6
"""What a number is small in relative to the others: its rounding is then a tenth of that."""
LANES = 16
"""Instances of a group that are looked at, each along a direction of its own."""
BINOMIALS = (-1.0, 3.0, -3.0, 1.0)


def own_class(effect: Effect) -> type | None:
    """The class of an effect, or of a module in it, if it has methods that are not the library's."""
    parts = jax.tree.leaves(effect, is_leaf=lambda x: isinstance(x, eqx.Module) and x is not effect)
    return next((type(x) for x in (effect, *parts) if own_methods(type(x))), None)


def check_degrees(system: Model, state: State) -> None:
    """Refuse effects of one's own of a higher degree; those of a scene that is traced are not looked at.

    Raises:
        ValueError: naming the effect, its method, by how much, and what to do.
    """
    if not is_concrete(system, state):
        return
    for group in (*system.effects, *system.joints):
        own = own_class(group.effect)
        if own is not None and type(group.effect).quadratic is not Effect.quadratic:
            excess, number = third_differences(system, group, state)
            if excess > THIRD:
                raise ValueError(_complaint(group, number, excess, own))


def third_differences(system: Model, group: Group, state: State, seed: int = 0) -> tuple[float, int]:
    """The largest of some instances, relative to what they are of, and the number of the instance."""
    lanes = np.unique(np.linspace(0, group.count - 1, LANES).astype(int))
    lanes = np.resize(lanes, max(lanes.size, 2))
    bodies, rows = np.asarray(group.bodies)[lanes], np.asarray(rows_with_ground(state.q))
    reach = np.max(np.abs(rows[:, 0] - rows[-1, 0]), initial=0.0)
    steps = np.random.default_rng(seed).normal(size=(*bodies.shape, *NODE))
    steps[..., 0, :] *= reach if reach > 0 else 1.0
    # (The ground does not move: what it carries are numbers.)
    steps[bodies == rows.shape[0] - 1] = 0.0
    # (As a group, so that numbers in methods get as many lanes.)
    some = jax.tree.map(lambda x: x[lanes], replace_fields(group, acting=None))
    some = replace_fields(some, count=len(lanes), names=())
    values = np.asarray(_four(some, group_places(system, group)[lanes], rows[bodies], steps))
    thirds, size = (
        np.abs(np.tensordot(values, BINOMIALS, ([1], [0]))),
        np.max(np.abs(values), axis=1, initial=0.0),
    )
    # (One that vanishes is rounded as the others are.)
    size = np.maximum(size, SMALL * np.max(size, axis=1, keepdims=True, initial=0.0))
    excess = np.where(np.isnan(thirds), np.inf, thirds / np.where(size > 0, size, 1.0))
    worst = np.max(excess, axis=1, where=np.isfinite(values[:, 0]), initial=0.0)
    return float(np.max(worst)), int(lanes[np.argmax(worst)])


@eager_numpy
def _four(group: Group, places: Array, rows: np.ndarray, steps: np.ndarray) -> Float[Array, "n 4 p"]:
    """What has to be quadratic, at four places in a row."""

    def values(effect: Any, place: Any, rows: Any, step: Any) -> Array:
        return jnp.stack([effect.quadratic(place, rows + k * step) for k in range(4)])

    return jax.vmap(values)(group.effect, places, rows, steps)


def _complaint(group: Group, number: int, excess: float, own: type) -> str:
    residual = not (group.effect.stores or group.effect.unilateral)
    name = group.names[number] if number < len(group.names) else group.labels[0]
    method = f"{own.__name__}.{'residual' if residual else 'invariants'}"
    rest = "use a stiff nc.Potential for the rest" if residual else "leave the rest to the energy"
    return (
        f"{group.effect.kind} {name!r}: {method} is not at most quadratic in points and directions (third "
        f"differences are {min(excess, 1e9):.1g} of it), and no step would keep it; make lengths squares, "
        f"and angles products of directions, and {rest}"
    )
