"""Rigid bodies and point masses from the usual data."""

from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.shapes import Placed, Shape
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.bodies import POINT, TRIAD, Body, mass_block
from natcoord_jax.core.checks import as_array, as_kind, numbers, positive, shape_of
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.inertia import possible, tensor, to_second_moment
from natcoord_jax.core.kinds import NAME, Choice, Kind, is_other, of
from natcoord_jax.core.numeric import COMPONENTS, Directions, Number, Numbers, Rotations
from natcoord_jax.maths.rotations import from_axis_angle, from_quaternion

MASS, TENSOR = Number("positive"), Numbers((3,)) | Numbers((3, 3))

_from_axis_angle, _from_quaternion = eager_numpy(from_axis_angle), eager_numpy(from_quaternion)


def orientation(value: Any, label: str) -> Float[Array, "3 3"]:
    """Rotation matrix from a matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad]).

    Raises:
        ValueError: if it is none of these, a matrix that is no rotation, or a zero quaternion or axis.
    """
    what = f"{label}: orientation"
    if value is None:
        return as_array(np.eye(3))
    if isinstance(value, tuple) and len(value) == 2 and shape_of(value[0]) == (3,):
        axis = as_kind(value[0], Directions(), f"{what} axis", "-")
        return _from_axis_angle(axis, numbers(value[1], (), f"{what} angle", "rad"))
    if shape_of(value) == (4,):
        return _from_quaternion(as_kind(value, Directions((4,)), f"{what} quaternion", "-"))
    return as_kind(value, Rotations(), f"{what} matrix", "-")


class Orientation(Kind):
    """A rotation in one of three forms; `orientation` looks at its numbers."""

    wanted = "a rotation matrix, a quaternion (w, x, y, z) or a pair (axis, angle [rad])"

    def complaint(self, value: Any) -> str | None:
        """Whether it has the shape of one."""
        pair = isinstance(value, tuple) and len(value) == 2 and shape_of(value[0]) == (3,)
        shape = None if isinstance(value, str) else shape_of(value)
        return None if pair or shape in ((4,), (3, 3)) else is_other(value)


