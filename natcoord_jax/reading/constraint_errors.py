"""Largest violations of constraints and of their rates, along a motion."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.mechanics.violations import largest, violation_rates_of, violations_of
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import over_states
from natcoord_jax.reading.tangent_states import Source, over_source


class ConstraintErrors(eqx.Module):
    """Largest violations at each time; of a trajectory, of the velocities that are read of it.

    Attributes:
        directors: of d_i . d_j = delta_ij [-].
        joints: of the joints' constraints [m, -].
        relations: of drives, couplings and pitches of screws [rad, m].
        director_rates: of the time derivatives of what holds for directors [1/s].
        joint_rates: of those of the joints' constraints [m/s, 1/s].
        relation_rates: of those of relations [rad/s, m/s].
    """

    directors: Float[Array, "*t"]
    joints: Float[Array, "*t"]
    relations: Float[Array, "*t"]
    director_rates: Float[Array, "*t"]
    joint_rates: Float[Array, "*t"]
    relation_rates: Float[Array, "*t"]

    def __repr__(self) -> str:
        """The largest over all times."""
        if not is_concrete(self) or self.joints.size == 0:
            return eqx.tree_pformat(self)
        units = "-", "m, -", "rad, m", "1/s", "m/s, 1/s", "rad/s, m/s"
        names = (field.name for field in dataclasses.fields(self))
        sizes = [f"{name} {np.max(getattr(self, name)):.2g} [{unit}]" for name, unit in zip(names, units)]
        times = f", largest of {self.joints.size} states" if self.joints.size > 1 else ""
        return f"ConstraintErrors({', '.join(sizes)}{times})"

    @property
    def position(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint."""
        return jnp.maximum(jnp.maximum(self.directors, self.joints), self.relations)

    @property
    def velocity(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint rate."""
        return jnp.maximum(jnp.maximum(self.director_rates, self.joint_rates), self.relation_rates)


def _relations(system: Model) -> tuple[Group, ...]:
    return tuple(g for g in system.effects if g.holds)


@over_states
def _values(system: Model, state: State) -> tuple[Array, Array, Array]:
    d = state.rows[:, 1:]
    gram = jnp.einsum("bik,bjk->bij", d, d) - jnp.eye(3)
    joints, relations = (
        largest(violations_of(system, groups, state)) for groups in (system.joints, _relations(system))
    )
    return jnp.max(jnp.abs(gram)), joints, relations


@over_source
def _rates(system: Model, state: State) -> tuple[Array, Array, Array]:
    d, rates = state.rows[:, 1:], state.row_rates[:, 1:]
    mixed = jnp.einsum("bik,bjk->bij", d, rates)
    joints, relations = (
        largest(violation_rates_of(system, groups, state)) for groups in (system.joints, _relations(system))
    )
    return jnp.max(jnp.abs(mixed + jnp.swapaxes(mixed, 1, 2))), joints, relations


def constraint_errors(system: Model, motion: State | Trajectory) -> ConstraintErrors:
    """Largest violations of internal constraints, joints and relations, and of their rates."""
    source = Source.of(system, motion)
    if isinstance(motion, State):
        source = replace_fields(source, as_they_are=True)
    return ConstraintErrors(*_values(system, motion), *_rates(source))
