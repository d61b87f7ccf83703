"""Nodes at the same place."""

import numpy as np
from jaxtyping import Float, Int

SAME = 1e-9
"""Distance relative to the extent of the mesh up to which nodes are at the same place."""


def places(nodes: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Numbers of places, equal for nodes at the same one."""
    size = SAME * max(float(np.ptp(nodes, axis=0).max(initial=0.0)), 1e-300)
    # Rounded to a grid of twice the distance, and again to one shifted by half: neighbours that one grid
    # parts share a place in the other, unless they are a diagonal apart.
    found = np.arange(len(nodes))
    for shift in (0.0, 0.5):
        _, number = np.unique(np.floor(nodes / (2 * size) + shift), axis=0, return_inverse=True)
        number = number.reshape(-1)
        least = np.full(number.max(initial=-1) + 1, len(nodes))
        np.minimum.at(least, number, found)
        found = least[number]
    return found


def twins(nodes: Float[np.ndarray, "n 3"]) -> tuple[int, int] | None:
    """Two nodes at the same place, if there are any."""
    number = places(nodes)
    first = np.unique(number, return_index=True)[1]
    later = np.setdiff1d(np.arange(len(nodes)), first)
    if not later.size:
        return None
    return int(np.flatnonzero(number == number[later[0]])[0]), int(later[0])
