"""Sensors: what bodies, joints and points do, at one time or along a trajectory.

Positions are read when the sensor is made. Velocities (see `reading`), accelerations and reactions, which
solve the equations of motion, are computed when they are asked for.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.handles import Handle, named
from natcoord_jax.core.markers import Interpolated, Marker
from natcoord_jax.core.names import clamped
from natcoord_jax.core.names import listed as listed_names
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.maths.rotations import angular_velocity, to_quaternion
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.coordinates import state_rates
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import rows_with_ground, states_of
from natcoord_jax.reading.instant import inputs_along, instants
from natcoord_jax.reading.markers import MarkerSensor, marker_weights, readings, tells, weighted
from natcoord_jax.reading.tangent_states import Source, over_source


class BodySensor(eqx.Module):
    """Pose and motion of a body.

    Attributes:
        position: of the reference point [m].
        rotation: rotation matrix, body to world; its columns are the directors [-].
        quaternion: (w, x, y, z) of it; with w >= 0 for a state, of continuous sign along a trajectory.
        com: centre of mass [m].
        index: number of the body.
        source: what the sensor looks at.
    """

    position: Float[Array, "*t 3"]
    rotation: Float[Array, "*t 3 3"]
    quaternion: Float[Array, "*t 4"]
    com: Float[Array, "*t 3"]
    index: int = eqx.field(static=True)
    source: Source = eqx.field(repr=False)

    @property
    def velocity(self) -> Float[Array, "*t 3"]:
        """Velocity of the reference point [m/s]."""
        return _body_rates(self.source)[0][..., self.index, :]

    @property
    def angular_velocity(self) -> Float[Array, "*t 3"]:
        """Angular velocity, world components [rad/s]."""
        return _body_rates(self.source)[1][..., self.index, :]

    @property
    def com_velocity(self) -> Float[Array, "*t 3"]:
        """Velocity of the centre of mass [m/s]."""
        return _body_rates(self.source)[2][..., self.index, :]

    @property
    def acceleration(self) -> Float[Array, "*t 3"]:
        """Acceleration of the reference point [m/s^2]."""
        return by_node(instants(self.source).accelerations)[..., self.index, 0, :]

    @property
    def angular_acceleration(self) -> Float[Array, "*t 3"]:
        """Angular acceleration, world components [rad/s^2]."""
        directors = jnp.swapaxes(self.rotation, -1, -2)
        own = by_node(instants(self.source).accelerations)[..., self.index, 1:, :]
        return angular_velocity(directors, own)


class JointSensor(eqx.Module):
    """Coordinates, rates and reactions of a joint.

    Attributes:
        coordinates: all coordinates of the joint in its order, angles counted on over many turns [rad or m].
        units: "rad" or "m" of each coordinate.
        name: of the joint.
        index: number of the joint.
        places: of its coordinates among those of all joints.
        source: what the sensor looks at.
        lever: from the point that torques are about to the joint's point on the child [m]; None: that is it.
    """

    coordinates: Float[Array, "*t n"]
    units: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    index: int = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    source: Source = eqx.field(repr=False)
    lever: Float[Array, "*t 3"] | None = None

    @property
    def rates(self) -> Float[Array, "*t n"]:
        """Rates of the coordinates [rad/s or m/s]."""
        return rates_of(self.source)[..., np.array(self.places, int)]

    def _all(self, values: Array, unit: str) -> Array:
        return values[..., np.array([k for k, u in enumerate(self.units) if u == unit], int)]

    def _only(self, values: Array, unit: str) -> Array:
        found = self._all(values, unit)
        if found.shape[-1] != 1:
            raise ValueError(
                f"joint {self.name!r} has {found.shape[-1]} coordinates in {unit}, not one; "
                f"its coordinates are in {list(self.units)}: use `angles`, `displacements` or `coordinates`"
            )
        return found[..., 0]

    @property
    def angles(self) -> Float[Array, "*t a"]:
        """All angles [rad]."""
        return self._all(self.coordinates, "rad")

    @property
    def angle(self) -> Float[Array, "*t"]:
        """The angle [rad] of a joint that has one; raises `ValueError` for others."""
        return self._only(self.coordinates, "rad")

    @property
    def angle_rate(self) -> Float[Array, "*t"]:
        """Rate of the angle [rad/s]."""
        return self._only(self.rates, "rad")

    @property
    def displacements(self) -> Float[Array, "*t d"]:
        """All displacements [m]."""
        return self._all(self.coordinates, "m")

    @property
    def displacement(self) -> Float[Array, "*t"]:
        """The displacement [m] of a joint that has one; raises `ValueError` for others."""
        return self._only(self.coordinates, "m")

    @property
    def displacement_rate(self) -> Float[Array, "*t"]:
        """Rate of the displacement [m/s]."""
        return self._only(self.rates, "m")

    @property
    def distance(self) -> Float[Array, "*t"]:
        """The distance [m] of a distance joint."""
        return self._only(self.coordinates, "m")

    @property
    def force(self) -> Float[Array, "*t 3"]:
        """Reaction force on the child at the joint's point [N], world components.

        The force of the constraints: motors, springs and dampers of the joint are not part of it. Along a
        trajectory with the inputs of the step that starts at each saved state (see `System.instant`).
        """
        return instants(self.source).forces[..., self.index, :]

    @property
    def torque(self) -> Float[Array, "*t 3"]:
        """Reaction torque on the child [N m], world components: about the joint's point on it, or `about`."""
        found = instants(self.source)
        torque = found.torques[..., self.index, :]
        return torque if self.lever is None else torque + cross(self.lever, found.forces[..., self.index, :])


