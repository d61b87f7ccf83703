"""What a fresh system is checked for: gaps, velocities across constraints, missing inertia, redundancy."""

import warnings
import weakref

import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.checks import as_array, at_top_level
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.admissible_velocities import with_admissible_velocities
from natcoord_jax.mechanics.reduced import ReducedStep, active_groups
from natcoord_jax.mechanics.redundancy import RANK, held_multipliers
from natcoord_jax.mechanics.violations import GAP, LEFT_OPEN, constrained, misses, spans, worst_violation
from natcoord_jax.reading.diagnostics import unknown_name
from natcoord_jax.stepping.assemble import with_admissible_positions
from natcoord_jax.system import System

UNTOLD = 1e-12
"""Rate [m/s, rad/s, 1/s] of a constraint that is rounding of what is prescribed: projected, not told."""


def check_gaps(system: System, state: State) -> None:
    """Refuse a joint that does not close, and a relation between coordinates that does not hold.

    Raises:
        ValueError: with the part, and by how much.
    """
    check_overlaps(system, state, GAP)
    worst = worst_violation(system, state)
    if worst is None:
        return
    by = f"by {worst.size:.3g} {worst.unit}"
    if worst.is_joint:
        raise ValueError(
            f"{worst} does not close: its constraints are violated {by}; move the bodies, or pass "
            "assemble=True to compile"
        )
    raise ValueError(
        f"the start violates {worst} {by} (coordinates count from the assembled pose, distances from zero); "
        f"pass assemble=True to compile, which moves the bodies there, or change what it asks for at "
        f"t = {float(state.t):g} s"
    )


def check_overlaps(system: System, state: State, allowed: float) -> None:
    """Refuse surfaces that overlap at the start.

    Raises:
        ValueError: with the contact, and by how much.
    """
    worst = worst_violation(system, state, overlaps=True, allowed=allowed)
    if worst is not None:
        raise ValueError(
            f"the surfaces of {worst} overlap by {worst.size:.3g} {worst.unit} at the start; move the bodies "
            "apart, or give the contact a stiffness, with which surfaces may overlap"
        )


def check_obeyed(system: System, state: State) -> None:
    """Refuse to start from positions that the constraints forbid; those of tracers pass, and pure trees.

    Velocities are not looked at: those at the ends of steps of order two miss the constraints by the square
    of the step, and a run may go on from there.

    Raises:
        ValueError: with the part, and by how much.
    """
    if not system.structure.multipliers or not at_top_level(system, state):
        return
    if _obeyed and all(seen() is now for seen, now in zip(_obeyed[0], (system, state))):
        return
    check_overlaps(system, state, LEFT_OPEN)
    worst = worst_violation(system, state, allowed=LEFT_OPEN)
    if worst is not None:
        raise ValueError(
            f"the state violates {worst} by {worst.size:.3g} {worst.unit}; pass nc.assemble(system, state)"
        )
    _obeyed[:] = [(weakref.ref(system), weakref.ref(state))]


_obeyed: list[tuple[weakref.ref, weakref.ref]] = []
"""The system and the state last found to obey each other: to look takes some milliseconds, as long as a short
run, and runs are repeated."""


def project_velocities(system: System, state: State) -> State:
    """State with velocities that obey the constraints, with a warning that says by how much they changed.

    Raises:
        ValueError: for velocities that no projection makes obey them, with the part.
    """
    worst = worst_violation(system, state, rates=True)
    if worst is None:
        return state
    projected, code = _with_admissible_velocities(system, state)
    if int(code) != Result.SUCCESSFUL:
        left = worst_violation(system, projected, rates=True) or worst
        raise ValueError(
            f"no velocities obey all constraints at the start: {left} misses its rate by {left.size:.3g} "
            f"{left.unit}; check drives that ask for what others or the position forbid"
        )
    change = float(np.max(np.abs(np.asarray(projected.v) - np.asarray(state.v))))
    if worst.size > UNTOLD:
        warnings.warn(
            f"initial velocities violate {worst} by {worst.size:.3g} {worst.unit}; they were projected onto "
            f"the constraints, which changed row velocities by up to {change:.3g} m/s (directors: 1/s)",
            stacklevel=5,
        )
    return projected


def admitted(system: System, state: State) -> State:
    """What `check_gaps` and `project_velocities` do, for numbers that are not known yet (inside jit).

    Returns:
        The state, with velocities that obey the constraints; all NaN where positions do not.
    """
    if not system.structure.multipliers and not constrained(system):
        return state
    open_, sliding = misses(system, state)
    projected, code = with_admissible_velocities(system, state)
    state = jax.tree.map(lambda x, y: jnp.where(sliding, y, x), state, projected)
    return jax.tree.map(lambda x: jnp.where(open_ | (sliding & (code != 0)), jnp.nan, x), state)


_with_admissible_velocities = eager_numpy(with_admissible_velocities)


