"""Whether effects of one's own are what steps keep exactly: quadratic, and blind to rigid motions of all."""

import warnings
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.callables import Stacked, own_methods
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.state import State
from natcoord_jax.maths.vectors import cross
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


class Some(Stacked):
    """Some instances of an effect, as many as numbers in its methods get lanes."""

    effect: Effect
    count: int = eqx.field(static=True)

    stacked: ClassVar[str] = "effect"

    @property
    def lanes(self) -> tuple[int, ...]:
        """One for each."""
        return (self.count,)


def own_class(effect: Effect) -> type | None:
    """The class of an effect, or of a module in it, if it has methods that are not the library's."""
    parts = jax.tree.leaves(effect, is_leaf=lambda x: isinstance(x, eqx.Module) and x is not effect)
    return next((type(x) for x in (effect, *parts) if own_methods(type(x))), None)


def _own(system: Model, state: State) -> Iterator[tuple[Group, type]]:
    """Groups of one's own, and their classes; none of a scene that is traced."""
    if is_concrete(system, state):
        for group in (*system.effects, *system.joints):
            own = own_class(group.effect)
            if own is not None and type(group.effect).quadratic is not Effect.quadratic:
                yield group, own


def check_degrees(system: Model, state: State) -> None:
    """Refuse effects of one's own of a higher degree.

    Raises:
        ValueError: naming the effect, its method, by how much, and what to do.
    """
    for group, own in _own(system, state):
        excess, number = third_differences(system, group, state)
        if excess > THIRD:
            residual = not (group.effect.stores or group.effect.unilateral)
            method = f"{own.__name__}.{'residual' if residual else 'invariants'}"
            remedy = "use a stiff nc.Potential for the rest" if residual else "leave the rest to the energy"
            raise ValueError(
                f"{group.effect.kind} {_name(group, number)!r}: {method} is not at most quadratic in points "
                f"and directions (third differences are {min(excess, 1e9):.1g} of it), and no step would "
                f"keep it; make lengths squares, and angles products of directions, and {remedy}"
            )


def warn_of_resultants(system: Model, state: State) -> None:
    """Warn of effects of one's own that push or turn from within, as they are assembled.

    Warns:
        UserWarning: naming the effect, and what to do.
    """
    for group, _ in _own(system, state):
        changes, lanes = rigid_changes(system, group, state)
        for k in np.flatnonzero(~np.all(changes <= THIRD, axis=1))[:1]:
            moves = f"{_name(group, int(lanes[k]))!r} {'pushes' if changes[k, 0] > THIRD else 'turns'}"
            warnings.warn(
                f"{group.effect.kind} {moves} all bodies that it acts between, as nothing within a system "
                "does: let it depend on relative positions alone, or give what acts from outside a marker of "
                "nc.ground",
                stacklevel=4,
            )


def _some(
    system: Model, group: Group, state: State, seed: int = 0, among: np.ndarray | None = None
) -> tuple[tuple[Some, Array, np.ndarray, np.ndarray], np.ndarray]:
    """Some instances of a group, their places, rows, and random steps of these; and their numbers."""
    among = np.arange(group.count) if among is None else among
    lanes = among[np.unique(np.linspace(0, len(among) - 1, LANES).astype(int))]
    lanes = np.resize(lanes, max(lanes.size, 2))
    bodies, rows = np.asarray(group.bodies)[lanes], np.asarray(rows_with_ground(state.q))
    reach = np.max(np.abs(rows[:, 0] - rows[-1, 0]), initial=0.0)
    steps = np.random.default_rng(seed).normal(size=(*bodies.shape, *NODE))
    steps[..., 0, :] *= reach if reach > 0 else 1.0
    # (The ground does not move: what it carries are numbers.)
    steps[bodies == rows.shape[0] - 1] = 0.0
    some = Some(jax.tree.map(lambda x: x[lanes], group.effect), len(lanes))
    return (some, group_places(system, group)[lanes], rows[bodies], steps), lanes


