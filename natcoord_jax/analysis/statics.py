"""Equilibrium under loads: by steps of the load, or along its path through limit points."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from natcoord_jax.analysis.static_equations import DENSE, Loading, Static
from natcoord_jax.analysis.static_search import search_equilibrium
from natcoord_jax.analysis.steady_rotation import complaint, turns_along
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.checks import at_top_level, is_concrete
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import FLAG, FunctionOf
from natcoord_jax.core.numeric import COMPONENTS, Number, Numbers, Vector, Whole
from natcoord_jax.core.results import REASONS, Result, SimulationError
from natcoord_jax.core.state import STATE, State
from natcoord_jax.linsolve.refinement import refined_solve
from natcoord_jax.maths.vectors import safe_divide, safe_norm
from natcoord_jax.mechanics.inversion import code_of
from natcoord_jax.mechanics.violations import refuse_contacts
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.system import System

INPUTS_OF_LOAD = Numbers(("...", None)) | FunctionOf("of the load parameter to the inputs (inputs,)")
ROTATION_OF_LOAD = Numbers(("...", 3)) | FunctionOf("of the load parameter to the angular velocity (3,)")

GROWING = "take more steps, or follow the path through a limit point with nc.load_path"
STANDING = (
    "nothing that acts depends on the load parameter, so neither steps nor a path of the load lead there: "
    "start nearer to the equilibrium, or let loads grow as functions of it"
)
"""What to do where no equilibrium is found, under loads that grow and others."""


class Equilibrium(eqx.Module):
    """Configurations of equilibrium at a series of loads.

    Attributes:
        states: at rest or in steady rotation, leading axis the loads; `states.t` is the load parameter.
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


