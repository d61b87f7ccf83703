"""Corrections of a linear system that make use of those before them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Directions(eqx.Module):
    """Moves of the last corrections and their images, which are orthonormal; 0 where there is none.

    What the residual has along the images is taken away by the moves; only the rest is left to the
    approximate inverse. So a matrix that differs from the one at hand by a small rank is solved with in a few
    corrections, however large the difference is.

    Source: S. C. Eisenstat, H. C. Elman and M. H. Schultz, Variational iterative methods for nonsymmetric
    systems of linear equations, SIAM J. Numer. Anal. 20 (1983) 345-357 (truncated conjugate residuals).
    """

    moves: Float[Array, "memory n"]
    images: Float[Array, "memory n"]

    @classmethod
    def none(cls, memory: int, like: Float[Array, " n"]) -> "Directions":
        """Room for so many."""
        nothing = jnp.zeros((memory, *like.shape), like.dtype)
        return cls(nothing, nothing)

    def followed_by(
        self,
        move: Float[Array, " n"],
        image: Float[Array, " n"],
        weights: Float[Array, " n"],
        telling: Bool[Array, ""],
    ) -> "Directions":
        """With one more in the place of the oldest, if it tells.

        Args:
            move: correction that was made.
            image: the matrix times that.
            weights: of the squares of the entries of images.
            telling: whether it is more than rounding.
        """
        for _ in range(2):  # The second time for what rounding has left.
            along = self._along(image, weights)
            image, move = image - along @ self.images, move - along @ self.moves
        square = jnp.sum(weights * image**2)
        telling = telling & (square > 0)
        scale = jnp.where(telling, 1.0, 0.0) / jnp.sqrt(jnp.where(telling, square, 1.0))
        found = (
            jnp.where(telling, jnp.concatenate([new[None] * scale, old[:-1]]), old)
            for new, old in ((move, self.moves), (image, self.images))
        )
        return Directions(*found)

    def correction(
        self, solver, residual: Float[Array, " n"], weights: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The next correction, with the approximate inverse of a solver."""
        move = jnp.zeros_like(residual)
        for _ in range(2):
            along = self._along(residual, weights)
            residual, move = residual - along @ self.images, move + along @ self.moves
        return solver.solve(residual) + move

    def _along(self, image: Float[Array, " n"], weights: Float[Array, " n"]) -> Float[Array, " memory"]:
        return jnp.sum(self.images * (weights * image), axis=1)
