"""Kicks that lag behind the unknowns while the equations of a step are solved.

A kick costs several times what an evaluation of the equations does, and depends on the unknowns weakly: of an
error of the stages it has a small part, of the order of the step. So the one that is held is kept from one
evaluation to the next, and found anew only where it is due:

- where the evaluation is expected to be the last: a step ends with the kick that belongs to its stages;
- where it is what the stages miss most, as far as that can be told;
- everywhere, and in the Jacobian, where it does depend strongly on the unknowns.

The first one of a step is extrapolated from those of the last steps, in the axes of the bodies.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.state import State
from natcoord_jax.mechanics.tangent_space import Velocity

FEWEST = 6
"""Unknowns of a stage from which on kicks lag: in smaller systems they cost no more than an evaluation."""

NEGLIGIBLE = 1e-14
"""Change of a kick in terms of the motion below which that which is held serves."""

NEGLIGIBLE_ENERGY = 1e-18
"""The same for the energy of the change, kick times change in terms of the motion squared."""

STRONG = 0.1
"""Change of a kick in terms of that of the stages from which on it is found in every evaluation."""

TELLING = 1e-12
"""Change of a kick in terms of the motion from which on it tells how kicks depend on the stages."""

MOST_RENEWALS = 6
"""Kicks in one step after which the same is done."""

SPANS = (8, 4096)
"""Steps for which it is done: the first time, and at most; twice as many each time."""

JUMP = 0.01
"""Change of a kick in terms of the last correction of the stages from which on the next does not compare."""

BEHIND = 3.0
"""The kick is due when it misses as much as a third of what the stages may."""


class FrozenKick(eqx.Module):
    """What an evaluation of the equations is told.

    Attributes:
        held: kick at hand.
        due: whether it is to be found anew; the same in all lanes.
        everywhere: whether it is in every evaluation. The Jacobian knows how it answers then, and would be of
            no use for equations with a kick that stays as it is.
        held_fast: whether that at hand is used in any case, in a lane without need where others have it.
    """

    held: Velocity
    due: Bool[Array, ""]
    everywhere: Bool[Array, ""]
    held_fast: Bool[Array, ""]


class Lagging(eqx.Module):
    """What is known of the kick while a step is solved; sizes are energy norms [sqrt(J)].

    Attributes:
        held: kick at hand.
        moved: by which the stages have moved since it was found.
        answer: change of the kick in terms of that of the stages, when it was found last.
        missed: by which the first kick of the last step was wrong.
        first: by which the stages were, then.
        renewals: kicks that have been found in this step.
        closed: steps for which it is found in every evaluation.
        span: their number the next time.
    """

    held: Velocity
    moved: Float[Array, ""]
    answer: Float[Array, ""]
    missed: Float[Array, ""]
    first: Float[Array, ""]
    renewals: Int[Array, ""]
    closed: Int[Array, ""]
    span: Int[Array, ""]

    @classmethod
    def begin(cls, held: Velocity) -> "Lagging":
        """Before the first step, of whose kick nothing is known."""
        zero = jnp.zeros((), held.rows.dtype)
        unknown = zero + jnp.inf
        return cls(held, zero, zero, unknown, zero, jnp.array(0), jnp.array(0), jnp.array(SPANS[0]))

    def wanted(self, it: Any) -> Bool[Array, ""]:
        """Whether the next evaluation wants the kick anew; `it`: where the iteration of the stages stands."""
        behind = jnp.where(self.renewals == 0, self.missed, self.answer * self.moved)
        begun = it.total > 0
        stages = jnp.where(begun, it.correction, self.first)
        told = (it.correction > 0) | ~begun
        # An iteration that waits for factors begins anew elsewhere.
        return it.last | it.wanting | (self.closed > 0) | (told & (stages <= BEHIND * behind))

    def jumped(self, kick: Any, lag: FrozenKick, it: Any) -> Bool[Array, ""]:
        """Whether the kick has changed so much that corrections of the stages do not compare.

        Nothing is so little that the last one may be left out: it would have the same sign in every step.
        """
        much = kick.change > jnp.where(it.last, 0.0, JUMP * it.correction)
        return lag.due & (self.closed == 0) & much

    def after(self, kick: Any, due: Array, correction: Array, it: Any) -> "Lagging":
        """After an evaluation.

        Args:
            kick: that was used, and its change.
            due: whether it was found anew.
            correction: size of the correction of the stages that followed.
            it: where their iteration stood before.
        """
        found = due & it.unsolved
        moving, first = it.unsolved & ~it.wanting, it.total == 0
        again = found & (self.renewals > 0)
        answer = jnp.where(self.moved > 0, kick.change / jnp.where(self.moved > 0, self.moved, 1.0), 0.0)
        answer = jnp.where(again, answer, self.answer)
        renewals = self.renewals + found
        telling = kick.change > TELLING * kick.motion
        strong = (again & telling & (answer > STRONG)) | (renewals >= MOST_RENEWALS)
        strong = strong & (self.closed == 0) & moving
        further = moving & jnp.isfinite(correction)
        return Lagging(
            held=jax.tree.map(lambda x, y: jnp.where(found, x, y), kick.kick, self.held),
            moved=jnp.where(found, 0.0, self.moved) + jnp.where(further, correction, 0.0),
            answer=answer,
            missed=jnp.where(found & ~again, kick.change, self.missed),
            first=jnp.where(first & further, correction, self.first),
            renewals=renewals,
            closed=jnp.where(strong, self.span, self.closed),
            span=jnp.where(strong, jnp.minimum(2 * self.span, SPANS[1]), self.span),
        )

    def beginning(self, held: Velocity) -> "Lagging":
        """Before the next step."""
        zero, nought = jnp.zeros_like(self.moved), jnp.zeros_like(self.renewals)
        return eqx.tree_at(
            lambda x: (x.held, x.moved, x.answer, x.renewals, x.closed),
            self,
            (held, zero, zero, nought, jnp.maximum(self.closed - 1, 0)),
        )


def in_body_axes(state: State, kick: Velocity) -> Float[Array, " numbers"]:
    """Components of a kick along the directors of its bodies, and rates of rotors."""
    directors = state.rows[:, 1:]
    components = jnp.sum(kick.rows[:, :, None, :] * directors[:, None, :, :], axis=-1)
    return jnp.concatenate([components.reshape(-1), kick.rotors])


def from_body_axes(state: State, numbers: Float[Array, " numbers"]) -> Velocity:
    """The kick with such components."""
    directors = state.rows[:, 1:]
    size = state.q.size
    components = by_node(numbers[:size].reshape(-1, 3))
    return Velocity(jnp.sum(components[..., None] * directors[:, None], axis=2), numbers[size:])
