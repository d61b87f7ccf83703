"""Elements by the thousands: equal effects on the nodes of a set, added to a scene as arrays."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import declared
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect, replace_fields
from natcoord_jax.core.flaws import flaws_of
from natcoord_jax.core.kinds import is_other
from natcoord_jax.core.markers import Attachment, Marker, Point
from natcoord_jax.core.nodes import NodeSet, NodeUnion
from natcoord_jax.core.numeric import array_of, range_of, shown
from natcoord_jax.core.potential import place_markers


class Elements(eqx.Module):
    """Effects of one kind on nodes of one set; made by `on`.

    Attributes:
        effect: one of them, whose numbers are those of all but `each`.
        each: numbers of every element by field, leading axis n.
        nodes: the set.
        connectivity: numbers of the nodes of each element.
        name: of the set of elements, or None.
    """

    effect: Effect
    each: dict[str, Any]
    nodes: NodeSet | NodeUnion = eqx.field(static=True)
    connectivity: Int[np.ndarray, "n k"]
    name: str | None = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.connectivity)

    def weights(self, rows: Float[np.ndarray, "nodes 4 4"]) -> Float[np.ndarray, "n k *m 4"]:
        """Weights of the vectors of every node: of its point, and of its directors.

        Args:
            rows: of all nodes, as weights of the rows of their bodies.
        """
        own = rows[self.connectivity, : self.effect.vectors]
        return own[:, :, 0] if self.effect.vectors == 1 else own

    def stacked(self, bare: Effect, weights: np.ndarray, rows: Float[Array, "n k 4 3"], label: str) -> Effect:
        """All elements as one module, with the numbers that they take from the assembled pose.

        Args:
            bare: `effect` as arrays.
            weights: of the vectors of the nodes.
            rows: of the bodies of the nodes of every element.
            label: the set, for messages.

        Raises:
            ValueError: for an element that cannot be, with its number and its nodes.
        """
        n = len(self)
        if not is_concrete(bare, self.each):
            raise ValueError(
                f"{label}: their numbers are traced; compile the scene outside of jit and grad, and pass "
                "what varies by system.set"
            )
        given = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (n, *np.shape(x))), bare)
        given = replace_fields(given, **{key: as_array(value, float) for key, value in self.each.items()})
        for key, value in self.each.items():
            self._check(key, np.asarray(value), label)
        found = given
        if type(bare).assembled_at is not Effect.assembled_at:
            found = _assembled(given, as_array(weights), rows)
        flaw, _ = flaws_of(found)
        if flaw is not None:
            number, said = flaw
            raise ValueError(
                f"{label}: element {number}, on the nodes {self.connectivity[number].tolist()}, {said}"
            )
        return found

    def _check(self, key: str, values: np.ndarray, label: str) -> None:
        """Refuse numbers of single elements that one alone would refuse."""
        kind = range_of(declared(self.effect, key))
        good = np.isfinite(values) if kind is None else kind.includes(values)
        for number in np.flatnonzero(~good.reshape(len(values), -1).all(1)):
            wanted = "finite numbers" if kind is None else kind.wanted
            raise ValueError(
                f"{label}: element {number}, on the nodes {self.connectivity[number].tolist()}, has {key} "
                f"{shown(values[number])}; pass {wanted}"
            )


@eager_numpy
def _assembled(effect: Effect, place: Array, rows: Array) -> Effect:
    return jax.vmap(lambda one, *where: one.assembled_at(place_markers(*where)))(effect, place, rows)


def on(
    cls: type, nodes: NodeSet | NodeUnion, connectivity: Any, each: Any, name: str | None, shared: Any
) -> Elements:
    """Elements of a class on nodes, see `Effect.on`.

    Raises:
        ValueError: for nodes of another kind, numbers that are none of the set's, or fields of another size.
    """
    label = f"{cls.__name__}.on"
    if not isinstance(nodes, NodeSet | NodeUnion):
        raise ValueError(f"{label}: nodes is {nodes!r}, but must be a set of nodes as scene.add returned it")
    table = np.asarray(connectivity)
    if table.ndim != 2 or table.dtype.kind not in "iu":
        raise ValueError(
            f"{label}: connectivity must be whole numbers (elements, nodes of each), not {table!r}"
        )
    if table.size and not 0 <= table.min() <= table.max() < len(nodes):
        raise ValueError(
            f"{label}: connectivity has nodes from {table.min()} to {table.max()}; {nodes!r} has 0 to "
            f"{len(nodes) - 1}"
        )
    odd = [key for key, value in (each or {}).items() if array_of(value) is None]
    if odd:
        raise ValueError(f"{label}: each[{odd[0]!r}] {is_other(each[odd[0]])}; pass numbers")
    each = {key: as_array(value, float) for key, value in (each or {}).items()}
    wrong = [key for key, value in each.items() if value.ndim < 1 or len(value) != len(table)]
    if wrong:
        raise ValueError(f"{label}: each[{wrong[0]!r}] needs a leading axis of {len(table)} elements")
    first = [nodes[int(k)] for k in table[0]] if len(table) else []
    markers: list[Marker | Attachment] = [Point(handle) for handle in first]
    if cls.vectors > 1:  # pyright: ignore[reportAttributeAccessIssue]
        markers = [Attachment(handle, (0.0, 0.0, 0.0), np.eye(3), local=True) for handle in first]
    one = {key: np.asarray(value)[0] for key, value in each.items()}
    return Elements(cls(tuple(markers), **shared, **one), each, nodes, nodes.numbers[table], name)
