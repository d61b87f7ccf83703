"""The velocities that the constraints admit, body by body, where none hangs on another.

Free bodies and bodies on the ground, whatever effects act between them: then the null space of the tree and
all that is made of it in `tangent_space` are blocks, one a body. A kick then costs in proportion to their
number, not to its cube.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import inverse_cholesky
from natcoord_jax.maths.projectors import isometric
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.equations_of_motion import loops_of, relations_of, rotors_of
from natcoord_jax.mechanics.momentum import inertia_alone, weighs_only, wrench
from natcoord_jax.mechanics.rates import joint_axes
from natcoord_jax.mechanics.tangent_space import TangentSpace, Velocity, driven
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import row_rates
from natcoord_jax.model.tree import turns


class SeparateTangents(eqx.Module):
    """As `TangentSpace`, in blocks of the slots in use; those that a body lacks are of no effect.

    Attributes:
        system: whose tangents they are, None while they are carried along.
        rows: of the bodies.
        velocity: of the bodies' points per unit rate of their free motions.
        spin: angular velocities per unit rate.
        impulses: M P.
        blocks: P^T M P, one where a slot is absent.
        frame: X, with X P^T M P X^T = 1.
    """

    system: Model | None
    rows: Float[Array, "bodies 4 3"]
    velocity: Float[Array, "bodies m 3"]
    spin: Float[Array, "bodies m 3"]
    impulses: Float[Array, "bodies m 4 3"]
    blocks: Float[Array, "bodies m m"]
    frame: Float[Array, "bodies m m"]

    @classmethod
    def at(cls, system: Model, state: State) -> "SeparateTangents":
        """The tangent spaces of a state; its velocities play no part."""
        rows, slots = state.rows, np.array(system.tree.slots, int)
        axes, points = joint_axes(system, rows)
        turning = turns(slots)[:, None]
        present = (system.tree.slot_index[:, slots] < system.tree.slot_of.shape[0])[..., None]
        axis = jnp.where(present, axes[:, slots], 0.0)
        velocity = jnp.where(turning, cross(axis, (rows[:, 0] - points)[:, None]), axis)
        spin = jnp.where(turning, axis, 0.0)
        columns = jnp.concatenate([velocity[:, :, None], cross(spin[:, :, None], rows[:, None, 1:])], axis=2)
        impulses = jax.vmap(inertia_alone, in_axes=(None, 1), out_axes=1)(system.mass, columns)
        blank = jnp.zeros((rows.shape[0], slots.size, slots.size), rows.dtype)
        space = cls(system, rows, velocity, spin, impulses, blank, blank)
        massless = weighs_only(system.mass)
        spin = jnp.where(massless[:, None, None], spin, 0.0)
        # A unit inertia for turns of point masses, which nothing else sees.
        idle = jnp.sum(spin[:, :, None] * spin[:, None], axis=-1)
        blocks = space.pulled(impulses) + jnp.where(present, 0.0, jnp.eye(slots.size))
        return replace_fields(space, blocks=blocks, frame=jax.vmap(inverse_cholesky)(blocks + idle))

    def impulse(self, v: Velocity) -> Velocity:
        """M v."""
        assert self.system is not None
        return Velocity(inertia_alone(self.system.mass, v.rows), v.rotors)

    def energy(self, v: Velocity) -> Float[Array, ""]:
        """Kinetic energy [J]."""
        return 0.5 * jnp.sum(self.impulse(v).rows * v.rows)

    def pulled(self, impulses: Float[Array, "bodies *k 4 3"]) -> Float[Array, "bodies m *k"]:
        """P^T of impulses, body by body."""
        several = impulses.ndim == 4
        rows = jnp.moveaxis(impulses, 1, 0) if several else impulses[None]
        force, torque = wrench(rows, self.rows[None, :, 1:])
        on_velocity = jnp.sum(self.velocity[:, :, None] * jnp.moveaxis(force, 0, 1)[:, None], axis=-1)
        found = on_velocity + jnp.sum(self.spin[:, :, None] * jnp.moveaxis(torque, 0, 1)[:, None], axis=-1)
        return found if several else found[:, :, 0]

    def framed(self, v: Velocity) -> Float[Array, "bodies m"]:
        """Components of a velocity along the frames, X P^T M v."""
        return jnp.sum(self.frame * self.pulled(self.impulse(v).rows)[:, None], axis=-1)

    def answers(
        self, forces: Float[Array, "n k 4 3"], bodies: Int[np.ndarray, "n k"]
    ) -> tuple[Float[Array, "n bodies m"], Float[Array, "n 0"]]:
        """What impulses on the rows of few bodies each bring about; see `TangentSpace.answers`."""
        rows, frame, velocity, spin = (x[bodies] for x in (self.rows, self.frame, self.velocity, self.spin))
        force, torque = wrench(forces, rows[:, :, 1:])
        pulled = jnp.sum(velocity * force[:, :, None] + spin * torque[:, :, None], axis=-1)
        found = jnp.sum(frame * pulled[:, :, None], axis=-1)
        none = jnp.zeros((bodies.shape[0], self.rows.shape[0], found.shape[-1]), found.dtype)
        answers = none.at[np.arange(bodies.shape[0])[:, None], bodies].add(found, mode="drop")
        return answers, none[:, 0, :0]

    def along(self, y: Float[Array, "bodies m"]) -> Velocity:
        """Velocity with given components along the frames."""
        w = jnp.sum(self.frame * y[:, :, None], axis=1)[:, :, None]
        velocity, spin = jnp.sum(self.velocity * w, axis=1), jnp.sum(self.spin * w, axis=1)
        return Velocity(row_rates(self.rows, velocity, spin), jnp.zeros(0, y.dtype))

    def projected(self, v: Velocity) -> Velocity:
        """Nearest velocity that the constraints admit; see `TangentSpace.projected`."""
        y = self.framed(v)
        return self.along(y + self.framed(v - self.along(y)))

    def normal(self, v: Velocity) -> Velocity:
        """What of a velocity is orthogonal to all that the constraints admit."""
        return v - self.along(self.framed(v))

    @property
    def drift(self) -> Velocity:
        """Velocity that drives prescribe: there are none."""
        return Velocity(jnp.zeros_like(self.rows), jnp.zeros(0, self.rows.dtype))

    def work(self, kick: Velocity) -> Float[Array, " c"]:
        """Work of the constraints in a kick [J]: there are none."""
        return jnp.zeros(0, kick.rows.dtype)

    @property
    def inertia(self) -> Float[Array, "u u"]:
        """P^T M P."""
        assert self.system is not None
        tree = self.system.tree
        places, size = tree.slot_index[:, np.array(tree.slots, int)], tree.slot_of.shape[0]
        # Absent slots go to one more row and column.
        whole = jnp.zeros((size + 1, size + 1), self.blocks.dtype)
        whole = whole.at[places[:, :, None], places[:, None, :]].set(self.blocks)
        return whole[:size, :size]

    def shares(self, after: "SeparateTangents", d: Velocity) -> tuple[Velocity, Velocity]:
        """P^_0 u and P^_1 (b_1 - 2 u - K^T u) of the kick from here to another configuration, see `kick`."""
        coupled = self.pulled(after.impulses)
        half = jnp.sum(self.frame[:, :, :, None] * coupled[:, None], axis=2)
        cosines = jnp.sum(half[:, :, None] * after.frame[:, None], axis=-1)
        first, last = jax.vmap(isometric)(cosines, self.framed(d), after.framed(d))
        return self.along(first), after.along(last)


Tangents = TangentSpace | SeparateTangents
"""What is admitted at one configuration, in one piece or body by body."""

T = TypeVar("T")


def with_system(found: T, system: Model | None) -> T:
    """With the system whose tangents are in it; None: with what belongs to configurations alone."""

    def one(x: Any) -> Any:
        return replace_fields(x, system=system) if isinstance(x, Tangents) else x

    return jax.tree.map(one, found, is_leaf=lambda x: isinstance(x, Tangents))


def separate(system: Model) -> bool:
    """Whether the constraints admit velocities body by body."""
    apart = len(system.tree.levels) == 1 and len(system.structure.bodies) > 1
    coupled = system.mass_between is not None or relations_of(system) or loops_of(system)
    return apart and not (coupled or rotors_of(system))


def tangents_at(system: Model, state: State) -> Tangents:
    """The tangent space of a state; its velocities play no part."""
    if separate(system):
        return SeparateTangents.at(system, state)
    return TangentSpace.at(system, state, lifted=driven(system))
