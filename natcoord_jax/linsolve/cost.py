"""What the work on fronts costs, as measured on one core; decides orders, merging and buckets.

The figures are times in microseconds on one core with AVX-512, in double precision. Only their ratios
matter: another machine gets a correct, perhaps not the best, plan.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

Number = int | float | np.number | np.ndarray
BUCKET = 20.0  # one bucket: the calls of its kernels, and a share of what it takes to compile them


def front(pivots: Number, boundary: Number) -> Any:
    """Time to eliminate a front with so many pivots and so many unknowns left."""
    p, b = np.asarray(pivots, float), np.asarray(boundary, float)
    inverse = 0.2 + 2 * p**3 / np.minimum(20000.0, 370.0 * np.maximum(p, 1))
    products = (4 * p**2 * b + 2 * p * b**2) / np.minimum(40000.0, 2000.0 + 900.0 * np.minimum(p, b))
    moved = 5e-4 * (p + b) ** 2 + 1.5e-3 * b**2 + 1e-3 * p * (p + 2 * b)
    return inverse + products + moved + 0.3


def cut(pivots: Sequence[int], boundary: Sequence[int], overhead: float) -> list[list[int]]:
    """Fronts of one level in buckets of similar size, padded to the largest in each: the cheapest way.

    Args:
        pivots: of the fronts.
        boundary: of the fronts.
        overhead: of one bucket, in the unit of `front`.

    Returns:
        Members of each bucket.
    """
    shapes: dict[tuple[int, int], list[int]] = {}
    for k, shape in enumerate(zip(map(padded, pivots), boundary)):
        shapes.setdefault(shape, []).append(k)
    order = sorted(shapes, key=lambda s: float(front(*s)))
    counts = np.array([len(shapes[s]) for s in order])
    before = np.concatenate([[0], np.cumsum(counts)])
    p, b = np.array(order).T
    best, start = [0.0], [0]
    for end in range(1, len(order) + 1):
        # The largest sizes of shapes `first` to `end`, for every `first`.
        most_p = np.maximum.accumulate(p[:end][::-1])[::-1]
        most_b = np.maximum.accumulate(b[:end][::-1])[::-1]
        work = (before[end] - before[:end]) * front(most_p, most_b)
        total = np.array(best) + work + overhead
        start.append(int(np.argmin(total)))
        best.append(float(total[start[-1]]))
    buckets, end = [], len(order)
    while end:
        buckets.append([k for s in order[start[end] : end] for k in shapes[s]])
        end = start[end]
    return buckets[::-1]


def padded(pivots: int) -> int:
    """Pivots of a front as it is stored: large ones are inverted by blocks of eight."""
    return pivots if pivots <= 16 else -(-pivots // 8) * 8
