"""Synthetic sparse systems with the patterns of multibody systems: chains, trees, loops, frames, shells.

Every system is a set of element matrices on a numbering of its unknowns. A body has six rates; a joint has
rows of constraints on them, scaled as the equations of a step are, and the multipliers of these rows belong
to the node of the body that the joint carries. Numbers are random but kind: inertias are definite, joints
independent; nothing is symmetric.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

BODY = 6  # rates of a body
JOINT = 5  # rows of a hinge


@dataclass(frozen=True)
class SparseSystem:
    """A sparse system of linear equations, element by element.

    Attributes:
        name: for reports.
        nodes: node of each unknown (n,).
        elements: unknowns of the elements, one array (count, width) for each kind.
        matrices: their matrices (count, width, width).
        coordinates: positions of the nodes (N, dimensions), or None.
    """

    name: str
    nodes: np.ndarray
    elements: tuple[np.ndarray, ...]
    matrices: tuple[np.ndarray, ...]
    coordinates: np.ndarray | None = None

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.nodes.shape[0]

    def triplets(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, columns and values of the entries, equal places summed, sorted by rows."""
        rows, columns, values = [], [], []
        for unknowns, matrices in zip(self.elements, self.matrices):
            shape = matrices.shape
            rows.append(np.broadcast_to(unknowns[:, :, None], shape).ravel())
            columns.append(np.broadcast_to(unknowns[:, None, :], shape).ravel())
            values.append(matrices.ravel())
        key = np.concatenate(rows).astype(np.int64) * self.size + np.concatenate(columns)
        places, inverse = np.unique(key, return_inverse=True)
        return places // self.size, places % self.size, np.bincount(inverse, np.concatenate(values))

    def dense(self) -> np.ndarray:
        """The matrix (n, n)."""
        matrix = np.zeros((self.size, self.size))
        for unknowns, matrices in zip(self.elements, self.matrices):
            np.add.at(matrix, (unknowns[:, :, None], unknowns[:, None, :]), matrices)
        return matrix

    def times(self, x: np.ndarray) -> np.ndarray:
        """Product of the matrix with a vector (n,)."""
        y = np.zeros(self.size)
        for unknowns, matrices in zip(self.elements, self.matrices):
            np.add.at(y, unknowns, np.einsum("eij,ej->ei", matrices, x[unknowns]))
        return y


def _definite(random: np.random.Generator, count: int, width: int) -> np.ndarray:
    """Matrices whose symmetric part is positive definite."""
    any_matrix = random.standard_normal((count, width, width)) / np.sqrt(width)
    skew = any_matrix - any_matrix.transpose(0, 2, 1)
    return any_matrix @ any_matrix.transpose(0, 2, 1) + np.eye(width) + 0.2 * skew


def chain(count: int, width: int = 9, ratio: float = 1.0) -> SparseSystem:
    """Chain of nodes without multipliers, as of beam elements.

    Args:
        count: number of nodes.
        width: unknowns of a node.
        ratio: of the last node's inertia to the first's.
    """
    random = np.random.default_rng(count)
    number = np.arange(count * width).reshape(count, width)
    pairs = np.concatenate([number[:-1], number[1:]], axis=1)
    scale = ratio ** (np.arange(count) / max(count - 1, 1))
    inertia = scale[:, None, None] * _definite(random, count, width)
    stiffness = np.minimum(scale[:-1], scale[1:])[:, None, None] * _definite(random, count - 1, 2 * width)
    nodes = np.repeat(np.arange(count), width)
    return SparseSystem(f"chain {count} x {width}", nodes, (number, pairs), (inertia, stiffness))


def jointed(
    name: str, parent: np.ndarray, loops: list[tuple[int, int, int]], ratio: float = 1.0
) -> SparseSystem:
    """Bodies with hinges to their parents, and further joints that close loops.

    Args:
        name: of the system.
        parent: of each body, of lower number; -1 for the ground.
        loops: pairs of bodies (the second may be -1) and numbers of rows of joints that close loops.
        ratio: of the last body's inertia to the first's.
    """
    bodies = len(parent)
    random = np.random.default_rng(bodies)
    scale = ratio ** (np.arange(bodies) / max(bodies - 1, 1))
    number = np.arange(bodies * BODY).reshape(bodies, BODY)
    elements, matrices = [number], [scale[:, None, None] * _definite(random, bodies, BODY)]
    nodes = [np.repeat(np.arange(bodies), BODY)]
    first = bodies * BODY
    joints = [(body, int(p), JOINT) for body, p in enumerate(parent)]
    for body, other, rows in joints + loops:
        lams = first + np.arange(rows)
        first += rows
        touched = np.concatenate([number[body], number[other]]) if other >= 0 else number[body]
        jacobian = _hinge(random, rows)[:, : len(touched)]
        local = np.zeros((len(touched) + rows,) * 2)
        local[len(touched) :, : len(touched)] = jacobian
        local[: len(touched), len(touched) :] = -jacobian.T
        elements.append(np.concatenate([touched, lams])[None])
        matrices.append(local[None])
        nodes.append(np.full(rows, body))
    return SparseSystem(name, np.concatenate(nodes), *_stacked(elements, matrices))


