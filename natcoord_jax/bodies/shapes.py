"""Solids of uniform density: mass, central inertia, and what to draw."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.host import on_host


class Shape(eqx.Module):
    """Base of solids centred at the centre of mass of their body, axes along the body's."""

    @abc.abstractmethod
    def volume(self) -> Array:
        """Volume [m^3]."""

    @abc.abstractmethod
    def gyration(self) -> Float[Array, "3"]:
        """Mean squares of the coordinates over the volume [m^2]: diagonal of E / M."""

    def mass_properties(self, density: Array) -> tuple[Array, Float[Array, "3 3"]]:
        """Mass [kg] and inertia about the centre [kg m^2]."""
        return _mass_properties(self, density)


@on_host
def _mass_properties(shape: Shape, density: Array) -> tuple[Array, Float[Array, "3 3"]]:
    mass = density * shape.volume()
    second = mass * shape.gyration()
    return mass, jnp.diag(jnp.sum(second) - second)


class Box(Shape):
    """Box with edge lengths `size` (3,) [m].

    Example:
        >>> import natcoord_jax as nc
        >>> brick = nc.RigidBody(shape=nc.Box((0.2, 0.1, 0.05)), density=2000.0)
    """

    size: Array = eqx.field(converter=lambda x: as_array(x, float))

    def volume(self) -> Array:
        """Product of the edges."""
        return jnp.prod(self.size)

    def gyration(self) -> Array:
        """a^2 / 12."""
        return self.size**2 / 12


class Cylinder(Shape):
    """Circular cylinder along the third body axis, `radius` and `length` [m]."""

    radius: Array = eqx.field(converter=lambda x: as_array(x, float))
    length: Array = eqx.field(converter=lambda x: as_array(x, float))

    def volume(self) -> Array:
        """Pi r^2 l."""
        return jnp.pi * self.radius**2 * self.length

    def gyration(self) -> Array:
        """r^2/4, r^2/4, l^2/12."""
        return jnp.stack([self.radius**2 / 4, self.radius**2 / 4, self.length**2 / 12])


class Sphere(Shape):
    """Sphere of `radius` [m]."""

    radius: Array = eqx.field(converter=lambda x: as_array(x, float))

    def volume(self) -> Array:
        """4/3 pi r^3."""
        return 4 / 3 * jnp.pi * self.radius**3

    def gyration(self) -> Array:
        """r^2 / 5."""
        return jnp.full(3, 1.0) * self.radius**2 / 5


class Ellipsoid(Shape):
    """Ellipsoid with semi-axes `semi_axes` (3,) [m]."""

    semi_axes: Array = eqx.field(converter=lambda x: as_array(x, float))

    def volume(self) -> Array:
        """4/3 pi a b c."""
        return 4 / 3 * jnp.pi * jnp.prod(self.semi_axes)

    def gyration(self) -> Array:
        """a^2 / 5."""
        return self.semi_axes**2 / 5
