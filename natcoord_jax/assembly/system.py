"""The compiled system: arrays as leaves, structure static and hashable."""

from dataclasses import dataclass

import equinox as eqx
from jaxtyping import Array, Float, Int

from natcoord_jax.assembly.tree import Tree
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.effect import Effect


class Group(eqx.Module):
    """All instances of one kind of effect, stacked.

    Attributes:
        effect: the effect with stacked numbers.
        weights: marker weights (n, k, 4) of effects on markers, else None.
        bodies: bodies of each instance; the number of bodies stands for the ground.
        joints: joints of effects that sit on joints.
        inputs: input channels.
        coordinates: joint coordinates in the state.
        rotors: stored rates in the state.
        works: entries of the work account.
        count: number of instances.
        names: of the instances.
        in_tree: joints of the spanning tree, whose multipliers are not needed.
        source: where the place of the effect comes from: "markers", "joint", "coordinates" or "mass".
    """

    effect: Effect
    weights: Float[Array, "n k 4"] | None
    bodies: Int[Array, "n k"]
    joints: Int[Array, "n j"]
    inputs: Int[Array, "n i"]
    coordinates: Int[Array, "n c"]
    rotors: Int[Array, "n r"]
    works: Int[Array, "n w"]
    count: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    source: str = eqx.field(static=True)
    in_tree: bool = eqx.field(static=True, default=False)

    @property
    def multipliers(self) -> int:
        """Multipliers of one instance and stage."""
        return self.effect.multipliers


class CoordinateGroup(eqx.Module):
    """Joint coordinates of one description: joints, their bodies and places in the state."""

    axis: Coordinate = eqx.field(static=True)
    joints: Int[Array, " n"]
    index: Int[Array, " n"]


@dataclass(frozen=True)
class Structure:
    """What is static about a system; hashable, so that equal structures share compiled programs.

    Attributes:
        bodies: names, in the order of the rows.
        joints: names of all joints, those of the tree first; the first `len(bodies)` belong to the bodies.
        inputs: names of the input channels.
        works: names of the entries of the work account.
        coordinates: (joint name, index) of each joint coordinate.
        rotors: number of stored rates.
        unknowns: number of tree unknowns (degrees of freedom of the spanning tree).
        multipliers: number of Lagrange multipliers that are solved for.
        solver: "reduced", "recursive" or "full".
        adjacent: whether all couplings are between a body and its parent, or a single body.
        notes: findings of the compilation for the report.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    inputs: tuple[str, ...]
    works: tuple[str, ...]
    coordinates: tuple[tuple[str, int], ...]
    rotors: int
    unknowns: int
    multipliers: int
    solver: str
    constraints: int
    redundant: int
    notes: tuple[str, ...]


class System(eqx.Module):
    """A compiled multibody system.

    Attributes:
        mass: mass blocks m (4, 4) of the bodies [kg, kg m, kg m^2] (15).
        frames: weights of the two frames of every joint; joint b carries body b.
        joint_bodies: parent and child of every joint.
        tree: the spanning tree.
        joints: constraint groups of all joints; a group is in the tree or closes loops, never both.
        effects: all other groups.
        coordinates: joint coordinates.
        structure: what is static.
    """

    mass: Float[Array, "bodies 4 4"]
    frames: Float[Array, "joints 2 4 4"]
    joint_bodies: Int[Array, "joints 2"]
    tree: Tree
    joints: tuple[Group, ...]
    effects: tuple[Group, ...]
    coordinates: tuple[CoordinateGroup, ...]
    structure: Structure = eqx.field(static=True)
