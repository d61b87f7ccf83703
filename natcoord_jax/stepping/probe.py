"""Jacobians by differences, one evaluation of the equations a column."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

FAILURES = 3
"""Jacobians with stages taken for alike that were not good enough, after which none is tried."""


class Probe(eqx.Module):
    """A Jacobian in the making, by differences; the same in all lanes but for its numbers.

    With several stages, the first one of a step takes them for alike: a change of an unknown is the same at
    all stages, so that one column is enough for all of them, see `natcoord_jax.linsolve.stages`. If that is
    not good enough, the next has all columns.

    Attributes:
        at: -1: none in the making; 0: the residual itself is evaluated; k: column k.
        residual: at the unknowns.
        columns: found so far, one a row; what is evaluated at other times goes to the last row.
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
        found = equations.probes(y)
        if equations.tableau.stages == 1:
            return found
        places = equations.stage_places
        same = found.at[places].set(jnp.max(found[places], axis=0))
        return jnp.where(self.alike, same, found)

    def moved(self, y: Float[Array, " unknowns"], equations: Any) -> Float[Array, " unknowns"]:
        """Where the equations are evaluated next."""
        here = jnp.arange(y.shape[0]) == self.at - 1
        if equations.tableau.stages > 1:
            places = equations.stage_places
            column = np.zeros(y.shape[0], int)
            column[places] = np.arange(places.shape[1])
            here = jnp.where(self.alike, column == self.at - 1, here)
        return y + jnp.where(here, self.steps(y, equations), 0.0)

    def with_column(
        self,
        y: Float[Array, " unknowns"],
        residual: Float[Array, " unknowns"],
        equations: Any,
        wanting: Bool[Array, ""],
        rounds: Int[Array, ""],
    ) -> tuple["Probe", Bool[Array, ""]]:
        """After an evaluation: the next state, and whether the Jacobian is complete.

        Args:
            y: where the Jacobian is wanted.
            residual: found.
            equations: of the step.
            wanting: whether a Jacobian is wanted; never while one is in the making.
            rounds: Jacobians that the step has had.
        """
        size = residual.shape[0]
        base = jnp.where(self.at == 0, residual, self.residual)
        # Of the changes of one unknown at all stages the first is the measure.
        steps = jnp.append(self.steps(y, equations), 1.0)
        row = jnp.where(self.at > 0, self.at - 1, size)
        alike, failures, last = self.alike, self.failures, jnp.array(size)
        measure = row
        if equations.tableau.stages > 1:
            first = np.full(size + 1, size)
            first[: equations.stage_places.shape[1]] = equations.stage_places[0]
            measure = jnp.where(alike & (self.at > 0), jnp.asarray(first)[row], row)
            last = jnp.where(alike, equations.stage_places.shape[1], size)
            again = wanting & (rounds > 0)
            failures = failures + (again & alike)
            alike = jnp.where(wanting, ~again & (failures < FAILURES), alike)
        quotient = (residual - base) / steps[measure]
        columns = jax.lax.dynamic_update_index_in_dim(self.columns, quotient, row, 0)
        complete = self.at == last
        further = jnp.where((self.at >= 0) & ~complete, self.at + 1, -1)
        return Probe(jnp.where(wanting, 0, further), base, columns, alike, failures), complete


def jacobian_by_differences(
    equations: Any, y: Float[Array, " unknowns"]
) -> Float[Array, "unknowns unknowns"]:
    """The same in one go, where the residual is not evaluated for anything else."""
    steps = equations.probes(y)
    points = jnp.concatenate([y[None], y + jnp.diag(steps)])
    found = jax.lax.map(lambda y: equations.residual(y)[0], points)
    return ((found[1:] - found[:1]) / steps[:, None]).T
