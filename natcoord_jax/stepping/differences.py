"""Evaluations of the equations that Jacobians by differences are formed with, and the factors these give."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.frozen_kick import FrozenKick
from natcoord_jax.mechanics.response import Evaluation
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.stepping.difference_jacobian import DifferenceJacobian, matrix_of
from natcoord_jax.stepping.factors import Factors, new_factors
from natcoord_jax.stepping.newton import Iterate, any_lane, refreshed
from natcoord_jax.stepping.rollout_state import RolloutProblem, RolloutState


def first_probe(setting: RolloutProblem, course: RolloutState, start_cache: StartCache) -> DifferenceJacobian:
    """What Jacobians by differences are formed with, before the first."""
    u, h, _ = setting.situation(course)
    near = replace_fields(start_cache, lag=setting.lag(course))
    equations = prepare(setting.system, course.state, u, h, setting.plan.tableau, near)
    return DifferenceJacobian.first(equations, course.it.y)


def evaluated(
    setting: RolloutProblem,
    equations: Any,
    probe: DifferenceJacobian,
    found: Evaluation,
    it: Iterate,
    factors: Factors,
) -> tuple[DifferenceJacobian, Evaluation, Iterate, Factors]:
    """The equations at the unknowns at hand, and everywhere a Jacobian asks for if one is to be formed.

    Args:
        setting: of the rollout.
        equations: of the step, told of the kick what they are where no Jacobian is formed.
        probe: what Jacobians are formed with.
        found: the last evaluation.
        it: where the iteration stands.
        factors: of the Jacobian at hand.

    Returns:
        The probe, the equations at the unknowns; the iteration and factors, which are new where there is a
        new Jacobian.
    """
    probe, found = probe.evaluated(equations, it.y, partial(_at, equations, probe.making), found)
    it, factors = _renewed(equations, probe, it, factors)
    return probe, found.with_system(setting.system), it, factors


def told(
    lag: FrozenKick | None, making: Array, at_end: Array | bool = True, moving: Array | bool = True
) -> FrozenKick | None:
    """What an evaluation is told of the kick where it may be one of those that a Jacobian asks for.

    In these kicks are held, or found anew where they are in every evaluation; multipliers do not change them.

    Args:
        lag: what it is told otherwise.
        making: whether a Jacobian is being formed.
        at_end: whether this is the last of its evaluations, that of the residual itself.
        moving: whether rates are others in it.
    """
    if lag is None:
        return None
    due = jnp.where(making, (at_end | moving) & any_lane(lag.everywhere), lag.due)
    return FrozenKick(lag.held, due, lag.everywhere, making & ~lag.everywhere)


def _at(equations: Any, making: Array, y: Array, at_end: Array, moving: Array) -> Evaluation:
    """The equations at unknowns of the probe."""
    lag = told(equations.start_cache.lag, making, at_end, moving)
    near = replace_fields(equations, start_cache=replace_fields(equations.start_cache, lag=lag))
    return near.evaluate(y).without_system()


def _renewed(
    equations: Any, probe: DifferenceJacobian, it: Iterate, factors: Factors
) -> tuple[Iterate, Factors]:
    """New factors where a Jacobian has been formed by differences, and the iteration with them."""

    def whole(columns: Array) -> tuple:
        return equations.factorised(matrix_of(equations, columns))

    def alike(columns: Array) -> tuple:
        return equations.factorised_alike(columns[: equations.stage_places.shape[1]])

    def renewed(carry: tuple) -> tuple:
        _, it, factors = carry
        columns = probe.columns(equations, it.y)
        if equations.tableau.stages == 1:
            made = whole(columns)
        else:
            made = jax.lax.cond(probe.alike, alike, whole, columns)
        return jnp.array(False), refreshed(it), new_factors(made, factors.noise, equations.grain)

    # A loop of no or one trip, as at the end of a step.
    _, it, factors = jax.lax.while_loop(lambda carry: carry[0], renewed, (probe.making, it, factors))
    return it, factors
