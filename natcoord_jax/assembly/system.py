"""The compiled system: arrays as leaves, structure static and hashable."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.assembly.local_rates import LocalRates
from natcoord_jax.assembly.segment_sum import SegmentSum
from natcoord_jax.assembly.tree import Tree
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Stacked
from natcoord_jax.core.coordinate import Coordinate
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY_NAME, JOINT_NAME, NAME, HandleOf, Several, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.names import Names, listed
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.state import MOTION, STATE, TRAJECTORY, State, Trajectory

ELEMENT = HandleOf("effect") | NAME
PART = of("the handle or name of a body, a joint or an effect", Handle, str)
SENSED = (
    of("the handle or name of a body, a joint or an element", Handle, str)
    | of("nc.Point or nc.Direction", Marker)
    | Several(ELEMENT, 1)
)


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
    """

    effect: Effect
    weights: Float[Array, "n k *m 4"] | None
    bodies: Int[Array | np.ndarray, "n k"]
    joints: Int[Array | np.ndarray, "n j"]
    inputs: Int[Array | np.ndarray, "n i"]
    coordinates: Int[Array | np.ndarray, "n c"]
    rotors: Int[Array | np.ndarray, "n r"]
    works: Int[Array | np.ndarray, "n w"]
    acting: SegmentSum
    count: int = eqx.field(static=True)
    names: Sequence[str] = eqx.field(static=True)
    source: str = eqx.field(static=True)
    in_tree: bool = eqx.field(static=True, default=False)
    turning: bool = eqx.field(static=True, default=True)

    stacked: ClassVar[str] = "effect"

    @property
    def lanes(self) -> tuple[int, ...]:
        """Instances, where each has numbers of its own, after the systems of a batch."""
        batch = np.shape(self.bodies)[:-2]
        return batch if self.effect.shared or self.source == "mass" else (*batch, self.count)

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


class CoordinateGroup(eqx.Module):
    """Joint coordinates of one description: joints, their bodies and places in the state."""

    axis: Coordinate = eqx.field(static=True)
    joints: Int[Array | np.ndarray, " n"]
    index: Int[Array | np.ndarray, " n"]


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

    slots: Int[Array | np.ndarray, "bodies m"]
    places: Int[Array | np.ndarray, " multipliers"]
    seats: tuple[Seats, ...]


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
        solver: "reduced", "recursive", "sparse" or "full".
        constraints: number of constraints, internal ones of rigid bodies included.
        dofs: degrees of freedom: unknowns less the structural rank of the remaining constraints.
        rank: structural rank of the constraints outside the tree where some are redundant, else None.
        points: numbers of the bodies that are point masses, without orientation.
        directors: numbers of the nodes with one director.
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
    dofs: int = field(default=0, compare=False)
    redundant: tuple[str, ...] = field(default=(), compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)
    shapes: tuple[Any, ...] = field(default=(), compare=False, repr=False)

    @property
    def held(self) -> int:
        """Multipliers of equations."""
        return self.multipliers - self.inequalities


