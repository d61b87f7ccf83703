"""An optimal control problem: a system, a horizon, what to make small, where to end, what to respect."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.bounds import BOUND, Bound
from natcoord_jax.control.cost import COST, Cost
from natcoord_jax.control.goal import GOAL, Goal
from natcoord_jax.control.inputs import SPLINE, Spline
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.callables import Function
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.kinds import FLAG, NAME, FunctionOf, Several, of
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.state import STATE, State
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.model.tree import SLOTS
from natcoord_jax.stepping.assemble import assemble
from natcoord_jax.system import System


class Parameter(Part):
    """A number of the system that is free: a stiffness, a mass, a length.

    Attributes:
        name: for reports.
        where: which leaf of the system, as for `eqx.tree_at`: system -> array. For more than one place,
            pass `apply` instead.
        index: place in the leaf; equal effects and bodies are stacked.
        lower: lower bound; None: none.
        upper: upper bound; None: none.
        apply: (system, value) -> system, for numbers that act in several places; needs `value`.
        value: initial value, where it cannot be read from the leaf.
        moves: whether it moves geometry, so that the initial state is assembled anew.

    Example:
        >>> import natcoord_jax as nc
        >>> mass = nc.Parameter("mass", where=lambda system: system.mass, index=(0, 0, 0), lower=1.0)
    """

    name: str = eqx.field(static=True, metadata=is_a(NAME))
    where: Callable[[System], Array] | None = eqx.field(
        default=None, kw_only=True, converter=Function.of, metadata=is_a(FunctionOf("(system) -> array"))
    )
    index: Any = eqx.field(default=(), kw_only=True, static=True, metadata=is_a(Whole() | Several(Whole())))
    lower: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    upper: float | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(Number()))
    apply: Callable[[System, Array], System] | None = eqx.field(
        default=None,
        kw_only=True,
        converter=Function.of,
        metadata=is_a(FunctionOf("(system, value) -> system")),
    )
    value: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number()))
    moves: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))

    def __check_init__(self):
        """Refuse a parameter that is nowhere, or has no room."""
        if (self.where is None) == (self.apply is None) or (self.where is None and self.value is None):
            raise ValueError(f"parameter {self.name!r}: pass `where`, or `apply` together with `value`")
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(
                f"parameter {self.name!r}: the lower bound {self.lower:g} is not below the upper bound "
                f"{self.upper:g}; pass bounds with room between them"
            )

    def initial(self, system: System) -> Float[Array, ""]:
        """Value at the start of the optimisation."""
        if self.value is not None or self.where is None:
            return jnp.asarray(self.value, float)
        return jnp.asarray(self._leaf(system)[1])[self.index]

    def applied(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another value."""
        if self.where is None:
            assert self.apply is not None
            return self.apply(system, value)
        number, leaf = self._leaf(system)
        leaves, structure = jax.tree.flatten(system)
        leaves[number] = jnp.asarray(leaf).at[self.index].set(value)
        return jax.tree.unflatten(structure, leaves)

    def _leaf(self, system: System) -> tuple[int, Array]:
        """Which leaf of the system it is a place of, and that leaf."""
        leaves, structure = jax.tree.flatten(system)
        assert self.where is not None
        number: Any = self.where(jax.tree.unflatten(structure, range(len(leaves))))
        if not isinstance(number, int):
            raise ValueError(
                f"parameter {self.name!r}: `where` gives {type(number).__name__}, which is no leaf of the "
                "system; return one of its arrays as it is, and a place in it as `index`, or pass `apply`"
            )
        return number, leaves[number]


PARAMETERS = Several(of("nc.Parameter(...)", Parameter))


