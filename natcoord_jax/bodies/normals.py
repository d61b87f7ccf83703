"""Normals of meshed surfaces at their nodes, and where these are folded."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mesh import Mesh

FOLD = 45.0
"""Angle [degrees] between cells and their mean normal at a node beyond which a surface is folded there."""


@eager_numpy
def normals_at(nodes: Float[Array, "n 3"], cells: Int[np.ndarray, "m 4"]) -> Float[Array, "n 3"]:
    """Mean normals of the cells at the nodes, by their areas."""
    corners = nodes[cells]
    areas = cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # The last node of a triangle, which is listed twice, counts once.
    counted = jnp.concatenate([jnp.ones((len(cells), 3)), cells[:, 3:] != cells[:, 2:3]], axis=1)
    total = jnp.zeros_like(nodes).at[cells].add(counted[:, :, None] * areas[:, None])
    size = jnp.sqrt(jnp.sum(total**2, axis=1, keepdims=True))
    return total / jnp.where(size > 0, size, 1.0)


def check_folds(mesh: Mesh, normals: Array, name: str) -> None:
    """Refuse surfaces without directors at a fold.

    Raises:
        ValueError: with the node.
    """
    if not is_concrete(normals, mesh.nodes):
        return
    corners = np.asarray(mesh.nodes)[mesh.cells]
    own = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    size = np.linalg.norm(own, axis=1)
    if np.any(size == 0):
        cell = int(np.argmin(size))
        raise ValueError(
            f"shell {name!r}: cell {cell} of the mesh, of the nodes {mesh.cells[cell].tolist()}, has no "
            "area; list its nodes in turn round it, or leave it out"
        )
    cosines = np.sum((own / size[:, None])[:, None] * np.asarray(normals)[mesh.cells], axis=2)
    if cosines.min() < np.cos(np.radians(FOLD)):
        node = int(mesh.cells.flat[np.argmin(cosines)])
        raise ValueError(
            f"shell {name!r}: at node {node} the surface is folded, or its cells are listed in turn one "
            "way and the other; list all of them the same way, pass `directors` (n, 3), or make one "
            "shell of each side of the fold and join them by nc.Fold"
        )


def check_turns(mesh: Mesh, name: str) -> None:
    """Refuse surfaces whose two sides are not told apart: what presses on one would not.

    Raises:
        ValueError: with two cells.
    """
    sides = np.stack([mesh.cells, np.roll(mesh.cells, -1, axis=1)], axis=2)
    owner = np.repeat(np.arange(len(sides)), 4)[(sides[:, :, 0] != sides[:, :, 1]).ravel()]
    sides = sides[sides[:, :, 0] != sides[:, :, 1]]
    _, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    if count.max() > 1:
        one, other = owner[number.ravel() == np.argmax(count)][:2]
        raise ValueError(
            f"shell {name!r}: cells {one} and {other} of the mesh are listed in turn one way and the other; "
            "list all of them the same way, so that the surface has two sides"
        )
