"""Steps of several stages: their unknowns, and the states and inputs within them.

Gauss collocation with s stages has the rates of all stages among the unknowns of a step, one stage after the
other, and then the multipliers. Costs and integrals are taken by its quadrature, which is of the same order;
bounds hold at the stages.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.memory import Instant
from natcoord_jax.control.mesh import spans
from natcoord_jax.control.phases import filled, most_unknowns
from natcoord_jax.control.problem import OptimalControl
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.mechanics.coordinates import stage_rates
from natcoord_jax.mechanics.equations import prepare, starting
from natcoord_jax.stepping.step import end_of_step
from natcoord_jax.system import System


def unknowns_each(problem: OptimalControl) -> int:
    """Number of unknowns of the equations of a step; of phases with systems of their own the most."""
    return problem.stages * most_unknowns(problem.systems)[0]


def _phases(problem: OptimalControl) -> list[tuple[slice, int]]:
    """Steps and number of free motions of all phases; of one system all steps at once."""
    pieces = spans(problem.phases) if problem.later else [(0, problem.steps)]
    return [(slice(a, b), s.structure.unknowns) for (a, b), s in zip(pieces, problem.systems)]


def stage_unknowns(
    problem: OptimalControl, rates: Float[Array, "steps n"] | Float[Array, "steps s n"]
) -> Float[Array, "steps y"]:
    """Unknowns of steps with given rates of the free motions; multipliers zero.

    Args:
        problem: the problem.
        rates: of all stages, or means of steps, which are made linear within them.
    """
    tableau, found = problem.scheme.tableau, []
    for here, own in _phases(problem):
        each = rates[here, ..., :own]
        if tableau.stages > 1 and each.ndim == 2:
            padded = jnp.concatenate([each[:1], each, each[-1:]])
            slope = 0.5 * (padded[2:] - padded[:-2])
            each = each[:, None] + (jnp.asarray(tableau.c) - 0.5)[:, None] * slope[:, None]
        found.append(filled(each.reshape(len(each), -1), unknowns_each(problem)))
    return jnp.concatenate(found)


def known_rates(
    problem: OptimalControl, y: Any
) -> Float[np.ndarray, "steps n"] | Float[np.ndarray, "steps s n"]:
    """Rates of the free motions in all steps, or at all their stages; zero where another phase has more."""
    stages, most, found = problem.stages, most_unknowns(problem.systems)[1], []
    for here, own in _phases(problem):
        each = np.asarray(y)[here, : stages * own].reshape(-1, stages, own)
        found.append(np.pad(each, ((0, 0), (0, 0), (0, most - own))))
    rates = np.concatenate(found)
    return rates if stages > 1 else rates[:, 0]


def collocated(
    system: System, before: State, u: Float[Array, "s inputs"], h: Array, y: Array, tableau: Tableau
) -> tuple[Array, State, tuple[Instant, ...]]:
    """A step of several stages from its unknowns: what is left of its equations, its end, and its stages."""
    equations = prepare(system, before, u, h, tableau, starting(system, before, tableau, None, later=True))
    found = equations.evaluate(y)
    at, a = found.at, h * jnp.asarray(tableau.a)
    turning = stage_rates(system, at, h)
    stages, bodies = tableau.stages, len(system.structure.bodies)
    v = at.rates[:, :bodies].reshape(stages, -1, 3)
    q, coordinates = before.q + jnp.tensordot(a, v, 1), before.coordinates + a @ turning
    carrying = [group.coordinates[:, 0] for group in equations.groups if group.effect.rotors]
    rotors = turning[:, np.concatenate(carrying)] if carrying else jnp.zeros((stages, 0))
    instants = []
    for k, (weight, part) in enumerate(zip(tableau.b, tableau.c)):
        fields = {"q": q[k], "v": v[k], "coordinates": coordinates[k], "rates": rotors[k]}
        state = replace_fields(before, t=before.t + part * h, **fields)
        instants.append(Instant(part, weight, state, u[k]))
    return found.residual, end_of_step(equations, found)[0], tuple(instants)