def _centres(mass: Float[Array, "bodies 4 4"]) -> Float[Array, "bodies 4"]:
    """Marker weights of the centres of mass; of bodies without mass those of the reference point."""
    total = mass[:, :1, 0]
    reference = jnp.eye(4, dtype=mass.dtype)[0]
    return jnp.where(total > 0, mass[:, 0] / jnp.where(total > 0, total, 1.0), reference)


@compiled
def _body_pose(system: Model, states: State, index: Array, along: bool) -> tuple[Array, ...]:
    rows = states.rows[..., index, :, :]
    rotation = jnp.swapaxes(rows[..., 1:, :], -1, -2)
    mass = _centres(system.mass)[index]
    quaternion = to_quaternion(rotation)
    if along:
        # Signs chosen so that neighbours are close to each other.
        products = jnp.sum(quaternion[..., 1:, :] * quaternion[..., :-1, :], axis=-1)
        flips = jnp.cumprod(jnp.where(products < 0, -1.0, 1.0), axis=-1)
        quaternion = quaternion.at[..., 1:, :].multiply(flips[..., None])
    return rows[..., 0, :], rotation, quaternion, jnp.sum(mass[:, None] * rows, axis=-2)


@over_source
def _body_rates(system: Model, state: State) -> tuple[Array, Array, Array]:
    """Velocities of the reference points, angular velocities and velocities of the centres of mass."""
    rows, rates = state.rows, state.row_rates
    shares = _centres(system.mass)
    return rates[:, 0], angular_velocity(rows[:, 1:], rates[:, 1:]), jnp.sum(shares[..., None] * rates, 1)


rates_of = over_source(state_rates)
"""Rates of all joint coordinates [rad/s or m/s]."""


def joint_coordinates(system: Model, joint: Handle | str) -> tuple[int, list[int], tuple[str, ...]]:
    """Number of a joint, the places of its coordinates in the state, and their units.

    Raises:
        ValueError: for a name that is no joint of this system.
    """
    index = system.joint_index(joint)
    name = system.structure.joints[index]
    places = [i for i, (owner, _) in enumerate(system.structure.coordinates) if owner == name]
    group = next(g for g in system.joints if name in g.names)
    kind: Any = group.effect
    return index, places, tuple(axis.unit for axis in kind.coordinates)


