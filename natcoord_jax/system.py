"""The compiled system: what can be asked of a model."""

from collections.abc import Sequence
from typing import Annotated, Any

from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import JOINT_NAME, NAME, Concrete, HandleOf, Several, of
from natcoord_jax.core.markers import Marker
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.state import MOTION, STATE, TRAJECTORY, State, Trajectory
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import states_of
from natcoord_jax.reading import (
    diagnostics,
    instant,
    parts,
    reporting,
    sensors,
    set_coordinates,
    tangent_states,
)
from natcoord_jax.reading.diagnostics import ConstraintErrors, Energy
from natcoord_jax.reading.instant import Instant

ELEMENT = HandleOf("effect") | NAME
PART = of("the handle or name of a body, a joint or an effect", Handle, str)
SENSED = (
    of("the handle or name of a body, a joint or an element", Handle, str)
    | of("nc.Point or nc.Direction", Marker)
    | Several(ELEMENT, 1)
)


class System(Model):
    """A compiled multibody system: what it holds, see `Model`, and what can be asked of it."""

    @checked("System.energy", motion=MOTION)
    def energy(self, motion: State | Trajectory) -> Energy:
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
    def constraint_errors(self, motion: State | Trajectory) -> ConstraintErrors:
        """Largest violations of the constraints and of their rates.

        Of a trajectory those velocities are judged that are read of it, see `tangent`; of a state its own.
        """
        return diagnostics.constraint_errors(self, motion)

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
        return tangent_states.tangent_states(self, motion)

    @checked("System.work", motion=MOTION)
    def work(self, motion: State | Trajectory) -> dict[str, Float[Array, "*t"]]:
        """Work done so far [J] by each input, load, damper and drive, by name.

        After a dissipative scheme also "numerical dissipation", which is negative.
        """
        states = states_of(motion)
        works = {name: states.work[..., k] for k, name in enumerate(self.structure.works)}
        if states.dissipated is not None:
            works["numerical dissipation"] = -states.dissipated
        return works

    @checked("System.instant", motion=MOTION, inputs=Numbers(("...", None)))
    def instant(self, motion: State | Trajectory, inputs: Any = None) -> Instant:
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
            part: handle or name of a body, a joint or an effect; or several of one kind, stacked. A name that
                parts share, as "floor" is that of "floor[0]" and so on, stands for all of them.
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
                that does not fit; for a number that the part refuses, as a negative stiffness. Where that
                is traced it becomes not a number, and a run with it ends with `Result.NONFINITE`.

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

    @checked("System.sense")
    def sense(
        self,
        motion: Annotated[State | Trajectory, MOTION],
        part: Annotated[Handle | Marker | str | tuple[Handle | str, ...], SENSED],
        *,
        inputs: Annotated[Any, Numbers(("...", None))] = None,
        state: Annotated[State | None, STATE] = None,
        about: Annotated[Any, Numbers(("...", 3)) | of("nc.Point", Marker)] = None,
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

    @checked("System.with_coordinate")
    def with_coordinate(
        self,
        state: Annotated[State, STATE],
        joint: Annotated[Handle | str, JOINT_NAME],
        value: Annotated[Any, Number()],
        *,
        rate: Annotated[Any, Number()] = None,
        index: Annotated[int, Whole(0)] = 0,
    ) -> State:
        """State with one joint coordinate set, and on request its rate.

        Everything that hangs on the joint is turned or moved along rigidly and keeps its motion relative to
        the joint: bodies on further joints, nodes of beams, shells and solids, and what constraints on points
        join to them. Nodes that hang on something that stays, too, are left as they are. The coordinate
        counts on, so that 4 pi are two turns. A relation among the coordinates of the joint (the pitch of a
        screw) is kept; loops, drives and couplings of several joints are not: use `nc.assemble` afterwards
        where there are any. It keeps the coordinates and rates that were set, where the constraints allow
        it, and moves the others. Pure, jittable and differentiable.

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

    def report(self) -> str:
        """Contents, unknowns before and after reduction, the solver and why, in words."""
        return reporting.report(self)

    @checked("System.explain", trajectory=Concrete(TRAJECTORY))
    def explain(self, trajectory: Trajectory) -> str:
        """How a run ended, in words, with the part of the worst residual by name."""
        return diagnostics.explain(self, trajectory)

    @checked("System.raise_on_failure", trajectory=TRAJECTORY)
    def raise_on_failure(self, trajectory: Trajectory) -> None:
        """Raise `SimulationError` for a concrete trajectory that failed."""
        diagnostics.raise_on_failure(self, trajectory)
