"""Stacking of equal kinds: one group for all instances that share class, structure and shapes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import NUMERIC, as_array, check_fields, shape_of
from natcoord_jax.core.eager_numpy import stacked
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.elements import Elements
from natcoord_jax.core.names import Names
from natcoord_jax.core.nodes import NodeUnion
from natcoord_jax.model.groups import Group
from natcoord_jax.model.segment_sum import SegmentSum


@dataclass
class Instance:
    """One effect ready for stacking: its bare module and where it sits."""

    name: str
    effect: Effect
    source: str
    bodies: list[int]
    weights: Any = None
    joints: list[int] = field(default_factory=list)
    inputs: list[int] = field(default_factory=list)
    coordinates: list[int] = field(default_factory=list)
    rotors: list[int] = field(default_factory=list)
    works: list[int] = field(default_factory=list)
    in_tree: bool = False


def bare(effect: Effect, drop: Sequence[str], label: str) -> Effect:
    """The effect with numbers as arrays and without what only the scene needs.

    Raises:
        ValueError: if a field is neither number nor function, or not finite.
    """
    effect = replace_fields(effect, **dict.fromkeys(drop))
    effect = replace_fields(effect, **{f.name: _as_one(getattr(effect, f.name)) for f in fields(effect)})
    check_fields(effect, label)

    def leaf(value: Any) -> Any:
        if isinstance(value, jax.Array | np.ndarray) and value.dtype.kind not in "USO":
            return as_array(value, float) if jnp.issubdtype(value.dtype, jnp.floating) else value
        if isinstance(value, bool | str):
            raise ValueError(
                f"{label}: the field value {value!r} is no number; declare the field "
                "`eqx.field(static=True)` to keep it as structure"
            )
        if isinstance(value, int | float | np.number):
            return as_array(value, float)
        if callable(value):
            return Function.of(value)
        raise ValueError(f"{label}: cannot use {value!r} as a parameter; pass numbers, arrays or functions")

    return jax.tree.map(leaf, effect)


def _as_one(value: Any) -> Any:
    """A tuple of numbers as one array, in modules too; anything else as it is."""
    if isinstance(value, eqx.Module) and not isinstance(value, Function):
        inner = {f.name: getattr(value, f.name) for f in fields(value) if not f.metadata.get("static")}
        return replace_fields(value, **{name: _as_one(x) for name, x in inner.items()})
    if not isinstance(value, tuple | list):
        return value
    leaves = jax.tree.leaves(value)
    if not leaves or not all(isinstance(x, NUMERIC) and not isinstance(x, bool) for x in leaves):
        return value
    return value if shape_of(value) is None else as_array(value, float)


def families(instances: list[Instance]) -> list[list[Instance]]:
    """Instances with equal class, static fields and shapes, in order of first appearance.

    A field sits on all bodies by itself and is a family of its own.
    """
    found: dict[Any, list[Instance]] = {}
    for instance in instances:
        leaves, structure = jax.tree.flatten(instance.effect)
        shapes = tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
        own = instance.name if instance.source == "mass" else ""
        key = (structure, shapes, len(instance.bodies), instance.source, instance.in_tree, own)
        found.setdefault(key, []).append(instance)
    return list(found.values())


def stack(instances: list[Instance], turning: np.ndarray) -> tuple[Group, ...]:
    """Groups of equal instances; `turning` tells which bodies do, the ground last."""
    return tuple(_group(members, turning) for members in families(instances))


def element_group(layout: Any, name: str, elements: Elements, turning: np.ndarray) -> Group:
    """The group of a set of elements."""
    effect, label, count = elements.effect, f"elements {name!r}", len(elements)
    if effect.inputs or effect.rotors:
        raise ValueError(f"{label}: {type(effect).__name__} has inputs; add it one by one")
    if effect.works:
        layout.works.append(name)
    # Of all nodes of a set, or of some of several.
    nodes = elements.nodes
    if isinstance(nodes, NodeUnion):
        located = [[x[part.numbers] for x in layout.nodes(part.name)] for part in nodes.parts]
        places, rows = map(np.concatenate, zip(*located))
    else:
        places, rows = layout.nodes(nodes.name)
    scene, weights = places[elements.connectivity], elements.weights(rows)
    alone = bare(effect, ("markers", "name"), label)
    bodies, nothing = layout.body_number[scene].astype(np.int32), np.zeros((count, 0), np.int32)
    return Group(
        elements.stacked(alone, weights, layout.rows_at(scene), label),
        as_array(weights),
        bodies,
        *(nothing,) * 5,
        acting=SegmentSum.of(bodies, len(layout.bodies)),
        count=count,
        names=Names(((name, (range(count),)),)),
        source="markers",
        turning=bool(turning[bodies].any()),
    )


def _group(members: list[Instance], turning: np.ndarray) -> Group:
    first, bodies = members[0], len(turning) - 1
    field_like = first.source == "mass"
    count = bodies if field_like else len(members)

    def table(name: str) -> np.ndarray:
        if field_like:
            every = np.arange(bodies, dtype=np.int32)[:, None]
            return every if name == "bodies" else every[:, :0]
        return np.array([getattr(m, name) for m in members], np.int32).reshape(count, -1)

    effects = [m.effect for m in members]
    return Group(
        first.effect if field_like else jax.tree.map(lambda *x: stacked(x), *effects),
        stacked([m.weights for m in members]) if first.weights is not None else None,
        *(table(name) for name in ("bodies", "joints", "inputs", "coordinates", "rotors", "works")),
        acting=SegmentSum.of(table("bodies"), bodies),
        count=count,
        names=tuple(m.name for m in members),
        source=first.source,
        in_tree=first.in_tree,
        turning=bool(turning[table("bodies")].any()),
    )
