"""Sparse matrices with couplings that are elsewhere in every step: solved by an iteration around the rest."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from natcoord_jax.maths.near_spheres import Pairs

ENOUGH = 1e-6
"""Part of the residual that an iteration may leave: Newton's makes up for it with the next correction."""

MOST = 50
"""Turns of one iteration."""


class NeighbourCouplings(eqx.Module):
    """What things have to do with their neighbours: sums over these of across_i stiffness_ij along_j^T.

    Each has `w` components of displacements and forces.

    Attributes:
        places: unknowns of each; `size` where there is none.
        across: equations of each by the components of the force on it.
        along: components of its displacement by its unknowns.
        pairs: of those that are neighbours.
        stiffness: of each pair, of the first by the displacement of the second, and the other way round.
        size: number of unknowns.
    """

    places: Int[Array, "r n"]
    across: Float[Array, "w r n"]
    along: Float[Array, "w r n"]
    pairs: Pairs
    stiffness: Float[Array, "2 w w p"]
    size: int = eqx.field(static=True)

    def product(self) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
        """The product with vectors, to be taken many times: each has what its neighbours do at hand."""
        others = self.pairs.seated(self.pairs.both[::-1])
        stiffness = self.pairs.seated(jnp.moveaxis(self.stiffness, 0, 2))

        def apply(x: Float[Array, " n"]) -> Float[Array, " n"]:
            own = jnp.concatenate([x, jnp.zeros(1, x.dtype)])[self.places]
            moved = jnp.sum(self.along * own, axis=1)
            forces = jnp.sum(stiffness * moved[:, others], axis=(1, 2))
            found = jnp.sum(self.across * forces[:, None], axis=0)
            return jnp.zeros(self.size + 1, x.dtype).at[self.places].add(found)[:-1]

        return apply

    def transpose(self) -> "NeighbourCouplings":
        """The transposed matrix."""
        turned = jnp.swapaxes(self.stiffness[::-1], 1, 2)
        return NeighbourCouplings(self.places, self.along, self.across, self.pairs, turned, size=self.size)

    def to_dense(self) -> Float[Array, "n n"]:
        """The matrix."""
        return jax.vmap(self.product(), out_axes=1)(jnp.eye(self.size, dtype=self.across.dtype))

    def times(self, factor: float) -> "NeighbourCouplings":
        """Multiplied by a number."""
        return eqx.tree_at(lambda x: x.stiffness, self, factor * self.stiffness)

    def around(self, factors: Any) -> "WithCouplings":
        """Factors of the sum of a matrix and these, from those of the matrix."""
        return WithCouplings(factors, self)


class WithCouplings(eqx.Module):
    """Factors of A, and couplings B: they solve with A + B by an iteration on 1 + A^-1 B.

    Attributes:
        factors: of A.
        couplings: B.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> from natcoord_jax.linsolve.dense import Inverse
        >>> places, maps = jnp.array([[0, 1]]), jnp.zeros((3, 1, 2)).at[0].set(1.0)
        >>> stiffness = jnp.zeros((2, 3, 3, 1)).at[:, 0, 0].set(-0.5)
        >>> seats, none = jnp.array([[0, 1]]), jnp.array([-1, -1])
        >>> pair = Pairs(jnp.array([[0], [1]]), jnp.array([True]), seats, none)
        >>> two = NeighbourCouplings(places, maps, maps, pair, stiffness, size=2)
        >>> two.to_dense().tolist()
        [[0.0, -0.5], [-0.5, 0.0]]
        >>> two.around(Inverse(jnp.eye(2))).solve(jnp.array([0.0, 1.5])).round(5).tolist()
        [1.0, 2.0]
    """

    factors: Any
    couplings: NeighbourCouplings

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for a right-hand side, nearly."""
        product = self.couplings.product()
        return stabilised(lambda x: x + self.factors.solve(product(x)), self.factors.solve(right))

    def transpose(self) -> "WithCouplings":
        """Factors of the transposed matrix."""
        return WithCouplings(self.factors.transpose(), self.couplings.transpose())


def stabilised(apply: Callable[[Array], Array], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution x of apply(x) = right, nearly, of a linear function that is not far from the identity.

    Source: H. A. van der Vorst, Bi-CGSTAB, SIAM J. Sci. Stat. Comput. 13 (1992) 631-644.

    Args:
        apply: the function.
        right: what it is to be; the first guess of the solution, too.
    """
    whole = jnp.sum(right * right)

    def quotient(a: Array, b: Array) -> Array:
        return jnp.where(b != 0, a / jnp.where(b != 0, b, 1.0), 0.0)

    def turn(carry: tuple) -> tuple:
        count, x, r, first, p, along = carry
        image = apply(p)
        step = quotient(along, jnp.sum(first * image))
        s = r - step * image
        t = apply(s)
        second = quotient(jnp.sum(t * s), jnp.sum(t * t))
        x, r = x + step * p + second * s, s - second * t
        following = jnp.sum(first * r)
        kept = quotient(following * step, along * second)
        return count + 1, x, r, first, r + kept * (p - second * image), following

    def going(carry: tuple) -> Array:
        return (carry[0] < MOST) & (jnp.sum(carry[2] ** 2) > ENOUGH**2 * whole)

    begun = right - apply(right)
    start = jnp.zeros((), jnp.int32), right, begun, begun, begun, jnp.sum(begun * begun)
    return jax.lax.while_loop(going, turn, start)[1]
