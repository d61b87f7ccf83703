"""What ParaView shows of a stored run: nodes and elements as VTK's format in HDF5 has them (VTKHDF).

One unstructured grid, whose points move and whose cells stay: quadrilaterals of shells, hexahedra of solids,
lines of beams, and a vertex for every body. See the format's description at
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/index.html, version 2.0.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from natcoord_jax.core.bodies import NODE
from natcoord_jax.model.groups import Group
from natcoord_jax.system import System

VERTEX, LINE, QUADRILATERAL, HEXAHEDRON = 1, 3, 9, 12
"""VTK's numbers of the kinds of cells."""

MOVING = "VTKHDF/Points", "VTKHDF/Steps/Values"
"""What is written as the run goes on: places and times."""


@dataclasses.dataclass(frozen=True)
class Geometry:
    """Points by their weights on the rows of the state, and cells between them.

    Attributes:
        rows: of the state, of each point (points, k), and their weights.
        weights: (points, k).
        cells: kind of each cell, and its points.
    """

    rows: np.ndarray
    weights: np.ndarray
    cells: list[tuple[int, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Points:
    """Places of a geometry at all times, in a file."""

    geometry: Geometry
    places: np.ndarray
    times: np.ndarray

    def write(self, first: int, times: np.ndarray, q: np.ndarray) -> None:
        """Put some times in their places."""
        g = self.geometry
        ground = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        q = np.concatenate([q, np.broadcast_to(ground, (len(q), *NODE))], axis=1)
        x = np.einsum("pk,tpkc->tpc", g.weights, q[:, g.rows])
        count = len(g.rows)
        self.places[first * count : (first + len(x)) * count] = x.reshape(-1, 3)
        self.times[first : first + len(x)] = times


def geometry_of(system: System) -> Geometry:
    """Bodies and elements of a system as points and cells."""
    keys: dict[tuple, int] = {}
    rows, weights, cells = [], [], []

    def point(bodies: np.ndarray, shares: np.ndarray) -> int:
        key = bodies.tobytes(), shares.tobytes()
        if key not in keys:
            keys[key] = len(rows)
            rows.append((NODE[0] * bodies[:, None] + np.arange(NODE[0])).reshape(-1))
            weights.append(shares.reshape(-1))
        return keys[key]

    for number in range(len(system.structure.bodies)):
        at = point(np.array([number]), np.array([[1.0, 0.0, 0.0, 0.0]]))
        cells.append((VERTEX, np.array([at])))
    for kind, bodies, shares in _elements(system):
        for each, own in zip(bodies, shares):
            cells.append((kind, np.array([point(b, w) for b, w in zip(each, own)])))
    most = max(map(len, rows))
    padded = [np.pad(x, (0, most - len(x))) for x in rows], [np.pad(x, (0, most - len(x))) for x in weights]
    return Geometry(np.array(padded[0]), np.array(padded[1]), cells)


def _elements(system: System) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Kind of cell of each group of elements, bodies (n, k, b) and weights (n, k, b, 4) of its points."""
    for group in system.effects:
        kind = _kind(group)
        if kind is not None:
            weights, bodies = np.asarray(group.weights, float), np.asarray(group.bodies)
            weights = weights if weights.ndim == 3 else weights[:, :, 0]
            each = weights.shape[-1] // NODE[0]
            shape = *weights.shape[:2], each
            yield kind, bodies.reshape(shape).astype(np.int64), weights.reshape(*shape, NODE[0])


def _kind(group: Group) -> int | None:
    if group.weights is None:
        return None
    if type(group.effect).faces:
        return QUADRILATERAL if len(type(group.effect).faces) == 1 else HEXAHEDRON
    chained = group.effect.couples and group.effect.stores and np.ndim(group.weights) == 4
    return LINE if chained else None


def create(file: Any, geometry: Geometry, times: int, room: Callable[..., None]) -> None:
    """The group of VTK in a file, with room for the places at so many times."""
    count, cells = len(geometry.rows), geometry.cells
    group = file.create_group("VTKHDF")
    group.attrs["Version"] = (2, 0)
    group.attrs["Type"] = np.bytes_("UnstructuredGrid")
    lengths = [len(points) for _, points in cells]
    numbers = {"NumberOfPoints": count, "NumberOfCells": len(cells), "NumberOfConnectivityIds": sum(lengths)}
    for name, number in numbers.items():
        group[name] = np.array([number], np.int64)
    group["Types"] = np.array([kind for kind, _ in cells], np.uint8)
    group["Offsets"] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    group["Connectivity"] = np.concatenate([points for _, points in cells]).astype(np.int64)
    room(group, "Points", (times * count, 3), np.float64)
    steps = group.create_group("Steps")
    steps.attrs["NSteps"] = times
    room(steps, "Values", (times,), np.float64)
    steps["PartOffsets"] = np.zeros(times, np.int64)
    steps["NumberOfParts"] = np.ones(times, np.int64)
    steps["PointOffsets"] = count * np.arange(times, dtype=np.int64)
    steps["CellOffsets"] = np.zeros((times, 1), np.int64)
    steps["ConnectivityIdOffsets"] = np.zeros((times, 1), np.int64)


def shorten(file: Any, times: int) -> None:
    """Show so many of the times only."""
    file["VTKHDF/Steps"].attrs["NSteps"] = times