def _tiny_step(system: System, state: State) -> ReducedStep:
    inputs = jnp.zeros(len(system.structure.inputs))
    return ReducedStep.prepare(system, state, inputs, jnp.asarray(1e-9), gauss(1))


@eager_numpy
def _jacobian(system: System, state: State):
    step = _tiny_step(system, state)
    return step.jacobian(step.guess())


@eager_numpy
def _constraint_rows(system: System, state: State):
    """Derivatives of the constraints by the rates, row by row: there are fewer of them than rates."""
    step, count = _tiny_step(system, state), system.structure.unknowns
    guess = step.guess()
    constraints, pull = jax.vjp(lambda y: step.residual(y)[0][count:], guess)
    return jax.vmap(lambda unit: pull(unit)[0][:count])(jnp.eye(len(constraints)))


def check_inertia(system: System, state: State) -> None:
    """Refuse a free motion that moves no mass.

    Raises:
        ValueError: naming the body or joint of the motion.
    """
    moments = np.asarray(system.mass)
    # Bodies without mass are fine between two joints, as the cross of a universal joint, but not at an end.
    massless = ~np.any(moments, axis=(1, 2))
    mass = np.where(massless[:, None, None], 1.0, moments[:, :1, :1])
    central = moments[:, 1:, 1:] - moments[:, :1, 1:] * moments[:, 1:, :1] / mass
    values = np.linalg.eigvalsh(central)
    thin = massless | ((values[:, 1] <= 1e-12 * values[:, 2]) & (values[:, 2] > 0))
    if not thin.any() or system.structure.unknowns > 200:
        return
    count = system.structure.unknowns
    matrix = np.asarray(_jacobian(system, state))
    balance, rows = matrix[:count, :count], matrix[count:, :count][held_multipliers(active_groups(system))]
    free = np.eye(count)
    if len(rows):
        _, sizes, vectors = np.linalg.svd(rows)
        free = vectors[int(np.sum(sizes > 1e-9 * max(sizes[0], 1e-300))) :].T
    values, vectors = np.linalg.eigh(free.T @ (balance + balance.T) @ free)
    if len(values) and values[0] <= 1e-11 * values[-1]:
        part = unknown_name(system, int(np.argmax(np.abs(free @ vectors[:, 0]))))
        raise ValueError(
            f"the motion of {part} moves no mass (an ideal rod has no inertia [kg m^2] about its axis); "
            "give the body a small inertia there, or a joint that fixes that rotation"
        )


_with_admissible_positions = eager_numpy(with_admissible_positions)


def find_redundancy(system: System, state: State) -> tuple[int, tuple[str, ...]]:
    """Structural rank of the constraints outside the tree, and the parts that are redundant.

    The rank is the largest over the start and two perturbed admissible configurations: a deficiency at the
    start only (a flat parallelogram) is no redundancy.
    """
    if system.structure.held == 0:
        return 0, ()
    groups = [group for group in active_groups(system) if group.multipliers]
    held = held_multipliers(groups)
    sizes = np.concatenate([np.ravel(x) for x in spans(system, [g for g in groups if g.holds])])
    best, names = -1, ()
    random = np.random.default_rng(0)
    for attempt in range(3):
        state_now = state
        if attempt:
            rows = np.asarray(state.rows)
            noise = 0.05 * random.normal(size=rows.shape)
            noise[:, 0] *= float(system.size)
            q, still = as_array((rows + noise).reshape(-1, 3)), as_array(np.zeros(state.v.shape))
            disturbed = replace_fields(state, q=q, v=still)
            state_now, code = _with_admissible_positions(system, disturbed)
            if int(code) != Result.SUCCESSFUL:
                continue
        # In terms of what motions of the size of the scene change: what repeats a joint is rounding.
        rows = np.asarray(_constraint_rows(system, state_now))[held] / sizes[:, None]
        rank, dependent = _rank(rows)
        if not dependent:
            return rank, ()
        if rank > best:
            best = rank
            places = system.structure.unknowns + np.flatnonzero(held)[dependent]
            names = tuple(dict.fromkeys(unknown_name(system, int(r)) for r in places))
    return best, names


def _rank(rows: np.ndarray) -> tuple[int, list[int]]:
    """Rank, and rows that depend on earlier ones, so that later joints are named; rows are relative."""
    sizes = np.linalg.svd(rows, compute_uv=False)
    rank = int(np.sum(sizes > RANK * max(sizes[0], 1.0))) if sizes.size else 0
    if rank == len(rows):
        return rank, []
    largest = np.max(np.linalg.norm(rows, axis=1), initial=1.0)
    basis: list[np.ndarray] = []
    dependent = []
    for number, row in enumerate(rows):
        rest = row / largest
        for _ in range(2):
            for b in basis:
                rest = rest - (rest @ b) * b
        size = np.linalg.norm(rest)
        if size > 1e-8 and len(basis) < rank:
            basis.append(rest / size)
        else:
            dependent.append(number)
    return rank, dependent
