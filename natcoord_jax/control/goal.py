"""Where an optimal control problem ends: conditions on the final state and on the way there, joined with `&`.

A goal counts independent numbers: three of an attitude, and as many rates as there are free motions. Rates
are those with the momenta of the state: the step (57) also carries a little velocity normal to the
constraints, and goals must not contradict the conservation laws by as much.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.free_motions import owners
from natcoord_jax.control.goal_base import GOAL as GOAL
from natcoord_jax.control.goal_base import All as All
from natcoord_jax.control.goal_base import Goal as Goal
from natcoord_jax.control.goal_links import Integral as Integral
from natcoord_jax.control.goal_links import Linked as Linked
from natcoord_jax.control.goal_links import Periodic as Periodic
from natcoord_jax.control.goal_links import Turned as Turned
from natcoord_jax.control.goal_places import At as At
from natcoord_jax.control.goal_places import Within as Within
from natcoord_jax.control.goal_rest import Equilibrium as Equilibrium
from natcoord_jax.control.goal_rest import Undeformed as Undeformed
from natcoord_jax.control.memory import Ending as Ending
from natcoord_jax.control.tangent import steady_rates
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.kinds import BODY_NAME, JOINT_NAME, NAME, FunctionOf
from natcoord_jax.core.numeric import COMPONENTS, Number, Numbers, Rotations, Whole
from natcoord_jax.core.state import State
from natcoord_jax.maths.rotations import angular_velocity, from_quaternion, to_rotation_vector
from natcoord_jax.system import System

ROTATION = Numbers((4,)) | Rotations()
RESIDUAL = FunctionOf("(state) -> number or vector", 1)


class Attitude(Goal):
    """Attitude of a body: three numbers, the rotation vector that is missing [rad], the short way round.

    At half a turn both ways are as short, and it is one of them. Its slope is zero nowhere, so that each
    start shows the way to the goal. It knows no number of turns: those are counted by `nc.goal.Turned`.

    Attributes:
        body: handle or name.
        rotation: unit quaternion (w, x, y, z) or rotation matrix, body to world.
    """

    body: Handle | str = eqx.field(static=True, metadata=is_a(BODY_NAME))
    rotation: Any = eqx.field(metadata=is_a(ROTATION))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Rotation vector from the wanted attitude to that of the body, in world components."""
        given = jnp.asarray(self.rotation, float)
        wanted = from_quaternion(given) if given.shape == (4,) else given
        first = 4 * system.body_index(self.body) + 1
        now = state.q[first : first + 3].T
        return to_rotation_vector(now @ wanted.T)

    def labels(self, system: System) -> tuple[str, ...]:
        """Three components of the rotation that is missing."""
        return tuple(f"attitude of {named(self.body)!r}, {axis} [rad]" for axis in "xyz")

    def wanted(self) -> dict[str, Any]:
        """The attitude, as a matrix."""
        given = jnp.asarray(self.rotation, float)
        return {f"attitude of {named(self.body)!r} [-]": from_quaternion(given) if given.ndim == 1 else given}


class Position(Goal):
    """Position of a point of a body: three numbers [m].

    Attributes:
        body: handle or name.
        position: in space [m].
        point: in coordinates of the body [m]; its reference point if none is given.
    """

    body: Handle | str = eqx.field(static=True, metadata=is_a(BODY_NAME))
    position: Any = eqx.field(metadata=is_a(COMPONENTS))
    point: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Position less the wanted one."""
        first = 4 * system.body_index(self.body)
        weights = jnp.concatenate([jnp.ones(1), jnp.asarray(self.point, float)])
        return weights @ state.q[first : first + 4] - jnp.asarray(self.position, float)

    def labels(self, system: System) -> tuple[str, ...]:
        """Three components."""
        return tuple(f"position on {named(self.body)!r}, {axis} [m]" for axis in "xyz")

    def wanted(self) -> dict[str, Any]:
        """The position."""
        if not is_concrete(self.point):
            return {}
        point = np.asarray(self.point, float).tolist()
        return {f"position of point {point} of {named(self.body)!r} [m]": self.position}


class Motion(Goal):
    """Velocity and angular velocity of a body: six numbers [m/s, rad/s].

    Attributes:
        body: handle or name.
        velocity: of the reference point [m/s].
        angular_velocity: in world components [rad/s].
    """

    body: Handle | str = eqx.field(static=True, metadata=is_a(BODY_NAME))
    of_motion: ClassVar[bool] = True

    velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    angular_velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Motion less the wanted one."""
        first = 4 * system.body_index(self.body)
        rows, rates = state.q[first : first + 4], system.tangent(state).v[first : first + 4]
        spin = angular_velocity(rows[1:], rates[1:])
        return jnp.concatenate(
            [rates[0] - jnp.asarray(self.velocity), spin - jnp.asarray(self.angular_velocity)]
        )

    def labels(self, system: System) -> tuple[str, ...]:
        """Three components of each."""
        kinds = (("velocity", "m/s"), ("angular velocity", "rad/s"))
        return tuple(
            f"{kind} of {named(self.body)!r}, {axis} [{unit}]" for kind, unit in kinds for axis in "xyz"
        )

    def wanted(self) -> dict[str, Any]:
        """Both velocities."""
        name = named(self.body)
        turning = f"rate of turning of {name!r} [rad/s]"
        return {f"velocity of {name!r} [m/s]": self.velocity, turning: self.angular_velocity}