@checked()
def RigidBody(
    *,
    mass: Annotated[Any, MASS] = None,
    inertia: Annotated[Any, TENSOR] = None,
    second_moment: Annotated[Any, TENSOR] = None,
    com: Annotated[Any, COMPONENTS] = (0.0, 0.0, 0.0),
    inertia_at: Annotated[str, Choice(("com", "reference"))] = "com",
    shape: Annotated[
        Shape | None, of("nc.Box(...), nc.Cylinder(...), nc.Sphere(...) or nc.Ellipsoid(...)", Shape)
    ] = None,
    density: Annotated[Any, MASS] = None,
    position: Annotated[Any, COMPONENTS] = (0.0, 0.0, 0.0),
    orientation: Annotated[Any, Orientation()] = None,
    velocity: Annotated[Any, COMPONENTS] = (0.0, 0.0, 0.0),
    angular_velocity: Annotated[Any, COMPONENTS] = (0.0, 0.0, 0.0),
    name: Annotated[str | None, NAME] = None,
) -> Body:
    """Rigid body.

    Give mass with `inertia` or `second_moment`, or a `shape` with `density`.

    Args:
        mass: [kg].
        inertia: inertia tensor (3, 3) or its diagonal (3,), in body axes [kg m^2]. Zero along one axis: an
            ideal rod, which needs joints that fix its spin. Rounding to three digits is allowed for: a
            principal inertia may exceed the sum of the other two by 5e-3 of the largest second moment.
        second_moment: E^ij (3, 3) or its diagonal about the reference point, instead of
            `inertia` (14) [kg m^2].
        com: centre of mass, from the reference point in body axes [m].
        inertia_at: the point `inertia` refers to: "com" or "reference".
        shape: a solid of uniform density centred at `com`; gives mass and inertia, and is drawn.
        density: of the shape [kg/m^3].
        position: of the reference point in the world [m].
        orientation: of the body axes: rotation matrix, quaternion (w, x, y, z) or (axis, angle [rad]).
        velocity: of the reference point [m/s].
        angular_velocity: world components [rad/s].
        name: unique name; default "body 1", "body 2", ...

    Raises:
        ValueError: for single precision, a non-positive mass, an inertia that no body can have, numbers
            that are not finite, or contradicting data; naming body, quantity, unit and remedy.

    Example:
        >>> import natcoord_jax as nc
        >>> body = nc.RigidBody(mass=2.0, inertia=(0.1, 0.2, 0.25), com=(0, 0, 0.3), name="arm")
        >>> body.mass_block.shape
        (4, 4)
    """
    label = f"RigidBody {name!r}" if name else "RigidBody"
    centre = numbers(com, (3,), f"{label}: com", "m")
    if shape is not None and density is not None:
        if mass is not None or inertia is not None or second_moment is not None:
            raise ValueError(f"{label}: give either shape and density [kg/m^3], or mass [kg] and inertia")
        mass, about_com = shape.mass_properties(positive(density, f"{label}: density", "kg/m^3"))
        central = to_second_moment(about_com)
        moment = _shifted(central, mass, centre)
    else:
        if mass is None or (inertia is None) == (second_moment is None):
            raise ValueError(
                f"{label}: give mass [kg] with one of inertia and second_moment [kg m^2], "
                "or shape and density [kg/m^3]"
            )
        mass = positive(mass, f"{label}: mass", "kg")
        if inertia is not None:
            moment = to_second_moment(tensor(inertia, f"{label}: inertia"))
            moment = _shifted(moment, mass, centre) if inertia_at == "com" else moment
        else:
            moment = tensor(second_moment, f"{label}: second_moment")
        given = "inertia" if inertia is not None else "second_moment"
        central = _shifted(moment, -mass, centre)
        about = central if inertia_at == "com" and inertia is not None else moment
        moment = possible(moment, central, about, label, given)
    return Body(
        mass_block(mass, centre, moment),
        numbers(position, (3,), f"{label}: position", "m"),
        _orientation(orientation, label),
        numbers(velocity, (3,), f"{label}: velocity", "m/s"),
        numbers(angular_velocity, (3,), f"{label}: angular_velocity", "rad/s"),
        TRIAD,
        None if shape is None else Placed(shape, centre),
        name,
    )


_orientation = orientation


@eager_numpy
def _shifted(moment: Float[Array, "3 3"], mass: Float[Array, ""], by: Float[Array, "3"]) -> Array:
    """Second moment about a point from which the centre of mass is at `by`; with minus the mass back."""
    return moment + mass * jnp.outer(by, by)


@checked(mass=MASS, position=COMPONENTS, velocity=COMPONENTS, name=NAME)
def PointMass(
    *, mass: Any, position: Any = (0.0, 0.0, 0.0), velocity: Any = (0.0, 0.0, 0.0), name: str | None = None
) -> Body:
    """Point mass: three degrees of freedom; joins others by spherical and distance joints and springs.

    Its directors are carried along without mass and do not turn.

    Args:
        mass: [kg].
        position: [m].
        velocity: [m/s].
        name: unique name.

    Raises:
        ValueError: for a non-positive mass or numbers that are not finite.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.PointMass(mass=1.0, position=(1, 0, 0)).oriented
        False
    """
    label = f"PointMass {name!r}" if name else "PointMass"
    mass, nothing = positive(mass, f"{label}: mass", "kg"), as_array(np.zeros(3))
    return Body(
        mass_block(mass, nothing, as_array(np.zeros((3, 3)))),
        numbers(position, (3,), f"{label}: position", "m"),
        as_array(np.eye(3)),
        numbers(velocity, (3,), f"{label}: velocity", "m/s"),
        nothing,
        POINT,
        None,
        name,
    )
