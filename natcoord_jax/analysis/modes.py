"""Small motions about an equilibrium or a steady rotation: frequencies, damping and shapes.

In a frame that rotates with the bodies, displacements and rotations x of all bodies and rates of change obey

    M x'' + D x' + K x = G^T lambda,    G x = 0,

with D from dampers and from the rotation, K from stiffness, loads, reactions and the rotation. With the null
space x = Z xi of the constraints it is a quadratic eigenvalue problem of the size of the degrees of freedom.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from natcoord_jax.analysis.static_equations import BALANCE, Loading, Static
from natcoord_jax.analysis.static_search import largest
from natcoord_jax.analysis.steady_rotation import complaint, turns_along
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete, numbers
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.kinds import FLAG
from natcoord_jax.core.numeric import COMPONENTS, Vector, Whole
from natcoord_jax.core.state import STATE, State
from natcoord_jax.maths.projectors import pseudo_inverse, range_projector
from natcoord_jax.maths.rotations import angular_velocity
from natcoord_jax.maths.spectrum import roots_of_sizes, spectrum
from natcoord_jax.maths.vectors import cross, safe_divide, safe_norm
from natcoord_jax.mechanics.equations_of_motion import relative_rates, rotor_inertias, with_rest
from natcoord_jax.mechanics.momentum import inertia, wrench
from natcoord_jax.mechanics.projection import TWIST, constraint_matrix
from natcoord_jax.mechanics.violations import refuse_contacts
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.model.rows import row_rates
from natcoord_jax.system import System

SLIGHT = 1e-9
"""Displacement, relative to the size of the scene, by which what is unbalanced may move the stiffest part."""


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


def _mass_matrix(system: System, state: State) -> Array:
    """Inertia of displacements and rotations of all bodies, rotors included."""
    rows, rates, t = state.rows, system.local_rates, state.t

    def moving(gains: Array) -> tuple[Array, Array]:
        """Momenta, and rates of rotors."""
        twists = rates.twists(gains, rows)[:, 0]
        impulses = inertia(system, row_rates(rows, twists[:, :3], twists[:, 3:]))
        parts = [x[0] for x in wrench(impulses[None], rows[None, :, 1:])]
        turning = relative_rates(system, rows, with_rest(twists[:, :3]), with_rest(twists[:, 3:]), t)[0]
        return rates.balances(jnp.concatenate(parts, axis=1)[:, None], rows), turning

    momenta, turning = jax.vmap(moving)(jnp.eye(rates.count))
    return (momenta + (turning * rotor_inertias(system)) @ turning.T).T


def _loading(system: System, state: State, inputs: Array, rotation: Array | None) -> tuple[Loading, Array]:
    """What acts, about the axis that velocities tell, and how far these are from a rotation about it."""
    if rotation is None:
        return Loading(inputs), jnp.zeros(())
    rows, rates = state.rows, system.local_rates
    points, speed = rows[:, 0], safe_norm(rotation)
    drift = jnp.mean(state.row_rates[:, 0] - cross(rotation, points), axis=0)
    about = safe_divide(cross(rotation, drift), speed**2)
    loading = Loading(inputs, rotation, safe_divide(rotation, speed), about)
    spin = angular_velocity(rows[:, 1:], state.row_rates[:, 1:])
    wanted = loading.turning(rotation, rows)
    missed = jnp.concatenate([state.row_rates[:, 0] - wanted[0], spin - wanted[1]], axis=1)
    shares = largest(system, rates.balances(missed[:, None], rows), system.size)
    return loading, safe_divide(jnp.maximum(*shares), speed)


@briefly
def _problem(
    system: System, state: State, inputs: Array, rotation: Array | None
) -> tuple[tuple[Array, ...], tuple[Array, ...], Loading]:
    """M, D, K and the null space of the constraints; what tells whether the state is steady; what acts.

    That is the largest force that nothing balances and how large it may be, how far velocities are from those
    of the rotation, and whether all that acts turns along.
    """
    rates, start = system.local_rates, state.rows
    # By their rates: what velocities alone obey has no gaps.
    by_twist = constraint_matrix(system, state).reshape(-1, rates.bodies, 1, TWIST)
    rows = jax.vmap(lambda row: rates.balances(row, start))(by_twist)
    loading, astray = _loading(system, state, inputs, rotation)
    static, size = Static(system, state, loading), rates.count
    y, free = jnp.zeros(size + rows.shape[0]), jnp.eye(size)
    left = static.forces(y)
    if rows.shape[0]:
        # Multipliers carry the steady state; redundant ones have the least norm.
        dofs = system.structure.dofs
        onto = range_projector(rows.T, size - dofs)
        lam = pseudo_inverse(rows.T, onto, size - dofs) @ left
        left, y = left - rows.T @ lam, y.at[size:].set(lam)
        # Any basis will do: one that is held, as far as the constraints admit it, follows them.
        basis = jnp.linalg.svd(jax.lax.stop_gradient(rows), full_matrices=True)[2][size - dofs :].T
        free = basis - onto @ basis
    stiffness = jax.jacfwd(lambda x: static.forces(y.at[:size].set(x)))(y[:size])
    damping = jax.jacfwd(lambda w: static.forces(y, w))(y[:size])
    mass, damping, reduced = (free.T @ x @ free for x in (_mass_matrix(system, state), damping, stiffness))
    allowed = jnp.maximum(SLIGHT * system.size * jnp.max(jnp.abs(stiffness)), 1e-300)
    force = jnp.max(jnp.abs(free.T @ left), initial=0.0)
    turns = jnp.array(True)
    if rotation is not None:
        # What it meets on its way must not change.
        turn = static.balanced(jnp.concatenate(loading.turning(loading.axis, start), axis=1))
        change = jnp.max(jnp.abs(free.T @ (stiffness @ turn)), initial=0.0)
        turns = turns_along(static) & (change <= allowed)
    return (mass, damping, reduced, free), (force, allowed, astray, turns), loading


@briefly
def _undamped(mass: Array, stiffness: Array) -> tuple[Array, Array]:
    """Eigenvalues and shapes of M x'' + K x = 0 with symmetric K."""
    lower = jnp.linalg.cholesky(mass)
    half = jax.scipy.linalg.solve_triangular(lower, 0.5 * (stiffness + stiffness.T), lower=True)
    whole = jax.scipy.linalg.solve_triangular(lower, half.T, lower=True)
    squares, vectors = spectrum(0.5 * (whole + whole.T), True)
    shapes = jax.scipy.linalg.solve_triangular(lower.T, vectors, lower=False).T
    root = roots_of_sizes(squares)
    return jnp.where(squares < 0, root + 0j, 1j * root), shapes.astype(complex)


@briefly
def _damped(mass: Array, damping: Array, stiffness: Array) -> tuple[Array, Array]:
    """All eigenvalues of the quadratic problem and their shapes."""
    count = mass.shape[0]
    both = jnp.linalg.solve(mass, jnp.concatenate([stiffness, damping], axis=1))
    top = jnp.concatenate([jnp.zeros((count, count)), jnp.eye(count)], axis=1)
    values, vectors = spectrum(jnp.concatenate([top, -both]), False)
    return values, vectors[:count].T


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
        rotation: angular velocity of a steady rotation of everything (3,) [rad/s], with the state that
            `nc.equilibrium` finds for it: its velocities tell the axis. Default: at rest.
        inputs: input channels [N, N m]; default zero.
        damped: whether dampers, rotation or loads that follow the motion make the problem unsymmetric;
            default: found out from the numbers, and False inside jit. Undamped frequencies are more accurate
            and run on every backend; the others need the CPU.

    Returns:
        The slowest modes first. Rigid motions have s = 0, to round-off of the stiffest mode. Differentiable
        in every mode and order, the pose included. Frequencies that coincide have derivatives in forward
        mode where a change does not split them; in reverse mode those functions have one that depend on all
        of them alike, as their mean. One that is zero has one in forward mode where it stays zero. What has
        none is NaN within jit, and raises in an eager call.

    Raises:
        ValueError: for a state or a rotation that is not steady (within jit its modes are not numbers),
            velocities of another rotation, or a motion without inertia.
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
    given = None if rotation is None else numbers(rotation, (3,), "modes: rotation", "rad/s")
    channels = len(system.structure.inputs)
    u = jnp.zeros(channels) if inputs is None else numbers(inputs, (channels,), "modes: inputs", "N, N m")
    (mass, damping, stiffness, free), (force, allowed, astray, turns), loading = _problem(
        system, state, u, given
    )
    concrete = is_concrete(mass, damping, stiffness)
    if concrete:
        remedy = "start from nc.equilibrium, or pass the rotation [rad/s] that its velocities belong to"
        if given is not None:
            remedy = "pass the state of nc.equilibrium(system, state, rotation=...)"
        if not astray <= BALANCE:
            raise ValueError(
                "modes: the velocities of the state [m/s, rad/s] are not those of the rotation [rad/s]: they "
                f"differ by {float(astray):.3g} of it; {remedy}"
            )
        if not force <= allowed:
            said = f"a force of {float(force):.3g} N or N m is unbalanced"
            raise ValueError(f"modes: the state is not steady: {said}; {remedy}")
        if not turns:
            said = complaint(Static(system, state, loading))
            raise ValueError(f"modes: the rotation is not steady: {said}; {remedy}")
        smallest = float(np.linalg.eigvalsh(np.asarray(mass))[0]) if mass.size else 1.0
        if smallest <= 0:
            raise ValueError(
                "modes: a motion moves no mass; give beams a rotary inertia [kg m] and bodies an inertia"
            )
    if damped is None:
        damped = concrete and _unsymmetric(mass, damping, stiffness)
    s, shapes = _damped(mass, damping, stiffness) if damped else _undamped(mass, stiffness)
    steady = (force <= allowed) & (astray <= BALANCE) & turns
    s = jnp.where(steady, s, complex(jnp.nan, jnp.nan))
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
