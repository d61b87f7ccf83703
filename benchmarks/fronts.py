"""What the fronts of plates and blocks hold and cost, by their meshes alone; nothing is simulated.

usage: python -m benchmarks.fronts [--quick]
"""

import argparse

import numpy as np

from natcoord_jax.linsolve.blocks import block_pattern
from natcoord_jax.linsolve.graph import graph_of
from natcoord_jax.linsolve.multifrontal import cheapest
from natcoord_jax.linsolve.symbolic import Sizes, estimate

PLATES = ((32, 32), (64, 64), (128, 128), (192, 192))
BLOCKS = ((8, 8, 8), (16, 16, 16), (24, 24, 24))
UNKNOWNS = {2: 5, 3: 3}
"""Of a node of a plate and of a block."""


def grid(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the cells of a grid, and places of its nodes."""
    nodes = [k + 1 for k in shape]
    numbers = np.arange(np.prod(nodes)).reshape(nodes)
    corners = [
        numbers[tuple(slice(at, at + k) for at, k in zip(corner, shape))].ravel()
        for corner in np.ndindex(*(2,) * len(shape))
    ]
    places = np.stack(np.meshgrid(*map(np.arange, nodes), indexing="ij"), axis=-1)
    return np.stack(corners, axis=1), places.reshape(-1, len(shape)).astype(float)


def fronts(shape: tuple[int, ...]) -> dict[str, float]:
    """What the plan for a plate or a block holds and costs.

    Batches are of fronts of about one size, which are eliminated together: what compiling costs. A front of
    p pivots and b rows that it leaves holds p^2 + 2 p b numbers, and takes 2 p^3 operations for its inverse
    and 4 p^2 b + 2 p b^2 for the products.

    Args:
        shape: cells along each edge.

    Returns:
        Unknowns, bytes of factors, operations of a factorisation, rows of the largest front, batches.
    """
    cells, places = grid(shape)
    own = UNKNOWNS[len(shape)]
    elements = (cells[:, :, None] * own + np.arange(own)).reshape(len(cells), -1)
    _, entries = block_pattern(np.repeat(np.arange(len(places)), own), [elements])
    graph = graph_of(entries)
    sizes, plan = Sizes(graph), cheapest(graph, places)
    p, b = np.array([sizes.of(front) for front in plan], float).T
    return {
        "unknowns": own * len(places),
        "factors": 8 * float(np.sum(p**2 + 2 * p * b)),
        "operations": float(np.sum(2 * p**3 + 4 * p**2 * b + 2 * p * b**2)),
        "largest": int(np.max(p + b)),
        "batches": sum(map(len, estimate(plan, sizes)[1])),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the coarsest meshes only")
    quick = parser.parse_args().quick
    print(f"{'mesh':>14} {'unknowns':>9} {'factors [MB]':>13} {'[Gflop]':>8} {'largest front':>14}")
    for shape in (PLATES[:1] + BLOCKS[:1]) if quick else PLATES + BLOCKS:
        found = fronts(shape)
        print(
            f"{' x '.join(map(str, shape)):>14} {found['unknowns']:>9} {1e-6 * found['factors']:>13.0f} "
            f"{1e-9 * found['operations']:>8.2f} {found['largest']:>14}",
            flush=True,
        )


if __name__ == "__main__":
    main()
