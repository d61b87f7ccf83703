"""Accelerations and reactions of a state: the solution of the equations of motion at one instant.

Redundant joints and relations are allowed: accelerations do not depend on how they share the load, and
of all possible reactions those with the least sum of squares of forces and torques are taken. Velocities
are taken as they are read, see `reading`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.mechanics.equations_of_motion import (
    Accelerations,
    EquationsOfMotion,
    loads,
    loops_of,
    relations_of,
)
from natcoord_jax.mechanics.rates import Twists, tree_rates
from natcoord_jax.mechanics.violations import GAP, contact_gaps, contacts, position_size, refuse_contacts
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import states_of
from natcoord_jax.reading.tangent_states import Source

SHIFT = 1e-7
"""Regularisation of redundant constraints, relative; refined away: `ROUNDS` corrections leave
(SHIFT / relative compliance)^ROUNDS of it, and round-off amplified by 1/SHIFT in the shares of the load."""
ROUNDS = 6


class Instant(eqx.Module):
    """What the equations of motion say at one time, or along a trajectory.

    Attributes:
        accelerations: second time derivatives of the rows [m/s^2 for points, 1/s^2 for directors].
        forces: force of each joint on its child [N], world components, in the order of
            `system.structure.joints`.
        torques: torque of each joint on its child about the joint's point on the child [N m].
        multipliers: of relations between coordinates (generalised force [N m or N]) and of joints that
            close loops, by name.
    """

    accelerations: Float[Array, "*t rows 3"]
    forces: Float[Array, "*t joints 3"]
    torques: Float[Array, "*t joints 3"]
    multipliers: dict[str, Float[Array, "*t m"]]


class Saddle(eqx.Module):
    """[[A, -C^T], [C, 0]] with redundant rows of C, solved for least reactions.

    A is completed by C^T C, which changes no solution, so that bodies without inertia along a motion that
    only loops forbid do no harm.

    Attributes:
        matrix: K = A + weight C^T C.
        inverse: K^-1.
        rows: C.
        weight: [kg].
        spread: K^-1 C^T.
        compliance: S = C K^-1 C^T.
        shift: what S is shifted by: the metric of the reactions, scaled.
        shifted: inverse of S + shift.
    """

    matrix: Float[Array, "n n"]
    inverse: Float[Array, "n n"]
    rows: Float[Array, "m n"]
    weight: Float[Array, ""]
    spread: Float[Array, "n m"]
    compliance: Float[Array, "m m"]
    shift: Float[Array, "m m"]
    shifted: Float[Array, "m m"]

    @classmethod
    def of(cls, inertia: Array, rows: Array, metric: Array, weight: Array) -> "Saddle":
        """From A, C, the metric H of the reactions and the mass of a typical body [kg]."""
        matrix = inertia + weight * rows.T @ rows
        inverse = jnp.linalg.inv(matrix) if matrix.size else matrix
        spread = inverse @ rows.T
        spread = spread + inverse @ (rows.T - matrix @ spread)
        compliance, shift = rows @ spread, SHIFT / weight * metric
        shifted = jnp.linalg.inv(compliance + shift)
        return cls(matrix, inverse, rows, weight, spread, compliance, shift, shifted)

    def shares(self, right: Float[Array, " m"], pull: Float[Array, " m"]) -> Float[Array, " m"]:
        """Multipliers with S lambda = right that minimise lambda H lambda / 2 + pull lambda."""
        lam = self.shifted @ (right - SHIFT / self.weight * pull)
        for _ in range(ROUNDS):
            lam = lam + self.shifted @ (right - self.compliance @ lam)
        return lam

    def solve(self, force: Float[Array, " n"], rates: Float[Array, " m"]) -> tuple[Array, Array]:
        """Solution x of A x - C^T lambda = force, C x = rates; and the right-hand side of S lambda."""
        force = force + self.weight * self.rows.T @ rates
        x = self.inverse @ force
        x = x + self.inverse @ (force - self.matrix @ x)
        right = rates - self.rows @ x
        return x + self.spread @ self.shares(right, jnp.zeros_like(right)), right


def scales(system: Model) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mass of a typical body [kg], and its squared radius of gyration [m^2]; of points the scene's size."""
    masses = system.mass[:, 0, 0]
    moment = jnp.sum(jnp.trace(system.mass[:, 1:, 1:], axis1=1, axis2=2))
    radius = moment / jnp.sum(masses)
    return jnp.mean(masses), jnp.where(radius > 0, radius, jnp.square(system.size))


def _accelerated(
    balances: EquationsOfMotion, columns: Accelerations, applied: Twists, bias: Accelerations
) -> tuple[Array, Array]:
    """Matrix and right-hand side P^T (F - M bias) of the balances."""
    matrix = jax.vmap(lambda gains: balances.project(*balances.inertial(gains)))(columns).T
    force, torque = balances.inertial(bias)
    return matrix, balances.project(applied[0] - force, applied[1] - torque)


def _combined(bias: Accelerations, columns: Accelerations, w_dot: Array) -> Accelerations:
    return jax.tree.map(lambda b, c: b + jnp.tensordot(w_dot, c, 1), bias, columns)


def _reactions(
    balances: EquationsOfMotion, gains: Accelerations, applied: Twists, lam: Array
) -> tuple[Array, Array]:
    pulled = balances.constrained(lam) if lam.size else (0.0, 0.0)
    force, torque = (a - b - c for a, b, c in zip(balances.inertial(gains), applied, pulled, strict=True))
    return balances.reactions(force, torque, lam)


