"""A tennis racket of beams and strings, and a tennis ball of a shell with gas inside."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

import natcoord_jax as nc
from natcoord_jax.bodies.mesh_handle import MeshHandle, Surface
from natcoord_jax.core.checks import as_array
from natcoord_jax.core.effect import replace_fields

Place = Float[np.ndarray, "n 3"]

SEMI_AXES = 0.17, 0.13
"""Of the head, along the handle and across [m]."""

MAINS, CROSSES = 7, 9
"""Lines of the net of strings along the handle and across it; strings of a racket are 16 and 19."""

STRINGS = 18
"""Strings each way that the lines stand for."""

TENSION, STRING_STIFFNESS, STRING_MASS = 250.0, 18e3, 0.016
"""Of one string [N], its modulus times area [N], and the mass of all [kg]."""

FRAME = {"radius": 0.009, "E": 3.2e10, "density": 830.0}
"""Of a solid rod as stiff in bending as a racket is, some 165 N m^2, and of its mass, 0.28 kg."""

RADIUS, THICKNESS, BALL_MASS = 0.031, 3.5e-3, 0.0577
"""Middle surface and wall of a ball [m], and its mass [kg]."""

RUBBER = {"E": 4e6, "nu": 0.45}

GAUGE, EXPONENT = 83e3, 1.2
"""Pressure of the gas above that of the air [N/m^2], and its exponent."""

RELAXATION = 3.5e-4
"""Time of the viscous stresses of the wall [s], see `nc.Shell`. None was found published: this is the one
with which balls of four and five cells along an edge rebound from a plate at 7 m/s as real ones do, with
0.744 and 0.754 of their speed; three cells are too few for that, 0.69."""


@dataclass(frozen=True)
class Racket:
    """Handles of a racket.

    Attributes:
        beams: of the handle and of both halves of the frame.
        strings: nodes of the net.
        bed: the net as a surface.
        middle: of the head at the start [m].
    """

    beams: tuple[nc.BeamHandle, ...]
    strings: Any
    bed: Surface
    middle: Float[np.ndarray, "3"]


def _lines(semi_axes: tuple[float, float]) -> tuple[Place, list[list[int]], np.ndarray, int]:
    """Crossings of the lines, then their ends: places, nodes of each line, cells, number of crossings."""
    a, b = semi_axes
    across = b * np.linspace(-1, 1, MAINS) * (MAINS - 1) / (MAINS + 0.2)
    along = a * np.linspace(-1, 1, CROSSES) * (CROSSES - 1) / (CROSSES + 0.2)
    grid = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)
    inside = np.sum((grid / (a, b)) ** 2, axis=-1) < 0.9
    number = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    places, count = [*grid[inside]], int(inside.sum())
    lines = []
    for k, (row, y) in enumerate([*zip(number, along), *zip(number.T, across)]):
        first, other = (a, b) if k < CROSSES else (b, a)
        reach = other * np.sqrt(1 - (y / first) ** 2)
        ends = [(y, sign * reach) if k < CROSSES else (sign * reach, y) for sign in (-1, 1)]
        lines.append([len(places), *row[row >= 0], len(places) + 1])
        places += [np.array(end) for end in ends]
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    cells = np.stack(corners, axis=-1).reshape(-1, 4)
    return np.array(places), lines, cells[(cells >= 0).all(axis=1)], count


def add_racket(scene: nc.Scene, hand: Any, placed: Any, grip: Any, throat: Any, width: Any) -> Racket:
    """Add a racket that a hand holds.

    Args:
        scene: to add it to.
        hand: handle of the body that the grip is part of; `nc.ground` clamps it.
        placed: where points of the upright player are, as a function.
        grip: of the racket on the upright player [m].
        throat: where the handle meets the frame [m].
        width: direction of the width of the head [-].
    """
    grip, throat, width = (np.asarray(x, float) for x in (grip, throat, width))
    forward = (throat - grip) / np.linalg.norm(throat - grip)
    middle = throat + SEMI_AXES[0] * forward

    def place(flat: Place) -> Place:
        # The first coordinate grows towards the hand, where the ellipse starts.
        return np.array([placed(middle - u * forward + v * width) for u, v in flat])

    flat, lines, cells, inner = _lines(SEMI_AXES)
    rim = flat[inner:]
    order = np.argsort(np.mod(np.arctan2(rim[:, 1] / SEMI_AXES[1], rim[:, 0] / SEMI_AXES[0]), 2 * np.pi))
    loop = place(rim[order])
    half = len(loop) // 2
    section = nc.CircularSection(**FRAME)
    one = scene.add(_through(section, loop[: half + 1], name="frame 1"))
    other = scene.add(
        _through(
            section, np.concatenate([loop[half:], loop[:1]]), start=one.end, end=one.start, name="frame 2"
        )
    )
    handle = scene.add(
        nc.Beam(
            section, np.array([placed(grip), loop[0]]), elements=3, start=hand, end=one.start, name="handle"
        )
    )
    holders = [*one.nodes, *other.nodes[1:-1]]
    nodes = scene.add(nc.Nodes.points(place(flat), mass=STRING_MASS / inner, name="strings"))
    for k, number in enumerate(order):
        scene.add(nc.Clamp(holders[k], nodes[[inner + int(number)]]))
    scene.add(_strings(nodes, flat, lines))
    mesh = nc.mesh.Mesh(place(flat)[:inner], cells)
    bed = MeshHandle(
        nodes[0].kind, "strings", nodes.scene, nodes[:inner], mesh, None, np.full(len(cells), 1.3e-3)
    )
    return Racket((handle, one, other), nodes, Surface(bed, cells, one_sided=True), placed(middle))


def _through(section: nc.Section, points: Place, **options: Any) -> nc.Beam:
    """A beam with a node at each of some points."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return nc.Beam(section, points, elements=1, stations=(arc / arc[-1])[1:-1], damping=2e-5, **options)