def _lever(system: Model, states: State, index: int, about: Any, state: State | None) -> Array:
    """From a point to that of a joint on its child."""
    child, weights = system.joint_bodies[index, 1], system.frames[index, 1, 0]
    rows = jnp.vectorize(rows_with_ground, signature="(r,k)->(b,n,k)")(states.q)
    joint = jnp.sum(weights[:, None] * jnp.take(rows, child, axis=-3), axis=-2)
    if isinstance(about, Marker):
        if not about.is_point:
            raise ValueError(f"about is a direction, {about!r}; pass a point [m], or nc.Point")
        weights, body = marker_weights(system, about, state)
        still = body == len(system.structure.bodies)
        return joint - (weights[1:] if still else weighted(weights, states.q, body))
    point, leading = jnp.asarray(about, float), states.t.shape
    if point.shape not in ((3,), (*leading, 3)):
        raise ValueError(f"about [m] has shape {point.shape}; pass (3,) or {(*leading, 3)}, or nc.Point")
    return joint - point


def sense(
    system: Model,
    motion: State | Trajectory,
    part: Handle | Marker | str | tuple[Handle | str, ...],
    *,
    inputs: Any = None,
    state: State | None = None,
    about: Any = None,
) -> Any:
    """Sensor of a body, a joint, a marker or elements of beams; see `System.sense`."""
    states = states_of(motion)
    sensed = named(part)
    if about is not None and (not isinstance(sensed, str) or sensed not in system.structure.joints):
        raise ValueError(f"{part!r} has no reaction about a point: pass `about` with a joint")
    source = Source.of(system, motion, inputs_along(system, motion, inputs))
    if isinstance(part, Interpolated):
        bodies = tuple(system.body_index(handle) for handle in part.bodies)
        weights = jnp.outer(jnp.asarray(part.vector, float), jnp.eye(4)[0 if part.is_point else 1])
        return MarkerSensor(weighted(weights, states.q, bodies), weights, bodies, source)
    if isinstance(part, Marker):
        weights, body = marker_weights(system, part, state)
        if body == len(system.structure.bodies):
            still = jnp.broadcast_to(weights[1:], (*states.t.shape, 3))
            return MarkerSensor(still, weights, body, source)
        return MarkerSensor(weighted(weights, states.q, body), weights, body, source)
    if isinstance(part, tuple) and not part:
        raise ValueError("cannot sense nothing: the tuple of elements is empty")
    listed = part if isinstance(part, tuple) else (part,)
    names = tuple(map(named, listed))
    if any(tells(group, names[0]) for group in system.effects):
        found = readings(system, states, names)
        axis = states.t.ndim
        sets = (g for g in system.effects if g.is_set and not g.effect.spread)
        whole = isinstance(part, tuple) or any(names[0] in g.labels for g in sets)
        return found if whole else jax.tree.map(lambda x: jnp.take(x, 0, axis), found)
    name = names[0]
    if name in system.structure.bodies:
        index = system.body_index(name)
        pose = _body_pose(system, states, jnp.asarray(index), isinstance(motion, Trajectory))
        return BodySensor(*pose, index=index, source=source)
    if name and name in system.structure.joints:
        index, places, units = joint_coordinates(system, name)
        chosen = np.array(places, int)
        lever = None if about is None else _lever(system, states, index, about, state)
        chosen = states.coordinates[..., chosen]
        return JointSensor(chosen, units, name, index, tuple(places), source, lever)
    raise ValueError(
        f"cannot sense {part!r}: pass a body ({listed_names(system.structure.bodies)}), a joint "
        f"({[n for n in system.structure.joints if n]}), nc.Point or nc.Direction" + _hint(system, name)
    )


def _hint(system: Model, name: str) -> str:
    """Of the name of clamped nodes, or one that effects have with a number, as the gaps of a contact."""
    found = [x for group in system.effects for x in group.names if x.startswith(f"{name}[")]
    if not found:
        return clamped(system.structure.bodies, name)
    return f"; {name!r} is {len(found)} effects, {found[0]!r} to {found[-1]!r}: pass one, or a tuple of them"