def _measured(
    balances: EquationsOfMotion, units: Array, radius: Array, gains: Any, applied: Twists, lam: Array
) -> Array:
    """All reactions as one vector [N], torques divided by the radius of gyration.

    Args:
        balances: of the system.
        units: of the constraints.
        radius: of gyration, squared [m^2].
        gains: accelerations.
        applied: loads.
        lam: multipliers, in these units [N].
    """
    forces, torques = _reactions(balances, gains, applied, lam / units)
    related = lam[: sum(g.count * g.multipliers for g in relations_of(balances.system))]
    return jnp.concatenate([forces.reshape(-1), torques.reshape(-1) / jnp.sqrt(radius), related])


def _with_constraints(
    system: Model, state: State, u: Array, balances: EquationsOfMotion, w: Array
) -> tuple[Accelerations, Twists, Array]:
    """Accelerations, loads and multipliers of a system with relations or loops."""
    mass, radius = scales(system)
    columns = balances.columns()
    nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), columns)
    still = jnp.zeros_like(balances.rows[:, 0])
    lam0 = nothing.constraints
    matrix, zero = _accelerated(balances, columns, (still, still), nothing)
    # What constraints change by where a body moves by one metre, or turns by as much.
    groups = (*relations_of(system), *loops_of(system))
    shift, turn = jnp.concatenate([g.spans.reshape(-1, 2) for g in groups]).T
    units = shift + turn / jnp.sqrt(radius)
    each = jnp.eye(lam0.shape[0], dtype=lam0.dtype)
    share = jax.vmap(lambda lam: _measured(balances, units, radius, nothing, (still, still), lam))(each).T
    saddle = Saddle.of(matrix, columns.constraints.T / units[:, None], share.T @ share, mass)
    w = w + saddle.solve(zero, -balances.rates(w).constraints / units)[0]
    applied = loads(system, state, u, *balances.twists(w))
    bias = balances.bias(w)
    free = _accelerated(balances, columns, applied, bias)[1]
    w_dot, right = saddle.solve(free, -bias.constraints / units)
    gains = _combined(bias, columns, w_dot)
    pull = share.T @ _measured(balances, units, radius, gains, applied, lam0)
    return gains, applied, saddle.shares(right, pull) / units


def _without_constraints(
    system: Model, state: State, u: Array, balances: EquationsOfMotion, w: Array
) -> tuple[Accelerations, Twists, Array]:
    """Accelerations, loads and no multipliers of a tree."""
    applied = loads(system, state, u, *balances.twists(w))
    bias = balances.bias(w)
    if w.size:
        columns = balances.columns()
        matrix, right = _accelerated(balances, columns, applied, bias)
        bias = _combined(bias, columns, jnp.linalg.solve(matrix, right))
    return bias, applied, bias.constraints


def _named(balances: EquationsOfMotion, lam: Array) -> dict[str, Array]:
    found, position = {}, 0
    for group in (*relations_of(balances.system), *loops_of(balances.system)):
        for name in group.names:
            found[name] = lam[position : position + group.multipliers]
            position += group.multipliers
    return found


def instant_of(system: Model, state: State, u: Float[Array, " inputs"]) -> Instant:
    """Accelerations and reactions of one state."""
    balances = EquationsOfMotion.at(system, state)
    w = tree_rates(system, state)
    solve = _with_constraints if system.structure.held else _without_constraints
    gains, applied, lam = solve(system, state, u, balances, w)
    these = contacts(system)
    if these:
        # What closed contacts do at an instant depends on what follows.
        closed = jnp.any(
            contact_gaps(system, these, state) <= GAP * system.size * position_size(system, state)
        )
        gains, lam = jax.tree.map(lambda x: jnp.where(closed, jnp.nan, x), (gains, lam))
    forces, torques = _reactions(balances, gains, applied, lam)
    return Instant(gains.rows.reshape(-1, 3), forces, torques, _named(balances, lam))


def inputs_along(system: Model, motion: State | Trajectory, inputs: Any) -> Float[Array, "*t inputs"]:
    """Inputs at every state: given ones, those of the steps that start there, or zero.

    Raises:
        ValueError: for a wrong shape.
    """
    states = states_of(motion)
    count, leading = len(system.structure.inputs), states.t.shape
    if inputs is None and isinstance(motion, Trajectory):
        inputs = jnp.concatenate([motion.inputs, motion.inputs[..., -1:, :]], axis=-2)
    given = jnp.zeros(count) if inputs is None else jnp.asarray(inputs, float)
    if given.shape[-1:] != (count,) or given.shape[:-1] not in ((), leading):
        raise ValueError(
            f"inputs has shape {given.shape}; this system has the input channels "
            f"{list(system.structure.inputs)}: pass shape {(count,)} or {(*leading, count)}"
        )
    return jnp.broadcast_to(given, (*leading, count))


@compiled
def instants(source: Source) -> Instant:
    """Accelerations and reactions at all states of a source."""
    return source.each(instant_of, source.inputs)


def instant(system: Model, motion: State | Trajectory, inputs: Any = None) -> Instant:
    """Accelerations and reactions of a state, or of all states of a trajectory; see `System.instant`.

    Raises:
        ValueError: for a wrong shape of the inputs, and where a contact that is a constraint is closed
            (inside jit: accelerations and reactions are then no numbers).
    """
    found = instants(Source.of(system, motion, inputs_along(system, motion, inputs)))
    if contacts(system) and is_concrete(found) and np.isnan(np.asarray(found.accelerations)).any():
        refuse_contacts(system, "an instant with closed contacts")
    return found
