"""Balances along a trajectory: change of energy less work, change of momenta less impulses.

Impulses of gravity, loads and springs to the ground are those of the discrete equations: the effects are
evaluated once more at the mid-points of the steps, where their quadrature is exact. Reactions of the ground
are unknown, so momenta are judged along those rigid motions of everything on which no reaction can work:
all six of a free system, turning about the axis of a hinge on the ground, none of a closed loop on the
ground. They are found from the constraints themselves, as the common null space of all reactions.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import Concrete
from natcoord_jax.core.motion import Motion, Response
from natcoord_jax.core.state import TRAJECTORY, State, Trajectory
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.maths.vectors import cross, safe_divide
from natcoord_jax.mechanics.momentum import body_momenta, inertia
from natcoord_jax.mechanics.response import gather, motion_between, respond, situation
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.model.own_effects import own_class
from natcoord_jax.system import System

INTERNAL = 1e-12
"""Impulse in a step, relative to the momenta of the bodies, up to which what acts has no resultant."""

TURNS = 1e-9
"""The same of effects that are not the library's, over the run, or relative to their forces."""

REACTION_FREE = 1e-12
"""A rigid motion counts as free of reactions when their mean square power is below this share: far above the
round-off of the eigenvalues, and with 1e-6 in amplitude far below any real constraint."""


class Balance(eqx.Module):
    """Errors of the balances at each saved time, relative to fixed scales.

    Attributes:
        energy: |E - E_0 - (W - W_0)| / scale; the scale is the largest T + sum |V_store| + sum |W| [-].
        momentum: the same for momentum and impulse, along the directions free of ground reactions; the
            scale is the largest sum over the bodies of sqrt(2 m_b T_b), which is |p_b| where they do not
            turn, plus the largest impulse in a step [-]. None if there is no such direction.
        angular_momentum: the same for turning about the axes free of reactions; the scale is the largest
            sum over the rows of the bodies of |q_a| |p_a|, of which J is made, plus the largest in a step
            and sum_k integral |u_k| dt [-]. None if there is no such axis.
        directions: number of directions `momentum` counts, 0 to 3.
        axes: number of axes `angular_momentum` counts, 0 to 3.
        note: why something is missing, and which effects of one's own push or turn the whole from within,
            by how much; or "".
    """

    energy: Float[np.ndarray, "*lanes saved"]
    momentum: Float[np.ndarray, "*lanes saved"] | None
    angular_momentum: Float[np.ndarray, "*lanes saved"] | None
    directions: int
    axes: int
    note: str

    def __repr__(self) -> str:
        """The largest errors over all times."""
        lines = [f"energy            {np.max(self.energy):.2g} of the largest sum of energies and works"]
        for name, errors, count, scale in (
            ("momentum", self.momentum, f"{self.directions} directions", "momenta"),
            ("angular momentum", self.angular_momentum, f"{self.axes} axes", "angular momenta"),
        ):
            worth = "not judged" if errors is None else f"{np.max(errors):.2g} of the largest sum of {scale}"
            lines.append(f"{name:<17} {worth}" + (f", along {count}" if errors is not None else ""))
        lines += [f"({self.note})"] if self.note else []
        return "\n".join(["Balance: largest relative errors [-]", *lines])


def _resultants(bodies: int, group: Group, motion: Motion, answer: Response) -> Float[Array, "n 6"]:
    """Force and torque about the origin that each instance of a group puts on the bodies (not the ground)."""
    moving = (group.bodies < bodies)[..., None]
    force = turning = jnp.zeros((*group.bodies.shape, 3))
    if answer.forces is not None:
        rows = answer.forces[:, 0]
        force, turning = rows[:, :, 0], jnp.sum(cross(motion.rows[0], rows), axis=2)
    if answer.torques is not None:
        turning = turning + answer.torques[:, 0]
    return jnp.sum(jnp.where(moving, jnp.concatenate([force, turning], axis=-1), 0.0), axis=1)


class _Known(eqx.Module):
    """What is known to act in a step.

    Attributes:
        impulse: resultant (6,) of what acts from outside.
        size: of all forces and torques, with their arms (2,).
        gram: of the reactions (6, 6).
        within: of each effect of one's own between bodies, its resultant (6,), and what its reactions have
            of one, relative to them.
    """

    impulse: Float[Array, "6"]
    size: Float[Array, "2"]
    gram: Float[Array, "6 6"]
    within: dict[str, tuple[Float[Array, "6"], Float[Array, ""]]]


