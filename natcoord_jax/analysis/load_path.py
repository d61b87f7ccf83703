"""Paths of equilibria through limit points, by their arc length."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.analysis.static_equations import Loading, Static
from natcoord_jax.analysis.static_search import (
    FLOOR,
    ITERATIONS,
    TOLERANCE,
    extent_of,
    largest,
)
from natcoord_jax.analysis.statics import Equilibrium, differentiable
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import as_array, at_top_level, is_concrete, positive
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.numeric import Number, Whole
from natcoord_jax.core.results import REASONS, Result, SimulationError
from natcoord_jax.core.state import STATE, State
from natcoord_jax.mechanics.inversion import code_of
from natcoord_jax.mechanics.violations import refuse_contacts
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.system import System


class _Point(eqx.Module):
    """A point of the path, the direction in which it was left, and how Newton's method got there."""

    state: State
    lam: Array
    direction: tuple[Array, Array]
    correction: Array
    count: Array
    done: Array
    finite: Array


class _Path(eqx.Module):
    """What measures lengths along the path."""

    system: System
    scale: Float[Array, ""]
    extent: Float[Array, ""]
    inputs: Callable[[Array], Loading]

    def product(self, one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
        """Product of two increments (displacements and rotations, load): mean squares over the bodies."""
        rates = self.system.local_rates
        shifts, turns = (jnp.sum(a * b) for a, b in zip(rates.parts(one[0]), rates.parts(other[0])))
        return (shifts / self.extent**2 + turns) / rates.bodies + one[1] * other[1] / self.scale**2

    def linear(self, state: State, lam: Array) -> tuple[Array, Array]:
        """Newton's change of displacements and multipliers at this load, and their rate with the load."""

        def residual(t: Array, y: Array) -> Array:
            return Static(self.system, replace_fields(state, t=t), self.inputs(t)).residual(y)

        static = Static(self.system, state, self.inputs(state.t))
        y = jnp.concatenate([jnp.zeros(static.balances), lam])
        solver = static.solver(y)[0]
        value, by_load = jax.jvp(lambda t: residual(t, y), (state.t,), (jnp.ones_like(state.t),))
        return -solver.solve(value), -solver.solve(by_load)

    def tangent(self, by_load: Array, before: tuple[Array, Array]) -> tuple[Array, Array]:
        """Direction of the path, of length one, with which `before` has a positive product."""
        count = self.system.local_rates.count
        rate = by_load[:count], jnp.ones(())
        length = jnp.sqrt(self.product(rate, rate))
        sign = jnp.where(self.product(rate, before) < 0, -1.0, 1.0) / length
        return sign * rate[0], sign * rate[1]

    def corrected(self, point: _Point) -> _Point:
        """One iteration in the plane across the direction of the path."""
        count = point.direction[0].shape[0]
        change, rate = self.linear(point.state, point.lam)
        unit = jnp.ones(()), jnp.zeros(())
        across = self.product((rate[:count], unit[0]), point.direction)
        load = -self.product((change[:count], unit[1]), point.direction) / across
        change = change + load * rate
        moved, turned = largest(self.system, change[:count], self.extent)
        correction = jnp.maximum(jnp.maximum(moved, turned), jnp.abs(load) / self.scale)
        stalled = (point.count > 0) & (correction > 0.5 * point.correction) & (correction <= FLOOR)
        static = Static(self.system, point.state, self.inputs(point.state.t))
        after = static.moved_along_tree(change)
        after = replace_fields(after, t=after.t + load)
        finite = jnp.isfinite(correction)
        done = (correction <= TOLERANCE) | stalled
        lam = point.lam + change[count:]
        return _Point(after, lam, point.direction, correction, point.count + 1, done & finite, finite)

    def next(self, state: State, lam: Array, before: tuple[Array, Array], arc: Array) -> _Point:
        """The next point, one arc further, or half of it and so on where Newton's method fails."""

        def shorter(carry: tuple[_Point, Array]) -> tuple[_Point, Array]:
            part = 0.5 * carry[1]
            return self.step(state, lam, before, part * arc), part

        # The whole arc first, in the same loop: a second copy of the step would compile for as long again.
        nothing = _point(state, lam, before)
        return jax.lax.while_loop(
            lambda c: ~c[0].done & (c[1] > SHORTEST), shorter, (nothing, 2 * jnp.ones(()))
        )[0]

    def step(self, state: State, lam: Array, before: tuple[Array, Array], arc: Array) -> _Point:
        """The point one arc further."""
        static = Static(self.system, state, self.inputs(state.t))
        rate = self.linear(state, lam)[1]
        direction = self.tangent(rate, before)
        change = arc * direction[1] * rate
        ahead = static.moved_along_tree(change)
        ahead = replace_fields(ahead, t=ahead.t + arc * direction[1])
        lam = lam + change[direction[0].shape[0] :]
        start = _point(ahead, lam, direction)
        return jax.lax.while_loop(
            lambda p: ~p.done & p.finite & (p.count < ITERATIONS), lambda p: self.corrected(p), start
        )


def _point(state: State, lam: Array, direction: tuple[Array, Array]) -> _Point:
    """A point that has not been corrected yet."""
    return _Point(state, lam, direction, jnp.zeros(()), jnp.array(0), jnp.array(False), jnp.array(True))


SHORTEST = 1 / 64
"""Shortest part of an arc that is tried where a whole one fails."""


@checked(
    system=SYSTEM,
    state=STATE,
    arc=Number("positive"),
    steps=Whole(1),
    scale=Number("positive"),
    inputs=FunctionOf("of the load parameter to the inputs (inputs,)"),
    throw=FLAG,
)
def load_path(
    system: System,
    state: State,
    *,
    arc: Any,
    steps: int,
    scale: Any = 1.0,
    inputs: Callable[[Array], Array] | None = None,
    throw: bool = True,
) -> Equilibrium:
    """Equilibria along the path of the load, through limit points where the load turns back.

    The arc length is that of displacements relative to the extent of the system, rotations and load,

        ds^2 = (sum over bodies of |dx|^2 / extent^2 + |dtheta|^2) / bodies + (dt / scale)^2,

    and the corrector stays in the plane across the direction of the path (Riks 1979).

    Args:
        system: compiled system.
        state: an equilibrium to start from; its time is the load parameter there, which grows first.
        arc: length of a step [-].
        steps: number of steps; where Newton's method fails, a step is a half, a quarter, ... of an arc.
        scale: load that counts like one radian of all bodies.
        inputs: function of the load parameter to the input channels; default zero.
        throw: raise in an eager call if there is no convergence.

    Returns:
        Equilibria, the load parameter in `states.t`. Derivatives are those at fixed load. After a failure
        the states repeat the last one.

    Raises:
        SimulationError: in an eager call, if Newton's method fails.
        ValueError: for an arc that is not positive.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=2.0, GJ=1.0, density=1.0, rotary=0.1)
        >>> beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=2, start=nc.ground))
        >>> tip = nc.Point(beam.end, (1, 0, 0))
        >>> load = scene.add(nc.PointForce((tip,), force=lambda t: jax.numpy.array([0.0, 0.0, 1.0]) * t))
        >>> system, state = scene.compile()
        >>> path = nc.load_path(system, state, arc=0.2, steps=3)
        >>> bool(path.states.t[2] > path.states.t[0] > 0)
        True
    """
    positive(arc, "load path: arc", "-")
    channels = _Loadings(Function.of(inputs, state.t), len(system.structure.inputs))
    refuse_contacts(system, "a path of equilibria")
    sizes = as_array(arc, float), as_array(scale, float)
    with_derivatives = not at_top_level(system, state, sizes)
    found = _followed(system, state, *sizes, steps, channels, with_derivatives)
    if throw and is_concrete(found.result):
        for number, code in enumerate(found.result):
            if int(code) != Result.SUCCESSFUL:
                raise SimulationError(
                    f"the path of equilibria was lost in step {number + 1} of {steps}, at the load parameter "
                    f"{float(found.states.t[number]):.6g}: {REASONS[Result(int(code))]}; use a shorter arc",
                    Result(int(code)),
                    found,
                )
    return found


class _Loadings(eqx.Module):
    """What acts at any load: inputs by a function of it, or none."""

    function: Any
    count: int = eqx.field(static=True)

    def __call__(self, t: Array) -> Loading:
        """At a load."""
        return Loading(jnp.zeros(self.count) if self.function is None else self.function(t))


@briefly
def _followed(
    system: System,
    state: State,
    arc: Array,
    scale: Array,
    steps: int,
    inputs: Callable[[Array], Loading],
    with_derivatives: bool,
) -> Equilibrium:
    # The search is not differentiated; `differentiable` gives its results their derivatives.
    fixed, begin = jax.lax.stop_gradient((system, state))
    path = _Path(fixed, scale, extent_of(fixed, begin), inputs)
    balances = system.local_rates.count
    lam = jnp.zeros(Static(system, state, inputs(state.t)).unknowns - balances)

    def one(carry: tuple, _: None) -> tuple[tuple, tuple]:
        now, lam, direction, alive = carry
        point = path.next(now, lam, direction, arc)
        failed = jnp.where(point.finite, int(Result.MAX_ITERATIONS), int(Result.NONFINITE))
        code = jnp.where(point.done, int(Result.SUCCESSFUL), failed)
        code = code_of(fixed, point.state, code)
        code = jnp.where(alive, code, int(Result.DIVERGED))
        good = code == int(Result.SUCCESSFUL)
        reached = point.state, point.lam, point.direction
        kept = jax.tree.map(lambda a, b: jnp.where(good, a, b), reached, (now, lam, direction))
        return (*kept, good), (*kept[:2], code, point.count)

    start = replace_fields(begin, v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
    direction = jnp.zeros(balances), jnp.ones(())
    carry = start, lam, direction, jnp.array(True)
    _, (states, lams, codes, counts) = jax.lax.scan(one, carry, None, length=steps)
    # (The loads that were found are results of the search, too.)
    states, lams = jax.lax.stop_gradient((states, lams))
    if with_derivatives:
        states, lams = jax.vmap(lambda s, lam: differentiable(system, s, lam, inputs(s.t)))(states, lams)
    return Equilibrium(states, lams, codes, counts, jnp.zeros(codes.shape, bool))
