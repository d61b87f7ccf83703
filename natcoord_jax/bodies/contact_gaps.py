"""Which gap there is between two kinds of sides: one table, to which a kind is added by its own lines."""

from collections.abc import Callable
from typing import Any

from natcoord_jax.bodies.contact_sides import (
    BeamSide,
    BodySide,
    MeshSide,
    Plane,
    PlaneSide,
    SegmentSide,
    Side,
    Strand,
)
from natcoord_jax.bodies.continua import Surface
from natcoord_jax.bodies.node_surface import surface_gaps
from natcoord_jax.bodies.shapes import CORNERS, Box, Capsule, Ellipsoid, Sphere
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.eager_numpy import stacked
from natcoord_jax.effects.contact import (
    CapsuleOnCapsule,
    EllipsoidOnPlane,
    SphereOnBox,
    SphereOnPlane,
    SphereOnSphere,
)

OF_SURFACES = "candidates", "one_pass"
"""Options that contacts of other sides have no use for."""

Law = dict[str, Any]
Gaps = list[Any]


def gaps_between(one: Side, other: Side, law: Law, name: str) -> Gaps:
    """Gaps of two sides, or of the simpler ones that stand for them.

    Args:
        one: side.
        other: side.
        law: numbers of the contact; stiffness None: that of the sides.
        name: of the contact, for messages.

    Raises:
        ValueError: for kinds that there is no gap for, or no stiffness.
    """
    for first, second in ((one, other), (other, one)):
        make = TABLE.get((first.kind, second.kind))
        if make is not None:
            return make(first, second, law, name)
    for whole, rest in ((one, other), (other, one)):
        if whole.parts:
            return [gap for part in whole.parts for gap in gaps_between(part, rest, law, name)]
    raise ValueError(
        f"contact {name!r}: there is no gap between {one.named} and {other.named}; model one of them by "
        "spheres or capsules"
    )


def _stiff(law: Law, name: str, *sides: Side) -> Law:
    """The law with the stiffness of the sides, where none is given."""
    law = {key: value for key, value in law.items() if key not in OF_SURFACES}
    if law["stiffness"] is not None:
        return law
    own = [s.stiffness for s in sides if isinstance(s, SegmentSide) and s.stiffness is not None]
    if not own:
        raise ValueError(
            f"contact {name!r}: {' and '.join(s.named for s in sides)} have no elements to take a stiffness "
            "[N/m] from; pass stiffness="
        )
    return law | {"stiffness": min(own)}


def _ball_on_plane(ball: SegmentSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    markers = *plane.plane.markers(), ball.ends[0]
    return [SphereOnPlane(markers, radius=ball.radius, **_stiff(law, name, ball, plane))]


def _segment_on_plane(segment: SegmentSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    balls = (SegmentSide.ball(end, segment.radius) for end in segment.ends)
    return [gap for ball in balls for gap in _ball_on_plane(ball, plane, law, name)]


def _beam_on_plane(beam: BeamSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    return [gap for ball in beam.balls for gap in _ball_on_plane(ball, plane, law, name)]


def _box_on_plane(box: BodySide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    shape: Any = box.shape
    corners = [SegmentSide.ball(box.point(0.5 * shape.size * corner)) for corner in CORNERS]
    return [gap for ball in corners for gap in _ball_on_plane(ball, plane, law, name)]


def _ellipsoid_on_plane(ellipsoid: BodySide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    shape: Any = ellipsoid.shape
    markers = *plane.plane.markers(), ellipsoid.point(), *ellipsoid.axes()
    given = _stiff(law, name, ellipsoid, plane)
    return [EllipsoidOnPlane(markers, semi_axes=shape.semi_axes, **given)]


def _ball_on_box(ball: SegmentSide, box: BodySide, law: Law, name: str) -> Gaps:
    shape: Any = box.shape
    markers = box.point(), ball.ends[0], *box.axes()
    return [SphereOnBox(markers, size=shape.size, radius=ball.radius, **_stiff(law, name, ball, box))]


def _radii(one: SegmentSide, other: SegmentSide, name: str) -> Any:
    """Of both.

    Raises:
        ValueError: for two points.
    """
    if all(isinstance(s.radius, float) and s.radius == 0.0 for s in (one, other)):
        raise ValueError(
            f"contact {name!r}: {one.handle.name!r} and {other.handle.name!r} are points, which do not "
            "overlap; give one of them a shape"
        )
    return stacked([as_array(s.radius, float) for s in (one, other)])


def _balls(one: SegmentSide, other: SegmentSide, law: Law, name: str) -> Gaps:
    radii = _radii(one, other, name)
    return [SphereOnSphere((one.ends[0], other.ends[0]), radii=radii, **_stiff(law, name, one, other))]


def _segments(one: SegmentSide, other: SegmentSide, law: Law, name: str) -> Gaps:
    radii = _radii(one, other, name)
    return [CapsuleOnCapsule((*one.ends, *other.ends), radii=radii, **_stiff(law, name, one, other))]


def _surfaces(one: MeshSide, other: MeshSide, law: Law, name: str) -> Gaps:
    return [surface_gaps(one, other, law, name)]


TABLE: dict[tuple[type, type], Callable[..., Gaps]] = {
    (Sphere, Plane): _ball_on_plane,
    (Capsule, Plane): _segment_on_plane,
    (Strand, Plane): _beam_on_plane,
    (Box, Plane): _box_on_plane,
    (Ellipsoid, Plane): _ellipsoid_on_plane,
    (Sphere, Box): _ball_on_box,
    (Sphere, Sphere): _balls,
    (Sphere, Capsule): _segments,
    (Capsule, Capsule): _segments,
    (Surface, Surface): _surfaces,
}
"""The gap of each pair of kinds, in one order."""
