"""Which gap there is between two kinds of sides: one table, to which a kind is added by its own lines."""

from collections.abc import Callable
from itertools import combinations, product
from typing import Any

import jax.numpy as jnp
import numpy as np

from natcoord_jax.bodies.contact_law import Law, kept_open
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
from natcoord_jax.bodies.mesh_handle import Surface
from natcoord_jax.bodies.mortar_surface import mortar_gaps
from natcoord_jax.bodies.node_surface import surface_gaps
from natcoord_jax.bodies.shapes import CORNERS, Box, Capsule, Cylinder, Ellipsoid, Sphere
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy, stacked
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.effects.contact import (
    CapsuleOnCapsule,
    CornersOnBox,
    DiscOnPlane,
    EdgesOnEdges,
    EllipsoidOnPlane,
    GapConstraint,
    SphereOnBox,
    SphereOnPlane,
    SphereOnSphere,
)

ROUNDING = 0.02
"""Radius of edges and corners of boxes on boxes, of the shortest edge."""

SHARED = 1e-9
"""Compliance of contacts with several gaps, which may depend on each other."""

STACKED = 1e-8
"""The same of boxes on boxes, of whose gaps twice as many share a load, in stacks of ten."""

Gaps = list[Any]


def gaps_between(one: Side, other: Side, law: Law, name: str) -> Gaps:
    """Gaps of two sides, or of the simpler ones that stand for them.

    Args:
        one: side.
        other: side.
        law: numbers of the contact; stiffness None: that of the sides.
        name: of the contact, for messages.

    Raises:
        ValueError: for kinds that there is no gap for, and numbers that do not go together.
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


def gaps_within(beam: Side, law: Law, name: str) -> Gaps:
    """Gaps of the segments of a beam with each other, but for those that are near along it.

    Args:
        beam: side.
        law: numbers of the contact.
        name: of the contact, for messages.

    Raises:
        ValueError: for a beam so short that none of its segments can touch another.
    """
    assert isinstance(beam, BeamSide)
    parts = beam.parts
    along = np.concatenate([[0.0], np.cumsum(beam.lengths)])
    pairs = [
        (int(i), int(j))
        for i, j in zip(*np.triu_indices(len(parts), 1))
        if along[j] - along[i + 1] > np.pi * beam.radius
    ]
    if not pairs:
        raise ValueError(
            f"contact {name!r}: {beam.named} is too short to touch itself: no two of its {len(parts)} "
            "segments are farther apart along it than half a turn about its section, "
            f"{np.pi * beam.radius:.3g} m"
        )
    return [gap for i, j in pairs for gap in gaps_between(parts[i], parts[j], law, name)]


def _sharing(gaps: Gaps, compliance: float = SHARED) -> Gaps:
    """Gaps of one body, which may depend on each other."""
    return [replace_fields(g, compliance=compliance) if isinstance(g, GapConstraint) else g for g in gaps]


def _ball_on_plane(ball: SegmentSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    markers = *plane.plane.markers(), ball.ends[0]
    return [kept_open(SphereOnPlane(radius=ball.radius), markers, law, name, ball, plane)]


def _segment_on_plane(segment: SegmentSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    balls = (SegmentSide.ball(end, segment.radius) for end in segment.ends)
    return _sharing([gap for ball in balls for gap in _ball_on_plane(ball, plane, law, name)])


def _beam_on_plane(beam: BeamSide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    return [gap for ball in beam.balls for gap in _ball_on_plane(ball, plane, law, name)]


def _box_on_plane(box: BodySide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    shape: Any = box.shape
    corners = [SegmentSide.ball(box.point(0.5 * shape.size * corner)) for corner in CORNERS]
    return _sharing([gap for ball in corners for gap in _ball_on_plane(ball, plane, law, name)])


def _ellipsoid_on_plane(ellipsoid: BodySide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    shape: Any = ellipsoid.shape
    markers = *plane.plane.markers(), ellipsoid.point(), *ellipsoid.axes()
    return [kept_open(EllipsoidOnPlane(semi_axes=shape.semi_axes), markers, law, name)]


def _cylinder_on_plane(cylinder: BodySide, plane: PlaneSide, law: Law, name: str) -> Gaps:
    """The lowest points of both rims, for what rolls, and four points of each, for what stands."""
    if law["stiffness"] is not None:
        raise ValueError(
            f"contact {name!r}: a stiffness [N/m] of {cylinder.named} would be that of several points "
            "where it stands, and of one where it lies; leave it out, or take an nc.Capsule"
        )
    shape: Any = cylinder.shape
    axis, found = cylinder.axes()[2], []
    for end in (-0.5, 0.5):
        middle = np.array([0.0, 0.0, 1.0]) * end * shape.length
        markers = *plane.plane.markers(), cylinder.point(middle), axis
        found.append(kept_open(DiscOnPlane(radius=shape.radius), markers, law, name))
        for corner in ((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)):
            ball = SegmentSide.ball(cylinder.point(middle + shape.radius * np.array(corner)))
            found += _ball_on_plane(ball, plane, law, name)
    return _sharing(found)


def _ball_on_box(ball: SegmentSide, box: BodySide, law: Law, name: str) -> Gaps:
    shape: Any = box.shape
    markers = box.point(), ball.ends[0], *box.axes()
    return [kept_open(SphereOnBox(size=shape.size, radius=ball.radius), markers, law, name, ball, box)]


def _segment_on_box(segment: SegmentSide, box: BodySide, law: Law, name: str) -> Gaps:
    """Its ends on the box, and the edges of the box on it."""
    shape: Any = box.shape
    balls = (SegmentSide.ball(end, segment.radius) for end in segment.ends)
    found = [gap for ball in balls for gap in _ball_on_box(ball, box, law, name)]
    corners = [box.point(0.5 * shape.size * corner) for corner in CORNERS]
    for one, other in combinations(range(len(CORNERS)), 2):
        if np.sum(CORNERS[one] != CORNERS[other]) == 1:
            edge = SegmentSide(box.handle, Capsule, (corners[one], corners[other]), 0.0)
            found += _segments(segment, edge, law, name)
    return _sharing(found)


def _box_on_box(one: BodySide, other: BodySide, law: Law, name: str) -> Gaps:
    """Corners of either on the other, opposite ones together, and edges on edges."""
    law, boxes = dict(law), (one, other)
    sizes: Any = stacked([box.shape.size for box in boxes])  # pyright: ignore[reportAttributeAccessIssue]
    rounding = law.pop("rounding", None)
    rounding = _rounding(sizes) if rounding is None else rounding
    known = is_concrete(sizes) and is_concrete(rounding)
    if known and 2 * float(rounding) >= (least := float(np.min(sizes))):
        raise ValueError(
            f"contact {name!r}: rounding [m] is {float(rounding):.6g}, but edges of the boxes are as short "
            f"as {least:.6g} m; pass less than half of that"
        )
    found = []
    for k, (box, rest) in enumerate((boxes, boxes[::-1])):
        markers = box.point(), rest.point(), *box.axes(), *rest.axes()
        for corner in CORNERS[len(CORNERS) // 2 :]:
            tip = 0.5 * sizes[1 - k] * corner
            gap = CornersOnBox(size=sizes[k], corner=tip, rounding=rounding)
            found.append(kept_open(gap, markers, law, name))
    markers = one.point(), other.point(), *one.axes(), *other.axes()
    for skew in product((-1.0, 1.0), repeat=2):
        gap = EdgesOnEdges(sizes=sizes, skew=skew, rounding=rounding)
        found.append(kept_open(gap, markers, law, name))
    return _sharing(found, STACKED)


@eager_numpy
def _rounding(sizes: Any) -> Any:
    return ROUNDING * jnp.min(sizes)


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
    return [kept_open(SphereOnSphere(radii=radii), (one.ends[0], other.ends[0]), law, name, one, other)]


def _segments(one: SegmentSide, other: SegmentSide, law: Law, name: str) -> Gaps:
    radii = _radii(one, other, name)
    return [kept_open(CapsuleOnCapsule(radii=radii), (*one.ends, *other.ends), law, name, one, other)]


def _surfaces(one: MeshSide, other: MeshSide, law: Law, name: str) -> Gaps:
    method = law.get("method")
    law = {key: value for key, value in law.items() if key != "method"}
    if method is None:
        return [surface_gaps(one, other, law, name)]
    if "friction" in law:
        raise ValueError(
            f"contact {name!r}: a mortar has no friction [-] yet; leave it out, or take method='nodes'"
        )
    if "one_pass" in law:
        raise ValueError(
            f"contact {name!r}: a mortar has one pass, the mean gaps of the first surface; leave out one_pass"
        )
    return [mortar_gaps(one, other, law, name)]


TABLE: dict[tuple[type, type], Callable[..., Gaps]] = {
    (Sphere, Plane): _ball_on_plane,
    (Capsule, Plane): _segment_on_plane,
    (Strand, Plane): _beam_on_plane,
    (Box, Plane): _box_on_plane,
    (Ellipsoid, Plane): _ellipsoid_on_plane,
    (Cylinder, Plane): _cylinder_on_plane,
    (Sphere, Box): _ball_on_box,
    (Capsule, Box): _segment_on_box,
    (Box, Box): _box_on_box,
    (Sphere, Sphere): _balls,
    (Sphere, Capsule): _segments,
    (Capsule, Capsule): _segments,
    (Surface, Surface): _surfaces,
}
"""The gap of each pair of kinds, in one order."""
