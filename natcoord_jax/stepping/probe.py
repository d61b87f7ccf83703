"""Jacobians by differences, one evaluation of the equations a column.

Multipliers act on the balances of their own stage alone, and do not change where the stages are. So one
evaluation gives their columns of all stages, and kicks stay as they are in it.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

FAILURES = 3
"""Jacobians with stages taken for alike that were not good enough, after which none is tried."""


class Layout(NamedTuple):
    """Which unknowns are changed together in one evaluation.

    Attributes:
        number: of the evaluation that changes each unknown.
        measure: by number, the unknown whose change is the measure.
    """

    number: np.ndarray
    measure: np.ndarray


def layouts(equations: Any) -> tuple[Layout, Layout]:
    """With all stages taken for alike, and with the rates of every stage apart."""
    places, balances = equations.stage_places, equations.balances
    rates = balances // places.shape[0]
    together, apart = np.zeros(places.size, int), np.arange(places.size)
    together[places] = np.arange(places.shape[1])
    apart[places[:, rates:]] = balances + np.arange(places.shape[1] - rates)
    measure = np.concatenate([np.arange(balances), places[0, rates:]])
    return Layout(together, places[0]), Layout(apart, measure)


def _whole(equations: Any, columns: Float[Array, "rows unknowns"]) -> Float[Array, "unknowns unknowns"]:
    """The Jacobian from its columns, one a row, those of multipliers for all stages together."""
    places, (_, apart) = equations.stage_places, layouts(equations)
    if places.shape[0] == 1:
        return columns[: places.size].T
    stage = np.zeros(places.size, int)
    stage[places] = np.arange(places.shape[0])[:, None]
    rate = np.arange(places.size) < equations.balances
    there = rate[:, None] | (stage[:, None] == stage)
    return jnp.where(there, columns[apart.number], 0.0).T


class Probe(eqx.Module):
    """A Jacobian in the making, by differences; the same in all lanes but for its numbers.

    With several stages, the first one of a step takes them for alike: a change of an unknown is the same at
    all stages, so that one column is enough for all of them, see `natcoord_jax.linsolve.stages`. If that is
    not good enough, the next has all columns.

    Attributes:
        at: -1: none in the making; 0: the residual itself is evaluated; k: column k.
        residual: at the unknowns.
        columns: found so far, one a row; what is evaluated at other times goes to the last row. Rows beyond
            those of the layout are not used.
        alike: whether stages are taken for alike.
        failures: how often that was not good enough.
    """

    at: Int[Array, ""]
    residual: Float[Array, " unknowns"]
    columns: Float[Array, "rows unknowns"]
    alike: Bool[Array, ""]
    failures: Int[Array, ""]

    @classmethod
    def first(cls, size: int, stages: int, dtype: Any) -> "Probe":
        """Before the first Jacobian."""
        columns = jnp.zeros((size + 1, size), dtype)
        return cls(jnp.array(0), columns[0], columns, jnp.array(stages > 1), jnp.array(0))

    def steps(self, y: Float[Array, " unknowns"], equations: Any) -> Float[Array, " unknowns"]:
        """Changes of the unknowns."""
        found, same = _changes(equations, y)
        return jnp.where(self.alike, same, found)

    def moved(self, y: Float[Array, " unknowns"], equations: Any) -> Float[Array, " unknowns"]:
        """Where the equations are evaluated next."""
        together, apart = layouts(equations)
        here = jnp.where(self.alike, together.number == self.at - 1, apart.number == self.at - 1)
        return y + jnp.where(here, self.steps(y, equations), 0.0)

    def moves_rates(self, rates: int, stages: int) -> Bool[Array, ""]:
        """Whether rates are changed, or nothing: multipliers leave kicks as they are."""
        return self.at <= jnp.where(self.alike, rates, rates * stages)

    def matrix(self, equations: Any) -> Float[Array, "unknowns unknowns"]:
        """The Jacobian that is complete, with stages told apart."""
        return _whole(equations, self.columns)

    def with_column(
        self,
        y: Float[Array, " unknowns"],
        residual: Float[Array, " unknowns"],
        equations: Any,
        wanting: Bool[Array, ""],
        rounds: Int[Array, ""],
        known: Bool[Array, ""],
    ) -> tuple["Probe", Bool[Array, ""]]:
        """After an evaluation: the next state, and whether the Jacobian is complete.

        Args:
            y: where the Jacobian is wanted.
            residual: found.
            equations: of the step.
            wanting: whether a Jacobian is wanted; never while one is in the making.
            rounds: Jacobians that the step has had.
            known: whether the residual is that at `y`, so that it need not be found again.
        """
        size = residual.shape[0]
        base = jnp.where(self.at == 0, residual, self.residual)
        steps = jnp.append(self.steps(y, equations), 1.0)
        row = jnp.where(self.at > 0, self.at - 1, size)
        both = layouts(equations)
        together, apart = (jnp.asarray(np.append(x.measure, np.full(size, size))) for x in both)
        measure = jnp.where(self.alike, together[row], apart[row])
        alike, failures, last = self.alike, self.failures, jnp.array(both[1].measure.size)
        if equations.tableau.stages > 1:
            last = jnp.where(alike, both[0].measure.size, last)
            again = wanting & (rounds > 0)
            failures = failures + (again & alike)
            alike = jnp.where(wanting, ~again & (failures < FAILURES), alike)
        quotient = (residual - base) / steps[measure]
        columns = jax.lax.dynamic_update_index_in_dim(self.columns, quotient, row, 0)
        complete = self.at == last
        further = jnp.where((self.at >= 0) & ~complete, self.at + 1, -1)
        base = jnp.where(wanting & known, residual, base)
        at = jnp.where(wanting, jnp.where(known, 1, 0), further)
        return Probe(at, base, columns, alike, failures), complete


def _changes(
    equations: Any, y: Float[Array, " unknowns"]
) -> tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]:
    """Changes of the unknowns, those of multipliers the same at all stages; and all the same."""
    found, places = equations.probes(y), equations.stage_places
    if places.shape[0] == 1:
        return found, found
    same = found.at[places].set(jnp.max(found[places], axis=0))
    return jnp.where(np.arange(y.shape[0]) < equations.balances, found, same), same


def jacobian_by_differences(
    equations: Any, y: Float[Array, " unknowns"]
) -> Float[Array, "unknowns unknowns"]:
    """The same in one go, where the residual is not evaluated for anything else."""
    steps, (_, apart) = _changes(equations, y)[0], layouts(equations)
    chosen = apart.number == np.arange(apart.measure.size)[:, None]
    points = jnp.concatenate([y[None], y + jnp.where(chosen, steps, 0.0)])
    found = jax.lax.map(lambda y: equations.residual(y)[0], points)
    return _whole(equations, (found[1:] - found[:1]) / steps[apart.measure][:, None])