def _step(
    system: System, midpoint: bool, own: dict[str, bool], before: State, after: State, u: Array
) -> _Known:
    """What is known of a step; `own` tells by name which groups are not the library's."""
    bodies, tableau = len(system.structure.bodies), gauss(1)
    h = after.t - before.t
    at = motion_between(before, after, h)
    impulse, sizes, gram, within = jnp.zeros(6), jnp.zeros(2), jnp.zeros((6, 6)), {}
    for group in (*system.effects, *system.joints):
        where, motion = situation(system, group, before, u, h), gather(group, at)
        lam = jnp.zeros((group.count, 1, group.multipliers))
        scale = 1.0 if group.effect.impulsive else h
        answer = respond(group, where, motion, lam, tableau)
        known = scale * _resultants(bodies, group, motion, answer)
        size, ends, name = scale * _sizes(motion, answer), jnp.asarray(group.bodies), group.labels[0]
        between = (ends < bodies).all(axis=1) & (ends.min(axis=1) < ends.max(axis=1))
        inside, sizes, share = (own[name] & between)[:, None], sizes + size, jnp.zeros(())
        outer = jnp.where(inside, 0.0, known)
        if midpoint:
            impulse = impulse + jnp.sum(outer, axis=0)
        else:
            # Impulses over several stages are not in the trajectory: they count as reactions do.
            gram = gram + safe_divide(outer.T @ outer, jnp.sum(size) ** 2)
        for number in range(group.multipliers):
            answer = respond(group, where, motion, lam.at[:, :, number].set(1.0), tableau)
            columns = scale * _resultants(bodies, group, motion, answer) - known
            outer = jnp.where(inside, 0.0, columns)
            gram = gram + outer.T @ outer
            most = jnp.max(jnp.abs(columns - outer))
            share = jnp.maximum(share, safe_divide(most, scale * jnp.sum(_sizes(motion, answer))))
        if own[name]:
            within[name] = jnp.sum(jnp.where(inside, known, 0.0), axis=0), share
    return _Known(impulse, sizes, gram, within)


def _sizes(motion: Motion, answer: Response) -> Float[Array, "2"]:
    """Forces, and torques and forces with their arms about the origin, by their sizes."""
    force = turning = jnp.zeros(())
    if answer.forces is not None:
        parts = jnp.linalg.norm(answer.forces[:, 0], axis=-1)
        force = jnp.sum(parts[:, :, 0])
        turning = jnp.sum(parts * jnp.linalg.norm(motion.rows[0], axis=-1))
    if answer.torques is not None:
        turning = turning + jnp.sum(jnp.abs(answer.torques))
    return jnp.stack([force, turning])


def _momentum_sizes(system: System, state: State) -> tuple[Array, Array]:
    """Momenta of what the bodies' energies would have in straight motion, and what angular momenta sum up."""
    unit = jnp.zeros_like(state.row_rates).at[:, 0, 0].set(1.0)
    parts, masses = inertia(system, state.row_rates), inertia(system, unit)[:, 0, 0]
    energies = jnp.abs(jnp.sum(parts * state.row_rates, axis=(1, 2)))
    norms = jnp.linalg.norm(state.rows, axis=-1) * jnp.linalg.norm(parts, axis=-1)
    return jnp.sum(jnp.sqrt(masses * energies)), jnp.sum(norms)


@eager_numpy
def _account(system: System, trajectory: Trajectory, own: dict[str, bool]) -> dict[str, Any]:
    """All that is needed of the trajectory, at the saved times."""
    states = trajectory.states
    before, after = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
    midpoint = trajectory.scheme is None or trajectory.scheme.tableau == gauss(1)
    known = jax.vmap(partial(_step, system, midpoint, own))(before, after, trajectory.inputs)
    sizes = jax.vmap(lambda s: _momentum_sizes(system, s))(states)
    linear, angular = jax.vmap(lambda s: body_momenta(system, s))(states)
    energy, work = system.energy(trajectory), states.work
    if states.dissipated is not None:
        work = jnp.concatenate([work, -states.dissipated[:, None]], axis=1)
    stores = sum((jnp.abs(v) for v in energy.stores.values()), jnp.zeros_like(energy.kinetic))
    pulled = jnp.sum(jnp.abs(trajectory.inputs) * (after.t - before.t)[:, None])
    return {
        "energy": energy.total - energy.total[0] - jnp.sum(work - work[0], axis=-1),
        "energy_scale": energy.kinetic + stores + jnp.sum(jnp.abs(work), axis=-1),
        "momenta": jnp.concatenate([jnp.sum(linear, axis=1), jnp.sum(angular, axis=1)], axis=-1),
        "momentum_scale": jnp.max(sizes[0]) + jnp.max(known.size[:, 0]),
        "angular_scale": jnp.max(sizes[1]) + jnp.max(known.size[:, 1]) + pulled,
        "impulses": known.impulse,
        "gram": jnp.mean(known.gram, axis=0),
        "within": known.within,
    }