def _strings(nodes: Any, flat: Place, lines: list[list[int]]) -> Any:
    """Springs in tension along the lines."""
    pairs = np.array([pair for line in lines for pair in zip(line, line[1:])])
    lengths = np.linalg.norm(flat[pairs[:, 1]] - flat[pairs[:, 0]], axis=1)
    share = np.concatenate([
        np.full(len(line) - 1, STRINGS / (CROSSES if k < CROSSES else MAINS)) for k, line in enumerate(lines)
    ])  # fmt: skip
    unstretched = lengths / (1 + TENSION / STRING_STIFFNESS)
    each = {"stiffness": share * STRING_STIFFNESS / unstretched, "length": unstretched}
    return nc.Spring.on(nodes, pairs, each=each, name="net")


def add_ball(scene: nc.Scene, count: int = 3, **placing: Any) -> MeshHandle:
    """Add a ball that is not inflated yet; `placing` goes to `nc.Shell`.

    Args:
        scene: to add it to.
        count: of cells along each edge of the cube that its mesh is made of.
        placing: position and velocity.
    """
    mesh = nc.mesh.sphere(RADIUS, count)
    density = BALL_MASS / (4 * np.pi * RADIUS**2 * THICKNESS)
    felt = nc.Elastic(**RUBBER, density=density)
    ball = scene.add(
        nc.Shell(mesh, thickness=THICKNESS, material=felt, damping=RELAXATION, name="ball", **placing)
    )
    scene.add(nc.Gas(ball, gauge_pressure=GAUGE, exponent=EXPONENT, name="gas"))
    return ball


Part = tuple[nc.System, nc.State]
"""A part of a scene, alone, and a state of it."""


def inflated_ball(count: int, place: Any, velocity: Any) -> Part:
    """A ball in equilibrium with its gas, flying."""
    scene = nc.Scene()
    add_ball(scene, count, velocity=velocity)
    system, state = scene.compile()
    # At the origin, where places are rounded least.
    q = np.array(nc.equilibrium(system, state, steps=1).state.q)
    q[::4] += place
    return system, replace_fields(state, q=as_array(q))


def with_part(state: nc.State, system: nc.System, part: Part) -> nc.State:
    """A state of a system in which the bodies of a part are as they are there, by name."""
    q, v = np.array(state.q), np.array(state.v)
    for k, name in enumerate(part[0].structure.bodies):
        rows = slice(4 * system.body_index(name), 4 * system.body_index(name) + 4)
        q[rows], v[rows] = (x[4 * k : 4 * k + 4] for x in (part[1].q, part[1].v))
    return replace_fields(state, q=as_array(q), v=as_array(v))
