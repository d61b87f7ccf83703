"""What the equations of a step need of the state it starts from, whatever its length and inputs."""

import equinox as eqx
from jaxtyping import Array, Float

from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.block_tangent_space import Tangents, tangents_at, with_system
from natcoord_jax.mechanics.dissipation import Damping
from natcoord_jax.mechanics.frozen_kick import FrozenKick
from natcoord_jax.model.model import Model


class StartCache(eqx.Module):
    """Found once a step, and carried along while its equations are solved.

    Attributes:
        projector: on the range of the constraints, for the multipliers of all stages; None: they are
            independent.
        tangents: tangent space, without the system; None for schemes without kicks, or if found later.
        damping: what can be damped; None for schemes that do not dissipate, or if found later.
        lag: kick at hand, while the equations are being solved; None: it is found in every evaluation.
    """

    projector: Float[Array, "m m"] | None
    tangents: Tangents | None
    damping: Damping | None = None
    lag: FrozenKick | None = None

    @classmethod
    def of(
        cls,
        system: Model,
        state: State,
        tableau: Tableau,
        projector: Array | None,
        tangents: Tangents | None = None,
        later: bool = False,
    ) -> "StartCache":
        """With the tangent space of a state.

        Args:
            system: compiled system.
            state: at the start.
            tableau: of the scheme.
            projector: of the multipliers.
            tangents: known from the end of the last step; None: found here.
            later: leave it to the evaluation, which finds it with that at the end of the step.
        """
        if tableau.dissipative and not later:
            return cls(projector, None, with_system(Damping.at(system, state), None))
        if not tableau.kick or later:
            return cls(projector, None)
        if tangents is None:
            tangents = with_system(tangents_at(system, state), None)
        return cls(projector, tangents)


NOTHING = StartCache(None, None)
"""Of the start of a step that is used for its constraints alone."""
