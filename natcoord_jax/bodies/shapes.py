"""Solids of uniform density: mass, central inertia, and what to draw."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.numeric import Number, Numbers

LENGTH, LENGTHS = Number("positive"), Numbers((3,), "positive")


AROUND = 32
"""Corners of a circle in a picture."""

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])

Surface = tuple[np.ndarray, list[np.ndarray]]
"""Points, and the numbers of those around each face."""


def _ring(radius: float, height: float) -> Float[np.ndarray, "n 3"]:
    """Points of a circle about the third axis."""
    angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(AROUND, height)], axis=1)


def _mantle(rings: int) -> list[np.ndarray]:
    """Faces between neighbouring rings."""
    here = np.arange(AROUND)
    following = np.roll(here, -1)
    piece = np.stack([here, following, AROUND + following, AROUND + here], axis=1)
    return [AROUND * k + face for k in range(rings - 1) for face in piece]


def _globe() -> Surface:
    """A sphere of radius one, by circles of latitude."""
    angles = np.linspace(0.0, np.pi, AROUND // 2 + 1)
    return np.concatenate([_ring(np.sin(a), -np.cos(a)) for a in angles]), _mantle(len(angles))


class Shape(Part):
    """Base of solids centred at the centre of mass of their body, axes along the body's."""

    makes_arrays: ClassVar[bool] = True

    @abc.abstractmethod
    def volume(self) -> Array:
        """Volume [m^3]."""

    @abc.abstractmethod
    def gyration(self) -> Float[Array, "3"]:
        """Mean squares of the coordinates over the volume [m^2]: diagonal of E / M."""

    @abc.abstractmethod
    def surface(self) -> Surface:
        """Its surface, for pictures: points (n, 3) [m] and the numbers of those around each face."""

    def mass_properties(self, density: Array) -> tuple[Array, Float[Array, "3 3"]]:
        """Mass [kg] and inertia about the centre [kg m^2]."""
        return _mass_properties(self, density)


@eager_numpy
def _mass_properties(shape: Shape, density: Array) -> tuple[Array, Float[Array, "3 3"]]:
    mass = density * shape.volume()
    second = mass * shape.gyration()
    return mass, jnp.diag(jnp.sum(second) - second)


class Box(Shape):
    """Box.

    Attributes:
        size: edge lengths (3,) [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> brick = nc.RigidBody(shape=nc.Box((0.2, 0.1, 0.05)), density=2000.0)
    """

    size: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTHS))

    def volume(self) -> Array:
        """Product of the edges."""
        return jnp.prod(self.size)

    def gyration(self) -> Array:
        """a^2 / 12."""
        return self.size**2 / 12

    def surface(self) -> Surface:
        """Six faces."""
        return 0.5 * np.asarray(self.size) * CORNERS, list(FACES)


class Cylinder(Shape):
    """Circular cylinder along the third body axis.

    Attributes:
        radius: [m].
        length: [m].
    """

    radius: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTH))
    length: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTH))

    def volume(self) -> Array:
        """Pi r^2 l."""
        return jnp.pi * self.radius**2 * self.length

    def gyration(self) -> Array:
        """r^2/4, r^2/4, l^2/12."""
        return jnp.stack([self.radius**2 / 4, self.radius**2 / 4, self.length**2 / 12])

    def surface(self) -> Surface:
        """Two ends, and a mantle of flat pieces."""
        size = np.array([self.radius, self.radius, 0.5 * self.length])
        rings = np.concatenate([_ring(1.0, -1.0), _ring(1.0, 1.0)])
        ends = [np.arange(AROUND), AROUND + np.arange(AROUND)]
        return size * rings, [*ends, *_mantle(2)]


class Sphere(Shape):
    """Sphere.

    Attributes:
        radius: [m].
    """

    radius: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTH))

    def volume(self) -> Array:
        """4/3 pi r^3."""
        return 4 / 3 * jnp.pi * self.radius**3

    def gyration(self) -> Array:
        """r^2 / 5."""
        return jnp.full(3, 1.0) * self.radius**2 / 5

    def surface(self) -> Surface:
        """Flat pieces between circles of latitude."""
        points, faces = _globe()
        return np.asarray(self.radius) * points, faces


class Ellipsoid(Shape):
    """Ellipsoid.

    Attributes:
        semi_axes: along the axes of the body (3,) [m].
    """

    semi_axes: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTHS))

    def volume(self) -> Array:
        """4/3 pi a b c."""
        return 4 / 3 * jnp.pi * jnp.prod(self.semi_axes)

    def gyration(self) -> Array:
        """a^2 / 5."""
        return self.semi_axes**2 / 5

    def surface(self) -> Surface:
        """That of a sphere, stretched."""
        points, faces = _globe()
        return np.asarray(self.semi_axes) * points, faces


class Capsule(Shape):
    """Cylinder along the third body axis with half a sphere at each end.

    Attributes:
        radius: of the cylinder and the spheres [m].
        length: of the cylinder, from centre to centre of the spheres [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> link = nc.RigidBody(shape=nc.Capsule(radius=0.03, length=0.2), density=1000.0)
    """

    radius: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTH))
    length: Array = eqx.field(converter=lambda x: as_array(x, float), metadata=is_a(LENGTH))

    def volume(self) -> Array:
        """Pi r^2 (l + 4/3 r)."""
        return jnp.pi * self.radius**2 * (self.length + 4 / 3 * self.radius)

    def gyration(self) -> Array:
        """Of the cylinder and of two half spheres, 3/8 r beyond its ends."""
        r, half = self.radius, self.length / 2
        middle, ends = jnp.pi * r**2 * self.length, 4 / 3 * jnp.pi * r**3
        across = middle * r**2 / 4 + ends * r**2 / 5
        # About the flat side of a half sphere the mean square along the axis is r^2/5, as of the whole.
        along = middle * half**2 / 3 + ends * (r**2 / 5 + half**2 + 3 / 4 * r * half)
        return jnp.stack([across, across, along]) / (middle + ends)

    def surface(self) -> Surface:
        """A globe whose halves are moved apart."""
        points, faces = _globe()
        shift = 0.5 * np.asarray(self.length) * np.sign(np.round(points[:, 2], 12))
        return np.asarray(self.radius) * points + shift[:, None] * np.array([0.0, 0.0, 1.0]), faces


class Placed(eqx.Module):
    """A shape where it is in its body, for pictures.

    Attributes:
        shape: centred at
        centre: from the reference point, in body axes [m].
    """

    shape: Shape
    centre: Float[Array, "3"]

    def surface(self) -> Surface:
        """Points from the reference point of the body [m], and faces."""
        points, faces = self.shape.surface()
        return points + np.asarray(self.centre), faces
