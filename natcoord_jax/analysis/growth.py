"""How fast a motion forgets its start: growth of small disturbances, and what it leaves of derivatives."""

from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import compiled
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.numeric import Whole
from natcoord_jax.core.results import Result
from natcoord_jax.core.state import STATE, State
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.checked import INPUTS, STEP, checked_inputs, checked_step
from natcoord_jax.stepping.scheme import SCHEME, SECOND_ORDER, Scheme
from natcoord_jax.stepping.simulate import simulate
from natcoord_jax.system import System

DIGITS = 16
"""Decades after which rounding of the start is as large as the motion."""
RANGE = 308 // 2
"""Decades after which squares of derivatives are not finite, and the derivatives of a rollout neither."""


class Growth(eqx.Module):
    """Growth of a small disturbance along a motion.

    Attributes:
        t: times (n,) [s].
        decades: logarithm to the base of ten of its size over that at the start (n,) [-].
        result: code of the run; what comes after a failure is NaN.
    """

    t: Float[Array, " n"]
    decades: Float[Array, " n"]
    result: Int[Array, ""]

    @property
    def rate(self) -> Float[Array, ""]:
        """Largest Lyapunov exponent of the second half of the motion [1/s]."""
        half = self.t.shape[0] // 2
        grown = (self.decades[-1] - self.decades[half]) * np.log(10.0)
        return grown / (self.t[-1] - self.t[half])

    def explain(self) -> str:
        """What is left of the motion and of its derivatives, in words."""
        known = np.isfinite(np.asarray(self.decades))
        decades, t = np.asarray(self.decades)[known], np.asarray(self.t)[known]

        def first(limit: float) -> str:
            beyond = decades > limit
            return f"from t = {t[np.argmax(beyond)]:.4g} s on" if beyond.any() else "nowhere in this run"

        lines = [
            f"disturbances grow by 10^{decades[-1]:.1f} in {t[-1] - t[0]:.4g} s",
            f"the path depends on rounding of its start: {first(DIGITS)}",
            f"derivatives by the start are too large to be numbers: {first(RANGE)}",
        ]
        if int(self.result) != 0:
            lines.append(f"the run ended early: {Result(int(self.result)).name}")
        return "\n".join(lines)


@compiled
def _grown(
    system: System,
    state: State,
    tangent: State,
    inputs: Any,
    dt: Array,
    length: int,
    scheme: Scheme,
    count: int,
) -> tuple[Array, Array, Array]:
    def size(tangent: State) -> Array:
        return jnp.sqrt(jnp.sum(tangent.q**2) + dt**2 * jnp.sum(tangent.v**2))

    def segment(carry: tuple, given: Any) -> tuple[tuple, tuple]:
        state, tangent = carry

        def run(state: State) -> tuple[State, Array]:
            u = inputs if callable(inputs) else given
            found = simulate(
                system, state, dt=dt, steps=length, inputs=u, save_every=length, throw=False, scheme=scheme
            )
            return jax.tree.map(lambda x: x[-1], found.states), found.result

        after, moved, result = jax.jvp(run, (state,), (tangent,), has_aux=True)
        grown = size(moved)
        known = jnp.where(grown > 0, grown, 1.0)
        moved = jax.tree.map(lambda x: x / known, moved)
        return (after, moved), (after.t, jnp.where(result == 0, jnp.log10(known), jnp.nan), result)

    first = jnp.log10(size(tangent))
    pieces = None if callable(inputs) else inputs.reshape(count, length, *inputs.shape[1:])
    _, (t, decades, results) = jax.lax.scan(segment, (state, tangent), pieces, length=count)
    total = jnp.cumsum(decades.at[0].add(-first))
    return t, total, jnp.max(results)


@checked()
def tangent_growth(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    *,
    dt: Annotated[Any, STEP],
    steps: Annotated[int | None, Whole(1)] = None,
    inputs: Annotated[Any, INPUTS] = None,
    save_every: Annotated[int, Whole(1)] = 1,
    scheme: Annotated[Scheme, SCHEME] = SECOND_ORDER,
    seed: Annotated[int, Whole(0)] = 0,
) -> Growth:
    """Growth of a small disturbance of the velocities at the start, by the exact derivative of every step.

    Of a chaotic motion it grows without bound, and derivatives of a long rollout are true and useless, and
    at last no numbers any more. This is scaled down after every interval and holds over any time, so that it
    tells a gradient that is not finite because the motion is chaotic from others.

    Args:
        system: compiled system.
        state: initial state.
        dt: step [s].
        steps: number of steps; may be left out when `inputs` is an array.
        inputs: as in `simulate`.
        save_every: steps of an interval; must divide `steps`.
        scheme: as in `simulate`.
        seed: of the direction of the disturbance.

    Returns:
        Growth at `steps / save_every + 1` times. Sizes are those of positions [m], of directors and of the
        way in a step at the disturbed velocity.

    Raises:
        ValueError: for a wrong dt, steps, shape of inputs or state.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0)))
        >>> system, state = scene.compile()
        >>> growth = nc.tangent_growth(system, state, dt=0.1, steps=100, save_every=10)
        >>> round(10 ** float(growth.decades[10] - growth.decades[5]), 1)  # free flight: twice the time
        2.0
    """
    state = scheme.started(state)
    step = checked_step(dt)
    inputs, count = checked_inputs(system, inputs, steps, scheme.stages)
    if save_every < 1 or count % save_every:
        raise ValueError(f"save_every is {save_every}; pass a positive divisor of steps = {count}")
    still = jax.tree.map(jnp.zeros_like, state)
    push = np.random.default_rng(seed).normal(size=state.v.shape)
    given = state, replace_fields(still, v=jnp.asarray(push)), inputs
    t, decades, result = _grown(system, *given, step, save_every, scheme, count // save_every)
    start = jnp.zeros(1, decades.dtype)
    return Growth(jnp.concatenate([state.t[None], t]), jnp.concatenate([start, decades]), result)