def _free_motions(gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rigid motions free of reactions: directions of translation (k, 6), and turns of unit rate (l, 6)."""
    values, vectors = np.linalg.eigh(gram)
    free = vectors[:, values <= REACTION_FREE * max(values[-1], 1.0)].T
    mix, sizes, _ = np.linalg.svd(free[:, 3:])
    rates = np.zeros(len(free))
    rates[: len(sizes)] = sizes
    turning = rates > 1e-8
    return mix.T[~turning] @ free, (mix.T[turning] @ free) / rates[turning, None]


def _scales(account: dict[str, Any]) -> np.ndarray:
    return np.repeat([account["momentum_scale"], account["angular_scale"]], 3)


def _not_conserved(account: dict[str, Any]) -> list[str]:
    """Effects of one's own between bodies that push or turn these as a whole, in words."""
    said = []
    for name, (impulses, shares) in account["within"].items():
        sums = np.cumsum(impulses, axis=0)
        pushed, turned = (np.max(np.linalg.norm(x, axis=-1)) for x in (sums[:, :3], sums[:, 3:]))
        push, turn = _scales(account)[[0, 3]]
        if pushed > TURNS * push:
            said.append(f"{name!r} pushes the whole by {pushed:.2g} N s")
        elif turned > TURNS * turn:
            said.append(f"{name!r} turns the whole by {turned:.2g} N m s")
        elif np.max(shares) > TURNS:
            said.append(f"reactions of {name!r} push or turn the whole")
    return [f"not conserved: {', '.join(said)}, from within: see nc.testing.check_effect"] if said else []


def _relative(error: np.ndarray, scale: float) -> np.ndarray:
    return np.zeros_like(error) if scale == 0 else error / scale


def _of_lanes(lanes: list[Balance]) -> Balance:
    """Errors of all lanes of a batch; none where one of them has none."""

    def stacked(errors: list[Any]) -> Any:
        return None if any(x is None for x in errors) else np.stack(errors)

    return Balance(
        np.stack([lane.energy for lane in lanes]),
        stacked([lane.momentum for lane in lanes]),
        stacked([lane.angular_momentum for lane in lanes]),
        min(lane.directions for lane in lanes),
        min(lane.axes for lane in lanes),
        "; ".join(dict.fromkeys(lane.note for lane in lanes if lane.note)),
    )


@checked(system=SYSTEM, trajectory=Concrete(TRAJECTORY))
def balance(system: System, trajectory: Trajectory) -> Balance:
    """Errors of the balances of energy, momentum and angular momentum along a trajectory.

    Args:
        system: compiled system.
        trajectory: computed with it, every step saved; of a batch, too.

    Returns:
        The relative errors; see `Balance` for their scales. Momenta are left out, with a note, where the
        trajectory does not hold every step (`save_every`, steps repeated in substeps) and impulses act,
        because these are then unknown. What effects of one's own between bodies put on the whole is no
        impulse from outside: momenta miss it, and the note names the effect. Of a batch the errors of all
        lanes, (lanes, saved), along the fewest directions and axes that any of them has.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0, 1, 0.1)))
        >>> system, state = scene.compile()
        >>> errors = nc.balance(system, nc.simulate(system, state, dt=0.1, steps=10))
        >>> errors.axes, bool(errors.angular_momentum.max() < 1e-13)
        (3, True)
    """
    if trajectory.t.ndim != 1:
        return _of_lanes([balance(system, lane) for lane in trajectory])
    saved = trajectory.t.shape[0]
    if saved == 1:
        return Balance(np.zeros(1), np.zeros(1), np.zeros(1), 3, 3, "no step was made")
    groups = (*system.effects, *system.joints)
    own = {
        g.labels[0]: bool(g.effect.stores or g.multipliers) and own_class(g.effect) is not None
        for g in groups
    }
    account = jax.tree.map(np.asarray, _account(system, trajectory, own))
    energy = _relative(np.abs(account["energy"]), np.max(account["energy_scale"]))
    notes = _not_conserved(account)
    # (States after the end of a run repeat the last one, and are no steps. The resultant of internal forces
    # is rounding.)
    acted_on = np.any(np.abs(account["impulses"]) > INTERNAL * _scales(account))
    if int(trajectory.steps_taken) > np.count_nonzero(np.diff(trajectory.t)) and acted_on:
        notes.append("momenta: some steps were made in parts or not saved")
        return Balance(energy, None, None, 0, 0, "; ".join(notes))
    impulse = np.concatenate([np.zeros((1, 6)), np.cumsum(account["impulses"], axis=0)])
    change = account["momenta"] - account["momenta"][0] - impulse
    along, about = _free_motions(account["gram"])
    linear = _relative(np.linalg.norm(change @ along.T, axis=-1), float(account["momentum_scale"]))
    angular = _relative(np.linalg.norm(change @ about.T, axis=-1), float(account["angular_scale"]))
    missing = [name for name, found in (("momentum", along), ("angular momentum", about)) if not len(found)]
    if missing:
        notes.append(f"{' and '.join(missing)}: every component feels reactions of the ground")
    parts = (linear if len(along) else None, angular if len(about) else None)
    return Balance(energy, *parts, len(along), len(about), "; ".join(notes))
