"""The constraints of a state linearised: which small motions close them, at least expense of mass.

All positions and velocities enter as twists of the bodies (velocities of the reference points, angular
velocities). Of the twists w with G w = -g the one of least kinetic energy is w = -M^-1 G^T (G M^-1 G^T)^-1 g.
Every constraint is measured by the root of the energy that closing it alone takes, so that metres, radians
and cosines compare. Where constraints depend on each other, or where one of them is nearly singular, the
damping mu in G M^-1 G^T + mu decides (Levenberg 1944, Marquardt 1963).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.joint import frames_at
from natcoord_jax.core.potential import place_markers
from natcoord_jax.core.state import State
from natcoord_jax.maths.elimination import definite_inverse
from natcoord_jax.maths.rotations import from_rotation_vector
from natcoord_jax.maths.vectors import safe_divide, safe_norm, safe_sqrt
from natcoord_jax.mechanics.coordinates import coordinate_values, velocities_with_ground
from natcoord_jax.mechanics.momentum import inertia
from natcoord_jax.mechanics.violations import constrained, violations_of
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model, SomeModel
from natcoord_jax.model.rows import group_places, row_rates, rows_with_ground

TWIST = 6
"""Components of a twist."""

SHARE = 1e-3
"""Of the inertia of a body, about axes where it has none, for how a gap is shared."""

SLACK = 1e-9
"""The same for velocities, which do not depend on it: each pass leaves that part of what has no inertia."""


def fills(system: Model, share: float) -> Float[Array, "bodies 6"]:
    """What is added to the inertias against twists, so that all are regular: nothing but against turns.

    Ideal rods have no inertia about their axis, and nodes may have none at all: these get a share of that of
    the body with the most.
    """
    size = jnp.trace(system.mass[:, 1:, 1:], axis1=1, axis2=2)
    most = jnp.max(size, initial=0.0)
    size = jnp.where(size > 0, size, jnp.where(most > 0, most, 1.0))
    return share * size[:, None] * jnp.asarray([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


def mobility(
    system: Model, rows: Float[Array, "bodies 4 3"], fill: Float[Array, "bodies 6"]
) -> Callable[[Float[Array, "twists *m"]], Float[Array, "twists *m"]]:
    """Twists of the bodies from impulses on them, (M + fill)^-1."""
    moving = _unit_motions(rows)
    inertias = jnp.einsum("bixc,bij,bjxd->bcd", moving, system.mass, moving)
    inertias = inertias + jax.vmap(jnp.diag)(fill)
    count, between = rows.shape[0], system.mass_between
    if between is None:
        inverse = jax.vmap(definite_inverse)(inertias)

        def by_body(impulses: Array) -> Array:
            parts = impulses.reshape(count, TWIST, *impulses.shape[1:])
            return jnp.einsum("bcd,bd...->bc...", inverse, parts).reshape(impulses.shape)

        return by_body
    one, other = between.bodies.T
    first, second = moving[one, : between.rows], moving[other, : between.rows]
    blocks = jnp.einsum("pixc,pij,pjxd->pcd", first, between.blocks, second)
    every = jnp.zeros((count, count, TWIST, TWIST), rows.dtype)
    every = every.at[jnp.arange(count), jnp.arange(count)].add(inertias)
    every = every.at[one, other].add(blocks).at[other, one].add(jnp.swapaxes(blocks, 1, 2))
    size = count * TWIST
    whole = definite_inverse(jnp.swapaxes(every, 1, 2).reshape(size, size))
    return lambda impulses: whole @ impulses


def _unit_motions(rows: Float[Array, "*n 4 3"]) -> Float[Array, "*n 4 3 6"]:
    """Velocities of the rows of bodies for unit twists."""
    flat = rows.reshape(-1, *NODE)
    unit = jnp.broadcast_to(jnp.eye(TWIST)[:, None], (TWIST, flat.shape[0], TWIST))
    found = jax.vmap(lambda w: row_rates(flat, w[:, :3], w[:, 3:]))(unit)
    return jnp.moveaxis(found, 0, -1).reshape(*rows.shape, TWIST)


def _along_twists(
    instances: Any, place: Any, rows: Float[Array, "n k 4 3"], t: Array, rate_of: Any
) -> Float[Array, "n m k6"]:
    """Derivatives of what `rate_of` finds from velocities of rows and spins, by the twists of its bodies."""
    count, bodies = rows.shape[:2]
    unit = jnp.eye(TWIST * bodies).reshape(-1, bodies, TWIST)

    def one(effect, place, rows):
        def along(w):
            return rate_of(effect, place, rows, row_rates(rows, w[:, :3], w[:, 3:]), w[:, 3:], t)

        return jax.vmap(along, out_axes=1)(unit)

    return jax.vmap(one)(instances, place, rows)


def _scattered(block: Float[Array, "n m k6"], bodies: Any, count: int) -> Float[Array, "nm count6"]:
    """Local derivatives as rows over the twists of all bodies; those of the ground are dropped."""
    n, m, width = block.shape
    columns = (bodies[:, :, None] * TWIST + jnp.arange(TWIST)).reshape(n, width)
    whole = jnp.zeros((n, m, count * TWIST), block.dtype)
    instance, row = jnp.arange(n)[:, None, None], jnp.arange(m)[None, :, None]
    return whole.at[instance, row, columns[:, None, :]].add(block, mode="drop").reshape(n * m, -1)


def _block(system: Model, group: Group, state: State, slope: Any) -> Float[Array, "n m k6"]:
    """Derivatives of what the constraints of a group have as `slope` by the twists of their bodies."""
    rows = rows_with_ground(state.q)[group.bodies]
    return _along_twists(group.effect, group_places(system, group), rows, state.t, slope)


def constraint_matrix(system: Model, state: State) -> Float[Array, "m twists"]:
    """G: derivatives of the rates of all constraints by the twists of the bodies."""
    count = len(system.structure.bodies)
    found = [jnp.zeros((0, TWIST * count), state.q.dtype)]
    found += [
        _scattered(_block(system, g, state, lambda e, *at: e.opening_slope(*at)), g.bodies, count)
        for g in constrained(system)
    ]
    return jnp.concatenate(found)


def with_sizes(system: SomeModel, state: State) -> SomeModel:
    """The system with the size of the scene as it is assembled, and with `spans` of its constraints."""
    size, spans = _sizes(system, state)
    joints, effects = (
        tuple(g if x is None else replace_fields(g, spans=x) for g, x in zip(*pair))
        for pair in zip((system.joints, system.effects), spans)
    )
    return replace_fields(system, size=size, joints=joints, effects=effects)


@eager_numpy
def _sizes(system: Model, state: State) -> tuple[Array, list[list[Array | None]]]:
    def spans(group: Group) -> Array | None:
        if not group.multipliers:
            return None
        if group.effect.unilateral:
            return jnp.broadcast_to(jnp.array([1.0, 0.0]), (group.count, 1, 2))
        twists = _block(system, group, state, lambda e, *at: e.violation_rate(*at, 0.0)).reshape(
            group.count, group.multipliers, -1, 2, 3
        )
        changes = jnp.max(safe_norm(twists), axis=2)
        return jnp.where(jnp.any(changes > 0, axis=-1, keepdims=True), changes, 1.0)

    by_group = [[spans(group) for group in groups] for groups in (system.joints, system.effects)]
    # What is compared with them has no derivatives by them.
    return jax.lax.stop_gradient((_scene_size(system, state), by_group))


def _scene_size(system: Model, state: State) -> Float[Array, ""]:
    """Distance of bodies, joints and markers from their middle, with the size of the largest body [m]."""
    rows = rows_with_ground(state.q)
    points = [state.rows[:, 0]]
    if system.joints:
        points.append(jnp.einsum("jbw,jbwx->jbx", system.frames[:, :, 0], rows[system.joint_bodies]))
    for group in system.effects:
        if group.weights is not None:
            at = jax.vmap(place_markers)(group.weights, rows[group.bodies])
            is_point = jnp.any(group.weights[..., ::4] != 0, axis=-1, keepdims=True)
            points.append(jnp.where(is_point, at, state.q[0]))
    places = jnp.concatenate([x.reshape(-1, 3) for x in points])
    mass, moment = system.mass[:, 0, 0], jnp.trace(system.mass[:, 1:, 1:], axis1=1, axis2=2)
    radius = safe_sqrt(safe_divide(moment, mass))
    size = jnp.max(safe_norm(places - jnp.mean(places, axis=0))) + jnp.max(radius)
    return jnp.where(size > 0, size, 1.0)


def coordinate_matrix(system: Model, state: State) -> Float[Array, "coordinates twists"]:
    """Derivatives of the rates of all joint coordinates by the twists of the bodies."""
    rows, count = rows_with_ground(state.q), len(system.structure.bodies)
    found = jnp.zeros((len(system.structure.coordinates), TWIST * count), state.q.dtype)
    for group in system.coordinates:
        bodies = system.joint_bodies[group.joints]

        def rate(_, place, rows, rates, spin, t, axis=group.axis):
            return axis.rate(*frames_at(place, rows), *frames_at(place, rates), spin[1] - spin[0])[None]

        block = _along_twists(group, system.frames[group.joints], rows[bodies], state.t, rate)
        found = found.at[group.index].set(_scattered(block, bodies, count))
    return found


class Projection(eqx.Module):
    """Linearised constraints of a state.

    Attributes:
        matrix: their derivatives by the twists of the bodies, in units of `scale`.
        impulses: twists that unit multipliers of them make.
        scale: root of the energy that one unit of violation takes, inverse [1/sqrt(J) times its unit].
    """

    matrix: Float[Array, "m twists"]
    impulses: Float[Array, "twists m"]
    scale: Float[Array, " m"]

    @classmethod
    def of(cls, system: Model, state: State, held: Float[Array, " coordinates"] | None) -> "Projection":
        """At the positions of a state.

        Args:
            system: compiled system.
            state: whose directors are orthonormal.
            held: coordinates that are constraints as well, where it is 1; None: there are none.
        """
        matrix = constraint_matrix(system, state)
        if held is not None:
            matrix = jnp.concatenate([matrix, held[:, None] * coordinate_matrix(system, state)])
        impulses = mobility(system, state.rows, fills(system, SHARE))(matrix.T)
        stiffness = jnp.einsum("mt,tm->m", matrix, impulses)
        scale = jnp.sqrt(jnp.where(stiffness > 0, stiffness, 1.0))
        return cls(matrix / scale[:, None], impulses / scale, scale)

    def damped(self, damping: Array | float) -> Float[Array, "m m"]:
        """The damped matrix of the constraints."""
        return self.matrix @ self.impulses + damping * jnp.eye(self.scale.shape[0])


def gaps(
    system: Model, state: State, held: Float[Array, " coordinates"] | None, wanted: Array
) -> Float[Array, " m"]:
    """Violations of all constraints, held coordinates included: these shall be as wanted."""
    found = [x.reshape(-1) for x in violations_of(system, constrained(system), state)]
    found += [] if held is None else [held * (state.coordinates - wanted)]
    return jnp.concatenate([jnp.zeros(0), *found])


def moved(
    system: Model, state: State, twist: Float[Array, "bodies 6"], increments: Float[Array, " coordinates"]
) -> State:
    """State after the bodies have been shifted, and turned about their reference points.

    Args:
        system: compiled system.
        state: before.
        twist: shifts [m] and rotation vectors [rad].
        increments: of the joint coordinates to first order, by which whole turns are told.
    """
    rows = state.rows
    directors = jnp.einsum("bij,bkj->bki", from_rotation_vector(twist[:, 3:]), rows[:, 1:])
    q = jnp.concatenate([rows[:, :1] + twist[:, None, :3], directors], axis=1).reshape(-1, 3)
    expected = replace_fields(state, q=q, coordinates=state.coordinates + increments)
    return replace_fields(expected, coordinates=nearest_coordinates(system, expected))


def nearest_coordinates(system: Model, state: State) -> Array:
    """Joint coordinates of the positions, each angle taken in the turn nearest to the stored one."""
    values = coordinate_values(system, rows_with_ground(state.q))
    for group in system.coordinates:
        if group.axis.unit == "rad":
            turns = jnp.round((state.coordinates - values)[group.index] / (2 * jnp.pi))
            values = values.at[group.index].add(2 * jnp.pi * turns)
    return values


def twists_of(system: Model, state: State) -> Float[Array, "bodies 6"]:
    """Twists of the bodies nearest to the velocities of their rows, in the metric of the mass."""
    rows, v = state.rows, state.row_rates
    _, spin = velocities_with_ground(state.v, rows_with_ground(state.q))
    rigid = jnp.concatenate([v[:, 0], spin[:-1]], axis=1)
    rest = v - row_rates(rows, rigid[:, :3], rigid[:, 3:])
    moved_by, moving_rows = mobility(system, rows, fills(system, SLACK)), _unit_motions(rows)

    def twist_of(v: Array) -> Array:
        pushed = jnp.einsum("bixc,bix->bc", moving_rows, inertia(system, v))
        return moved_by(pushed.reshape(-1)).reshape(rigid.shape)

    more = twist_of(rest)
    # What made the inertias regular is gone after one more pass.
    return rigid + more + twist_of(rest - row_rates(rows, more[:, :3], more[:, 3:]))


def moving(state: State, twists: Float[Array, "bodies 6"]) -> State:
    """The state with velocities from the twists of its bodies."""
    rates = row_rates(state.rows, twists[:, :3], twists[:, 3:])
    return replace_fields(state, v=rates.reshape(-1, 3))
