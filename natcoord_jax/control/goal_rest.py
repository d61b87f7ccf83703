"""Goals of rest for what is flexible: without strain, and without accelerations."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.control.free_motions import owners
from natcoord_jax.control.goal_base import Goal
from natcoord_jax.control.memory import Ending
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.handles import named
from natcoord_jax.core.kinds import BODY_NAME, FLAG, Several, of
from natcoord_jax.core.state import STATE, State
from natcoord_jax.maths.rotations import to_rotation_vector
from natcoord_jax.mechanics.equations_of_motion import EquationsOfMotion, loads, loops_of, relations_of
from natcoord_jax.system import System

CHAIN = of("a beam, as scene.add(nc.Beam(...)) returned it", BeamHandle) | Several(BODY_NAME, 2)


def _chain(part: Any) -> tuple[Any, ...]:
    """Bodies one after the other."""
    return part.nodes if isinstance(part, BeamHandle) else tuple(part)


class Undeformed(Goal):
    """Beams that are neither bent nor twisted: nodes that follow each other are turned as they were.

    Three numbers for each pair of neighbours, the rotation vector [rad] of the second seen from the first.
    `nc.goal.Rest` stops a beam wherever it is, and it springs back afterwards; with both nothing swings any
    more (as long as no load, like gravity, needs a strain: `nc.goal.Equilibrium`). Slender beams are so stiff
    against stretch and shear that inputs hardly bring these about: to ask for them as well is easily too
    much, as it is of stiff springs.

    Attributes:
        parts: handles of beams, or sequences of bodies (handles or names) along what is flexible.
        reference: state without strains; None: the initial one.
        places: whether the place of the second seen from the first counts, too: stretch and shear, three
            numbers more [m].

    Example:
        >>> import natcoord_jax as nc
        >>> goal = nc.goal.Rest() & nc.goal.Undeformed((("hub", "node 1", "node 2"),))
    """

    parts: tuple[Any, ...] = eqx.field(static=True, converter=tuple, metadata=is_a(Several(CHAIN, 1)))
    reference: State | None = eqx.field(default=None, kw_only=True, metadata=is_a(STATE))
    places: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))

    def _pairs(self) -> list[tuple[Any, Any]]:
        return [pair for part in self.parts for pair in zip(_chain(part)[:-1], _chain(part)[1:])]

    def looks_at_start(self) -> bool:
        """It does, unless a reference is given."""
        return self.reference is None

    def missing(self, system: System, ending: Ending) -> Float[Array, " n"]:
        """Relative places and attitudes less those without strain."""
        before = ending.first if self.reference is None else self.reference
        found = []
        for pair in self._pairs():
            (place, turn), (rest, unturned) = (_seen(system, state, *pair) for state in (ending.last, before))
            found += [place - rest] if self.places else []
            found.append(to_rotation_vector(turn @ unturned.T))
        return jnp.concatenate(found)

    def labels(self, system: System) -> tuple[str, ...]:
        """Three or six for each pair."""
        kinds = (("place", "m"), ("turn", "rad")) if self.places else (("turn", "rad"),)
        return tuple(
            f"{named(b)!r} on {named(a)!r}: {kind}, {axis} [{unit}]"
            for a, b in self._pairs()
            for kind, unit in kinds
            for axis in "xyz"
        )


def _seen(system: System, state: State, a: Any, b: Any) -> tuple[Array, Array]:
    """Place and attitude of one body, seen from another."""
    one, two = (state.rows[system.body_index(body)] for body in (a, b))
    return one[1:] @ (two[0] - one[0]), one[1:] @ two[1:].T


class Equilibrium(Goal):
    """A state in which forces balance when all inputs are zero: what rests there stays there.

    The generalised forces of all free motions vanish [N, N m], those of springs, beams and loads at rest, as
    far as loops do not bear them. Where nothing is flexible and nothing pulls, it holds everywhere.

    Example:
        >>> import natcoord_jax as nc
        >>> goal = nc.goal.Rest() & nc.goal.Equilibrium()
    """

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Generalised forces."""
        still = replace_fields(state, v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
        balances, rest = EquationsOfMotion.at(system, still), jnp.zeros((len(system.structure.bodies), 3))
        found = balances.project(*loads(system, still, jnp.zeros(len(system.structure.inputs)), rest, rest))
        if not relations_of(system) and not loops_of(system):
            return found
        rows = balances.columns().constraints
        return found - jnp.linalg.pinv(rows.T @ rows) @ (rows.T @ (rows @ found)) if rows.size else found

    def sizes(self, system: System) -> tuple[int, int]:
        """As many as there are free motions."""
        return system.structure.unknowns, 0

    def labels(self, system: System) -> tuple[str, ...]:
        """The free motions, by the body they belong to."""
        return tuple(f"force on a free motion of {name!r} [N or N m]" for name in owners(system))
