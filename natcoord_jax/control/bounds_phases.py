"""Bounds of motions with phases: within some steps only, and of what the ground can give."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.control.bounds_base import BOUND, Bound
from natcoord_jax.control.memory import Step, each_inside, only_where
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.numeric import Directions, Number, Whole
from natcoord_jax.mechanics.equations_of_motion import EquationsOfMotion, loads
from natcoord_jax.mechanics.momentum import body_momenta
from natcoord_jax.mechanics.rates import tree_rates
from natcoord_jax.system import System

SMOOTH = 1e-3
"""Part of a body's weight by which a sideways force is rounded off at zero."""


class During(Bound):
    """A bound within some steps only, as those of one phase; elsewhere it counts as kept by its own unit.

    Attributes:
        bound: what has to hold.
        first: the first step, from 0.
        last: the one after the last step.

    Raises:
        ValueError: for no step at all.

    Example:
        >>> import natcoord_jax as nc
        >>> slow = nc.bounds.During(nc.bounds.Rate("hinge", -1.0, 1.0), first=10, last=20)
    """

    bound: Bound = eqx.field(metadata=is_a(BOUND))
    first: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))
    last: int = eqx.field(kw_only=True, static=True, metadata=is_a(Whole(1)))

    def __check_init__(self):
        """Refuse no steps."""
        if not self.first < self.last:
            raise ValueError(
                f"bounds.During: there are no steps from {self.first} to {self.last}; pass first < last"
            )

    def inside(self) -> tuple[Bound, ...]:
        """The bound."""
        return (self.bound,)

    def furthest(self) -> int:
        """Its last step."""
        return max(self.last, self.bound.furthest())

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excess where it counts."""
        ((bound, own),) = each_inside(self, system, memory)
        here = (step.number >= self.first) & (step.number < self.last)
        bound, system, step = only_where(here, (bound, system, step))
        return jnp.where(here, bound.of_step(system, own, step), -1.0)

    def labels(self, system: System) -> tuple[str, ...]:
        """Those of the bound."""
        return self.bound.labels(system)

    def widened(self, factor: Any) -> Bound:
        """The same with the limits of inputs so many times as wide; itself if it has none."""
        wider = self.bound.widened(factor)
        return self if wider is self.bound else During(wider, first=self.first, last=self.last)


class Support(Bound):
    """What the ground can give: it presses, and holds by friction only (Coulomb's cone).

    The force of the ground is that of all joints with it together, the mean over a step: rate of momentum
    less loads. It is measured by the weight of all bodies, or where there is none by `unit`. For a foot that
    is on the ground in one phase only, see `During`; an impact where a joint closes is not part of it.

    Attributes:
        normal: direction in which the ground presses.
        friction: coefficient; None: it holds sideways whatever it takes.
        least: what it has to press with at least [N].
        unit: force that counts as one [N].

    Example:
        >>> import natcoord_jax as nc
        >>> standing = nc.bounds.During(nc.bounds.Support(friction=0.6), last=20)
    """

    normal: Any = eqx.field(default=(0.0, 0.0, 1.0), metadata=is_a(Directions((3,))))
    friction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    least: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number()))
    unit: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))

    def of_step(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excesses in units of the weight."""
        force, weight = ground_force(system, step)
        unit = jnp.linalg.norm(weight) if self.unit is None else jnp.asarray(self.unit, float)
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


def ground_force(system: System, step: Step) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Mean force of joints with the ground on all bodies over a step, and that of the loads at rest [N]."""
    before, after = step.before, step.after
    start, finish = (jnp.sum(body_momenta(system, state)[0], axis=0) for state in (before, after))
    names = ("q", "v", "coordinates", "t")
    state = replace_fields(before, **{x: 0.5 * (getattr(before, x) + getattr(after, x)) for x in names})
    velocity, spin = EquationsOfMotion.at(system, state).twists(tree_rates(system, state))
    applied = jnp.sum(loads(system, state, step.u, velocity, spin)[0], axis=0)
    still = jnp.zeros_like(velocity)
    weight = jnp.sum(loads(system, state, jnp.zeros_like(step.u), still, still)[0], axis=0)
    return (finish - start) / step.dt - applied, weight
