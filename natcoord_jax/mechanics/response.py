"""Evaluation of all effects on a given motion: gather, respond (vmapped over equal kinds), scatter."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.core.bodies import NODE
from natcoord_jax.core.motion import Motion, Response, StepContext
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.vectors import cross
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, rows_with_ground


class StageKinematics(eqx.Module):
    """Motion of all bodies and, last, the ground; `force_rows` as in `Motion`."""

    start: Float[Array, "bodies_and_ground 4 3"]
    rows: Float[Array, "s bodies_and_ground 4 3"]
    rates: Float[Array, "s bodies_and_ground 4 3"]
    spin: Float[Array, "s bodies_and_ground 3"]
    force_rows: Float[Array, "s bodies_and_ground 4 3"] | None = None

    @property
    def held(self) -> Float[Array, "s bodies_and_ground 4 3"]:
        """Rows on which forces take hold."""
        return self.rows if self.force_rows is None else self.force_rows


def stations(
    start: Float[Array, "bodies 4 3"],
    points: Float[Array, "s bodies 3"],
    directors: Float[Array, "s bodies 3 3"],
    velocity: Float[Array, "s bodies 3"],
    spin: Float[Array, "s bodies 3"],
) -> StageKinematics:
    """Motion with the ground appended; director rates are spin x director."""
    ground = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)]).astype(start.dtype)[None]
    stages = points.shape[0]
    rows = jnp.concatenate([points[:, :, None], directors], axis=2)
    rates = jnp.concatenate([velocity[:, :, None], cross(spin[:, :, None], directors)], axis=2)
    still = jnp.zeros((stages, 1, *NODE), start.dtype)
    return StageKinematics(
        jnp.concatenate([start, ground]),
        jnp.concatenate([rows, jnp.broadcast_to(ground, still.shape)], axis=1),
        jnp.concatenate([rates, still], axis=1),
        jnp.concatenate([spin, still[:, :, 0]], axis=1),
    )


def motion_between(before: State, after: State, h: Array) -> StageKinematics:
    """Motion over a step as the effects saw it: mid-point rows, mean velocities, spins of the mid-points."""
    start, rates = before.rows, 0.5 * (before.row_rates + after.row_rates)
    if before.contacts is not None:
        # At the end of a step impacts and what stops slip change velocities, but not where bodies are.
        rates = (after.rows - start) / jnp.where(h > 0, h, 1.0)
    middle = (start + 0.5 * h * rates)[:, 1:]
    d1, d2, d3 = middle[:, 0], middle[:, 1], middle[:, 2]
    dual = jnp.stack([cross(d2, d3), cross(d3, d1), cross(d1, d2)], axis=1)
    volume = jnp.sum(d1 * dual[:, 0], axis=-1)
    spin = 0.5 * jnp.sum(cross(dual, rates[:, 1:]), axis=1) / volume[:, None]
    points = (start + 0.5 * h * rates)[:, 0]
    return stations(start, points[None], middle[None], rates[None, :, 0], spin[None])


class GroupData(eqx.Module):
    """What a group needs besides the motion: places, inputs, coordinates, rates, time, step, extra stress.

    And what it has looked up at the start of the step, see `Effect.neighbours`.
    """

    place: Array
    inputs: Array
    coordinates: Array
    rates: Array
    t: Float[Array, ""]
    h: Float[Array, ""]
    stress: Float[Array, "n s p"] | None = None
    neighbours: Any = None


def situation(system: Model, group: Group, state: State, u: Array, h: Array) -> GroupData:
    """Gather what a group needs at the start of a step."""
    return GroupData(
        group_places(system, group),
        jnp.moveaxis(u[..., group.inputs], -2, 0),
        state.coordinates[group.coordinates],
        state.rates[group.rotors],
        state.t,
        h,
        neighbours=neighbours_of(system, group, state, h) if group.searches else None,
    )


def neighbours_of(system: Model, group: Group, state: State, h: Array) -> Any:
    """What the instances of a group look up at the start of a step."""
    place, rows, rates, h = jax.lax.stop_gradient((group_places(system, group), *group_rows(group, state), h))
    return jax.vmap(lambda effect, *given: effect.neighbours(*given, h))(
        jax.lax.stop_gradient(group.effect), place, rows, rates
    )


def group_rows(group: Group, state: State) -> tuple[Float[Array, "n k 4 3"], Float[Array, "n k 4 3"]]:
    """Rows of the bodies of a group, and their velocities."""
    still = jnp.zeros((1, *NODE), state.v.dtype)
    rates = jnp.concatenate([state.row_rates, still])
    return rows_with_ground(state.q)[group.bodies], rates[group.bodies]


def step_context(where: GroupData, tableau: Tableau) -> StepContext:
    """What all instances of a group may depend on."""
    given = where.inputs, where.coordinates, where.rates, tableau, where.stress, where.neighbours
    return StepContext(where.t, where.h, *given)


def respond(
    group: Group, where: GroupData, motion: Motion, lam: Float[Array, "n s m"], tableau: Tableau
) -> Response:
    """Responses of all instances of a group; leading axis `n`."""
    now = step_context(where, tableau)
    with jax.named_scope(group.effect.kind.replace(" ", "_")):
        return group.effect.responses(where.place, motion, now, lam)


def gather(group: Group, at: StageKinematics) -> Motion:
    """Motion of the bodies of a group: start (n, k, ...), stage quantities (s, n, k, ...)."""
    index = group.bodies
    force_rows = None if at.force_rows is None else at.force_rows[:, index]
    return Motion(at.start[index], at.rows[:, index], at.rates[:, index], at.spin[:, index], force_rows)


class Evaluation(eqx.Module):
    """The equations of a step at given unknowns, and the motion that goes with them.

    Attributes:
        residual: [N s, N m s; m/s, 1/s for constraints].
        size: of the terms of the residual [sqrt(J)].
        at: stage motion of all bodies.
        power: power of each group, for work accounts (instances, s).
        loads: forces and torques missing in the balances of all bodies, see `momentum.Balance`.
        kick: of the step, if the method has any.
        given: what else the end of the step asks for: situations and multipliers of the groups for the
            variational scheme, what is damped for a dissipative one, multipliers where there are contacts.
    """

    residual: Float[Array, " unknowns"]
    size: Float[Array, ""]
    at: StageKinematics
    power: list[Float[Array, "_ s"]]
    loads: tuple[Float[Array, "s bodies 3"], Float[Array, "s bodies 3"]]
    kick: Any = None
    given: Any = None


def collect(group: Group, loads: Float[Array, "n s k *rest"]) -> Float[Array, "bodies s *rest"]:
    """Sum of the loads of all instances by body; those on the ground fall away."""
    if group.source == "mass":
        return loads[:, :, 0]
    by_place = jnp.moveaxis(loads, 2, 1)
    return group.acting.collect(by_place.reshape(-1, *by_place.shape[2:]))


def no_multipliers(group: Group, tableau: Tableau, dtype) -> Array:
    """Multipliers of a group that has none."""
    return jnp.zeros((group.count, tableau.stages, group.effect.multipliers), dtype)
