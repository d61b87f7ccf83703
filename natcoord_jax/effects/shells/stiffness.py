"""The constant matrix of a shell element of four nodes, made once from its shape without stress.

Shear is as at the middles of the edges (Bathe and Dvorkin, Int. J. Numer. Methods Eng. 21, 1985), membrane
stresses have five parameters (Pian and Sumihara, ibid. 20, 1984); the membrane strains that these work on
are those of the surface, or those assumed by Ko, Lee, Lee and Bathe (Comput. Struct. 182, 2017).
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.effects.materials import Sheet
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.vectors import cross

XI, ETA = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
"""Natural coordinates of the nodes."""
MODES = np.stack([XI, ETA, XI * ETA]) / 4.0
"""Derivatives by xi, by eta and mixed ones, from values at the nodes."""
EDGES = ((0, 1), (3, 2), (0, 3), (1, 2))
GAUSS = 1.0 / np.sqrt(3.0)
POINTS = ((-GAUSS, -GAUSS), (GAUSS, -GAUSS), (GAUSS, GAUSS), (-GAUSS, GAUSS))
SHAPES = np.array([(1 + XI * xi) * (1 + ETA * eta) / 4 for xi, eta in POINTS])
"""Shape functions of the nodes at the Gauss points."""


def natural_strains(xi: float, eta: float) -> np.ndarray:
    """Strains xi xi, eta eta and twice xi eta at a point, from changes of the membrane invariants."""
    half = 0.5
    return np.array(
        [[half, 0, half * eta**2, 0, eta, 0], [0, half, half * xi**2, 0, 0, xi], [0, 0, xi * eta, 1, xi, eta]]
    )


def natural_shears(xi: float, eta: float) -> np.ndarray:
    """Shears along xi and eta at a point, from those at the middles of the edges."""
    return 0.5 * np.array([[1 - eta, 1 + eta, 0, 0], [0, 0, 1 - xi, 1 + xi]])


class QuadrilateralSurface:
    """The element's surface without stress: tangents, and Cartesian axes that follow it.

    The first axis is the direction that is given, projected on the surface; without one it is half way
    between the axes that would follow one tangent and those that would follow the other.
    """

    def __init__(self, x: Float[Array, "4 3"], direction: Any = None):
        self.a, self.b, self.c = jnp.asarray(MODES) @ x
        if direction is not None:
            self.along = jnp.asarray(direction)
            return
        one, other = (v / jnp.linalg.norm(v) for v in (self.a, self.b))
        normal = cross(one, other)
        along = one + cross(other, normal / jnp.linalg.norm(normal))
        self.along = along / jnp.linalg.norm(along)

    def at(self, xi: float, eta: float) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
        """Components of the tangents along the axes, and the area per natural area [m^2]."""
        return along_axes(self.a + self.c * eta, self.b + self.c * xi, self.along)


def along_axes(one: Array, other: Array, along: Array) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
    """Components of two tangents along axes in their plane, the first nearest to `along`; their area."""
    normal = cross(one, other)
    area = jnp.linalg.norm(normal)
    normal = normal / area
    first = along - (along @ normal) * normal
    first = first / jnp.linalg.norm(first)
    axes = jnp.stack([first, cross(normal, first)])
    return jnp.stack([one, other]) @ axes.T, area


def cartesian(jacobian: Float[Array, "2 2"]) -> tuple[Float[Array, "3 3"], Float[Array, "2 2"]]:
    """From natural to Cartesian strains and shears."""
    (p, q), (r, s) = jacobian
    inverse = jnp.stack([jnp.stack([s, -q]), jnp.stack([-r, p])]) / (p * s - q * r)
    (p, q), (r, s) = inverse
    rows = [p * p, q * q, p * q], [r * r, s * s, r * s], [2 * p * r, 2 * q * s, p * s + q * r]
    return jnp.stack([jnp.stack(row) for row in rows]), inverse


def assumed_strains(surface: QuadrilateralSurface) -> Callable[[float, float], Array]:
    """What stands in for `natural_strains`: interpolated between the edges and the middle (MITC4+).

    A function of the natural coordinates. The coefficients tell how far the element is from a parallelogram.
    """
    a, b, c = surface.a, surface.b, surface.c
    normal = cross(a, b)
    square = normal @ normal
    along, across = c @ cross(b, normal) / square, c @ cross(normal, a) / square
    scale = along**2 + across**2 - 1.0
    one, two = along * (along - 1) / (2 * scale), along * (along + 1) / (2 * scale)
    three, four = across * (across - 1) / (2 * scale), across * (across + 1) / (2 * scale)
    both = 2 * along * across / scale
    up, down = natural_strains(0.0, 1.0)[0], natural_strains(0.0, -1.0)[0]
    right, left = natural_strains(1.0, 0.0)[1], natural_strains(-1.0, 0.0)[1]
    mixed = natural_strains(0.0, 0.0)[2] / 2

    def at(xi: float, eta: float) -> Array:
        r, s = xi * xi - 1.0, eta * eta - 1.0
        first = 0.5 * (1 + eta + 2 * one * eta**2 - 2 * one) * up
        first = first + 0.5 * (1 - eta + 2 * two * eta**2 - 2 * two) * down
        first = first + s * (three * right + four * left + both * mixed)
        second = 0.5 * (1 + xi + 2 * three * xi**2 - 2 * three) * right
        second = second + 0.5 * (1 - xi + 2 * four * xi**2 - 2 * four) * left
        second = second + r * (one * up + two * down + both * mixed)
        twist = 0.25 * ((xi + 4 * one * xi * eta) * up + (-xi + 4 * two * xi * eta) * down)
        twist = twist + 0.25 * ((eta + 4 * three * xi * eta) * right + (-eta + 4 * four * xi * eta) * left)
        twist = twist + (1 + both * xi * eta) * mixed
        return jnp.stack([first, second, 2 * twist])

    return at


class QuadrilateralMatrices:
    """Integrals over an element.

    Attributes:
        stiffness: second derivatives of the energy by all invariants (16, 16).
        membrane: the same of a sheet that does not bend, by the membrane invariants (6, 6).
        stretching: integrals (3, 6) of the membrane strains by their invariants [1].
    """

    def __init__(self, x: Float[Array, "4 3"], sheet: Sheet, direction: Any, assumed: bool):
        surface = QuadrilateralSurface(x, direction)
        (j1, j2), _ = surface.at(0.0, 0.0)
        points = [(xi, eta, *surface.at(xi, eta)) for xi, eta in POINTS]
        area = sum(p[3] for p in points)
        middle = [sum(p[k] * p[3] for p in points) / area for k in (0, 1)]
        softness, unit = definite_inverse(sheet.membrane), jnp.eye(3)
        bending = sheet.bending - sheet.coupling @ softness @ sheet.coupling
        strains = assumed_strains(surface) if assumed else natural_strains

        def stress(j: Array) -> Array:
            return jnp.stack([j[0] ** 2, j[1] ** 2, j[0] * j[1]])

        # Energy of the resultants n: n.(strain + coupling) - n.softness n / 2, and of bending without them.
        mixed, soft = jnp.zeros((5, 12)), jnp.zeros((5, 5))
        bend, slide = jnp.zeros((6, 6)), jnp.zeros((4, 4))
        self.stretching = jnp.zeros((3, 6))
        for xi, eta, jacobian, weight in points:
            strain, inverse = cartesian(jacobian)
            stretch, curve = strain @ strains(xi, eta), strain @ natural_strains(xi, eta)
            columns = (eta - middle[1]) * stress(j1), (xi - middle[0]) * stress(j2)
            stresses = jnp.concatenate([unit, jnp.stack(columns, axis=1) / area], axis=1)
            whole = jnp.concatenate([stretch, softness @ sheet.coupling @ curve], axis=1)
            mixed = mixed + weight * stresses.T @ whole
            soft = soft + weight * stresses.T @ softness @ stresses
            bend = bend + weight * curve.T @ bending @ curve
            shears = inverse @ natural_shears(xi, eta)
            slide = slide + weight * shears.T @ sheet.shear @ shears
            self.stretching = self.stretching + weight * stretch
        found = jnp.zeros((16, 16)).at[:12, :12].set(mixed.T @ definite_inverse(soft) @ mixed)
        self.stiffness = found.at[6:12, 6:12].add(bend).at[12:, 12:].set(slide)
        self.membrane = self.stiffness[:6, :6]


def overlaps_of(x: Float[Array, "4 3"]) -> Float[Array, "4 4"]:
    """Integrals of the products of the shape functions [m^2]."""
    surface = QuadrilateralSurface(x)
    areas = jnp.stack([surface.at(xi, eta)[1] for xi, eta in POINTS])
    return (jnp.asarray(SHAPES.T) * areas) @ SHAPES


def dot(u: Array, v: Array) -> Array:
    """Product of vectors along the first axis."""
    return jnp.sum(u * v, axis=0)


def derivatives_of(y: Float[Array, "4 3 *n"]) -> list[Float[Array, "3 *n"]]:
    """By xi, by eta and mixed, of what is interpolated between the nodes."""
    return [jnp.sum(row.reshape(4, *(1,) * (y.ndim - 1)) * y, axis=0) for row in MODES]
