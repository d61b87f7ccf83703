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
        raise ValueError(f"shell {name!r}: cell {int(np.argmin(size))} of the mesh has no area")
    cosines = np.sum((own / size[:, None])[:, None] * np.asarray(normals)[mesh.cells], axis=2)
    if cosines.min() < np.cos(np.radians(FOLD)):
        node = int(mesh.cells.flat[np.argmin(cosines)])
        raise ValueError(
            f"shell {name!r}: at node {node} the surface is folded, or its cells are listed in turn one "
            "way and the other; list all of them the same way, pass `directors` (n, 3), or make one "
            "shell of each side of the fold and join them by nc.Fold"
        )
