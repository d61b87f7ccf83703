"""Integration over triangles."""

import numpy as np

# Seven points of a triangle, exact to degree five (Radon 1948): barycentric coordinates and weights.
_A, _B = (6 - np.sqrt(15)) / 21, (6 + np.sqrt(15)) / 21
_WA, _WB = (155 - np.sqrt(15)) / 1200, (155 + np.sqrt(15)) / 1200
TRIANGLE = np.array(
    [(1 / 3, 1 / 3, 1 / 3)]
    + [np.roll((1 - 2 * a, a, a), k) for a in (_A, _B) for k in range(3)]
)  # fmt: skip
WEIGHTS = np.array([9 / 40] + [w for w in (_WA, _WB) for _ in range(3)])

THREE = np.array([np.roll((2 / 3, 1 / 6, 1 / 6), k) for k in range(3)])
"""Three points of equal weights, exact to degree two."""
