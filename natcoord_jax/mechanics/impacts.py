"""Impacts at the end of a step: what contacts have taken from the motion, and what they give back.

A gap that a step would have made negative is zero at its end (66), by an impulse that takes some energy with
it, more or less by where in the step the surfaces met. `natcoord_jax.maths.impact_law` says what velocities
follow: those of the restitution that is asked for, wherever that was; and `natcoord_jax.maths.friction_law`
what slip friction stops at the same time.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.core.checks import as_array
from natcoord_jax.core.constraint import FREE, RESTING
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import Tableau
from natcoord_jax.maths.friction_law import impulses_with_friction, without_friction
from natcoord_jax.maths.impact_law import collision_impulses, impact_impulses
from natcoord_jax.maths.vectors import positive_part
from natcoord_jax.mechanics.block_tangent_space import Tangents, tangents_at
from natcoord_jax.mechanics.free_flight import apart, meeting, touch
from natcoord_jax.mechanics.response import Evaluation
from natcoord_jax.mechanics.tangent_space import Velocity, driven, prescribing
from natcoord_jax.mechanics.violations import contact_gaps
from natcoord_jax.model.groups import Group
from natcoord_jax.model.islands import IslandOrder
from natcoord_jax.model.model import Model, SomeModel
from natcoord_jax.model.rows import group_places, rows_with_ground


class Answers:
    """What impulses at contacts do to the velocities of one configuration.

    Attributes:
        space: of the velocities that the constraints admit.
        along: what unit impulses do, in its frame, one a row.
        prescribed: work [J] of unit impulses on the motion that each constraint prescribes.
        each: number of these of a contact.
    """

    def __init__(self, space: Tangents, system: Model, groups: Sequence[Group], state: State, name: str):
        """Of impulses along forces on the rows of the bodies, by a method of the effects."""
        self.space = space
        rows, answers = rows_with_ground(state.q), []
        for group in groups:
            each = jax.vmap(lambda effect, place, rows: getattr(effect, name)(place, rows))
            forces = each(group.effect, group_places(system, group), rows[group.bodies])
            self.each = forces.shape[1]
            bodies = np.repeat(group.bodies, self.each, axis=0)
            answers.append(space.answers(forces.reshape(-1, *forces.shape[2:]), bodies))
        self.along, self.prescribed = (jnp.concatenate(x) for x in zip(*answers))

    @property
    def flat(self) -> Float[Array, "c u"]:
        """The same, one vector a row."""
        return self.along.reshape(self.along.shape[0], -1)

    def by_island(self, order: IslandOrder) -> Float[Array, "islands m u"]:
        """The same, island by island."""
        flat = order.split(self.flat.reshape(-1, self.each, self.flat.shape[-1]))
        return flat.reshape(flat.shape[0], -1, flat.shape[-1])

    def matrices(self, order: IslandOrder, others: "Answers") -> Float[Array, "islands m n"]:
        """W = G M^-1 H^T of each island: rates at these by impulses at others. Sums call no library."""
        return jnp.sum(self.by_island(order)[:, :, None] * others.by_island(order)[:, None], axis=-1)

    def rates(self, velocity: Velocity) -> Float[Array, " c"]:
        """gamma: work of unit impulses on a velocity, as far as constraints admit or prescribe it."""
        return self.flat @ self.space.framed(velocity).reshape(-1) + jnp.sum(self.prescribed, axis=1)

    def pushed(self, velocity: Velocity, impulses: Float[Array, " c"]) -> Velocity:
        """A velocity after impulses."""
        return velocity + self.space.along(jnp.tensordot(impulses, self.along, 1))


def after_impacts(
    system: Model,
    start: State,
    end: State,
    h: Array,
    groups: Sequence[Group],
    found: Evaluation,
    tableau: Tableau,
) -> tuple[State, dict[int, Array], Array]:
    """The state after the impacts at the end of a step of one stage, and work [J].

    That of the impacts by number of group, and of constraints that prescribe motions, which go on.

    Args:
        system: compiled system.
        start: state at the start of the step.
        end: at its end.
        h: step [s].
        groups: that act.
        found: solved equations of the step.
        tableau: of the scheme.
    """
    numbers = [k for k, group in enumerate(groups) if group.effect.unilateral]
    these, lam = [groups[k] for k in numbers], [found.given[k][:, 0] for k in numbers]
    # Of the multipliers of a contact the first is that of the gap.
    pushed = jnp.concatenate([x[:, 0] for x in lam])
    # As in the equations: what is left of the impulse of an open contact may be of either sign.
    bouncing = np.repeat([group.effect.bounces for group in these], [group.count for group in these])
    before, ahead = (contact_gaps(system, these, state) for state in (start, end))
    # What is soft pushes where surfaces overlap; elsewhere its impulse is rounding.
    touching = bouncing | (jnp.minimum(before, ahead) < 0)
    if tableau.max_events:
        phase = _numbers(these, "phase")
        ahead = ahead - jnp.where(phase == RESTING, positive_part(before), 0.0)
    reach = jnp.where(bouncing, ahead / h, 0.0)
    active = (0.5 * _numbers(these, "mobility") * pushed > reach) & touching
    hit = None
    if tableau.max_events:
        free = phase == FREE
        active, hit = active & ~free, free & meeting(system, these, end)
    none = jnp.zeros_like(pushed)

    drives = jnp.zeros(prescribing(system).size * driven(system))
    some, contacts = active if hit is None else active | hit, (these, active, hit, lam, bouncing)
    v, rotors, drives, done, struck, met = jax.lax.cond(
        jnp.any(some),
        lambda: _impacts(system, start, end, h, *contacts),
        lambda: (end.v, end.rates, drives, none, none, none),
    )
    after = replace_fields(end, v=v, rates=rotors)
    if start.contacts is not None:
        happened = [jnp.where(active, positive_part(pushed), 0.0), struck, met]
        if hit is not None:
            happened.append(hit.astype(met.dtype))
        happened = jnp.stack(happened, axis=1)
        after = replace_fields(after, contacts=start.contacts + happened)
    return after, dict(zip(numbers, _by_group(these, done))), drives


def untouched(system: Model) -> Float[Array, "c 3"] | None:
    """`State.contacts` before anything has touched; None without contacts that have impacts."""
    count = sum(group.count for group in system.effects if group.effect.unilateral)
    return as_array(np.zeros((count, 3))) if count else None


def _by_group(groups: Sequence[Group], every: Any) -> list[Any]:
    counts = [group.count for group in groups]
    return [every[end - count : end] for count, end in zip(counts, np.cumsum(counts))]


def _numbers(groups: Sequence[Group], name: str) -> Float[Array, " c"]:
    """A number, or a truth, of all contacts; zero where there is none."""
    each = ((group.count, getattr(group.effect, name)) for group in groups)
    return jnp.concatenate([jnp.zeros(count) if value is None else value for count, value in each])


def _impacts(
    system: Model,
    start: State,
    end: State,
    h: Array,
    groups: Sequence[Group],
    active: Bool[Array, " c"],
    hit: Bool[Array, " c"] | None,
    lam: Sequence[Float[Array, "n m"]],
    bouncing: Any,
) -> tuple[Array, ...]:
    """After impacts: velocities, rates of rotors, work of drives, work of contacts, impulses, which met."""
    space, bouncing = tangents_at(system, end), jnp.asarray(bouncing)
    pushes = Answers(space, system, groups, end, "pushes")
    # With friction it has three multipliers besides that of the gap.
    held = jnp.concatenate([jnp.pad(x, ((0, 0), (0, 4 - x.shape[1]))) for x in lam])
    before = contact_gaps(system, groups, start)
    shut = (before - contact_gaps(system, groups, end)) / h
    on, active = active, active & bouncing
    met = active & (before > touch(system, start) if hit is None else apart(system, groups, start, h))
    velocity = Velocity(end.row_rates, end.rates)
    order = IslandOrder(system.structure.islands, range(len(on)))
    rates, normal = pushes.rates(velocity), pushes.matrices(order, pushes)

    def work(pushed: Float[Array, " c"]) -> Float[Array, " c"]:
        return jnp.where(met, positive_part(pushed * shut), 0.0)

    pushed, room = held[:, 0], work(held[:, 0])
    rubs, mixed, drives = None, None, 0.0
    effects: list[Any] = [group.effect for group in groups]
    if any(effect.friction is not None for effect in effects):
        rubs = Answers(space, system, groups, end, "rubs")
        mixed = rubs.matrices(order, pushes)
        pushed = _by_island(order, without_friction, (normal, mixed), held, active)
    restitution = _numbers(groups, "restitution")
    given = rates, work(pushed), restitution, active, met
    plastic, impulses = _by_island(order, impact_impulses, (normal,), *given)
    if hit is not None:
        touching, some = bouncing & (contact_gaps(system, groups, end) <= touch(system, end)), jnp.any(hit)
        at_once = _by_island(order, collision_impulses, (normal,), rates, restitution, touching)
        plastic, impulses = (jnp.where(some, x, y) for x, y in zip(at_once, (plastic, impulses)))
        room, on = jnp.where(some, 0.0, room), on | hit
    if rubs is None or mixed is None:
        done = impulses * (rates + 0.5 * _by_island(order, jnp.matmul, (normal,), impulses))
    else:
        slip, friction = rubs.rates(velocity).reshape(-1, 3), _numbers(groups, "friction")
        given = rates, slip, held, friction, plastic, impulses, on, bouncing, room
        matrices = normal, mixed, rubs.matrices(order, rubs)
        found, done = _by_island(order, impulses_with_friction, matrices, *given)
        impulses, rubbing = found[:, 0], found[:, 1:].reshape(-1)
        velocity, drives = rubs.pushed(velocity, rubbing), -rubbing @ rubs.prescribed
    velocity, drives = pushes.pushed(velocity, impulses), drives - impulses @ pushes.prescribed
    v, met = velocity.rows.reshape(end.v.shape), met.astype(done.dtype)
    return v, velocity.rotors, drives, done, impulses, met


def _by_island(order: IslandOrder, law: Callable[..., Any], matrices: Sequence[Array], *given: Array) -> Any:
    """What a law says of each contact by the matrices of its island."""
    return jax.tree.map(order.joined, jax.vmap(law)(*matrices, *map(order.split, given)))


def with_mobilities(system: SomeModel, state: State) -> SomeModel:
    """The system with what unit impulses do at its contacts, at one state: of the masses that it has now."""
    groups = [group for group in system.effects if group.effect.unilateral]
    if not groups:
        return system
    each = _by_group(groups, mobilities(system, state))
    return eqx.tree_at(lambda s: [g.effect.mobility for g in s.effects if g.effect.unilateral], system, each)


@eager_numpy
def mobilities(system: Model, state: State) -> Float[Array, " c"]:
    """What unit impulses do at each contact that has impacts, to the speed at which it closes [1/kg].

    They weigh rows of equations against each other, so that no derivative goes through them.
    """
    system, state = jax.lax.stop_gradient((system, state))
    groups = [group for group in system.effects if group.effect.unilateral]
    answers = Answers(tangents_at(system, state), system, groups, state, "pushes")
    found = jnp.sum(answers.flat**2, axis=-1)
    return jnp.where(found > 0, found, 1.0)
