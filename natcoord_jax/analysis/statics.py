"""Equilibrium under loads: by steps of the load, or along its path through limit points."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.analysis.static_equations import DENSE, Static
from natcoord_jax.analysis.static_search import code_of_search, search_equilibrium
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import at_top_level, is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.numeric import Number, Numbers, Vector, Whole
from natcoord_jax.core.results import REASONS, Result, SimulationError
from natcoord_jax.core.state import STATE, State
from natcoord_jax.linsolve.refinement import refined_solve
from natcoord_jax.mechanics.inversion import code_of
from natcoord_jax.mechanics.violations import refuse_contacts
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.system import System

INPUTS_OF_LOAD = Numbers(("...", None)) | FunctionOf("of the load parameter to the inputs (inputs,)")

GROWING = "take more steps, or follow the path through a limit point with nc.load_path"
STANDING = (
    "nothing that acts depends on the load parameter, so neither steps nor a path of the load lead there: "
    "start nearer to the equilibrium, or let loads grow as functions of it"
)
"""What to do where no equilibrium is found, under loads that grow and others."""


class Equilibrium(eqx.Module):
    """Configurations of equilibrium at a series of loads.

    Attributes:
        states: at rest, leading axis the loads; `states.t` is the load parameter.
        multipliers: of relations between coordinates and of all joints [N, N m], by load.
        result: result code (see `nc.Result`), by load.
        iterations: of Newton's method, by load.
        snapped: whether Newton's method left the path of the loads before, by load: a correction was larger
            than that along the tangent, or it failed and the configuration was let downhill. What is found is
            an equilibrium, but may be one of another branch.
    """

    states: State
    multipliers: Float[Array, "loads m"]
    result: Int[Array, " loads"]
    iterations: Int[Array, " loads"]
    snapped: Bool[Array, " loads"]

    @property
    def state(self) -> State:
        """The last state."""
        return jax.tree.map(lambda x: x[-1], self.states)


def differentiable(system: System, state: State, lam: Array, inputs: Array) -> tuple[State, Array]:
    """A solution as a function of system, load and inputs, by the implicit function theorem, to any order."""
    # Where it was found plays no part in what it depends on: that is in the residual alone.
    fixed = jax.lax.stop_gradient(replace_fields(state, t=jnp.zeros_like(state.t)))
    static = Static(system, replace_fields(fixed, t=state.t), inputs)
    at = jax.lax.stop_gradient(jnp.concatenate([jnp.zeros(static.balances), lam]))

    def tangent_solve(linear: Any, right: Array) -> Array:
        # The Jacobian itself where it is small; nearly so of large meshes, whose formulas leave parts out.
        if static.unknowns <= DENSE:
            solver: Any = static.inverse(jax.jacfwd(linear)(jnp.zeros_like(right)))
        else:
            solver = jax.lax.stop_gradient(static).solver(at)
        return refined_solve(
            linear,
            right,
            solver,
            lambda near, b: near.solve(b),
            lambda near, b: near.transpose().solve(b),
            rounds=None,
        )

    y = jax.lax.custom_root(lambda y: static.residual(y), at, lambda f, start: start, tangent_solve)
    return static.displaced(y), y[static.balances :]


@checked(
    system=SYSTEM,
    state=STATE,
    loads=Number() | Vector(None),
    inputs=INPUTS_OF_LOAD,
    steps=Whole(1),
    snap=FLAG,
    throw=FLAG,
)
def equilibrium(
    system: System,
    state: State,
    loads: Any = 1.0,
    *,
    inputs: Any = None,
    steps: int = 10,
    snap: bool = True,
    throw: bool = True,
) -> Equilibrium:
    """Equilibrium at a series of loads, each found by Newton's method from the one before.

    Where Newton's method fails, the configuration is let downhill to a stable equilibrium, which may be far
    away: a shallow arch snaps through, a cable falls into its sag. `snapped` tells at which loads the path
    may have been left, and an eager call warns of those after the first.

    The load parameter is the time of the state: forces, torques and drives that are functions of time are
    taken at it. Loads that are constant (gravity, say) act in full from the first load on.

    Args:
        system: compiled system.
        state: start configuration; velocities play no part.
        loads: values of the load parameter, increasing or not; one number: `steps` equal parts of it.
        inputs: function of the load parameter to the input channels, or their values [N, N m]; default zero.
        steps: number of loads where one number is given.
        snap: False: end with `nc.Result.DIVERGED` at the first load at which Newton's method leaves the path.
        throw: raise in an eager call if there is no convergence.

    Returns:
        States at all loads. Differentiable with respect to the system's numbers, to the loads and to the
        inputs, by the implicit function theorem, in every mode and order; pure and jittable. Where Newton's
        method fails the code says so, and later states repeat the last one.

    Raises:
        SimulationError: in an eager call, if Newton's method fails or turns an element of a solid inside out,
            with the load.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=2.0, GJ=1.0, density=1.0, rotary=0.1)
        >>> beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=4, start=nc.ground))
        >>> tip = nc.Point(beam.end, (1, 0, 0))
        >>> load = scene.add(nc.PointForce((tip,), force=lambda t: jax.numpy.array([0.0, 0.0, 0.01]) * t))
        >>> system, state = scene.compile()
        >>> found = nc.equilibrium(system, state)
        >>> round(float(system.sense(found.state, beam.end).position[2]), 5)  # 0.00167 with many elements
        0.00164
    """
    refuse_contacts(system, "equilibrium")
    values = jnp.asarray(loads, float)
    if values.ndim == 0:
        values = values * jnp.arange(1, steps + 1) / steps
    given = _inputs_at(system, inputs, values)
    found = _equilibria(system, state, values, given, snap, not at_top_level(system, state, values, given))
    if is_concrete(found.result) and bool(jnp.any(found.snapped[1:] & (found.result[1:] == 0))):
        left = [f"{value:.6g}" for value in np.asarray(values)[1:][np.asarray(found.snapped)[1:]]]
        warnings.warn(
            f"equilibrium: Newton's method left the path at the load parameter {', '.join(left)}: what was "
            f"found there may be on another branch (`snapped`); {GROWING}, or pass snap=False to stop there",
            stacklevel=3,
        )
    if throw and is_concrete(found.result):
        for number, code in enumerate(found.result):
            if int(code) != Result.SUCCESSFUL:
                before = max(number - 1, 0)
                reached = jax.tree.map(lambda x, k=before: x[k], found.states)
                grows = _grows(system, replace_fields(reached, t=values[number]), given, number)
                raise SimulationError(
                    f"no equilibrium found at the load parameter {float(values[number]):.6g} (load "
                    f"{number + 1} of {len(values)}): {REASONS[Result(int(code))]}; "
                    f"{GROWING if grows else STANDING}",
                    Result(int(code)),
                    found,
                )
    return found


def _grows(system: System, state: State, inputs: Array, number: int) -> bool:
    """Whether the equations of a load are others than those of the load before, or depend on it."""
    if number > 0 and bool(jnp.any(inputs[number] != inputs[number - 1])):
        return True

    def residual(t: Array) -> Array:
        static = Static(system, replace_fields(state, t=t), inputs[number])
        return static.residual(jnp.zeros(static.unknowns))

    return bool(jnp.any(jax.jvp(residual, (state.t,), (jnp.ones_like(state.t),))[1] != 0))


def _inputs_at(system: System, inputs: Any, values: Array) -> Float[Array, "loads inputs"]:
    count = len(system.structure.inputs)
    if callable(inputs):
        function: Any = inputs
        return jax.vmap(function)(values)
    given = jnp.zeros(count) if inputs is None else jnp.asarray(inputs, float)
    if given.shape not in ((count,), (len(values), count)):
        raise ValueError(
            f"inputs has shape {given.shape}; this system has the input channels "
            f"{list(system.structure.inputs)}: pass shape {(count,)} or {(len(values), count)}, or a function"
        )
    return jnp.broadcast_to(given, (len(values), count))


@briefly
def _equilibria(
    system: System, state: State, values: Array, inputs: Array, snap: bool, with_derivatives: bool
) -> Equilibrium:
    # What gives the results their derivatives takes longer to trace than the search, and is left out where
    # nothing asks for it.
    static = Static(system, state, inputs[0])
    # The search is not differentiated; `differentiable` gives its results their derivatives.
    still = jax.lax.stop_gradient((system, state))

    def one(carry: tuple, load: tuple) -> tuple[tuple, tuple]:
        now, lam, alive = carry
        value, u = load
        # Loads belong to the search as well; `differentiable` is given them again.
        begin = replace_fields(now, t=jax.lax.stop_gradient(value))
        search = search_equilibrium(still[0], begin, lam, jax.lax.stop_gradient(u), snap)
        code = code_of(still[0], search.state, code_of_search(search))
        code = jnp.where(alive, code, int(Result.DIVERGED))
        good = code == int(Result.SUCCESSFUL)
        reached = jax.tree.map(lambda a, b: jnp.where(good, a, b), (search.state, search.lam), (now, lam))
        return (*reached, good), (*reached, code, search.count, search.snapped & alive)

    start = replace_fields(still[1], v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
    lam = jnp.zeros(static.unknowns - static.balances)
    _, (states, lams, codes, counts, snapped) = jax.lax.scan(
        one, (start, lam, jnp.array(True)), (values, inputs)
    )
    # Results of the search: their derivatives are those of the equations that they solve, below.
    states, lams = jax.lax.stop_gradient((states, lams))
    states = replace_fields(states, t=values)
    if with_derivatives:
        states, lams = jax.vmap(lambda s, lam, u: differentiable(system, s, lam, u))(states, lams, inputs)
    return Equilibrium(states, lams, codes, counts, snapped)
