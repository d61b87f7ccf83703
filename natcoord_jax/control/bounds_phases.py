"""Bounds of motions with phases: within some steps only, and of what the ground can give."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.bounds_base import BOUND, Bound
from natcoord_jax.control.memory import Step, each_inside, only_where
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import Several
from natcoord_jax.core.numeric import Directions, Number, Whole
from natcoord_jax.maths.rotations import angular_velocity
from natcoord_jax.mechanics.equations_of_motion import loads
from natcoord_jax.mechanics.momentum import body_momenta
from natcoord_jax.system import System

GRAVITY = 9.81
"""Of the Earth [m/s^2]: a unit only."""
SMOOTH = 1e-3
"""Part of a body's weight by which a sideways force is rounded off at zero."""


def _pairs(steps: Any) -> tuple:
    """Hashable."""
    return tuple(tuple(int(x) for x in pair) for pair in steps)


class During(Bound):
    """A bound within some steps only, as those of one phase; elsewhere it counts as kept by its own unit.

    Attributes:
        bound: what has to hold.
        steps: pairs (first, one after the last), from 0, in which it does.

    Raises:
        ValueError: for no steps at all.

    Example:
        >>> import natcoord_jax as nc
        >>> slow = nc.bounds.During(nc.bounds.Rate(-1.0, 1.0, joint="hinge"), steps=[(10, 20), (30, 40)])
    """

    bound: Bound = eqx.field(metadata=is_a(BOUND))
    steps: tuple[tuple[int, int], ...] = eqx.field(
        kw_only=True, static=True, converter=_pairs, metadata=is_a(Several(Several(Whole(0), 2, 2), 1))
    )

    def __check_init__(self):
        """Refuse no steps."""
        for first, last in self.steps:
            if not first < last:
                raise ValueError(
                    f"bounds.During: there are no steps from {first} to {last}; pass pairs with first < last"
                )

    def inside(self) -> tuple[Bound, ...]:
        """The bound."""
        return (self.bound,)

    def furthest(self) -> int:
        """Its last step."""
        return max(self.bound.furthest(), *(last for _, last in self.steps))

    def marks(self) -> tuple[int, ...]:
        """Where it begins and ceases to count."""
        return tuple(mark for pair in self.steps for mark in pair)

    def remarked(self, moved: Callable[[int], int]) -> "During":
        """The same within other steps."""
        return dataclasses.replace(self, steps=[[moved(mark) for mark in pair] for pair in self.steps])

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excess where it counts."""
        ((bound, own),) = each_inside(self, system, memory)
        here = jnp.any(jnp.array([(step.number >= a) & (step.number < b) for a, b in self.steps]))
        bound, system, step = only_where(here, (bound, system, step))
        return jnp.where(here, bound.of_step(system, own, step), -1.0)

    def labels(self, system: System) -> tuple[str, ...]:
        """Those of the bound."""
        return self.bound.labels(system)

    def widened(self, factor: Any) -> Bound:
        """The same with the limits of inputs so many times as wide; itself if it has none."""
        wider = self.bound.widened(factor)
        return self if wider is self.bound else During(wider, steps=self.steps)


class Support(Bound):
    """What the ground can give: it presses, and holds by friction only (Coulomb's cone).

    The force of the ground is that of all joints with it together, the mean over a step: rate of momentum
    less loads. It is measured in units of the weight of all bodies on the Earth, or of `unit`. For a foot
    that is on the ground in one phase only, see `During`; an impact is not part of it.

    Attributes:
        normal: direction in which the ground presses.
        friction: coefficient; None: it holds sideways whatever it takes.
        least: what it has to press with at least [N].
        unit: force that counts as one [N]; None: that weight.

    Example:
        >>> import natcoord_jax as nc
        >>> standing = nc.bounds.During(nc.bounds.Support(friction=0.6), steps=[(0, 20)])
    """

    normal: Any = eqx.field(default=(0.0, 0.0, 1.0), metadata=is_a(Directions((3,))))
    friction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    least: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))
    unit: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excesses in units of the weight."""
        force = ground_force(system, step)
        unit = GRAVITY * jnp.sum(system.mass[:, 0, 0]) if self.unit is None else jnp.asarray(self.unit, float)
        normal = jnp.asarray(self.normal, float)
        normal = normal / jnp.linalg.norm(normal)
        pressing = force @ normal
        found = [(jnp.asarray(self.least, float) - pressing) / unit]
        if self.friction is not None:
            sideways = (force - pressing * normal) / unit
            size = jnp.sqrt(sideways @ sideways + SMOOTH**2) - SMOOTH
            found.append(size - jnp.asarray(self.friction, float) * pressing / unit)
        return jnp.stack(found)

    def labels(self, system: System) -> tuple[str, ...]:
        """What is bounded."""
        pressing = ("the ground presses [weight]",)
        return pressing if self.friction is None else (*pressing, "friction of the ground [weight]")


def ground_force(system: System, step: Step) -> Float[Array, " 3"]:
    """Mean force of joints with the ground on all bodies over a step [N]."""
    before, after = step.before, step.after
    start, finish = (jnp.sum(body_momenta(system, state)[0], axis=0) for state in (before, after))
    names = ("q", "v", "coordinates", "t")
    state = replace_fields(before, **{x: 0.5 * (getattr(before, x) + getattr(after, x)) for x in names})
    rows, rates = state.rows, state.row_rates
    spin = angular_velocity(rows[:, 1:], rates[:, 1:])
    applied = loads(system, state, step.u, rates[:, 0], spin)[0]
    return (finish - start) / step.dt - jnp.sum(applied, axis=0)
