"""The forms in which the equations of a step can be solved; all give the same trajectory."""

from typing import Any

from jaxtyping import Array

from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.block_tangent_space import Tangents
from natcoord_jax.mechanics.full import FullStep
from natcoord_jax.mechanics.recursive import RecursiveStep
from natcoord_jax.mechanics.reduced import ReducedStep
from natcoord_jax.mechanics.sparse import SparseStep
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.model.model import Model

FORMS: dict[str, Any] = {
    "reduced": ReducedStep,
    "full": FullStep,
    "recursive": RecursiveStep,
    "sparse": SparseStep,
}


def kind_of(system: Model, tableau: Tableau) -> Any:
    """The form in which a scheme is solved: that chosen at compile, if it is separable or dense."""
    chosen = system.structure.solver
    return FORMS[chosen if tableau.separable or (tableau.max_events and chosen == "full") else "reduced"]


def prepare(
    system: Model, state: State, u: Array, h: Array, tableau: Tableau, start_cache: StartCache | None = None
) -> Any:
    """The equations of one step, in the form of the scheme; what is known of its start may be given."""
    return kind_of(system, tableau).prepare(system, state, u, h, tableau, start_cache)


def starting(
    system: Model,
    state: State,
    tableau: Tableau,
    tangents: Tangents | None = None,
    later: bool = False,
) -> StartCache:
    """What the equations of a step that starts from a state need of it, see `StartCache.of`."""
    return kind_of(system, tableau).starting(system, state, tableau, tangents, later)
