"""A loop of NumPy that stands in for a peer: products, an assembly and a solution, as a step of elements has.

It is FROZEN: ratios that are kept are to this very work. Never change it; write another beside it.
"""

from collections.abc import Callable

import numpy as np

ELEMENTS, LOCAL, UNKNOWNS, ROUNDS = 64, 24, 160, 2


def frozen_loop(steps: int) -> Callable[[], None]:
    """So many steps of always the same numbers, ready to be timed."""
    random = np.random.default_rng(0)
    matrices = random.normal(size=(ELEMENTS, LOCAL, LOCAL))
    places = random.integers(0, UNKNOWNS, size=(ELEMENTS, LOCAL))
    system = random.normal(size=(UNKNOWNS, UNKNOWNS)) + 4 * UNKNOWNS**0.5 * np.eye(UNKNOWNS)

    def call() -> None:
        x = np.ones(UNKNOWNS)
        for _ in range(steps):
            for _ in range(ROUNDS):
                forces = np.matmul(matrices, np.sin(x[places])[:, :, None])[:, :, 0]
                residual = np.bincount(places.ravel(), weights=forces.ravel(), minlength=UNKNOWNS)
                x = x - np.linalg.solve(system, residual)
            x /= np.linalg.norm(x)

    return call
