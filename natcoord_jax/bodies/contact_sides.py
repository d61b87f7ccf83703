"""Sides of a contact: shapes on bodies, planes, segments of beams, surfaces of shells and solids."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.mesh_handle import Surface
from natcoord_jax.bodies.shapes import Capsule, Shape, Sphere
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.kinds import BODY
from natcoord_jax.core.markers import Direction, Marker, Point
from natcoord_jax.core.numeric import COMPONENTS, Directions
from natcoord_jax.effects.materials import Elastic


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


@dataclass(frozen=True)
class Side:
    """What one side of a contact is.

    Attributes:
        handle: it moves with.
        kind: of shape, by which the table of gaps knows it.
    """

    handle: Handle
    kind: type

    @property
    def parts(self) -> "Sequence[Side]":
        """Simpler sides that stand for it where there is no gap for the whole; none."""
        return ()

    @property
    def named(self) -> str:
        """For messages."""
        return f"{self.kind.__name__} {self.handle.name!r}"


@dataclass(frozen=True)
class PlaneSide(Side):
    """A plane.

    Attributes:
        plane: itself.
    """

    plane: Plane


@dataclass(frozen=True)
class SegmentSide(Side):
    """All within a radius of a segment: a capsule, or part of a beam; with twice the same end, a ball.

    Attributes:
        ends: of the segment.
        radius: [m]; of a point zero.
        stiffness: of its contacts by default [N/m]; None: it has none.
    """

    ends: tuple[Marker, Marker]
    radius: Any
    stiffness: Any = None

    @staticmethod
    def ball(marker: Marker, radius: Any = 0.0, stiffness: Any = None) -> "SegmentSide":
        """A ball, or a point."""
        return SegmentSide(marker.body, Sphere, (marker, marker), radius, stiffness)


@dataclass(frozen=True)
class BodySide(Side):
    """A shape on a body.

    Attributes:
        shape: of which kind it is.
        centre: of it, in the axes of the body [m].
    """

    shape: Shape
    centre: Any

    def point(self, place: Any = (0.0, 0.0, 0.0)) -> Marker:
        """A point of it, from its centre."""
        return Point(self.handle, self.centre + as_array(place, float), local=True)

    def axes(self) -> tuple[Marker, ...]:
        """Its own."""
        return tuple(Direction(self.handle, axis, local=True) for axis in np.eye(3))


class Strand:
    """Kind of sides that are beams."""


@dataclass(frozen=True)
class BeamSide(Side):
    """A beam, as capsules between its nodes.

    Attributes:
        points: its nodes.
        radius: within which its section is [m].
        name: of the beam.
    """

    points: tuple[Marker, ...]
    radius: Any
    name: str

    @staticmethod
    def of(beam: BeamHandle, name: str) -> "BeamSide":
        """Of a beam whose section has an outline.

        Raises:
            ValueError: for another.
        """
        if beam.outline is None:
            raise ValueError(
                f"contact {name!r}: the section of beam {beam.name!r} has no outline, and so no radius; make "
                "it of nc.CircularSection or another section with a shape"
            )
        radius = np.linalg.norm(np.asarray(beam.outline), axis=1).max()
        points = tuple(Point(a.body, a.point) for a in beam.attachments)
        return BeamSide(beam.nodes[0], Strand, points, float(radius), beam.name)

    @property
    def named(self) -> str:
        """For messages."""
        return f"beam {self.name!r}"

    @property
    def parts(self) -> Sequence[Side]:
        """Its segments."""
        pairs = zip(self.points, self.points[1:])
        return [SegmentSide(ends[0].body, Capsule, ends, self.radius) for ends in pairs]

    @property
    def lengths(self) -> Float[np.ndarray, " n"]:
        """Of its segments [m]."""
        places = np.array([np.asarray(point.vector, float) for point in self.points])
        return np.linalg.norm(np.diff(places, axis=0), axis=1)

    @property
    def balls(self) -> list[SegmentSide]:
        """Its nodes, for contacts with planes."""
        return [SegmentSide.ball(point, self.radius) for point in self.points]


@dataclass(frozen=True)
class MeshSide(Side):
    """Faces of a solid, or a shell.

    Attributes:
        surface: the faces.
    """

    surface: Surface

    @property
    def shell(self) -> bool:
        """Whether it has a thickness."""
        return self.surface.handle.thickness is not None

    @property
    def two_sided(self) -> bool:
        """Whether it is touched from both sides."""
        return self.shell and not self.surface.one_sided

    @property
    def numbers(self) -> np.ndarray:
        """Of the nodes of its faces, each once."""
        return np.unique(self.surface.faces)

    @property
    def half_thickness(self) -> Float[np.ndarray, " n"]:
        """Of a shell at its nodes, the largest of their cells; of a solid zero [m]."""
        handle, faces = self.surface.handle, self.surface.faces
        thick = np.zeros(len(handle.nodes))
        if self.shell:
            depth = np.asarray(handle.thickness)[_behind(faces, handle.mesh.cells)]
            np.maximum.at(thick, faces, 0.5 * np.broadcast_to(depth[:, None], faces.shape))
        return thick[self.numbers]

    @property
    def depth(self) -> Float[np.ndarray, " f"]:
        """How far a solid reaches behind each face [m]; a shell that is touched from one side has no end."""
        if self.shell:
            return np.full(len(self.surface.faces), 1e300)
        places = np.asarray(self.surface.handle.nodes.positions)
        corners = places[self.surface.faces[:, :4]]
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.sum(normals * corners.mean(axis=1), axis=1) - np.min(normals @ places.T, axis=1)

    @property
    def _areas_and_moduli(self) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
        """Of the faces [m^2], and the modulus of the material over how thick the elements behind are [N/m^3].

        Raises:
            ValueError: for a material without a modulus.
        """
        handle, faces = self.surface.handle, self.surface.faces
        if not isinstance(handle.material, Elastic):
            raise ValueError(
                f"contact with {handle.name!r}: its material has no one modulus E [Pa] to take a stiffness "
                "[N/m] from; pass stiffness="
            )
        places = np.asarray(handle.nodes.positions)
        x, cells = places[faces], _behind(faces, handle.mesh.cells)
        normal = 0.5 * np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
        area = np.linalg.norm(normal, axis=1)
        inwards = x.mean(axis=1) - places[handle.mesh.cells[cells]].mean(axis=1)
        depth = 2 * np.abs(np.sum(inwards * normal, axis=1)) / area
        if self.shell:
            depth = np.asarray(handle.thickness)[cells]
        return area, float(handle.material.E) / depth

    @property
    def stiffness(self) -> Float[np.ndarray, " n"]:
        """Along the normal at the nodes, which have a quarter of each of their faces [N/m]."""
        area, modulus = self._areas_and_moduli
        total = np.zeros(len(self.surface.handle.nodes))
        np.add.at(total, self.surface.faces, (0.25 * modulus * area)[:, None])
        return total[self.numbers]

    @property
    def stiffness_per_area(self) -> float:
        """Along the normal, the mean of all faces [N/m^3]."""
        area, modulus = self._areas_and_moduli
        return float(modulus @ area / area.sum())

    @property
    def parts(self) -> Sequence[Side]:
        """Its nodes, as balls of the thickness there."""
        nodes = self.surface.handle.nodes[self.numbers]
        given = zip(nodes, self.half_thickness, self.stiffness)
        return [SegmentSide.ball(Point(node), t, k) for node, t, k in given]


def _behind(faces: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """For each face a cell that has all its corners."""
    first: dict[int, list[int]] = {}
    for number, cell in enumerate(cells):
        for node in cell:
            first.setdefault(int(node), []).append(number)
    sets = [set(cell) for cell in cells.tolist()]
    return np.array([next(c for c in first[f[0]] if sets[c].issuperset(f)) for f in faces.tolist()])
