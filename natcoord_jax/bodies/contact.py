"""Contact of bodies with shapes, planes, and the nodes of shells and solids: which gaps it is made of."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from natcoord_jax.bodies.continua import MeshHandle
from natcoord_jax.bodies.shapes import CORNERS, Box, Capsule, Ellipsoid, Shape, Sphere
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.bodies import Body
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import stacked
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.kinds import BODY, NAME, Choice, HandleOf, of
from natcoord_jax.core.markers import Direction, Marker, Point
from natcoord_jax.core.numeric import COMPONENTS, Directions, Number
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.contact import (
    CapsuleOnCapsule,
    EllipsoidOnPlane,
    Gap,
    GapConstraint,
    GapPotential,
    SphereOnBox,
    SphereOnPlane,
    SphereOnSphere,
)


class Plane(Part):
    """A plane that is part of a body, or of the ground: what is behind it overlaps with it.

    Attributes:
        normal: towards what it is in contact with, in the world axes of the assembled pose [-].
        point: any point of it in the assembled pose [m].
        body: handle of the body.

    Example:
        >>> import natcoord_jax as nc
        >>> floor = nc.Plane(normal=(0, 0, 1))
    """

    normal: Any = eqx.field(default=(0.0, 0.0, 1.0), kw_only=True, metadata=is_a(Directions()))
    point: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    body: Handle = eqx.field(default=ground, kw_only=True, static=True, metadata=is_a(BODY))

    def markers(self) -> tuple[Marker, Marker]:
        """A point and the unit normal."""
        normal = as_array(self.normal, float)
        unit = normal / np.linalg.norm(normal) if is_concrete(normal) else normal / _size(normal)
        return Point(self.body, self.point), Direction(self.body, unit)


def _size(vector: Array) -> Array:
    return (vector @ vector) ** 0.5


SHARED = 1e-9
"""Compliance of contacts with several gaps, which may depend on each other."""

SOLID = HandleOf("body") | of(
    "what scene.add(nc.Shell(...)) or scene.add(nc.Solid(...)) returned", MeshHandle
)
SIDE = SOLID | of("nc.Plane(...)", Plane)


@dataclass(frozen=True)
class _Solid:
    """A shape on a body: what it is, and its markers in the axes of the body."""

    handle: Handle
    shape: Shape | None
    centre: Any

    def point(self, place: Any = (0.0, 0.0, 0.0)) -> Marker:
        """A point of it, from its centre."""
        return Point(self.handle, self.centre + as_array(place, float), local=True)

    def axes(self) -> tuple[Marker, ...]:
        """Its own."""
        return tuple(Direction(self.handle, axis, local=True) for axis in np.eye(3))

    @property
    def radius(self) -> Any:
        """Of a sphere or a capsule; of a point zero."""
        shape: Any = self.shape
        return 0.0 if shape is None else shape.radius

    def ends(self) -> tuple[Marker, Marker]:
        """Of the segment that a capsule is round, or twice the centre of a sphere."""
        half = 0.5 * self.shape.length if isinstance(self.shape, Capsule) else 0.0
        return self.point((0.0, 0.0, -half)), self.point((0.0, 0.0, half))


Pair = tuple[Gap, tuple[Marker, ...]]
"""A gap, and what it is of."""


def _on_plane(solid: _Solid, plane: Plane) -> list[Pair]:
    """A solid on a plane."""
    table, shape = plane.markers(), solid.shape
    if isinstance(shape, Box):
        corners = (0.5 * shape.size * corner for corner in CORNERS)
        return [(SphereOnPlane(), (*table, solid.point(corner))) for corner in corners]
    if isinstance(shape, Capsule):
        return [(SphereOnPlane(radius=shape.radius), (*table, end)) for end in solid.ends()]
    if isinstance(shape, Ellipsoid):
        markers = (*table, solid.point(), *solid.axes())
        return [(EllipsoidOnPlane(semi_axes=shape.semi_axes), markers)]
    return [(SphereOnPlane(radius=solid.radius), (*table, solid.point()))]


def _between(one: _Solid, other: _Solid) -> list[Pair] | None:
    """Two solids; None: there is no gap for them."""
    if isinstance(other.shape, Box) and not isinstance(one.shape, Box):
        return _between(other, one)
    if isinstance(one.shape, Box):
        if other.shape is not None and not isinstance(other.shape, Sphere):
            return None
        markers = one.point(), other.point(), *one.axes()
        return [(SphereOnBox(size=one.shape.size, radius=other.radius), markers)]
    if any(isinstance(s.shape, Ellipsoid) for s in (one, other)):
        return None
    radii = stacked([as_array(s.radius, float) for s in (one, other)])
    if isinstance(one.shape, Capsule) or isinstance(other.shape, Capsule):
        return [(CapsuleOnCapsule(radii=radii), (*one.ends(), *other.ends()))]
    return [(SphereOnSphere(radii=radii), (one.point(), other.point()))]


SHAPES = "nc.Sphere, nc.Capsule, nc.Box, nc.Ellipsoid or a point"


class Contact(Recipe):
    """Contact of a body with a plane or with another body, without friction.

    The surfaces may overlap a little: an energy of the overlap pushes them apart. At an impact of speed v a
    mass m goes v sqrt(m / stiffness) deep, whatever the step; a contact lasts pi sqrt(m / stiffness), and for
    rebounds and gradients that are good to 5 % it wants six steps of that. Energy, momentum and angular
    momentum are exact, at impacts of any number of bodies, too.

    There are gaps for spheres, capsules, boxes (by their corners), ellipsoids, points and the nodes of shells
    and solids on planes; for spheres and capsules on each other and on points and nodes; for spheres and
    points on boxes. A shell or a solid is touched at its nodes only: what is smaller than its cells slips
    through. Where a step is longer than a body, it may pass another without ever overlapping with it.

    Attributes:
        one: handle of a body with a shape, of a point mass or a node, or of a shell or a solid.
        other: `nc.Plane`, or another handle of that kind.
        stiffness: k [N/m] of each contact: of each corner of a box on a plane, of each node; with law="hertz"
            [N/m^1.5], for spheres 4/3 E* sqrt(R).
        restitution: part of the closing speed that is left after an impact [-], where no other force acts
            (weight in a soft contact takes some more of it); None: nothing is lost.
        speed: of the impact that `restitution` is of [m/s]; less is lost of slower ones.
        law: force proportional to the overlap, "linear", or to its power 3/2, "hertz".
        name: of the contact; several gaps are called "name[0]" and so on.

    Raises:
        ValueError: when it is added: for shapes that there is no gap for.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity())
        >>> ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.03), density=400.0, position=(0, 0, 0.5)))
        >>> bounce = scene.add(nc.Contact(ball, nc.Plane(normal=(0, 0, 1)), stiffness=5e3))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=1e-3, steps=500)
        >>> float(nc.balance(system, trajectory).energy.max()) < 1e-12
        True
    """

    one: Handle = eqx.field(static=True, metadata=is_a(SOLID))
    other: Any = eqx.field(metadata=is_a(SIDE))
    stiffness: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    restitution: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    friction: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    speed: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    law: str = eqx.field(
        default="linear", kw_only=True, static=True, metadata=is_a(Choice(("linear", "hertz")))
    )
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "contact"

    def add_to(self, scene: Builder, name: str) -> tuple[Handle, ...]:
        """Add its gaps; their handles."""
        plane = self.other.body if isinstance(self.other, Plane) else self.other
        if self.one == plane:
            raise ValueError(f"contact {name!r}: {self.one.name!r} would be in contact with itself")
        solids = self._solids(scene, self.one, name)
        pairs = [pair for solid in solids for pair in self._pairs(scene, solid, name)]
        named = (name if len(pairs) == 1 else f"{name}[{k}]" for k in range(len(pairs)))
        several = len(pairs) > 1
        return tuple(
            scene.add(self._effect(markers, gap, said, several)) for (gap, markers), said in zip(pairs, named)
        )

    def _effect(
        self, markers: tuple[Marker, ...], gap: Gap, name: str, several: bool
    ) -> GapPotential | GapConstraint:
        """What keeps one gap open, of several or alone."""
        if self.stiffness is None:
            restitution = 1.0 if self.restitution is None else self.restitution
            given = {"restitution": restitution, "friction": self.friction, "compliance": SHARED * several}
            return GapConstraint(markers, gap, **given, name=name)
        law = {"stiffness": self.stiffness, "law": self.law}
        if self.restitution is not None:
            law |= {"restitution": self.restitution, "speed": self.speed}
        return GapPotential(markers, gap, **law, name=name)

    def _pairs(self, scene: Builder, solid: _Solid, name: str) -> list[Pair]:
        if isinstance(self.other, Plane):
            return _on_plane(solid, self.other)
        found: list[Pair] = []
        for second in self._solids(scene, self.other, name):
            gaps = _between(solid, second)
            if solid.shape is None and second.shape is None:
                raise ValueError(
                    f"contact {name!r}: {solid.handle.name!r} and {second.handle.name!r} are points, which "
                    "do not overlap; give one of them a shape"
                )
            if gaps is None:
                shapes = [type(s.shape).__name__ for s in (solid, second)]
                raise ValueError(
                    f"contact {name!r}: there is no gap between {shapes[0]} {solid.handle.name!r} and "
                    f"{shapes[1]} {second.handle.name!r}; model one of them by spheres or capsules"
                )
            found += gaps
        return found

    def _solids(self, scene: Builder, handle: Handle, name: str) -> list[_Solid]:
        """What a handle stands for."""
        if isinstance(handle, MeshHandle):
            return [_Solid(node, None, np.zeros(3)) for node in handle.nodes]
        part = scene.find(handle, f"contact {name!r}")
        if not isinstance(part, Body):
            raise ValueError(
                f"contact {name!r}: {handle!r} has no surface; pass nc.Plane(body=...) for a plane"
            )
        if part.shape is None:
            if part.oriented:
                raise ValueError(
                    f"contact {name!r}: {handle.name!r} has no shape; give it one: {SHAPES} (nc.PointMass)"
                )
            return [_Solid(handle, None, np.zeros(3))]
        if not isinstance(part.shape.shape, Sphere | Capsule | Box | Ellipsoid):
            raise ValueError(
                f"contact {name!r}: {handle.name!r} is a {type(part.shape.shape).__name__}; there are gaps "
                f"for {SHAPES}"
            )
        return [_Solid(handle, part.shape.shape, part.shape.centre)]
