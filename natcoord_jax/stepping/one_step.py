"""A single step, and its derivatives."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import Concrete
from natcoord_jax.core.numeric import Number, Vector
from natcoord_jax.core.results import REASONS, REMEDIES, Result, SimulationError
from natcoord_jax.core.state import STATE, State
from natcoord_jax.mechanics.impacts import with_mobilities
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.checked import STEP, check_state, checked_inputs, checked_step
from natcoord_jax.stepping.derivative import run_slots
from natcoord_jax.stepping.newton import TOLERANCE
from natcoord_jax.stepping.plan import Plan
from natcoord_jax.stepping.scheme import SCHEME, SECOND_ORDER, Scheme
from natcoord_jax.system import System

CHANNELS = Vector(None)


@compiled
def _one_step(system, state, u, dt, tolerance, extra, tableau):
    plan = Plan(1, extra, tolerance, None, None, tableau)
    course = run_slots(plan, system, state, u[None], dt)[1].course
    return course.state, course.code


@checked()
def step(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    u: Annotated[Any, CHANNELS] = None,
    dt: Annotated[Any, STEP] = None,
    *,
    newton_tol: Annotated[float, Concrete(Number("positive"))] = TOLERANCE,
    scheme: Annotated[Scheme, SCHEME] = SECOND_ORDER,
) -> State:
    """One step, by default the energy-momentum step (57), differentiable in everything.

    Args:
        system: compiled system.
        state: state at the start.
        u: inputs held over the step, shape (inputs,) [N, N m]; None: zero.
        dt: step [s].
        newton_tol: see `simulate`.
        scheme: see `simulate`.

    Returns:
        State at the end; all NaN if the step failed (an eager call raises instead).

    Raises:
        ValueError: for a wrong dt or shape.
        SimulationError: if the step fails in an eager call.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(1.0, 0, 0)))
        >>> system, state = scene.compile()
        >>> float(nc.step(system, state, dt=0.5).q[0, 0])
        0.5
    """
    check_state(system, state)
    state = scheme.started(replace_fields(state, held=None))
    system = with_mobilities(system, state)
    h = checked_step(dt)
    inputs, _ = checked_inputs(system, None if u is None else jnp.asarray(u, float)[None], 1)
    after, code = _one_step(system, state, inputs[0], h, float(newton_tol), 16, scheme.tableau)
    if is_concrete(code):
        result = Result(int(code))
        if not result.ok:
            raise SimulationError(f"step failed: {REASONS[result]}; {REMEDIES[result]}", result, after)
        return after
    return jax.tree.map(lambda x: jnp.where(code == 0, x, jnp.nan), after)


@checked(system=SYSTEM, state=STATE, u=CHANNELS, dt=STEP)
def linearise(
    system: System, state: State, u: Any = None, dt: Any = None
) -> tuple[Float[Array, "n n"], Float[Array, "n inputs"]]:
    """Derivatives of one step with respect to state and inputs.

    Args:
        system: compiled system.
        state: state at the start.
        u: inputs held over the step, shape (inputs,).
        dt: step [s].

    Returns:
        A and B: A is a matrix over the flattened (q, v, coordinates) of the state, shape (n, n); B has shape
        (n, inputs). Rows and columns are redundant coordinates; only tangent directions are meaningful.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0)))
        >>> system, state = scene.compile()
        >>> A, B = nc.linearise(system, state, dt=0.5)
        >>> A.shape, B.shape
        ((24, 24), (24, 0))
    """
    inputs, _ = checked_inputs(system, None if u is None else jnp.asarray(u, float)[None], 1)
    x, unflat = ravel_pytree((state.q, state.v, state.coordinates))

    def flat(x: Array, u: Array) -> Array:
        moved = eqx.tree_at(lambda s: (s.q, s.v, s.coordinates), state, unflat(x))
        after = step(system, moved, u, dt)
        return ravel_pytree((after.q, after.v, after.coordinates))[0]

    return jax.jacfwd(flat, argnums=(0, 1))(x, inputs[0])
