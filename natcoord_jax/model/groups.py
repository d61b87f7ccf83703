"""Groups of equal kinds of effects and of joint coordinates, stacked."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.callables import Stacked
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.names import Names
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.model.segment_sum import SegmentSum


class Group(Stacked):
    """All instances of one kind of effect, stacked.

    Attributes:
        effect: the effect with stacked numbers.
        weights: marker weights (n, k, 4), or (n, k, 4, 4) of attachments, of effects on markers, else None.
        bodies: bodies of each instance; the number of bodies stands for the ground.
        joints: joints of effects that sit on joints.
        inputs: input channels.
        coordinates: joint coordinates in the state.
        rotors: stored rates in the state.
        works: entries of the work account.
        acting: how bodies collect what acts on them.
        count: number of instances.
        names: of the instances.
        in_tree: joints of the spanning tree, whose multipliers are not needed.
        source: where the place of the effect comes from: "markers", "joint", "coordinates" or "mass".
        turning: whether any of the bodies turns; points do not.
        spans: of constraints how much each changes with the place of a body, and with its angle, at most: by
            them violations are compared with the size of the scene, (n, m, 2). None: there are none.
    """

    effect: Effect
    weights: Float[Array, "n k *m 4"] | None
    bodies: Int[np.ndarray, "n k"] = eqx.field(**INDICES)
    joints: Int[np.ndarray, "n j"] = eqx.field(**INDICES)
    inputs: Int[np.ndarray, "n i"] = eqx.field(**INDICES)
    coordinates: Int[np.ndarray, "n c"] = eqx.field(**INDICES)
    rotors: Int[np.ndarray, "n r"] = eqx.field(**INDICES)
    works: Int[np.ndarray, "n w"] = eqx.field(**INDICES)
    acting: SegmentSum
    count: int = eqx.field(static=True)
    names: Sequence[str] = eqx.field(static=True)
    source: str = eqx.field(static=True)
    in_tree: bool = eqx.field(static=True, default=False)
    turning: bool = eqx.field(static=True, default=True)
    spans: Any = None

    stacked: ClassVar[str] = "effect"

    @property
    def lanes(self) -> tuple[int, ...]:
        """Instances, where each has numbers of its own."""
        return () if self.effect.shared or self.source == "mass" else (self.count,)

    @property
    def is_set(self) -> bool:
        """Whether they were added as a set, which has one name and one account."""
        return isinstance(self.names, Names)

    @property
    def labels(self) -> Sequence[str]:
        """Names of the instances; of a set its own."""
        return [name for name, _ in self.names.runs] if isinstance(self.names, Names) else self.names

    @property
    def multipliers(self) -> int:
        """Multipliers of one instance and stage."""
        return self.effect.multipliers

    @property
    def holds(self) -> bool:
        """Whether they are of equations, which hold at any time."""
        return self.multipliers > 0 and not self.effect.unilateral

    @property
    def has_volumes(self) -> bool:
        """Whether they can be turned inside out."""
        return type(self.effect).volume_ratios is not Effect.volume_ratios

    @property
    def searches(self) -> bool:
        """Whether they look up their neighbours at the start of a step."""
        return type(self.effect).neighbours is not Effect.neighbours


class CoordinateGroup(eqx.Module):
    """Joint coordinates of one description: joints, their bodies and places in the state."""

    axis: Coordinate = eqx.field(static=True)
    joints: Int[np.ndarray, " n"] = eqx.field(**INDICES)
    index: Int[np.ndarray, " n"] = eqx.field(**INDICES)


class Seats(eqx.Module):
    """Nodes and parents of the instances of a group, whose blocks they collect."""

    nodes: SegmentSum
    parents: SegmentSum


class Elimination(eqx.Module):
    """Places in the nodes of the tree for recursive elimination.

    Attributes:
        slots: multipliers of each node, padded with their total number.
        places: of each multiplier, in the flattened slots.
        seats: of the instances of each effect group.
    """

    slots: Int[np.ndarray, "bodies m"] = eqx.field(**INDICES)
    places: Int[np.ndarray, " multipliers"] = eqx.field(**INDICES)
    seats: tuple[Seats, ...]
