"""The data of a compiled system: numbers as leaves, structure static and hashable, indices included."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Batched
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import BODY_NAME, JOINT_NAME, NAME, HandleOf, of
from natcoord_jax.core.names import clamped, listed
from natcoord_jax.maths.indices import INDICES
from natcoord_jax.model.groups import CoordinateGroup, Elimination, Group
from natcoord_jax.model.islands import Islands
from natcoord_jax.model.local_rates import LocalRates
from natcoord_jax.model.masses import MassBetween
from natcoord_jax.model.tree import Tree


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
        inequalities: how many of them are of contacts.
        islands: numbers of the contacts that have impacts or rub, by what an impact at one of them reaches.
        solver: "reduced", "recursive", "sparse" or "full".
        constraints: number of constraints, internal ones of rigid bodies included.
        dofs: degrees of freedom: unknowns less the structural rank of the remaining constraints.
        rank: structural rank of the constraints outside the tree where some are redundant, else None.
        points: numbers of the bodies that are point masses, without orientation.
        directors: numbers of the nodes with one director.
        clamped: of nodes that are clamped, set and body by name, how many they are, and of how many.
        redundant: names of joints and relations whose constraints depend on the others.
        notes: findings of the compilation for the report.
        shapes: what to draw of the bodies, in their order; None: what has their inertia.
    """

    bodies: Sequence[str]
    joints: Sequence[str]
    inputs: tuple[str, ...]
    works: tuple[str, ...]
    coordinates: tuple[tuple[str, int], ...]
    rotors: int
    unknowns: int
    multipliers: int
    solver: str
    constraints: int
    rank: int | None = None
    points: Sequence[int] = ()
    directors: Sequence[int] = ()
    inequalities: int = 0
    islands: Islands = ()
    dofs: int = field(default=0, compare=False)
    clamped: tuple[tuple[str, str, int, int], ...] = field(default=(), compare=False)
    redundant: tuple[str, ...] = field(default=(), compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)
    shapes: tuple[Any, ...] = field(default=(), compare=False, repr=False)

    @property
    def held(self) -> int:
        """Multipliers of equations."""
        return self.multipliers - self.inequalities


class Model(Batched):
    """What a compiled multibody system holds.

    Attributes:
        mass: mass blocks m (4, 4) of the bodies [kg, kg m, kg m^2] (15).
        frames: weights of the two frames of every joint; joint b carries body b.
        joint_bodies: parent and child of every joint.
        tree: the spanning tree.
        local_rates: which components of the twists of the bodies are unknowns of local equations.
        joints: constraint groups of all joints; a group is in the tree or closes loops, never both.
        effects: all other groups.
        coordinates: joint coordinates.
        coordinate_order: place of each coordinate among those of all groups, one group after the other.
        elimination: order of recursive elimination, only where it is the solver.
        structure: what is static.
        mass_between: mass between bodies, as consistent masses of elements have it; None: there is none.
        sparsity: pattern and plan of the sparse Jacobian, only where it is the solver.
        size: of the assembled scene, with which lengths are compared: a scalar [m].
    """

    mass: Float[Array, "bodies 4 4"]
    frames: Float[Array, "joints 2 4 4"]
    joint_bodies: Int[np.ndarray, "joints 2"] = eqx.field(**INDICES)
    tree: Tree
    local_rates: LocalRates
    joints: tuple[Group, ...]
    effects: tuple[Group, ...]
    coordinates: tuple[CoordinateGroup, ...]
    coordinate_order: Int[np.ndarray, " coordinates"] = eqx.field(**INDICES)
    elimination: Elimination | None
    structure: Structure = eqx.field(static=True)
    mass_between: MassBetween | None = None
    sparsity: Any = None
    size: Any = None

    @property
    def batch(self) -> tuple[int, ...]:
        """Leading axes of several systems of one structure, as one of `jax.vmap`."""
        return np.shape(self.mass)[:-3]

    @checked("System.body_index", body=BODY_NAME)
    def body_index(self, body: Handle | str) -> int:
        """Number of a body in the rows of the state.

        Raises:
            ValueError: for a name that is no body of this system.
        """
        return _index(self.structure.bodies, body, "body")

    @checked("System.joint_index", joint=JOINT_NAME)
    def joint_index(self, joint: Handle | str) -> int:
        """Number of a joint.

        Raises:
            ValueError: for a name that is no joint of this system.
        """
        return _index(self.structure.joints, joint, "joint")

    @checked("System.input_index", name=HandleOf("effect") | NAME)
    def input_index(self, name: Handle | str) -> int:
        """Number of an input channel.

        Raises:
            ValueError: for a name that is no input of this system.
        """
        return _index(self.structure.inputs, name, "input")


SYSTEM = of("a system, as scene.compile() returned it with the state", Model)
"""What an argument may be."""

SomeModel = TypeVar("SomeModel", bound=Model)
"""A model, or a system, which is one."""


def _index(names: Sequence[str], part: Handle | str, kind: str) -> int:
    name = named(part)
    if name not in names or not name:
        raise ValueError(f"this system has no {kind} {name!r}; it has {listed(names)}{clamped(names, name)}")
    return names.index(name)