def differentiable(system: System, state: State, lam: Array, loading: Loading) -> tuple[State, Array]:
    """A solution as a function of system and loads, by the implicit function theorem, to any order."""
    # Where it was found plays no part in what it depends on: that is in the residual alone.
    fixed = jax.lax.stop_gradient(replace_fields(state, t=jnp.zeros_like(state.t)))
    static = Static(system, replace_fields(fixed, t=state.t), loading)
    at = jax.lax.stop_gradient(jnp.concatenate([jnp.zeros(static.balances), lam]))

    def tangent_solve(linear: Any, right: Array) -> Array:
        # The Jacobian itself where it is small; nearly so of large meshes, whose formulas leave parts out.
        if static.unknowns <= DENSE:
            solver, pins = static.inverse(jax.jacfwd(linear)(jnp.zeros_like(right)))
        else:
            solver, pins = jax.lax.stop_gradient(static).solver(at)
        # What nothing resists stays where it is.
        pins = jax.lax.stop_gradient(pins)
        return refined_solve(
            lambda x: linear(x) + pins * x,
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
    rotation=ROTATION_OF_LOAD,
    about=COMPONENTS,
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
    rotation: Any = None,
    about: Any = (0.0, 0.0, 0.0),
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

    With `rotation` it is a relative equilibrium, a steady rotation of everything about a fixed axis: loads
    and reactions balance the centripetal accelerations, and the states move as that rotation does. The angle
    about the axis stays, unless a drive sets it, and so does the place along an axis that nothing holds. All
    that acts has to turn along: gravity along the axis does, a spring to the ground beside it does not. Other
    angles that nothing determines, as of a round bob about its own rod, have to be held.

    Args:
        system: compiled system.
        state: start configuration; velocities play no part.
        loads: values of the load parameter, increasing or not; one number: `steps` equal parts of it.
        inputs: function of the load parameter to the input channels, or their values [N, N m]; default zero.
        rotation: angular velocity (3,) [rad/s], one for each load (loads, 3), or a function of the load
            parameter to it: a constant one acts in full from the first load on. Default: at rest.
        about: a point of the axis [m].
        steps: number of loads where one number is given.
        snap: False: end with `nc.Result.DIVERGED` at the first load at which Newton's method leaves the path.
        throw: raise in an eager call if there is no convergence.

    Returns:
        States at all loads. Differentiable with respect to the system's numbers, to the loads and to the
        inputs, by the implicit function theorem, in every mode and order; pure and jittable. Where Newton's
        method fails the code says so, and later states repeat the last one.

    Raises:
        SimulationError: in an eager call, if Newton's method fails or turns an element of a solid inside out,
            with the load; and if what was found is no steady rotation (`nc.Result.UNSTEADY`), with the part
            that does not turn along.

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
    given = _loadings(system, values, inputs, rotation, about)
    found = _equilibria(system, state, values, given, snap, not at_top_level(system, state, values, given))
    if is_concrete(found.result, values) and bool(jnp.any(found.snapped[1:] & (found.result[1:] == 0))):
        left = [f"{value:.6g}" for value in np.asarray(values)[1:][np.asarray(found.snapped)[1:]]]
        warnings.warn(
            f"equilibrium: Newton's method left the path at the load parameter {', '.join(left)}: what was "
            f"found there may be on another branch (`snapped`); {GROWING}, or pass snap=False to stop there",
            stacklevel=3,
        )
    if throw and is_concrete(found.result, values):
        for number, code in enumerate(found.result):
            if int(code) != Result.SUCCESSFUL:
                before = replace_fields(_one(found.states, max(number - 1, 0)), t=values[number])
                acts = _one(given, number)
                remedy = complaint(Static(system, before, acts)) if code == Result.UNSTEADY else STANDING
                if code != Result.UNSTEADY and _grows(system, before, given, number):
                    remedy = GROWING
                raise SimulationError(
                    f"no equilibrium found at the load parameter {float(values[number]):.6g} (load "
                    f"{number + 1} of {len(values)}): {REASONS[Result(int(code))]}; "
                    f"{remedy}",
                    Result(int(code)),
                    found,
                )
    return found


def _one(several: Any, number: int) -> Any:
    return jax.tree.map(lambda x: x[number], several)


def _grows(system: System, state: State, given: Loading, number: int) -> bool:
    """Whether the equations of a load are others than those of the load before, or depend on it."""
    pairs = jax.tree.leaves((_one(given, number), _one(given, max(number - 1, 0))))
    if any(bool(jnp.any(x != y)) for x, y in zip(pairs[: len(pairs) // 2], pairs[len(pairs) // 2 :])):
        return True

    def residual(t: Array) -> Array:
        static = Static(system, replace_fields(state, t=t), _one(given, number))
        return static.residual(jnp.zeros(static.unknowns))

    return bool(jnp.any(jax.jvp(residual, (state.t,), (jnp.ones_like(state.t),))[1] != 0))


def _loadings(system: System, values: Array, inputs: Any, rotation: Any, about: Any) -> Loading:
    """What acts at all loads; leading axis the loads."""
    names = system.structure.inputs
    said = f"this system has the input channels {list(names)}"
    channels = _at_loads("inputs", inputs, values, len(names), said)
    if rotation is None:
        return Loading(channels)
    rates = _at_loads("rotation", rotation, values, 3, "it has three components")
    speeds = safe_norm(rates)
    # Where it is zero, it is about the axis of the fastest.
    fastest = rates[jnp.argmax(speeds)]
    axes = jnp.where((speeds > 0)[:, None], rates, fastest)
    axes = jax.lax.stop_gradient(safe_divide(axes, safe_norm(axes)[:, None]))
    return Loading(channels, rates, axes, jnp.broadcast_to(jnp.asarray(about, float), rates.shape))


def _at_loads(name: str, given: Any, values: Array, count: int, said: str) -> Float[Array, "loads n"]:
    """Numbers at all loads, from a function of the load, numbers for all of them, or for each."""
    if callable(given):
        given = jax.vmap(given)(values)
    numbers = jnp.zeros(count) if given is None else jnp.asarray(given, float)
    if numbers.shape not in ((count,), (len(values), count)):
        raise ValueError(
            f"{name} has shape {numbers.shape}; {said}: pass shape {(count,)} or {(len(values), count)}, or "
            "a function"
        )
    return jnp.broadcast_to(numbers, (len(values), count))


@briefly
def _equilibria(
    system: System, state: State, values: Array, given: Loading, snap: bool, with_derivatives: bool
) -> Equilibrium:
    # What gives the results their derivatives takes longer to trace than the search, and is left out where
    # nothing asks for it.
    static = Static(system, state, _one(given, 0))
    # The search is not differentiated; `differentiable` gives its results their derivatives.
    still = jax.lax.stop_gradient((system, state))

    def one(carry: tuple, load: tuple) -> tuple[tuple, tuple]:
        now, lam, alive = carry
        value, u = load
        # Loads belong to the search as well; `differentiable` is given them again.
        begin = replace_fields(now, t=jax.lax.stop_gradient(value))
        search = search_equilibrium(still[0], begin, lam, jax.lax.stop_gradient(u), snap)
        code = code_of(still[0], search.state, search.code)
        if given.rotation is not None:
            turns = turns_along(Static(still[0], search.state, jax.lax.stop_gradient(u)))
            steady = search.steady & turns | jnp.all(u.rotation == 0)
            code = jnp.where((code == 0) & ~steady, int(Result.UNSTEADY), code)
        code = jnp.where(alive, code, int(Result.DIVERGED))
        good = code == int(Result.SUCCESSFUL)
        reached = jax.tree.map(lambda a, b: jnp.where(good, a, b), (search.state, search.lam), (now, lam))
        return (*reached, good), (*reached, code, search.count, search.snapped & alive)

    start = replace_fields(still[1], v=jnp.zeros_like(state.v), rates=jnp.zeros_like(state.rates))
    lam = jnp.zeros(static.unknowns - static.balances)
    _, (states, lams, codes, counts, snapped) = jax.lax.scan(
        one, (start, lam, jnp.array(True)), (values, given)
    )
    # Results of the search: their derivatives are those of the equations that they solve, below.
    states, lams = jax.lax.stop_gradient((states, lams))
    states = replace_fields(states, t=values)
    if with_derivatives:
        states, lams = jax.vmap(lambda s, lam, u: differentiable(system, s, lam, u))(states, lams, given)
    return Equilibrium(states, lams, codes, counts, snapped)