class Coordinate(Goal):
    """Value of a joint coordinate: one number [rad, counted on over many turns, or m].

    Attributes:
        joint: handle or name.
        value: [rad or m].
        index: which coordinate of the joint.
    """

    joint: Handle | str = eqx.field(static=True, metadata=is_a(JOINT_NAME))
    value: Any = eqx.field(metadata=is_a(Number()))
    index: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Coordinate less the wanted value."""
        return (system.coordinate(state, self.joint, index=self.index) - self.value)[None]

    def labels(self, system: System) -> tuple[str, ...]:
        """The coordinate."""
        return (f"coordinate {self.index} of {named(self.joint)!r} [rad or m]",)

    def wanted(self) -> dict[str, Any]:
        """The value."""
        return {f"coordinate {self.index} of {named(self.joint)!r} [rad or m]": self.value}


class Rate(Goal):
    """Rate of a joint coordinate: one number [rad/s or m/s].

    Attributes:
        joint: handle or name.
        value: [rad/s or m/s].
        index: which coordinate of the joint.
    """

    joint: Handle | str = eqx.field(static=True, metadata=is_a(JOINT_NAME))
    of_motion: ClassVar[bool] = True

    value: Any = eqx.field(default=0.0, metadata=is_a(Number()))
    index: int = eqx.field(default=0, kw_only=True, static=True, metadata=is_a(Whole(0)))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Rate less the wanted one."""
        return (system.rate(state, self.joint, index=self.index) - self.value)[None]

    def labels(self, system: System) -> tuple[str, ...]:
        """The rate."""
        return (f"rate {self.index} of {named(self.joint)!r} [rad/s or m/s]",)

    def wanted(self) -> dict[str, Any]:
        """The value."""
        return {f"rate {self.index} of {named(self.joint)!r} [rad/s or m/s]": self.value}


class Rest(Goal):
    """No motion at all: the rates of all free motions of the spanning tree are zero.

    That is six numbers of a free body and one of a hinge, not twelve a body. Some may follow from others,
    as the base of a spacecraft rests when its wheels do and there is no momentum; the solver sees that. What
    is flexible springs back from where it rests: see `nc.goal.Undeformed` and `nc.goal.Equilibrium`.
    """

    stops: ClassVar[bool] = True

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Rates of the free motions."""
        return steady_rates(system, state)

    def sizes(self, system: System) -> tuple[int, int]:
        """As many as there are free motions."""
        return system.structure.unknowns, 0

    def labels(self, system: System) -> tuple[str, ...]:
        """The body each free motion belongs to."""
        return tuple(f"rest of {name!r} [m/s or rad/s]" for name in owners(system))


class Equal(Goal):
    """Any smooth function of the final state that has to vanish.

    Attributes:
        function: (state) -> number or vector.
        name: for reports.
        count: how many numbers the function returns.
    """

    function: Callable[[State], Any] = eqx.field(converter=Function.of, metadata=is_a(RESIDUAL))
    name: str = eqx.field(default="own goal", static=True, metadata=is_a(NAME))
    count: int = eqx.field(default=1, kw_only=True, static=True, metadata=is_a(Whole(1)))

    def residual(self, system: System, state: State) -> Float[Array, " n"]:
        """Value of the function."""
        return jnp.atleast_1d(jnp.asarray(self.function(state), float)).reshape(self.count)

    def labels(self, system: System) -> tuple[str, ...]:
        """The name, numbered if there are several."""
        return (self.name,) if self.count == 1 else tuple(f"{self.name} [{k}]" for k in range(self.count))