class OptimalControl(Part):
    """Inputs, and free parameters, that make a cost small over a horizon of steps of the discrete motion.

    The motion is that of `nc.simulate`, step for step: what is found is optimal for the energy-momentum
    scheme (57) at this step, not for an approximation of it.

    Attributes:
        system: compiled system with input channels.
        state: initial state.
        dt: step [s]; with `free_time` its first guess.
        steps: number of steps.
        cost: what to make small.
        goal: what the final state has to fulfil.
        bounds: what has to hold at the end of every step.
        inputs: how inputs are made of coefficients; default: held over each step.
        parameters: numbers of the system that are free as well.
        free_time: whether the step, and so the final time, is free; or (lower, upper) of the final time [s].
            It needs something that makes waiting cost or forbids it: `nc.cost.Duration`, a running cost, or
            an upper bound (least effort takes all the time there is); and limits of the inputs where time
            is what is made small. `dt` is where it starts; a time too short for the limits is made longer
            on the way.

    Raises:
        ValueError: for a horizon without steps, a system without inputs, shapes that do not fit.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0), name="disc"))
        >>> hinge = scene.add(nc.Revolute(nc.ground, disc, name="hinge"))
        >>> motor = scene.add(nc.JointTorque(hinge, name="motor"))
        >>> system, state = scene.compile()
        >>> problem = nc.OptimalControl(
        ...     system, state, dt=0.05, steps=20, cost=nc.cost.Effort(),
        ...     goal=nc.goal.Coordinate(hinge, 1.0) & nc.goal.Rest(),
        ... )
        >>> solution = nc.optimise(problem, progress=False)
        >>> round(float(solution.cost), 2)  # 12 I^2 angle^2 / T^3, and O(dt^2)
        48.15
    """

    system: System = eqx.field(metadata=is_a(SYSTEM))
    state: State = eqx.field(metadata=is_a(STATE))
    dt: Any = eqx.field(kw_only=True, metadata=is_a(Number("positive")))
    steps: int = eqx.field(kw_only=True, static=True, metadata=is_a(Whole(1)))
    cost: Cost = eqx.field(default_factory=Cost, kw_only=True, metadata=is_a(COST))
    goal: Goal = eqx.field(default_factory=Goal, kw_only=True, metadata=is_a(GOAL))
    bounds: Bound = eqx.field(default_factory=Bound, kw_only=True, metadata=is_a(BOUND))
    inputs: Spline = eqx.field(default_factory=Spline, kw_only=True, metadata=is_a(SPLINE))
    parameters: tuple[Parameter, ...] = eqx.field(
        default=(), kw_only=True, converter=tuple, metadata=is_a(PARAMETERS)
    )
    free_time: Any = eqx.field(
        default=False, kw_only=True, static=True, metadata=is_a(FLAG | Numbers((2,), "positive"))
    )

    makes_arrays: ClassVar[bool] = True

    def __check_init__(self):
        """Refuse what is no problem."""
        channels = self.system.structure.inputs
        if not channels:
            raise ValueError(
                "the system has no input channels; add a JointTorque or another actuator to the scene"
            )
        if self.free_time is not False and self.free_time is not True:
            lower, upper = self.free_time
            if not 0 < lower < upper:
                raise ValueError(f"free_time is ({lower}, {upper}) s; pass 0 < lower < upper, or True")
        names = [parameter.name for parameter in self.parameters]
        if len(set(names)) != len(names):
            raise ValueError(f"parameters have the names {names}; give each its own")
        if is_concrete(eqx.filter((self.system, self.state), eqx.is_array)):
            self._check_shapes()

    def _check_shapes(self) -> None:
        u, t = jnp.zeros(len(self.system.structure.inputs)), jnp.zeros(())
        cost = jax.eval_shape(lambda s: self.cost.running(self.system, s, u, t), self.state)
        end = jax.eval_shape(lambda s: self.cost.terminal(self.system, s), self.state)
        if cost.shape != () or end.shape != ():
            raise ValueError(f"the cost has shape {cost.shape} and at the end {end.shape}; return a scalar")
        missing = jax.eval_shape(lambda s: self.goal.residual(self.system, s), self.state)
        excess = jax.eval_shape(lambda s: self.bounds.excess(self.system, s, u, t), self.state)
        for what, found, names in (
            ("goal", missing, self.goal.labels(self.system)),
            ("bounds", excess, self.bounds.labels(self.system)),
        ):
            if found.shape != (len(names),):
                raise ValueError(
                    f"the {what} returns shape {found.shape} for the labels {names}; make them agree"
                )

    @property
    def channels(self) -> int:
        """Number of input channels."""
        return len(self.system.structure.inputs)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of what is free besides the inputs."""
        times = ("final time [s]",) if self.free_time else ()
        return (*times, *(parameter.name for parameter in self.parameters))

    @property
    def rates(self) -> tuple[str, ...]:
        """Names and units of the rates of the free motions, in the order of `nc.Guess(rates=...)`.

        Axis 3 of a joint is its `axis`, axis 1 its `second`; those of a body without one are its own.
        """
        structure, names = self.system.structure, []
        for number, slot in (divmod(int(k), SLOTS) for k in np.asarray(self.system.tree.slot_of)):
            whose = "its joint" if structure.joints[number] else "the body"
            axis = 1 if slot == 6 else slot % 3 + 1
            way, unit = ("along", "m/s") if 3 <= slot < 6 else ("about", "rad/s")
            names.append(f"{structure.bodies[number]!r} {way} axis {axis} of {whose} [{unit}]")
        return tuple(names)

    def references(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Initial values of what is free besides the inputs, and the scale of each."""
        found = [parameter.initial(self.system) for parameter in self.parameters]
        if self.free_time:
            found = [self.steps * jnp.asarray(self.dt, float), *found]
        values = jnp.stack(found) if found else jnp.zeros(0)
        return values, jnp.where(values == 0, 1.0, jnp.abs(values))

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of what is free besides the inputs."""
        sides = [(p.lower, p.upper) for p in self.parameters]
        if self.free_time:
            sides = [(0.0, None) if self.free_time is True else tuple(self.free_time), *sides]
        lower = np.array([-np.inf if a is None else a for a, _ in sides], float)
        upper = np.array([np.inf if b is None else b for _, b in sides], float)
        return lower, upper

    def values(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        """Values of what is free from the solver's unknowns: changes in units of the scale."""
        reference, scale = self.references()
        return reference + scale * scaled

    def applied(self, scaled: Float[Array, " p"]) -> tuple[System, Float[Array, ""]]:
        """The system and the step [s] at given values of what is free."""
        values, system = self.values(scaled), self.system
        dt = values[0] / self.steps if self.free_time else jnp.asarray(self.dt, float)
        for parameter, value in zip(self.parameters, values[1 if self.free_time else 0 :]):
            system = parameter.applied(system, value)
        return system, dt

    def start(self, scaled: Float[Array, " p"]) -> State:
        """Initial state at given values of what is free."""
        if not any(parameter.moves for parameter in self.parameters):
            return self.state
        return assemble(self.applied(scaled)[0], self.state)


def numeric(problem: OptimalControl) -> OptimalControl:
    """The problem with all its numbers as arrays, so that a changed number never compiles anew."""
    return jax.tree.map(lambda x: jnp.asarray(x, float) if isinstance(x, int | float) else x, problem)


PROBLEM = of("a problem, nc.OptimalControl(...)", OptimalControl)
"""What an argument may be."""
