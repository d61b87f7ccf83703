"""Jacobians by differences, one evaluation of the equations a column."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Probe(eqx.Module):
    """A Jacobian in the making, by differences; the same in all lanes but for its numbers.

    Attributes:
        at: -1: none in the making; 0: the residual itself is evaluated; k: column k.
        residual: at the unknowns.
        columns: found so far, one a row; what is evaluated at other times goes to the last row.
    """

    at: Int[Array, ""]
    residual: Float[Array, " unknowns"]
    columns: Float[Array, "rows unknowns"]

    @classmethod
    def first(cls, size: int, dtype: Any) -> "Probe":
        """Before the first Jacobian."""
        return cls(jnp.array(0), jnp.zeros(size, dtype), jnp.zeros((size + 1, size), dtype))

    def moved(self, y: Float[Array, " unknowns"], equations: Any) -> Float[Array, " unknowns"]:
        """Where the equations are evaluated next."""
        return y + jnp.where(jnp.arange(y.shape[0]) == self.at - 1, equations.probes(y), 0.0)

    def with_column(
        self,
        y: Float[Array, " unknowns"],
        residual: Float[Array, " unknowns"],
        equations: Any,
        wanting: Bool[Array, ""],
    ) -> tuple["Probe", Bool[Array, ""]]:
        """After an evaluation: the next state, and whether the Jacobian is complete.

        Args:
            y: where the Jacobian is wanted.
            residual: found.
            equations: of the step.
            wanting: whether a Jacobian is wanted; never while one is in the making.
        """
        size = residual.shape[0]
        base = jnp.where(self.at == 0, residual, self.residual)
        steps = jnp.append(equations.probes(y), 1.0)
        row = jnp.where(self.at > 0, self.at - 1, size)
        quotient = (residual - base) / steps[row]
        columns = jax.lax.dynamic_update_index_in_dim(self.columns, quotient, row, 0)
        complete = self.at == size
        further = jnp.where((self.at >= 0) & ~complete, self.at + 1, -1)
        return Probe(jnp.where(wanting, 0, further), base, columns), complete


def jacobian_by_differences(
    equations: Any, y: Float[Array, " unknowns"]
) -> Float[Array, "unknowns unknowns"]:
    """The same in one go, where the residual is not evaluated for anything else."""
    steps = equations.probes(y)
    points = jnp.concatenate([y[None], y + jnp.diag(steps)])
    found = jax.lax.map(lambda y: equations.residual(y)[0], points)
    return ((found[1:] - found[:1]) / steps[:, None]).T
