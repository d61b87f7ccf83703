"""Energies, momenta and constraint errors of a state or of a whole trajectory, and how a run ended."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import REASONS, REMEDIES, Result, SimulationError
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.mechanics.equations_of_motion import EquationsOfMotion, relations_of
from natcoord_jax.mechanics.failures import failure
from natcoord_jax.mechanics.momentum import body_momenta, group_energies, inertia
from natcoord_jax.mechanics.violations import (
    LEFT_OPEN,
    largest,
    violation_rates_of,
    violations_of,
    worst_violation,
)
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import over_states
from natcoord_jax.reading.tangent_states import Source, over_source

DEPENDENT = 1e-6
"""Singular values of constraints, relative to the largest, up to which some depend on others."""

SINGULAR = 0.15
"""The least of them where a run fails, relative to that at its start, that a dead centre is told from: of the
shortest substep that is tried, the root of its part of the way is left, a tenth and less."""


class Energy(eqx.Module):
    """Energies of a state, or along a trajectory [J].

    Attributes:
        kinetic: of the bodies (1).
        stores: stored energy by name of the effect: springs, gravity, rotors.
    """

    kinetic: Float[Array, "*t"]
    stores: dict[str, Float[Array, "*t"]]

    @property
    def potential(self) -> Float[Array, "*t"]:
        """Sum of the stores."""
        require_double("Energy.potential")
        return sum(self.stores.values(), jnp.zeros_like(self.kinetic))

    @property
    def total(self) -> Float[Array, "*t"]:
        """Kinetic energy and stores."""
        require_double("Energy.total")
        return self.kinetic + self.potential


@over_states
def energy(system: Model, state: State) -> Energy:
    """Energies (1) and stores."""
    v = state.row_rates
    kinetic = 0.5 * jnp.sum(v * inertia(system, v))
    stores = {}
    for group in system.effects:
        if group.effect.stores:
            values = group_energies(system, group, state)
            if len(group.labels) < values.shape[0]:
                values = jnp.sum(values)[None]
            stores |= dict(zip(group.labels, values))
    return Energy(kinetic, stores)


@over_states
def momentum(system: Model, state: State) -> Float[Array, "3"]:
    """Momentum."""
    return jnp.sum(body_momenta(system, state)[0], axis=0)


@over_states
def angular_momentum(system: Model, state: State) -> Float[Array, "3"]:
    """Angular momentum about the origin (55)."""
    return jnp.sum(body_momenta(system, state)[1], axis=0)


def unknown_name(system: Model, index: int, stages: int = 1) -> str:
    """Name of the part that an unknown of the equations of a step with so many stages belongs to."""
    structure = system.structure
    if index < structure.unknowns * stages:
        body = int(np.asarray(system.tree.slot_of)[index % structure.unknowns]) // 7
        joint = structure.joints[body]
        return f"joint {joint!r}" if joint else f"body {structure.bodies[body]!r}"
    index -= structure.unknowns * stages
    for group in (*system.effects, *(g for g in system.joints if not g.in_tree)):
        each = stages * group.multipliers
        if index < group.count * each:
            return f"{group.effect.kind} {group.names[index // each]!r}"
        index -= group.count * each
    return "an unknown"


def explain(system: Model, trajectory: Trajectory) -> str:
    """How a run ended, in words: result, step, time, and the part with the worst residual by name.

    Of a batch, how many lanes failed for which reason at which part, and the first of each.
    """
    if np.ndim(trajectory.result):
        return _explain_lanes(system, trajectory)
    result = Result(int(trajectory.result))
    if result == Result.SUCCESSFUL:
        return REASONS[result]
    where = f" in step {int(trajectory.failed_step)} at t = {float(trajectory.failed_time):.6g} s"
    return REASONS[result] + where + _culprit(system, trajectory) + _remedy(system, trajectory)


def _remedy(system: Model, trajectory: Trajectory) -> str:
    """What to do: no smaller step helps a drive that leads beyond a dead centre."""
    result = Result(int(trajectory.result))
    drive = _beyond_reach(system, trajectory) if "a smaller dt" in REMEDIES.get(result, "") else ""
    if drive:
        return (
            f"; {drive!r} asks for what the mechanism cannot follow on from here (a dead centre, or arms "
            "stretched out): change its function, or drive another joint"
        )
    return f"; {REMEDIES[result]}" if result in REMEDIES else ""


@eager_numpy
def _constraint_rates(system: Model, state: State) -> tuple[Array, Array]:
    """What the constraints outside of the tree take of the rates, a row each, and the rates prescribed."""
    balances = EquationsOfMotion.at(system, state)
    moved = balances.rates(jnp.zeros(system.structure.unknowns)).constraints
    return balances.columns().constraints.T, moved


def _beyond_reach(system: Model, trajectory: Trajectory) -> str:
    """Name of a drive that the other constraints stand in the way of where a run failed, or ""."""
    # (In small systems: the others are not solved densely, and here neither.)
    if np.ndim(system.mass) > 3 or not system.structure.held or system.structure.solver != "reduced":
        return ""
    states = (jax.tree.map(lambda x, k=k: x[k], trajectory.states) for k in (0, -1))
    (first, _), (rows, moved) = (map(np.asarray, _constraint_rates(system, state)) for state in states)
    if not np.all(np.isfinite(rows)) or not moved.any():
        return ""
    lengths = [np.maximum(np.linalg.norm(x, axis=1), 1e-300) for x in (first, rows)]
    before = np.linalg.svd(first / lengths[0][:, None], compute_uv=False)
    left, after, _ = np.linalg.svd(rows / lengths[1][:, None])
    rank = int(np.sum(before > DEPENDENT * before[0]))
    if rank == 0 or after[rank - 1] > SINGULAR * before[rank - 1]:
        return ""
    names = [name for g in relations_of(system) for name in g.names for _ in range(g.multipliers)]
    shares = np.abs(left[:, rank - 1] * moved / lengths[1])[: len(names)]
    return names[int(np.argmax(shares))] if shares.max(initial=0.0) > 0 else ""


def _culprit(system: Model, trajectory: Trajectory) -> str:
    """The part that a run failed at, as far as it is known."""
    result = Result(int(trajectory.result))
    if result == Result.BAD_START:
        start = jax.tree.map(lambda x: x[0], trajectory.states)
        every = (worst_violation(system, start, allowed=LEFT_OPEN, overlaps=x) for x in (False, True))
        # (There is none where each lane has numbers of its own for the system.)
        return "".join(f": {worst} by {worst.size:.3g} {worst.unit}" for worst in every if worst is not None)
    # The first interval without an end holds the inputs of the step that failed.
    failed = int(np.argmax(np.diff(np.asarray(trajectory.t)) == 0))
    broken = ~np.isfinite(np.asarray(trajectory.inputs)[failed])
    if result == Result.NONFINITE and broken.any():
        # Such a number spoils all unknowns of the step, of which the first would be named.
        names = [repr(name) for name, bad in zip(system.structure.inputs, broken) if bad]
        return f"; not finite: the input {', '.join(names)}"
    if int(trajectory.failed_part) < -1:
        return f": {failure(system, -2 - int(trajectory.failed_part))[1]}"
    if int(trajectory.failed_part) >= 0:
        stages = trajectory.scheme.stages if trajectory.scheme is not None else 1
        return f"; worst residual at {unknown_name(system, int(trajectory.failed_part), stages)}"
    return ""


def _explain_lanes(system: Model, batch: Trajectory) -> str:
    """A line for each reason and part, the most frequent first."""
    batch = jax.tree.map(np.asarray, batch)
    shape = batch.result.shape
    found: dict[tuple[Result, str], list[tuple[int, ...]]] = {}
    for place in np.ndindex(*shape):
        result = Result(int(batch.result[place]))
        if result != Result.SUCCESSFUL:
            lane = jax.tree.map(lambda x, place=place: x[place], batch)
            found.setdefault((result, _culprit(system, lane)), []).append(place)
    failed = sum(len(lanes) for (result, _), lanes in found.items() if not result.ok)
    lines = [f"{failed or 'none'} of {batch.result.size} lanes failed"]
    for (result, culprit), lanes in sorted(found.items(), key=lambda item: -len(item[1])):
        first = lanes[0]
        name = first[0] if len(first) == 1 else first
        step, t = int(batch.failed_step[first]), float(batch.failed_time[first])
        at = f"first lane {name} in step {step} at t = {t:.6g} s"
        remedy = _remedy(system, jax.tree.map(lambda x, place=first: x[place], batch))
        lines.append(f"{len(lanes)}: {REASONS[result]}{culprit}; {at}{remedy}")
    return "\n".join(lines)


def raise_on_failure(system: Model, trajectory: Trajectory) -> None:
    """Raise for a concrete trajectory that failed.

    Raises:
        SimulationError: with step, time, the worst part by name and the remedy.
    """
    codes = np.asarray(trajectory.result)
    bad = [int(c) for c in codes.reshape(-1) if not Result(int(c)).ok]
    if bad:
        raise SimulationError(explain(system, trajectory), Result(bad[0]), trajectory)


class ConstraintErrors(eqx.Module):
    """Largest violations at each time; of a trajectory, of the velocities that are read of it.

    Attributes:
        directors: of d_i . d_j = delta_ij [-].
        joints: of the joints' constraints [m, -].
        relations: of drives, couplings and pitches of screws [rad, m].
        director_rates: of the time derivatives of what holds for directors [1/s].
        joint_rates: of those of the joints' constraints [m/s, 1/s].
        relation_rates: of those of relations [rad/s, m/s].
    """

    directors: Float[Array, "*t"]
    joints: Float[Array, "*t"]
    relations: Float[Array, "*t"]
    director_rates: Float[Array, "*t"]
    joint_rates: Float[Array, "*t"]
    relation_rates: Float[Array, "*t"]

    def __repr__(self) -> str:
        """The largest over all times."""
        if not is_concrete(self) or self.joints.size == 0:
            return eqx.tree_pformat(self)
        units = "-", "m, -", "rad, m", "1/s", "m/s, 1/s", "rad/s, m/s"
        names = (field.name for field in dataclasses.fields(self))
        sizes = [f"{name} {np.max(getattr(self, name)):.2g} [{unit}]" for name, unit in zip(names, units)]
        times = f", largest of {self.joints.size} states" if self.joints.size > 1 else ""
        return f"ConstraintErrors({', '.join(sizes)}{times})"

    @property
    def position(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint."""
        return jnp.maximum(jnp.maximum(self.directors, self.joints), self.relations)

    @property
    def velocity(self) -> Float[Array, "*t"]:
        """Largest violation of any constraint rate."""
        return jnp.maximum(jnp.maximum(self.director_rates, self.joint_rates), self.relation_rates)


@over_states
def _values(system: Model, state: State) -> tuple[Array, Array, Array]:
    d = state.rows[:, 1:]
    gram = jnp.einsum("bik,bjk->bij", d, d) - jnp.eye(3)
    groups = system.joints, tuple(relations_of(system))
    joints, relations = (largest(violations_of(system, some, state)) for some in groups)
    return jnp.max(jnp.abs(gram)), joints, relations


@over_source
def _rates(system: Model, state: State) -> tuple[Array, Array, Array]:
    d, rates = state.rows[:, 1:], state.row_rates[:, 1:]
    mixed = jnp.einsum("bik,bjk->bij", d, rates)
    groups = system.joints, tuple(relations_of(system))
    joints, relations = (largest(violation_rates_of(system, some, state)) for some in groups)
    return jnp.max(jnp.abs(mixed + jnp.swapaxes(mixed, 1, 2))), joints, relations


def constraint_errors(system: Model, motion: State | Trajectory) -> ConstraintErrors:
    """Largest violations of internal constraints, joints and relations, and of their rates."""
    source = Source.of(system, motion)
    if isinstance(motion, State):
        source = replace_fields(source, as_they_are=True)
    return ConstraintErrors(*_values(system, motion), *_rates(source))
