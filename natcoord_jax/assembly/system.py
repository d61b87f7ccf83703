"""The compiled system: arrays as leaves, structure static and hashable."""

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.assembly.tree import Tree
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.state import State, Trajectory


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
    bodies: Int[Array | np.ndarray, "n k"]
    joints: Int[Array | np.ndarray, "n j"]
    inputs: Int[Array | np.ndarray, "n i"]
    coordinates: Int[Array | np.ndarray, "n c"]
    rotors: Int[Array | np.ndarray, "n r"]
    works: Int[Array | np.ndarray, "n w"]
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
    joints: Int[Array | np.ndarray, " n"]
    index: Int[Array | np.ndarray, " n"]


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
    joint_bodies: Int[Array | np.ndarray, "joints 2"]
    tree: Tree
    joints: tuple[Group, ...]
    effects: tuple[Group, ...]
    coordinates: tuple[CoordinateGroup, ...]
    structure: Structure = eqx.field(static=True)

    def energy(self, motion: State | Trajectory) -> "diagnostics.Energy":
        """Kinetic energy and stored energies [J]; see `Energy`."""
        return diagnostics.energy(self, motion)

    def momentum(self, motion: State | Trajectory) -> Float[Array, "*t 3"]:
        """Momentum L [kg m/s]."""
        return diagnostics.momentum(self, motion)

    def angular_momentum(self, motion: State | Trajectory) -> Float[Array, "*t 3"]:
        """Angular momentum J about the origin [kg m^2/s] (55)."""
        return diagnostics.angular_momentum(self, motion)

    def constraint_errors(self, motion: State | Trajectory) -> "diagnostics.ConstraintErrors":
        """Largest violations of the constraints and of their rates."""
        return diagnostics.constraint_errors(self, motion)

    def work(self, motion: State | Trajectory) -> dict[str, Float[Array, "*t"]]:
        """Work done so far [J] by each input, load, damper and drive, by name."""
        states = diagnostics.states_of(motion)
        return {name: states.work[..., k] for k, name in enumerate(self.structure.works)}

    def body_index(self, body: Handle | str) -> int:
        """Number of a body in the rows of the state.

        Raises:
            ValueError: for a name that is no body of this system.
        """
        return _index(self.structure.bodies, body, "body")

    def joint_index(self, joint: Handle | str) -> int:
        """Number of a joint.

        Raises:
            ValueError: for a name that is no joint of this system.
        """
        return _index(self.structure.joints, joint, "joint")

    def input_index(self, name: Handle | str) -> int:
        """Number of an input channel.

        Raises:
            ValueError: for a name that is no input of this system.
        """
        return _index(self.structure.inputs, name, "input")

    def explain(self, trajectory: Trajectory) -> str:
        """How a run ended, in words, with the part of the worst residual by name."""
        return diagnostics.explain(self, trajectory)

    def raise_on_failure(self, trajectory: Trajectory) -> None:
        """Raise `SimulationError` for a concrete trajectory that failed."""
        diagnostics.raise_on_failure(self, trajectory)


def _index(names: tuple[str, ...], part: Handle | str, kind: str) -> int:
    name = part.name if isinstance(part, Handle) else part
    if name not in names or not name:
        known = [n for n in names if n]
        raise ValueError(f"this system has no {kind} {name!r}; it has {known}")
    return names.index(name)


from natcoord_jax.assembly import diagnostics  # noqa: E402  (needs System)
