"""Which form of the equations a system is solved in, and the order of recursive elimination."""

import numpy as np

from natcoord_jax.model.groups import Elimination, Group, Seats
from natcoord_jax.model.layout import Layout
from natcoord_jax.model.segment_sum import SegmentSum
from natcoord_jax.model.tree import Tree

REDUCED_LIMIT = 32
"""Unknowns up to which a tree is solved densely in one piece."""

LOOP_LIMIT = 40
"""Unknowns up to which a system with loops is solved in the joint null space."""

FULL_LIMIT = 100
"""Unknowns of the form with all multipliers up to which its matrix is dense."""

DEPTH_LIMIT = 12
"""Levels of the tree up to which its sweeps are unrolled."""


def adjacent(group: Group, neighbour: np.ndarray) -> bool:
    """Whether a group couples at most a body with the neighbour it follows (the ground aside)."""
    for members in group.bodies:
        real = sorted({int(b) for b in members if b < len(neighbour)})
        if len(real) > 2:
            return False
        if len(real) == 2 and neighbour[real[1]] != real[0] and neighbour[real[0]] != real[1]:
            return False
    return True


def dense_solver(effects: tuple[Group, ...], mass_between: bool) -> str:
    """Form with one dense matrix: the smallest, unless its Jacobian may not be found by differences."""
    return "full" if mass_between or any(group.effect.bends for group in effects) else "reduced"


def choose_solver(
    tree: Tree,
    multipliers: int,
    joints: tuple[Group, ...],
    effects: tuple[Group, ...],
    bodies: int,
    mass_between: bool,
) -> str:
    """Form of the equations: small systems reduced, large trees recursive, everything else full."""
    unknowns, depth = len(tree.slot_of), len(tree.levels)
    if dense_solver(effects, mass_between) != "reduced":
        depth = DEPTH_LIMIT + 1
    if unknowns + multipliers <= REDUCED_LIMIT and depth <= DEPTH_LIMIT:
        return "reduced"
    neighbour = np.asarray(tree.neighbour)
    open_tree = multipliers == 0 and not mass_between and all(g.in_tree for g in joints)
    if open_tree and all(adjacent(g, neighbour) for g in effects):
        return "recursive"
    if unknowns + multipliers <= LOOP_LIMIT and depth <= DEPTH_LIMIT:
        return "reduced"
    every = 6 * bodies + sum(g.count * g.multipliers for g in (*effects, *joints))
    return "full" if every <= FULL_LIMIT else "sparse"


def elimination_order(
    layout: Layout, effects: tuple[Group, ...], joints: tuple[Group, ...], mass_between: bool
) -> Elimination:
    """Where multipliers and blocks sit in the nodes of the tree.

    Raises:
        ValueError: if the system is no open tree with couplings between neighbours.
    """
    neighbour, bodies = np.array(layout.spanning.neighbour), len(layout.bodies)
    fitting = all(g.in_tree for g in joints) and all(adjacent(g, neighbour) for g in effects)
    if mass_between or not fitting:
        raise ValueError(
            'solver="recursive" needs an open tree whose effects couple a body with its parent at most, '
            'without mass between bodies; use solver="full" or None'
        )
    owned: list[list[int]] = [[] for _ in range(bodies)]
    seats, total = [], 0
    for group in effects:
        table = np.asarray(group.bodies)
        # Bodies are numbered from the root: the deeper one has the larger number.
        nodes = np.where(table < bodies, table, -1).max(axis=1)
        others = np.where((table < bodies) & (table != nodes[:, None]), table, -1).max(axis=1)
        nodes, others = (np.where(x < 0, bodies, x) for x in (nodes, others))
        seats.append(Seats(SegmentSum.of(nodes, bodies), SegmentSum.of(others, bodies)))
        for node in nodes:
            owned[min(node, bodies - 1)] += range(total, total + group.multipliers)
            total += group.multipliers
    most = max((len(o) for o in owned), default=0)
    slots = np.array([o + [total] * (most - len(o)) for o in owned], np.int32).reshape(bodies, most)
    places = np.argsort(slots.reshape(-1), kind="stable")[:total].astype(np.int32)
    return Elimination(slots, places, tuple(seats))