class System(eqx.Module):
    """A compiled multibody system.

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
        sparsity: pattern and plan of the sparse Jacobian, only where it is the solver.
    """

    mass: Float[Array, "bodies 4 4"]
    frames: Float[Array, "joints 2 4 4"]
    joint_bodies: Int[Array | np.ndarray, "joints 2"]
    tree: Tree
    local_rates: LocalRates
    joints: tuple[Group, ...]
    effects: tuple[Group, ...]
    coordinates: tuple[CoordinateGroup, ...]
    coordinate_order: Int[Array | np.ndarray, " coordinates"]
    elimination: Elimination | None
    structure: Structure = eqx.field(static=True)
    sparsity: Any = None

    @checked("System.energy", motion=MOTION)
    def energy(self, motion: State | Trajectory) -> "diagnostics.Energy":
        """Kinetic energy and stored energies [J]; see `Energy`."""
        return diagnostics.energy(self, motion)

    @checked("System.momentum", motion=MOTION)
    def momentum(self, motion: State | Trajectory) -> Float[Array, "*t 3"]:
        """Momentum L [kg m/s]."""
        return diagnostics.momentum(self, motion)

    @checked("System.angular_momentum", motion=MOTION)
    def angular_momentum(self, motion: State | Trajectory) -> Float[Array, "*t 3"]:
        """Angular momentum J about the origin [kg m^2/s] (55)."""
        return diagnostics.angular_momentum(self, motion)

    @checked("System.constraint_errors", motion=MOTION)
    def constraint_errors(self, motion: State | Trajectory) -> "violations.ConstraintErrors":
        """Largest violations of the constraints and of their rates.

        Of a trajectory those velocities are judged that are read of it, see `tangent`; of a state its own.
        """
        return violations.constraint_errors(self, motion)

    @checked("System.tangent", motion=MOTION)
    def tangent(self, motion: State | Trajectory) -> State:
        """States with velocities that obey the constraints: the nearest in the metric of the mass.

        So velocities are read, by all sensors, and by controllers and terminal events. States of the
        energy-momentum step of order two, `trajectory.states`, have small parts across the constraints
        besides, which alternate from step to step: its balances hold with them. Trajectories of other
        schemes that keep velocities tangent, and of `EnergyMomentum(kick=False)`, are read as they are.

        Args:
            motion: state or trajectory, with any leading axes.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> scene = nc.Scene()
            >>> arm = scene.add(nc.RigidBody(mass=2.0, inertia=(1.0, 1.0, 1.0), com=(1.0, 0.0, 0.0)))
            >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0)))
            >>> gravity = scene.add(nc.Gravity())
            >>> system, state = scene.compile()
            >>> trajectory = nc.simulate(system, state, dt=0.1, steps=10)
            >>> as_they_are = system.constraint_errors(trajectory.states).velocity
            >>> as_read = system.constraint_errors(system.tangent(trajectory)).velocity
            >>> bool(as_they_are.max() > 1e-3), bool(as_read.max() < 1e-13)
            (True, True)
        """
        return reading.tangent_states(self, motion)

    @checked("System.work", motion=MOTION)
    def work(self, motion: State | Trajectory) -> dict[str, Float[Array, "*t"]]:
        """Work done so far [J] by each input, load, damper and drive, by name.

        After a dissipative scheme also "numerical dissipation", which is negative.
        """
        states = diagnostics.states_of(motion)
        works = {name: states.work[..., k] for k, name in enumerate(self.structure.works)}
        if states.dissipated is not None:
            works["numerical dissipation"] = -states.dissipated
        return works

    @checked("System.instant", motion=MOTION, inputs=Numbers(("...", None)))
    def instant(self, motion: State | Trajectory, inputs: Any = None) -> "instant.Instant":
        """Accelerations and reactions from the equations of motion at one instant, or along a trajectory.

        Args:
            motion: state or trajectory, with any leading axes.
            inputs: shape (inputs,) or (*leading, inputs) [N, N m]. Default: of a trajectory, at every saved
                state those of the step that starts there (with `save_every`, of the last step of the
                interval that starts there), and at the last state those of the last step; of a state, zero.

        Raises:
            ValueError: for a wrong shape of the inputs.
        """
        return instant.instant(self, motion, inputs)

    @checked("System.get", part=PART | Several(PART, 1), field=NAME)
    def get(self, part: Handle | str | Sequence[Handle | str], field: str | None = None) -> Any:
        """Numbers of a part by name.

        Args:
            part: handle or name of a body, a joint or an effect; or several of one kind, stacked.
            field: name of the number; None: all of them, in a dictionary. Of a body "mass" [kg], "com" [m]
                and "inertia" about it [kg m^2] in body axes, or all of it as "mass_block" (15); of an effect
                its fields, "field.number" for those of a module in a field, and "weights" of its markers
                (1, position in the body) or (0, direction); of a joint its fields and "frames", the weights
                of (point, axis 1, 2, 3) in parent and child.

        Raises:
            ValueError: for a part or a number that there is not, naming those that there are.
        """
        return parts.get(self, part, field)

    def set(self, part: Handle | str | Sequence[Handle | str], **values: Any) -> "System":
        """A copy of the system with other numbers in a part.

        Pure, differentiable in the numbers, and nothing is compiled anew for the copy. Numbers that move
        the geometry (weights, frames, the pitch of a screw) ask for `nc.assemble` of the state.

        Args:
            part: see `get`; of several, in a list, each is given the same value or one of its own, along a
                leading axis.
            **values: numbers by name, see `get`. Other numbers keep their values: with another mass a body
                keeps its centre of mass and its inertia.

        Raises:
            ValueError: for a part or a number that there is not, naming those that there are, or a shape
                that does not fit.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> scene = nc.Scene()
            >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), name="ball"))
            >>> ends = (nc.Point(nc.ground, (0, 0, 1)), nc.Point(ball))
            >>> spring = scene.add(nc.Spring(ends, stiffness=50.0, name="spring"))
            >>> system, state = scene.compile()
            >>> stiffer = system.set("spring", stiffness=60.0).set(ball, mass=2.0)
            >>> float(stiffer.get("spring", "stiffness")), float(stiffer.get(ball)["mass"])
            (60.0, 2.0)
        """
        return parts.set_numbers(self, part, values)

    @checked(
        "System.sense",
        motion=MOTION,
        part=SENSED,
        inputs=Numbers(("...", None)),
        state=STATE,
        about=Numbers(("...", 3)) | of("nc.Point", Marker),
    )
    def sense(
        self,
        motion: State | Trajectory,
        part: Handle | Marker | str | tuple[Handle | str, ...],
        *,
        inputs: Any = None,
        state: State | None = None,
        about: Any = None,
    ) -> Any:
        """Sensor of a body, a joint, a marker or elements of a beam.

        Args:
            motion: state or trajectory, with any leading axes.
            part: handle or name of a body (gives a `BodySensor`: position, rotation, quaternion, velocity,
                angular_velocity, com, ...) or joint (`JointSensor`: angle, displacement, coordinates, rates,
                force, torque), a point or direction (`MarkerSensor`: position, velocity, acceleration), or an
                element of a beam or several of them, `beam.elements` (`BeamReadings`: strain, resultant,
                energy).
            inputs: for accelerations and reactions, as in `instant`.
            state: the assembled pose that a marker in world coordinates refers to.
            about: of a joint, the point that its torque is about: shape (3,) or (*leading, 3) [m] in the
                world, or an `nc.Point`, which moves with its body. Default: the joint's point on the child.

        Raises:
            ValueError: for a part that is not in the system, a marker in world coordinates without
                `state`, or `about` where there is no reaction.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> scene = nc.Scene()
            >>> arm = scene.add(nc.RigidBody(mass=2.0, inertia=(1.0, 1.0, 1.0), com=(1.0, 0.0, 0.0)))
            >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(0, 1, 0)))
            >>> gravity = scene.add(nc.Gravity(vector=(0.0, 0.0, -9.0)))
            >>> system, state = scene.compile()
            >>> float(system.sense(state, hinge).angle)
            0.0
            >>> float(system.sense(state, hinge).force[2].round(9))
            6.0
        """
        return sensors.sense(self, motion, part, inputs=inputs, state=state, about=about)

    @checked("System.coordinate", motion=MOTION, joint=JOINT_NAME, index=Whole(0))
    def coordinate(
        self, motion: State | Trajectory, joint: Handle | str, *, index: int = 0
    ) -> Float[Array, "*t"]:
        """Coordinate number `index` of a joint [rad, counted on over many turns, or m].

        Raises:
            ValueError: for a joint that is not in the system or has no such coordinate.
        """
        return set_coordinates.coordinate(self, motion, joint, index)

    @checked("System.rate", motion=MOTION, joint=JOINT_NAME, index=Whole(0))
    def rate(self, motion: State | Trajectory, joint: Handle | str, *, index: int = 0) -> Float[Array, "*t"]:
        """Rate of coordinate number `index` of a joint [rad/s or m/s].

        Raises:
            ValueError: for a joint that is not in the system or has no such coordinate.
        """
        return set_coordinates.rate(self, motion, joint, index)

    @checked(
        "System.with_coordinate",
        state=STATE,
        joint=JOINT_NAME,
        value=Number(),
        rate=Number(),
        index=Whole(0),
    )
    def with_coordinate(
        self, state: State, joint: Handle | str, value: Any, *, rate: Any = None, index: int = 0
    ) -> State:
        """State with one joint coordinate set, and on request its rate.

        Everything that hangs on the joint is turned or moved along rigidly and keeps its motion relative to
        the joint; the coordinate counts on, so that 4 pi are two turns. A relation among the coordinates of
        the joint (the pitch of a screw) is kept; loops, drives and couplings of several joints are not: use
        `nc.assemble` afterwards where there are any. It keeps the coordinates and rates that were set, where
        the constraints allow it, and moves the others. Pure, jittable and differentiable.

        Args:
            state: one state.
            joint: handle or name of a joint of the spanning tree.
            value: new value [rad or m].
            rate: new rate [rad/s or m/s]; default: kept.
            index: which coordinate of the joint.

        Raises:
            ValueError: for a joint that closes a loop, is not in the system or has no such coordinate.
        """
        return set_coordinates.with_coordinate(self, state, joint, value, rate=rate, index=index)

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

    def report(self) -> str:
        """Contents, unknowns before and after reduction, the solver and why, in words."""
        return reporting.report(self)

    @checked("System.explain", trajectory=TRAJECTORY)
    def explain(self, trajectory: Trajectory) -> str:
        """How a run ended, in words, with the part of the worst residual by name."""
        return diagnostics.explain(self, trajectory)

    @checked("System.raise_on_failure", trajectory=TRAJECTORY)
    def raise_on_failure(self, trajectory: Trajectory) -> None:
        """Raise `SimulationError` for a concrete trajectory that failed."""
        diagnostics.raise_on_failure(self, trajectory)


SYSTEM = of("a system, as scene.compile() returned it with the state", System)
"""What an argument may be."""


def _index(names: Sequence[str], part: Handle | str, kind: str) -> int:
    name = part.name if isinstance(part, Handle) else part
    if name not in names or not name:
        raise ValueError(f"this system has no {kind} {name!r}; it has {listed(names)}")
    return names.index(name)


from natcoord_jax.assembly import (  # noqa: E402  (need System)
    diagnostics,
    instant,
    parts,
    reading,
    reporting,
    sensors,
    set_coordinates,
    violations,
)
