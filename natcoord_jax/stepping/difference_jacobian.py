"""Jacobians by differences, one evaluation of the equations a column.

Multipliers act on the balances of their own stage alone, and do not change where the stages are. So one
evaluation gives their columns of all stages, and kicks stay as they are in it.

With several stages, the first Jacobian of a step takes them for alike: a change of an unknown is the same at
all stages, so that one column is enough for all of them, see `natcoord_jax.linsolve.stages`. If that is not
good enough, the next has all columns.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.core.effect import replace_fields
from natcoord_jax.mechanics.block_tangent_space import with_system
from natcoord_jax.mechanics.equations import prepare
from natcoord_jax.mechanics.frozen_kick import FrozenKick
from natcoord_jax.mechanics.response import Evaluation
from natcoord_jax.mechanics.start_cache import StartCache
from natcoord_jax.stepping.factors import Factors, factors_of
from natcoord_jax.stepping.newton import Iterate, any_lane, refreshed
from natcoord_jax.stepping.rollout_state import RolloutProblem, RolloutState
from natcoord_jax.xla.rows import with_row

FAILURES = 3
"""Jacobians with stages taken for alike that were not good enough, after which none is tried."""


class Layout(NamedTuple):
    """Which unknowns are changed together in one evaluation.

    Attributes:
        number: of the evaluation that changes each unknown.
        measure: by number, the unknown whose change is the measure.
        count: of the evaluations.
        moving: of those among them, the first ones, that change rates.
    """

    number: Any
    measure: Any
    count: Any
    moving: Any


def layouts(equations: Any) -> tuple[Layout, Layout]:
    """With all stages taken for alike, and with the rates of every stage apart; of the same shapes."""
    places, balances = equations.stage_places, equations.balances
    rates, alike = balances // places.shape[0], places.shape[1]
    together, apart = np.zeros(places.size, int), np.arange(places.size)
    together[places] = np.arange(alike)
    apart[places[:, rates:]] = balances + np.arange(alike - rates)
    measure = np.concatenate([np.arange(balances), places[0, rates:]])
    count = measure.size
    return Layout(together, np.resize(places[0], count), alike, rates), Layout(
        apart, measure, count, balances
    )


class DifferenceJacobian(eqx.Module):
    """What Jacobians by differences are formed with; the same in all lanes but for its numbers.

    Columns are found right before the residual itself, by the same code: a second copy of it would compile
    for half as long again, and step by step it would have to be fetched anew.

    Attributes:
        making: whether a Jacobian is to be formed, where the residual is evaluated next.
        alike: whether stages are taken for alike, in that or in the last one.
        failures: how often that was not good enough.
        moved: residuals at other unknowns, one a row; the last row is that at the unknowns themselves.
    """

    making: Bool[Array, ""]
    alike: Bool[Array, ""]
    failures: Int[Array, ""]
    moved: Float[Array, "rows unknowns"]

    @classmethod
    def first(cls, equations: Any, y: Float[Array, " unknowns"]) -> "DifferenceJacobian":
        """Before the first Jacobian of the equations of a step, with so many unknowns."""
        size, no = layouts(equations)[1].measure.size, jnp.array(False)
        moved = jnp.zeros((size + 1, *y.shape), y.dtype)
        return cls(no, jnp.array(equations.tableau.stages > 1), jnp.array(0), moved)

    def asked(self, wanting: Bool[Array, ""], rounds: Int[Array, ""], stages: int) -> "DifferenceJacobian":
        """After an evaluation.

        Args:
            wanting: whether a Jacobian is.
            rounds: Jacobians that the step has had.
            stages: of a step.
        """
        alike, failures = self.alike, self.failures
        if stages > 1:
            again = wanting & (rounds > 0)
            failures = failures + (again & alike)
            alike = jnp.where(wanting, ~again & (failures < FAILURES), alike)
        return DifferenceJacobian(wanting, alike, failures, self.moved)

    def evaluated(
        self,
        equations: Any,
        y: Float[Array, " unknowns"],
        evaluate: Callable[[Array, Array, Array], Any],
        found: Any,
    ) -> tuple["DifferenceJacobian", Any]:
        """With the equations evaluated: everywhere a Jacobian asks for, if it is to be formed, and at y.

        Args:
            equations: of the step.
            y: unknowns.
            evaluate: the equations at given unknowns, told whether these are y, and if not, whether rates are
                others, or multipliers alone.
            found: an evaluation of them, for its shapes.

        Returns:
            The probe, and the equations at y.
        """
        choice = self._choice(equations)
        last = choice.measure.shape[0]
        steps = self.changes(equations, y)

        def point(carry: tuple) -> tuple:
            k, moved, _ = carry
            end = k == last
            found = evaluate(y + jnp.where(choice.number == k, steps, 0.0), end, k < choice.moving)
            moved = with_row(moved, k, found.residual)
            return jnp.where(k + 1 == choice.count, last, k + 1), moved, found

        start = jnp.where(self.making, 0, last), self.moved, found
        _, moved, found = jax.lax.while_loop(lambda carry: carry[0] <= last, point, start)
        return DifferenceJacobian(self.making, self.alike, self.failures, moved), found

    def columns(self, equations: Any, y: Float[Array, " unknowns"]) -> Float[Array, "columns unknowns"]:
        """Columns of the Jacobian, one a row, in the order of the layout."""
        measure = self._choice(equations).measure
        steps = self.changes(equations, y)[measure]
        return (self.moved[: measure.shape[0]] - self.moved[measure.shape[0]]) / steps[:, None]

    def changes(self, equations: Any, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        """Changes of the unknowns, those of multipliers the same at all stages, or all the same."""
        found, places = equations.probes(y), equations.stage_places
        if places.shape[0] == 1:
            return found
        same = found.at[places].set(jnp.max(found[places], axis=0))
        apart = jnp.where(np.arange(y.shape[0]) < equations.balances, found, same)
        return jnp.where(self.alike, same, apart)

    def _choice(self, equations: Any) -> Layout:
        """One of the two layouts, in arrays."""
        together, apart = (
            x._replace(number=jnp.asarray(x.number), measure=jnp.asarray(x.measure))
            for x in layouts(equations)
        )
        if equations.tableau.stages == 1:
            return apart
        return Layout(*(jnp.where(self.alike, x, y) for x, y in zip(together, apart)))


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
    return probe, with_system(found, setting.system), it, factors


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
    return with_system(near.evaluate(y), None)


def _renewed(
    equations: Any, probe: DifferenceJacobian, it: Iterate, factors: Factors
) -> tuple[Iterate, Factors]:
    """New factors where a Jacobian has been formed by differences, and the iteration with them."""

    def whole(columns: Array) -> tuple:
        places = equations.stage_places
        if places.shape[0] == 1:
            return equations.factorised(columns.T)
        stage = np.zeros(places.size, int)
        stage[places] = np.arange(places.shape[0])[:, None]
        rate = np.arange(places.size) < equations.balances
        there = rate[:, None] | (stage[:, None] == stage)
        return equations.factorised(jnp.where(there, columns[layouts(equations)[1].number], 0.0).T)

    def alike(columns: Array) -> tuple:
        return equations.factorised_alike(columns[: equations.stage_places.shape[1]])

    def renewed(carry: tuple) -> tuple:
        _, it, factors = carry
        columns = probe.columns(equations, it.y)
        if equations.tableau.stages == 1:
            made = whole(columns)
        else:
            made = jax.lax.cond(probe.alike, alike, whole, columns)
        return jnp.array(False), refreshed(it), factors_of(made, factors.noise, equations.grain)

    # A loop of no or one trip, as at the end of a step.
    _, it, factors = jax.lax.while_loop(lambda carry: carry[0], renewed, (probe.making, it, factors))
    return it, factors