def inside(system: Model, group: Group) -> np.ndarray:
    """Numbers of the instances that act between bodies and hold them or store energy, without the ground."""
    ends = np.asarray(group.bodies)
    between = np.all(ends < len(system.structure.bodies), axis=1) & (ends.min(axis=1) < ends.max(axis=1))
    return np.flatnonzero(between & bool(group.effect.stores or group.effect.multipliers))


def rigid_changes(system: Model, group: Group, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Changes (n, 2) of energies or residuals when all that some instances act between is pushed, and turned.

    Relative to the terms that they are sums of; of residuals as far as they are obeyed. And the numbers of
    the instances, of which there are none where none acts within a system.
    """
    among = inside(system, group)
    if not among.size or group.source not in ("markers", "joint"):
        return np.zeros((0, 2)), among[:0]
    given, lanes = _some(system, group, state, among=among)
    work, size, left = (np.asarray(x) for x in _rigid(*given))
    size = np.maximum(size, SMALL * np.max(size, axis=(1, 2), keepdims=True, initial=0.0))
    work, left = (x / np.where(size > 0, size, 1.0) for x in (work, left[..., None]))
    changes = work[..., :3], np.maximum(work[..., 3:] - left, 0.0)
    return np.stack([np.max(x, axis=(1, 2)) for x in changes], axis=1), lanes


def _name(group: Group, number: int) -> str:
    return group.names[number] if number < len(group.names) else group.labels[0]


@eager_numpy
def _rigid(some: Some, places: Array, rows: np.ndarray, steps: np.ndarray) -> tuple[Array, Array, Array]:
    """Changes (n, m, 6) of energies, away from where they may vanish, or of residuals, along rigid motions.

    And (n, m, 1) of the terms of these, and (n, m) what residuals are.
    """
    stores = some.effect.stores

    def lane(effect: Any, place: Any, rows: Any, step: Any) -> tuple[Array, Array, Array]:
        rows = rows + 0.1 * stores * step

        def value(rows: Array) -> Array:
            nothing = jnp.zeros(0)
            if stores:
                return effect.stored(place, rows, nothing, nothing)[None]
            return effect.quadratic(place, rows)

        pushes = jnp.zeros((3, *rows.shape)).at[:, :, 0].set(jnp.eye(3)[:, None])
        motions = jnp.concatenate([pushes, cross(jnp.eye(3)[:, None, None], rows)])
        slopes = jax.jacrev(value)(rows)
        parts = slopes[:, None] * motions
        left = jnp.zeros(1) if stores else jnp.linalg.norm(value(rows))[None]
        size = jnp.max(jnp.sum(jnp.abs(parts), axis=(2, 3, 4)), axis=1, keepdims=True)
        return jnp.abs(jnp.sum(parts, axis=(2, 3, 4))), size, left

    return jax.vmap(lane)(some.effect, places, rows, steps)


def third_differences(system: Model, group: Group, state: State, seed: int = 0) -> tuple[float, int]:
    """The largest of some instances, relative to what they are of, and the number of the instance."""
    given, lanes = _some(system, group, state, seed)
    values = np.asarray(_four(*given))
    thirds = np.abs(np.tensordot(values, BINOMIALS, ([1], [0])))
    size = np.max(np.abs(values), axis=1, initial=0.0)
    # (One that vanishes is rounded as the others are.)
    size = np.maximum(size, SMALL * np.max(size, axis=1, keepdims=True, initial=0.0))
    excess = np.where(np.isnan(thirds), np.inf, thirds / np.where(size > 0, size, 1.0))
    worst = np.max(excess, axis=1, where=np.isfinite(values[:, 0]), initial=0.0)
    return float(np.max(worst)), int(lanes[np.argmax(worst)])


@eager_numpy
def _four(some: Some, places: Array, rows: np.ndarray, steps: np.ndarray) -> Float[Array, "n 4 p"]:
    """What has to be quadratic, at four places in a row."""

    def values(effect: Any, place: Any, rows: Any, step: Any) -> Array:
        return jnp.stack([effect.quadratic(place, rows + k * step) for k in range(4)])

    return jax.vmap(values)(some.effect, places, rows, steps)
