"""Edges of the graph of bodies: joints, and elements that make neighbours."""

from itertools import pairwise
from typing import Any

from natcoord_jax.core.effect import Effect
from natcoord_jax.core.joint import Joint
from natcoord_jax.model.assembled_poses import Poses
from natcoord_jax.model.graph import Edge


def edge_of(name: str, joint: Joint, poses: Poses, sets: int) -> Edge:
    """The edge of a joint.

    Raises:
        ValueError: for a joint that is to be free in a tree, which cannot hold it.
    """
    pair = poses.of(joint.parent), poses.of(joint.child)
    # Nodes of sets are free: what joins them keeps its multipliers.
    free = joint.free and min(pair) >= sets
    edge = Edge(*pair, joint.rotations, joint.translations, joint.child_rotation, free)
    if joint.free and not (edge.carries and len(edge.slots) == 6 - joint.multipliers):
        also = " and about the child's first axis" if joint.child_rotation else ""
        raise ValueError(
            f"joint {name!r}: a tree cannot hold a joint of {joint.multipliers} multipliers that turns "
            f"about axes {joint.rotations}{also} and slides along axes {joint.translations}; declare "
            f"`free = False` in {type(joint).__name__}, which keeps its multipliers"
        )
    return edge


def coupled_pairs(effects: dict[str, Effect], poses: Poses, sets: int) -> list[tuple[int, int]]:
    """Pairs of neighbouring bodies of the effects that make neighbours of them, but for nodes of sets."""
    found = []
    for effect in effects.values():
        if effect.couples:
            markers: Any = getattr(effect, "markers", ())
            listed = [poses.carrier(handle) for m in markers for handle in getattr(m, "handles", (m.body,))]
            found += [pair for pair in pairwise(listed) if min(pair) >= sets]
    return found
