"""Pressure on the surfaces of shells and solids, flat and curved, as it follows them."""

from functools import lru_cache
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.cells import CELLS, Cell, shapes
from natcoord_jax.core.force import Force, Load
from natcoord_jax.core.kinds import FunctionOf
from natcoord_jax.core.markers import Markers
from natcoord_jax.core.numeric import Number
from natcoord_jax.maths.vectors import cross

XI, ETA = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the corners."""


def follower_loads(x: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Integrals of the shape functions times the normal of a quadrilateral [m^2], exact for a bilinear one.

    With phi_xi = a + c eta and phi_eta = b + c xi the normal is a x b + xi a x c + eta c x b, and the shape
    functions are (1 + xi_A xi) (1 + eta_A eta) / 4.
    """
    a, b, c = (0.25 * jnp.asarray(signs) @ x for signs in (XI, ETA, XI * ETA))
    across, one, other = cross(a, b), cross(a, c), cross(c, b)
    return across + (jnp.asarray(XI)[:, None] * one + jnp.asarray(ETA)[:, None] * other) / 3.0


class FacePressure(Force):
    """A pressure on a quadrilateral between four points, normal to it wherever it moves.

    Of a closed surface the forces and their moments cancel, at every step (the forces are those of the
    middle of the step).

    Attributes:
        markers: the corners in turn; the pressure pushes to the side from which they are seen clockwise, that
            is against the normal of a face of a solid, and against the directors of a shell.
        pressure: [N/m^2], or a function of time [s] to it.

    Example:
        >>> import natcoord_jax as nc
        >>> corners = tuple(nc.Point(nc.ground, x) for x in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)))
        >>> wind = nc.FacePressure(corners, pressure=500.0)
    """

    markers: Any = eqx.field(metadata=is_a(Markers(4)))
    pressure: Any = eqx.field(
        kw_only=True, metadata=is_a(Number() | FunctionOf("of time [s] to the pressure"))
    )

    kind: ClassVar[str] = "face pressure"

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> Load:
        """Against the normal."""
        pressure: Any = self.pressure(t) if callable(self.pressure) else self.pressure
        return Load(-pressure * follower_loads(x), None)


CELL_OF_FACE = {6: 10, 8: 20, 9: 27}
"""Nodes of the cell that has faces of so many nodes."""


@lru_cache
def face_table(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shape functions (g, k) of a face of so many nodes, derivatives (g, k, 2), and weights."""
    whole = CELLS[CELL_OF_FACE[count]]
    # The face z = 0 of a tetrahedron, or z = 1 of a hexahedron, and its polynomials.
    face = np.array(whole.faces[0 if count == 6 else 1])
    face = face[[0, 2, 1, 5, 4, 3]] if count == 6 else face
    powers = tuple(p for p in whole.powers if p[2] == 0)
    cell = Cell("faces", whole.nodes[face] * np.array([1.0, 1.0, 0.0]), (), powers)
    if count == 6:
        points, weights = _on_triangle()
    else:
        x, w = np.polynomial.legendre.leggauss(3)
        points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
        weights = np.outer(w, w).reshape(-1)
    values, slopes = shapes(cell, np.pad(points, ((0, 0), (0, 1))))
    return values, slopes[:, :, :2], weights


def _on_triangle() -> tuple[np.ndarray, np.ndarray]:
    """Nine points, exact to the fourth degree: those of a square, two corners of which are drawn together."""
    x, w = np.polynomial.legendre.leggauss(3)
    u, v = (a.reshape(-1) for a in np.meshgrid(0.5 * (x + 1), 0.5 * (x + 1), indexing="ij"))
    weights = 0.25 * np.outer(w, w).reshape(-1) * (1 - u)
    return np.stack([u, v * (1 - u)], axis=1), weights


class CurvedFacePressure(Force):
    """Base of pressures on faces of quadratic elements; a subclass says of how many nodes.

    Of a closed surface the forces and their moments cancel, at every step.

    Attributes:
        markers: corners in turn as seen from outside, middles of the edges, the middle; the pressure pushes
            inwards.
        pressure: [N/m^2], or a function of time [s] to it.

    Class attributes:
        count: number of nodes.
    """

    markers: Any = eqx.field(metadata=is_a(Markers()))
    pressure: Any = eqx.field(
        kw_only=True, metadata=is_a(Number() | FunctionOf("of time [s] to the pressure"))
    )

    count: ClassVar[int]

    def load(self, x: Float[Array, "k 3"], rate: Array, inputs: Array, t: Array) -> Load:
        """Against the normal, by the shape functions."""
        pressure: Any = self.pressure(t) if callable(self.pressure) else self.pressure
        values, slopes, weights = face_table(self.count)
        one, other = (jnp.einsum("gk,kx->gx", slopes[:, :, axis], x) for axis in (0, 1))
        return Load(-pressure * (values.T @ (weights[:, None] * cross(one, other))), None)


class FacePressure6(CurvedFacePressure):
    """A pressure on a triangle of six points, as a face of `nc.Tetrahedron10` is.

    Attributes:
        markers: as of `nc.mesh.Mesh.faces`; the pressure pushes inwards.
        pressure: [N/m^2], or a function of time [s] to it.

    Example:
        >>> import natcoord_jax as nc
        >>> points = tuple(nc.Point(nc.ground, (x, 0.0, 0.0)) for x in range(6))
        >>> wind = nc.FacePressure6(points, pressure=500.0)
    """

    kind: ClassVar[str] = "pressure on six points"
    count: ClassVar[int] = 6


class FacePressure8(CurvedFacePressure):
    """A pressure on a quadrilateral of eight points, as a face of `nc.Hexahedron20` is.

    Its fields are those of `nc.FacePressure6`, the pressure in [N/m^2].
    """

    kind: ClassVar[str] = "pressure on eight points"
    count: ClassVar[int] = 8


class FacePressure9(CurvedFacePressure):
    """A pressure on a quadrilateral of nine points, as a face of `nc.Hexahedron27` is.

    Its fields are those of `nc.FacePressure6`, the pressure in [N/m^2].
    """

    kind: ClassVar[str] = "pressure on nine points"
    count: ClassVar[int] = 9