def _hinge(random: np.random.Generator, rows: int) -> np.ndarray:
    """Rows of a joint by the rates of its two bodies (rows, 12), the joint one arm away from the second."""
    turned = np.linalg.qr(random.standard_normal((BODY, BODY)))[0]
    x, y, z = random.uniform(-1.0, 1.0, 3)
    carried = np.eye(BODY)
    carried[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return np.concatenate([turned, -turned @ carried], axis=1)[:rows]


def _stacked(elements: list, matrices: list) -> tuple[tuple, tuple]:
    """Elements of equal width in one array."""
    widths = sorted({e.shape[1] for e in elements})
    groups = [[k for k, e in enumerate(elements) if e.shape[1] == w] for w in widths]
    return (
        tuple(np.concatenate([elements[k] for k in group]) for group in groups),
        tuple(np.concatenate([matrices[k] for k in group]) for group in groups),
    )


def body_chain(count: int, ratio: float = 1.0) -> SparseSystem:
    """Chain of bodies with hinges, the first one at the ground."""
    return jointed(f"chain of {count} bodies", np.arange(count) - 1, [], ratio)


def body_tree(count: int) -> SparseSystem:
    """Binary tree of bodies with hinges."""
    return jointed(f"binary tree of {count} bodies", (np.arange(count) + 1) // 2 - 1, [])


def ring(count: int) -> SparseSystem:
    """Chain of bodies with hinges whose last one is joined to the first by a ball joint."""
    return jointed(f"ring of {count} bodies", np.arange(count) - 1, [(count - 1, 0, 3)])


def ladder(count: int) -> SparseSystem:
    """Two chains of bodies with hinges, and ball joints between them: many loops, as in a planar truss."""
    parent = np.maximum(np.arange(2 * count) - 2, -1)
    rungs = [(2 * k + 1, 2 * k, 3) for k in range(2, count, 3)]
    return jointed(f"ladder of {2 * count} bodies", parent, rungs)


def frame(rows: int, columns: int) -> SparseSystem:
    """Grid of nodes with beams along its lines: twelve unknowns a beam."""
    number = np.arange(rows * columns).reshape(rows, columns)
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    beams = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])
    return _mesh(f"frame {rows} x {columns}", (rows, columns), beams)


def shell(rows: int, columns: int, hinged: bool = False) -> SparseSystem:
    """Mesh of four-node elements, six unknowns a node.

    Args:
        rows: nodes in one direction.
        columns: nodes in the other.
        hinged: whether the nodes of one edge are held by three rows of constraints each.
    """
    number = np.arange(rows * columns).reshape(rows, columns)
    corners = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.stack([c.ravel() for c in corners], axis=1)
    name = f"shell {rows} x {columns}" + (", hinged" if hinged else "")
    return _mesh(name, (rows, columns), faces, number[0] if hinged else number[:0, 0])


def _mesh(
    name: str, shape: tuple[int, int], faces: np.ndarray, held: np.ndarray | None = None
) -> SparseSystem:
    count, held = shape[0] * shape[1], np.zeros(0, int) if held is None else held
    random = np.random.default_rng(count)
    unknowns = (faces[:, :, None] * BODY + np.arange(BODY)).reshape(len(faces), -1)
    number = np.arange(count * BODY).reshape(count, BODY)
    elements = [number, unknowns]
    matrices = [_definite(random, count, BODY), _definite(random, *unknowns.shape)]
    nodes = [np.repeat(np.arange(count), BODY)]
    if held.size:
        lams = count * BODY + np.arange(held.size * 3).reshape(-1, 3)
        local = np.zeros((held.size, 9, 9))
        local[:, 6:, :6] = random.standard_normal((held.size, 3, 6))
        local[:, :6, 6:] = -local[:, 6:, :6].transpose(0, 2, 1)
        elements.append(np.concatenate([number[held], lams], axis=1))
        matrices.append(local)
        nodes.append(np.repeat(held, 3))
    place = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    return SparseSystem(name, np.concatenate(nodes), tuple(elements), tuple(matrices), place.astype(float))


KINDS: dict[str, Callable[..., SparseSystem]] = {
    "ring": ring,
    "chain": chain,
    "body_chain": body_chain,
    "body_tree": body_tree,
    "ladder": ladder,
    "frame": frame,
    "shell": shell,
}


def named(name: str) -> SparseSystem:
    """The system that a name such as `shell:16,16` calls for."""
    kind, _, sizes = name.partition(":")
    return KINDS[kind](*(float(x) if "e" in x else int(x) for x in sizes.split(",")))


def right_hand_side(system: SparseSystem) -> np.ndarray:
    """A right-hand side (n,)."""
    return np.random.default_rng(1).standard_normal(system.size)


def backward_error(system: SparseSystem, x: np.ndarray) -> float:
    """Largest residual of a solution relative to the sum of the absolute terms of its row."""
    right = right_hand_side(system)
    rows, columns, values = system.triplets()
    terms = np.bincount(rows, np.abs(values * x[columns]), system.size) + np.abs(right)
    return float(np.max(np.abs(system.times(x) - right) / terms))
