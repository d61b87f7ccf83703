"""Where the surface of a solid in contact has sharp edges, between which it is in patches."""

import numpy as np
from jaxtyping import Bool, Float, Int

SHARP = 0.4
"""Cosine of the angle between the normals of two facets below which the edge between them is sharp: those of
boxes are, those of a round body of six facets along its girth or more are not."""


def sharp_edges(
    facets: Int[np.ndarray, "f 4"], places: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, "f 4"], Int[np.ndarray, " f"]]:
    """Which edges of facets are sharp and convex, and the number of the patch between those, facet by facet.

    Args:
        facets: numbers of their corners, in turn as seen from outside.
        places: of the nodes [m].

    Example:
        >>> import numpy as np
        >>> places = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, -1), (1, 1, -1.0)])
        >>> sharp, patch = sharp_edges(np.array([(0, 1, 2, 3), (1, 4, 5, 2)]), places)
        >>> sharp.astype(int).tolist(), patch.tolist()
        ([[0, 1, 0, 0], [0, 0, 0, 1]], [0, 1])
    """
    corners = places[facets]
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one, other = _pairs(np.sort(np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1), axis=-1))
    f, g = one // 4, other // 4
    cosines = np.sum(normals[f] * normals[g], axis=1)
    convex = np.sum(normals[f] * (middles[g] - middles[f]), axis=1) < 0
    bent = convex & (cosines < SHARP)
    sharp = np.zeros(facets.size, bool)
    sharp[np.concatenate([one[bent], other[bent]])] = True
    patch, before = np.arange(len(facets)), None
    f, g = f[~bent], g[~bent]
    while before is None or np.any(patch != before):
        before = patch.copy()
        least = np.minimum(patch[f], patch[g])
        np.minimum.at(patch, f, least)
        np.minimum.at(patch, g, least)
        # The facet that has given its number has a lower one itself by now.
        patch = patch[patch]
    return sharp.reshape(facets.shape), patch


def _pairs(edges: Int[np.ndarray, "f 4 2"]) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Numbers of edges of facets that are the same edge, of two of them."""
    flat = edges.reshape(-1, 2)
    _, number, count = np.unique(flat, axis=0, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    shared = np.flatnonzero((count[number] == 2) & (flat[:, 0] != flat[:, 1]))
    order = shared[np.argsort(number[shared], kind="stable")]
    return order[::2], order[1::2]
