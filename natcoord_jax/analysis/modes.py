"""Small motions about an equilibrium or a steady rotation: frequencies, damping and shapes.

In a frame that rotates with the bodies, displacements and rotations x of all bodies and rates of change obey

    M x'' + D x' + K x = G^T lambda,    G x = 0,

with D from dampers and from the rotation, K from stiffness, loads, reactions and the rotation. With the null
space x = Z xi of the constraints it is a quadratic eigenvalue problem of the size of the degrees of freedom.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from natcoord_jax.analysis.static_equations import Static
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete, numbers
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.kinds import FLAG
from natcoord_jax.core.numeric import COMPONENTS, Vector, Whole
from natcoord_jax.core.state import STATE, State
from natcoord_jax.maths.projectors import pseudo_inverse, range_projector
from natcoord_jax.maths.spectrum import spectrum
from natcoord_jax.maths.vectors import cross
from natcoord_jax.mechanics.equations_of_motion import loads, relative_rates, rotors_of, with_rest
from natcoord_jax.mechanics.momentum import inertia, wrench
from natcoord_jax.mechanics.projection import TWIST, constraint_matrix
from natcoord_jax.mechanics.violations import refuse_contacts
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.model.rows import row_rates
from natcoord_jax.system import System

BALANCE = 1e-6
"""Largest unbalanced force, relative to the largest force on a body, of what counts as steady."""


class Modes(eqx.Module):
    """Small motions exp(s t), the slowest first.

    Attributes:
        s: eigenvalues [1/s], one of each conjugate pair; real ones (overdamped, unstable) each by itself.
        shapes: displacements of the rows [m for points, - for directors], largest entry of size one, in the
            frame that rotates with the system.
    """

    s: Complex[Array, " modes"]
    shapes: Complex[Array, "modes rows 3"]

    @property
    def frequencies(self) -> Float[Array, " modes"]:
        """Angular frequencies |Im s| [rad/s]."""
        return jnp.abs(jnp.imag(self.s))

    @property
    def damping(self) -> Float[Array, " modes"]:
        """Damping ratios -Re s / |s| [-]; negative: unstable."""
        size = jnp.abs(self.s)
        return jnp.where(size > 0, -jnp.real(self.s) / jnp.where(size > 0, size, 1.0), 0.0)


class _Steady(eqx.Module):
    """Balances of all bodies as functions of displacements, twists and accelerations."""

    system: System
    state: State
    inputs: Array
    rotation: Float[Array, "3"]
    lam: Array

    def forces(self, x: Array, rates: Array) -> Array:
        """Inertia less loads and reactions [N, N m], for displacements and rates in the rotating frame."""
        static = Static(self.system, self.state, self.inputs)
        y = jnp.concatenate([x, self.lam])
        state = static.displaced(y)
        rows = state.rows
        (moved, _), (v_rel, w_rel) = self._apart(x), self._apart(rates)
        first = rows.shape[0]
        origin = self.state.rows[:, 0]
        about = self._steady_velocity(origin)
        velocity = about + v_rel + cross(self.rotation, moved)
        spin = jnp.broadcast_to(self.rotation, (first, 3)) + w_rel
        # Accelerations while the rates in the rotating frame stay as they are.
        gain = cross(self.rotation, velocity) + cross(self.rotation, v_rel)
        twist_gain = cross(self.rotation, w_rel)
        directors = cross(twist_gain[:, None], rows[:, 1:]) + cross(
            spin[:, None], cross(spin[:, None], rows[:, 1:])
        )
        accelerations = jnp.concatenate([gain[:, None], directors], axis=1)
        impulses = inertia(self.system, accelerations)
        inertial = wrench(impulses[None], rows[None, :, 1:])
        applied = loads(self.system, state, self.inputs, velocity, spin)
        pulled = static.constraint_loads(state, y)
        parts = [a[0] - b - c for a, b, c in zip(inertial, applied, pulled)]
        return self._balances(parts)

    def _apart(self, x: Array) -> tuple[Array, Array]:
        rows = self.state.rows
        every = self.system.local_rates.twists(x, rows)[:, 0]
        return every[:, :3], every[:, 3:]

    def _balances(self, forces_and_torques: Sequence[Array]) -> Array:
        wrenches = jnp.concatenate(forces_and_torques, axis=1)[:, None]
        return self.system.local_rates.balances(wrenches, self.state.rows)

    def _steady_velocity(self, points: Array) -> Array:
        v = self.state.row_rates[:, 0]
        return jnp.where(jnp.any(self.rotation != 0), v, jnp.zeros_like(points))

    def mass_matrix(self) -> Array:
        """Inertia of displacements and rotations of all bodies, rotors included."""
        rows = self.state.rows

        def inertial(gains: Array) -> Array:
            impulses = inertia(self.system, row_rates(rows, *self._apart(gains)))
            parts = [x[0] for x in wrench(impulses[None], rows[None, :, 1:])]
            return self._balances(parts)

        size = self.system.local_rates.count
        matrix = jax.vmap(inertial)(jnp.eye(size)).T
        groups = rotors_of(self.system)
        if groups:
            inertias = jnp.concatenate([jax.vmap(lambda e: e.inertia_of())(g.effect) for g in groups])

            def turning(gains: Array) -> Array:
                velocity, spin = self._apart(gains)
                found = relative_rates(self.system, rows, with_rest(velocity), with_rest(spin), self.state.t)
                return found[0]

            rates = jax.vmap(turning)(jnp.eye(size)).T
            matrix = matrix + rates.T @ (inertias[:, None] * rates)
        return matrix


def _matrices(steady: _Steady, rows: Array, size: int) -> tuple[Array, Array, Array, Array, Array, Array]:
    """M, D, K in the null space of the constraints, the null space, and the unbalanced and largest forces."""
    still, free = jnp.zeros(size), jnp.eye(size)
    left = steady.forces(still, still)
    if rows.shape[0]:
        # Multipliers carry the steady state; redundant ones have the least norm.
        dofs = steady.system.structure.dofs
        onto = range_projector(rows.T, size - dofs)
        lam = pseudo_inverse(rows.T, onto, size - dofs) @ left
        left = left - rows.T @ lam
        steady = eqx.tree_at(lambda s: s.lam, steady, lam)
        # Any basis will do: one that is held, as far as the constraints admit it, follows them.
        basis = jnp.linalg.svd(jax.lax.stop_gradient(rows), full_matrices=True)[2][size - dofs :].T
        free = basis - onto @ basis
    stiffness = jax.jacfwd(steady.forces, argnums=0)(still, still)
    damping = jax.jacfwd(steady.forces, argnums=1)(still, still)
    mass, damping, reduced = (free.T @ x @ free for x in (steady.mass_matrix(), damping, stiffness))
    scale = jnp.maximum(jnp.max(jnp.abs(stiffness)) * 1e-6, 1e-300)
    return mass, damping, reduced, free, jnp.max(jnp.abs(free.T @ left)), scale


@briefly
def _undamped(mass: Array, stiffness: Array) -> tuple[Array, Array]:
    """Eigenvalues and shapes of M x'' + K x = 0 with symmetric K."""
    lower = jnp.linalg.cholesky(mass)
    half = jax.scipy.linalg.solve_triangular(lower, 0.5 * (stiffness + stiffness.T), lower=True)
    whole = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    squares, vectors = spectrum(0.5 * (whole + whole.T), True)
    shapes = jax.scipy.linalg.solve_triangular(lower.T, vectors, lower=False).T
    root = jnp.sqrt(jnp.where(squares == 0, 1.0, jnp.abs(squares))) * (squares != 0)
    return jnp.where(squares < 0, root + 0j, 1j * root), shapes.astype(complex)


@briefly
def _damped(mass: Array, damping: Array, stiffness: Array) -> tuple[Array, Array]:
    """All eigenvalues of the quadratic problem and their shapes."""
    count = mass.shape[0]
    both = jnp.linalg.solve(mass, jnp.concatenate([stiffness, damping], axis=1))
    top = jnp.concatenate([jnp.zeros((count, count)), jnp.eye(count)], axis=1)
    values, vectors = spectrum(jnp.concatenate([top, -both]), False)
    return values, vectors[:count].T


@briefly
def _problem(system: System, state: State, inputs: Array, rotation: Array) -> tuple[Array, ...]:
    rates, start = system.local_rates, state.rows
    # By their rates: what velocities alone obey has no gaps.
    by_twist = constraint_matrix(system, state).reshape(-1, rates.bodies, 1, TWIST)
    rows = jax.vmap(lambda row: rates.balances(row, start))(by_twist)
    steady = _Steady(system, state, inputs, rotation, jnp.zeros(rows.shape[0]))
    return _matrices(steady, rows, rates.count)


@checked(system=SYSTEM, state=STATE, count=Whole(1), rotation=COMPONENTS, inputs=Vector(None), damped=FLAG)
def modes(
    system: System,
    state: State,
    *,
    count: int | None = None,
    rotation: Any = None,
    inputs: Any = None,
    damped: bool | None = None,
) -> Modes:
    """Frequencies and shapes of small motions about an equilibrium or a steady rotation.

    Args:
        system: compiled system.
        state: at equilibrium (see `nc.equilibrium`); its velocities count only with `rotation`. Its time is
            that of loads and drives.
        count: number of modes; default all.
        rotation: angular velocity of a steady rotation of everything (3,) [rad/s]; the velocities of the
            state must be those of that rotation. Default: at rest.
        inputs: input channels [N, N m]; default zero.
        damped: whether dampers, rotation or loads that follow the motion make the problem unsymmetric;
            default: found out from the numbers, and False inside jit. Undamped frequencies are more accurate
            and run on every backend; the others need the CPU.

    Returns:
        The slowest modes first. Rigid motions have s = 0, to round-off of the stiffest mode. Differentiable
        in every mode and order, the pose included. Frequencies that coincide have derivatives in forward
        mode where a change does not split them; in reverse mode those functions have one that depend on all
        of them alike, as their mean. What has none is NaN within jit, and raises in an eager call.

    Raises:
        ValueError: for a state that is not steady, or a motion without inertia.
        DerivativeError: for a derivative of frequencies that a change splits, outside of jit.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> arm = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), com=(0, 0, -1.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, arm, axis=(1, 0, 0)))
        >>> gravity = scene.add(nc.Gravity(vector=(0, 0, -8.0)))
        >>> system, state = scene.compile()
        >>> float(nc.modes(system, state).frequencies[0].round(9))
        2.0
    """
    refuse_contacts(system, "vibration")
    given = jnp.zeros(3) if rotation is None else numbers(rotation, (3,), "modes: rotation", "rad/s")
    channels = len(system.structure.inputs)
    u = jnp.zeros(channels) if inputs is None else numbers(inputs, (channels,), "modes: inputs", "N, N m")
    mass, damping, stiffness, free, left, scale = _problem(system, state, u, given)
    concrete = is_concrete(mass, damping, stiffness)
    if concrete:
        if float(left) > BALANCE * float(scale) / 1e-6 * 1e-3:
            raise ValueError(
                f"modes: the state is not steady: a force of {float(left):.3g} N or N m is unbalanced; start "
                "from nc.equilibrium, or pass the rotation [rad/s] that its velocities belong to"
            )
        smallest = float(np.linalg.eigvalsh(np.asarray(mass))[0]) if mass.size else 1.0
        if smallest <= 0:
            raise ValueError(
                "modes: a motion moves no mass; give beams a rotary inertia [kg m] and bodies an inertia"
            )
    if damped is None:
        damped = concrete and _unsymmetric(mass, damping, stiffness)
    s, shapes = _damped(mass, damping, stiffness) if damped else _undamped(mass, stiffness)
    return _ordered(system, state, s, shapes @ free.T, mass.shape[0], count, damped)


def _unsymmetric(mass: Array, damping: Array, stiffness: Array) -> bool:
    """Whether there is damping, gyroscopic coupling or circulation, beyond round-off."""
    size = float(jnp.max(jnp.abs(stiffness), initial=0.0))
    circulation = float(jnp.max(jnp.abs(stiffness - stiffness.T), initial=0.0))
    weight = float(jnp.max(jnp.abs(mass), initial=1e-300))
    drag = float(jnp.max(jnp.abs(damping), initial=0.0))
    return circulation > 1e-9 * size or drag**2 > 1e-24 * size * weight


def _ordered(
    system: System, state: State, s: Array, moved: Array, freedoms: int, count: int | None, damped: bool
) -> Modes:
    """One of each conjugate pair, by frequency; shapes as displacements of rows."""
    if damped:
        order = jnp.argsort(jnp.where(jnp.imag(s) < 0, jnp.inf, jnp.abs(s)))
        kept = order[: int(jnp.sum(jnp.imag(s) >= 0))] if is_concrete(s) else order[:freedoms]
    else:
        kept = jnp.argsort(jnp.abs(s))
    kept = kept[:count]
    rows = state.rows
    parts = jax.vmap(lambda w: system.local_rates.twists(w, rows)[:, 0])(moved[kept])
    turned = jnp.cross(parts[:, :, None, 3:], rows[None, :, 1:])
    shapes = jnp.concatenate([parts[:, :, None, :3], turned], axis=2).reshape(len(kept), -1, 3)
    largest = jnp.max(jnp.abs(shapes), axis=(1, 2), keepdims=True, initial=1e-300)
    return Modes(s[kept], shapes / largest)
