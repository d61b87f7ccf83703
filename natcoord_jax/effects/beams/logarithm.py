"""Derivatives of the work that given resultants do on the logarithm of a relative motion, in formulas.

With k = 2 tan(angle/2) n, x = |k|^2 / 4 and the place s, the logarithm is the turn a k and the shift
s - a k x s / 2 + b k x (k x s), with a(x) = f_0 and b(x) = f_1 / 4 of `arctan_coefficients`. Moments m on the
turn and forces n on the shift do the work

    a q . k + b [(n . k)(k . s) - |k|^2 n . s] + n . s,    q = m - s x n / 2,

whose gradient is that of any energy of turn and shift with these resultants.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.maths.components import Triple, rows_of
from natcoord_jax.maths.rotations import arctan_coefficients
from natcoord_jax.maths.vectors import quotient
from natcoord_jax.xla.materialise import materialised


class Logarithm(eqx.Module):
    """A relative motion and its logarithm.

    Attributes:
        k: 2 tan(angle/2) times the axis.
        place: s [m].
        per_axial: dk / d(axial part) = 2 / (1 + trace).
        coefficients: a, b and their first derivatives by x.
        second: second derivatives of a and b.
        turn: rotation vector [rad].
        shift: [m].
    """

    k: Triple
    place: Triple
    per_axial: Float[Array, "*n"]
    coefficients: tuple[Array, Array, Array, Array]
    second: tuple[Array, Array]
    turn: Triple
    shift: Triple

    @classmethod
    def of(cls, invariants: Float[Array, "7 *n"]) -> "Logarithm":
        """Of axial part and trace of the relative rotation and the relative place."""
        axial, trace, place = Triple.of(invariants[:3]), invariants[3], Triple.of(invariants[4:])
        factor = quotient(2.0 * jnp.ones_like(trace), 1.0 + trace)
        k = axial * factor
        k, place, factor = materialised((k, place, factor))
        x = materialised(0.25 * k.dot(k))
        (f0, f1, f2), (_, _, slope) = jax.jvp(arctan_coefficients, (x,), (jnp.ones_like(x),))
        f0, f1, f2, slope = materialised((f0, f1, f2, slope))
        near = 1.0 / (1.0 + x)
        first, middle = 0.5 * (f1 - near), 0.5 * (3.0 * f2 - near)
        coefficients = f0, 0.25 * f1, first, 0.25 * middle
        second = 0.5 * (middle + near * near), 0.125 * (3.0 * slope + near * near)
        turn, shift = materialised(_logarithm(k, place, f0, 0.25 * f1))
        coefficients, second = materialised((coefficients, second))
        return cls(k, place, factor, coefficients, second, turn, shift)

    def gradient(self, resultants: Float[Array, "6 *n"]) -> Float[Array, "7 *n"]:
        """Gradient by the invariants of the work of forces and moments."""
        force, moment = Triple.of(resultants[:3]), Triple.of(resultants[3:])
        by_k, by_place = _work_gradient(self.k, *self.coefficients, self.place, force, moment)
        return rows_of(*self._by_rotation(by_k), by_place)

    def _by_rotation(self, by_k: Triple) -> tuple[Triple, Any]:
        """Derivatives by axial part and trace from those by k = 2 axial / (1 + trace)."""
        return by_k * self.per_axial, -0.5 * self.per_axial * self.k.dot(by_k)

    def _along(self, function: Any, dk: Triple) -> Any:
        """Change of a function of k and the coefficients for a change of k."""
        dx = 0.5 * self.k.dot(dk)
        changes = (self.coefficients[2], self.coefficients[3], *self.second)
        return jax.jvp(function, (self.k, *self.coefficients), (dk, *(c * dx for c in changes)))[1]

    def hessian(
        self, resultants: Float[Array, "6 *n"], moduli: Float[Array, "6 6 *n"]
    ) -> Float[Array, "7 7 *n"]:
        """Second derivatives by the invariants of an energy of shift and turn.

        Args:
            resultants: its gradient.
            moduli: its second derivatives.
        """
        force, moment = Triple.of(resultants[:3]), Triple.of(resultants[3:])
        like = jnp.zeros_like(self.k.x)

        def by_k(unit: Array) -> tuple[Array, Array]:
            def rows(k: Triple, a: Array, b: Array, a1: Array, b1: Array) -> tuple[Array, Array]:
                turn, shift = _logarithm(k, self.place, a, b)
                gradient = _work_gradient(k, a, b, a1, b1, self.place, force, moment)
                return rows_of(shift, turn), rows_of(*gradient)

            return self._along(rows, Triple(unit[0] + like, unit[1] + like, unit[2] + like))

        def by_place(unit: Array) -> Array:
            a, b = self.coefficients[:2]
            moved = Triple(unit[0] + like, unit[1] + like, unit[2] + like)
            turn, shift = _logarithm(self.k, moved, a, b)
            return rows_of(shift, turn * 0.0)

        units = jnp.eye(3, dtype=like.dtype)
        turned, work = materialised(jax.vmap(by_k)(units))
        columns = materialised(jnp.concatenate([turned, jax.vmap(by_place)(units)]))
        pulled = materialised(jnp.sum(moduli[None] * columns[:, None], axis=2))
        both = materialised(jnp.sum(columns[:, None] * pulled[None], axis=2))
        mixed = jnp.swapaxes(work[:, 3:], 0, 1)
        lower = jnp.concatenate([mixed, jnp.zeros_like(mixed)], axis=1)
        gradient = _work_gradient(self.k, *self.coefficients, self.place, force, moment)[0]
        return self._in_invariants(both + jnp.concatenate([work, lower]), gradient)

    def _in_invariants(self, both: Float[Array, "6 6 *n"], gradient: Triple) -> Float[Array, "7 7 *n"]:
        """Second derivatives by the invariants from those by k and s, and the gradient by k."""
        g, k = self.per_axial, rows_of(self.k)

        def spread(x: Float[Array, "r 6 *n"]) -> Float[Array, "r 7 *n"]:
            along = jnp.sum(k * x[:, :3], axis=1, keepdims=True)
            return jnp.concatenate([g * x[:, :3], -0.5 * g * along, x[:, 3:]], axis=1)

        square = spread(materialised(jnp.swapaxes(spread(materialised(both)), 0, 1)))
        # The second derivatives of k by axial part and trace, times the gradient.
        zero = jnp.zeros_like(g)
        half = -0.25 * g * g * gradient.dot(self.k)
        bent = rows_of(gradient * (-0.5 * g * g), -half, zero, zero, zero)
        at_trace = (np.arange(7) == 3).reshape(7, *(1,) * g.ndim) * 1.0
        return square + bent[:, None] * at_trace + at_trace[:, None] * bent


def _logarithm(k: Triple, place: Triple, a: Any, b: Any) -> tuple[Triple, Triple]:
    across = k.cross(place)
    return k * a, place - across * (0.5 * a) + k.cross(across) * b


def _work_gradient(
    k: Triple, a: Any, b: Any, a1: Any, b1: Any, place: Triple, force: Triple, moment: Triple
) -> tuple[Triple, Triple]:
    """Gradient of the work by k and by the place, at given resultants."""
    q = moment - place.cross(force) * 0.5
    along, shared, square = force.dot(k), k.dot(place), k.dot(k)
    work = force.dot(place)
    bracket = along * shared - square * work
    by_k = q * a + k * (0.5 * (a1 * q.dot(k) + b1 * bracket) - 2.0 * b * work)
    by_k = by_k + (force * shared + place * along) * b
    by_place = force * (1.0 - b * square) - force.cross(k) * (0.5 * a) + k * (b * along)
    return by_k, by_place
