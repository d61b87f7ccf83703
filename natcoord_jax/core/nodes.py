"""Handles of sets of nodes: indexed, sliced, and selected by position."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, NAME, of


@dataclass(frozen=True, eq=False)
class NodeSet:
    """Nodes of a set, or some of them.

    One number gives the handle of a node, which joints, markers and sensors take as that of any body;
    slices, arrays of numbers and conditions give some of the nodes.

    Attributes:
        name: of the set.
        scene: identity of the scene.
        numbers: of the nodes in the set.
        positions: of the nodes in the assembled pose (n, 3) [m].

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> line = scene.add(nc.Nodes.points(np.linspace((0, 0, 0), (1, 0, 0), 5), mass=0.1, name="line"))
        >>> line[4], len(line[1:3]), line.where(lambda x: x[:, 0] > 0.6)
        (<body 'line[4]'>, 2, <2 nodes of 'line'>)
    """

    name: str
    scene: int
    numbers: np.ndarray
    positions: Any

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[Handle]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, index: Any) -> Any:
        """A handle, or a set of some.

        Raises:
            IndexError: for numbers beyond the ends.
        """
        if isinstance(index, int | np.integer) and not isinstance(index, bool):
            if not -len(self) <= index < len(self):
                raise IndexError(f"nodes {self.name!r}: there is no node {index}; there are {len(self)}")
            return Handle("body", f"{self.name}[{int(self.numbers[index])}]", self.scene)
        index = index if isinstance(index, slice) else np.asarray(index)
        return NodeSet(self.name, self.scene, self.numbers[index].reshape(-1), self.positions[index])

    def where(self, condition: Callable[[Any], Any]) -> "NodeSet":
        """The nodes whose positions obey a condition.

        Args:
            condition: of positions (n, 3) [m] to booleans (n,).
        """
        return self[np.flatnonzero(np.asarray(condition(self.positions)))]

    def __repr__(self) -> str:
        return f"<{len(self)} nodes of {self.name!r}>"


@dataclass(frozen=True, eq=False)
class NodeUnion:
    """Nodes of several sets, one set after the other, for elements that lie on all of them.

    Attributes:
        parts: the sets, or some nodes of each.
    """

    parts: tuple[NodeSet, ...]

    @property
    def numbers(self) -> np.ndarray:
        """Of the nodes, through all sets."""
        return np.arange(len(self))

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def __getitem__(self, index: int) -> Handle:
        for part in self.parts:
            if index < len(part):
                return part[index]
            index -= len(part)
        raise IndexError(f"there is no node {index}")

    def __repr__(self) -> str:
        return " and ".join(map(repr, self.parts))


class Clamp(Part):
    """Nodes that are rigidly part of a body, or of the ground, with all that they carry.

    They have no unknowns of their own, and are no bodies of the system any more: what is fixed to them is
    fixed to the body, which also gets their mass.

    Attributes:
        body: handle of the body, or `nc.ground`.
        nodes: some nodes of a set.
        name: optional name.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> import numpy as np
        >>> scene = nc.Scene()
        >>> line = scene.add(nc.Nodes.points(np.linspace((0, 0, 0), (1, 0, 0), 5), mass=0.1, name="line"))
        >>> pairs = np.stack([np.arange(4), np.arange(1, 5)], axis=1)
        >>> springs = scene.add(nc.Spring.on(line, pairs, stiffness=50.0, length=0.25))
        >>> held = scene.add(nc.Clamp(nc.ground, line[:1]))
        >>> scene.compile()[0].structure.unknowns
        12
    """

    body: Handle = eqx.field(static=True, metadata=is_a(BODY))
    nodes: NodeSet = eqx.field(static=True, metadata=is_a(of("some nodes of a set, as mesh[:4]", NodeSet)))
    name: Any = eqx.field(static=True, default=None, kw_only=True, metadata=is_a(NAME))

    kind = "clamp"
