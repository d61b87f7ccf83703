"""What contacts do along a trajectory, and where its derivatives stop to be those of the motion."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from natcoord_jax.analysis.searched_contacts import NearPairs, mean_force, near_pairs, searching
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.state import TRAJECTORY, State, Trajectory
from natcoord_jax.effects.contact.law import ContactLaw
from natcoord_jax.mechanics.free_flight import gaps_and_rates, lowest
from natcoord_jax.mechanics.impacts import mobilities
from natcoord_jax.mechanics.violations import contact_gaps
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import SYSTEM, Model
from natcoord_jax.model.rows import over_states
from natcoord_jax.system import System

GRAZING = 1e-8
"""Margin, relative to the size of all places, below which rounding may decide whether surfaces touch."""

RESOLVED = 6
"""Steps in a contact from which on derivatives through it are good to 5 %."""


class Contacts(eqx.Module):
    """Contacts along a trajectory. What is of intervals between saved states is one shorter than these.

    A difference quotient of the motion by a parameter p with the step d agrees with the derivative of the
    program where d |dq/dp| is less than the margin. That is the derivative of the motion, too, where no note
    says otherwise.

    Of a contact of many bodies that looks for its pairs (`nc.CapsuleContacts`) there are those that come
    within its skin at a saved time, each as if it was listed. Gaps of all others are larger than that, and so
    are their margins.

    Attributes:
        names: of the contacts; of pairs that are looked for "name[one, other]", by their bodies.
        t: saved times [s].
        gap: of the surfaces at the saved times, negative where they overlap [m].
        force: that pushes them apart on average over each interval [N]; of contacts without a stiffness with
            their impacts, of others what the energy of the gap gives.
        active: whether they have pushed in an interval.
        impacts: how many impacts an interval has; of contacts without a stiffness.
        inside: how many of these are inside a step, not located where they happen.
        margin: by how much gaps would have to change for contacts to open that are active, or to close, also
            within an interval [m].
        size: of all places, which margins are compared with [m].
        hard: which contacts have no stiffness.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> gravity = scene.add(nc.Gravity())
        >>> ball = scene.add(nc.RigidBody(shape=nc.Sphere(0.1), density=400.0, position=(0, 0, 0.2)))
        >>> bounce = scene.add(nc.Contact(ball, nc.Plane(), restitution=0.5, name="bounce"))
        >>> system, state = scene.compile()
        >>> found = nc.contacts(system, nc.simulate(system, state, dt=0.01, steps=20))
        >>> found.names, int(found.impacts.sum())
        (('bounce',), 1)
        >>> found.notes
        ('impact inside a step: bounce; derivatives are those of the program',)
    """

    names: tuple[str, ...]
    t: Float[np.ndarray, "*lanes saved"]
    gap: Float[np.ndarray, "*lanes saved c"]
    force: Float[np.ndarray, "*lanes intervals c"]
    active: Bool[np.ndarray, "*lanes intervals c"]
    impacts: Float[np.ndarray, "*lanes intervals c"]
    inside: Float[np.ndarray, "*lanes intervals c"]
    margin: Float[np.ndarray, "*lanes intervals c"]
    size: float
    hard: Bool[np.ndarray, " c"]

    def __repr__(self) -> str:
        """The least margin, and what is to be said of derivatives."""
        least = "no bodies have come within the skin of their contact"
        if self.names:
            least = f"least margin {np.min(self.margin):.2g} m of {len(self.names)} contacts"
        return "\n".join((least, *self.notes))

    @property
    def steps_in_contact(self) -> Float[np.ndarray, " c"]:
        """Intervals of the shortest stay in each contact that begins and ends; infinite without one."""
        # What is open at the start has not begun, whatever the first interval brings.
        first = ~self.active[..., :1, :] | (self.gap[..., :1, :] > 0)
        flags = np.moveaxis(np.concatenate([~first, self.active], axis=-2), -2, -1)
        flat = flags.reshape(math.prod(flags.shape[:-2]), *flags.shape[-2:])
        shortest = np.full(len(self.names), np.inf)
        for lane in flat:
            for k, on in enumerate(lane):
                change = np.flatnonzero(np.diff(on.astype(int)))
                begun = change[~on[change]]
                stays = [change[change > b] for b in begun]
                shortest[k] = min([shortest[k], *(s[0] - b for b, s in zip(begun, stays) if s.size)])
        return shortest

    @property
    def notes(self) -> tuple[str, ...]:
        """Where derivatives are those of the program but may not be those of the motion; empty if nowhere."""
        lanes = tuple(range(self.active.ndim - 1))
        grazing = (self.margin < GRAZING * self.size).any(axis=lanes)
        inside = (self.inside > 0).any(axis=lanes)
        short = ~self.hard & (self.steps_in_contact < RESOLVED)
        said = (
            ("impact inside a step", inside, "derivatives are those of the program"),
            ("grazing", grazing, "derivatives are those of one side"),
            ("fewer than six steps in a contact", short, "derivatives are not good to 5 %"),
        )
        return tuple(f"{what}: {_listed(self.names, at)}; {means}" for what, at, means in said if at.any())


def _listed(names: tuple[str, ...], at: Any) -> str:
    """Names of those, three at most."""
    chosen = [name for name, yes in zip(names, at) if yes]
    return ", ".join(chosen[:3]) + (f" and {len(chosen) - 3} more" if len(chosen) > 3 else "")


def touching(system: Model) -> list[Group]:
    """Contacts without a stiffness, in the order of `State.contacts`, then others that are listed."""
    every = system.effects
    laws = [g for g in every if isinstance(g.effect, ContactLaw) and not g.effect.unilateral]
    laws = [g for g in laws if not g.effect.spread]
    return [g for g in every if g.effect.unilateral] + laws


@over_states
def _gaps(system: Model, state: State) -> list[Array]:
    return [contact_gaps(system, [group], state) for group in touching(system)]


@over_states
def _rates(system: Model, state: State) -> Array:
    groups = [g for g in system.effects if g.effect.unilateral]
    return gaps_and_rates(system, groups, state, state.v)[1]


@checked(system=SYSTEM, trajectory=TRAJECTORY)
def contacts(system: System, trajectory: Trajectory) -> Contacts:
    """Gaps, forces and impacts along a trajectory, and the margins within which its derivatives hold.

    Of pairs that are looked for, memory is by the number of those that come near, see `Contacts`, and time by
    that of all: with 200 capsules and 500 states two seconds, with spheres less than one.

    Args:
        system: compiled system, with contacts.
        trajectory: of it, with any leading axes and all steps saved (`save_every=1`). Of some of the states
            alone, impulses of contacts without a stiffness are whole, and forces of the others are those by
            the gaps at the saved times.

    Raises:
        ValueError: for a system without contacts, and states that do not know of their impulses.
    """
    groups = touching(system)
    if not groups and not searching(system):
        raise ValueError("this system has no contacts; add nc.Contact(...) to its scene")
    gaps = [np.asarray(x) for x in _gaps(system, trajectory)]
    soft = [g for g in groups if not g.effect.unilateral]  # whose impulses states do not know
    first = len(groups) - len(soft)
    measured = [_of_law(group, gap) for group, gap in zip(soft, gaps[first:])]
    if first:
        measured.insert(0, _of_impulses(system, trajectory, groups[:first], gaps[:first]))
    names = []
    for group in groups:
        names += [group.names[k] if len(group.names) == group.count else f"{group.labels[0]}[{k}]"
                  for k in range(group.count)]  # fmt: skip
    searched = near_pairs(system, trajectory)
    for found in searched:
        names += found.names
        gaps.append(found.gap)
        measured.append(_of_pairs(found))
    force, impacts, inside, margin = (np.concatenate(x, axis=-1) for x in zip(*measured))
    hard = np.zeros(len(names), bool)
    hard[: sum(g.count for g in groups)] = [g.effect.bounces for g in groups for _ in range(g.count)]
    states, every = trajectory.states, np.concatenate(gaps, axis=-1)
    size = 1.0 + float(np.max(np.abs(np.asarray(states.q))))
    t, active = np.asarray(states.t), force > 0
    return Contacts(tuple(names), t, every, force, active, impacts, inside, margin, size, hard)


def _of_impulses(
    system: System, trajectory: Trajectory, groups: list[Group], gaps: list[np.ndarray]
) -> tuple[np.ndarray, ...]:
    """Forces, impacts, those that are not located, and margins of contacts without a stiffness.

    Raises:
        ValueError: for states that do not know of their impulses.
    """
    states = trajectory.states
    if states.contacts is None:
        raise ValueError("states of this trajectory have no impulses of contacts; simulate it again")
    span = np.diff(np.asarray(states.t), axis=-1)[..., None]
    moving = np.where(span > 0, span, 1.0)
    steps, struck, inside, *located = np.moveaxis(np.diff(np.asarray(states.contacts), axis=-3), -1, 0)
    impacts = inside + np.sum(located, axis=0) if located else inside
    every = np.concatenate(gaps, axis=-1)
    before, after = every[..., :-1, :], every[..., 1:, :]
    start: Any = jax.tree.map(lambda x: x[(0,) * states.t.ndim], states)
    halves = 0.5 * np.asarray(mobilities(system, start))
    bounces = np.concatenate([np.full(g.count, g.effect.bounces) for g in groups])
    # What comes near within an interval is nearest there, or would be as deep as its impact is fast.
    rates = _rates(system, trajectory)
    begun, ended = rates[..., :-1, :], rates[..., 1:, :]
    least = np.abs(np.asarray(lowest(jnp.asarray(before), begun, ended, jnp.asarray(moving))))
    change = np.abs(np.asarray(begun)) + np.abs(np.asarray(ended))
    deep = 0.5 * moving * (halves * struck) ** 2 / np.where(change > 0, change, 1.0)
    least = np.where(impacts > 0, np.where(change > 0, deep, np.inf), least)
    margin = np.where(bounces & (steps > 0), halves * steps * moving, np.minimum(least, np.abs(after)))
    return (steps + struck) / moving, impacts, inside, margin


def _of_law(group: Group, gap: np.ndarray) -> tuple[np.ndarray, ...]:
    """The same of a group of contacts with a stiffness."""
    effect: Any = group.effect
    law = jax.vmap(lambda e, before, after: e.mean_force(before, after))
    before, after = (np.moveaxis(x, -1, 0) for x in (gap[..., :-1, :], gap[..., 1:, :]))
    flat = [jnp.asarray(x.reshape(group.count, -1)) for x in (before, after)]
    found = jax.vmap(law, in_axes=(None, 1, 1), out_axes=1)(effect, *flat)
    force = np.moveaxis(np.asarray(found).reshape(before.shape), 0, -1)
    return force, np.zeros_like(force), np.zeros_like(force), np.abs(gap[..., 1:, :])


def _of_pairs(found: NearPairs) -> tuple[np.ndarray, ...]:
    """The same of pairs that have been looked for."""
    before, after = found.gap[..., :-1, :], found.gap[..., 1:, :]
    force = np.asarray(mean_force(found.law, before, after))
    return force, np.zeros_like(force), np.zeros_like(force), np.abs(after)
