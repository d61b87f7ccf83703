"""An optimal control problem: a system, a horizon, what to make small, where to end, what to respect."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.control.bounds import BOUND, Bound
from natcoord_jax.control.cost import COST, Cost
from natcoord_jax.control.goal import GOAL, Goal
from natcoord_jax.control.initial import begun, changed
from natcoord_jax.control.inputs import SPLINE, Spline
from natcoord_jax.control.memory import Carrier, Ending, Step
from natcoord_jax.control.mesh import durations, mesh_of
from natcoord_jax.control.parameters import FreeNumber
from natcoord_jax.control.phases import Systems, check_systems, kinds, like
from natcoord_jax.control.wrong import refuse_contradictions, refuse_endless_haste, refuse_state
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.kinds import FLAG, Several, of
from natcoord_jax.core.numeric import Number, Numbers, Whole
from natcoord_jax.core.state import STATE, State
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.model.tree import SLOTS
from natcoord_jax.stepping.scheme import EnergyMomentum
from natcoord_jax.system import System

PARAMETERS = Several(
    of(
        "nc.Parameter(...), nc.InitialCoordinate(...), nc.InitialRate(...) or nc.InitialState(...)",
        FreeNumber,
    )
)
PHASES = Several(Whole(1))
SCHEME = of("nc.EnergyMomentum(order=...)", EnergyMomentum)
TIMES = FLAG | Numbers((2,), "positive") | Several(Numbers((2,), "positive"))


def _numbers(dt: Any) -> Any:
    """One number as it is, several as an array."""
    return jnp.asarray(dt, float) if np.ndim(dt) else dt


def _agree(what: str, found: Any, names: tuple[str, ...]) -> None:
    """Refuse values that are not as many as their labels."""
    if found.shape != (len(names),):
        raise ValueError(f"the {what} returns shape {found.shape} for the labels {names}; make them agree")


def _hashable(times: Any) -> Any:
    """Limits of times as tuples."""
    if isinstance(times, bool | np.bool_):
        return bool(times)
    values = np.asarray(times, float).tolist()
    return tuple(tuple(x) if isinstance(x, list) else x for x in values)


class OptimalControl(Part):
    """Inputs, and free parameters, that make a cost small over a horizon of steps of the discrete motion.

    The motion is that of `nc.simulate`, step for step: what is found is optimal for the energy-momentum
    scheme (57), or the one that is asked for, at this step, not for an approximation of it.

    Attributes:
        system: compiled system, with input channels unless something else is free; or one for each phase,
            as (standing, flying): joints close and open between phases as `nc.transfer` says, with the same
            bodies and input channels in all of them. It is then the first.
        later: systems of the later phases, as `system` has said; not to be given.
        state: initial state.
        dt: step [s], one number, one for each phase or one for each step; with `free_time` its first guess.
        steps: number of steps; of several phases one number for each, as (20, 20), and then their sum.
        phases: number of steps of each phase, as `steps` has said; not to be given.
        cost: what to make small.
        goal: what the final state has to fulfil.
        bounds: what has to hold at the end of every step.
        inputs: how inputs are made of coefficients; default: held over each step.
        scheme: of the motion; default: of order two. At order four and above costs and integrals are taken by
            the quadrature of the stages, bounds hold at the stages instead of at the ends of the steps, and
            `Solution.inputs` are those of the stages (steps, stages, inputs), as `nc.simulate` takes them. It
            pays with inputs that are smooth, as `nc.inputs.piecewise_linear()` and `nc.inputs.cubic(1)`.
        parameters: numbers of the system (`nc.Parameter`) and of the initial state (`nc.InitialCoordinate`,
            `nc.InitialRate`, `nc.InitialState`) that are free as well.
        free_time: whether the step, and so the final time, is free; or (lower, upper) of the final time [s].
            Of several phases each has a free duration; limits are those of each, or ((lower, upper), ...).
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

    system: System = eqx.field(metadata=is_a(SYSTEM | Several(SYSTEM, 1)))
    state: State = eqx.field(metadata=is_a(STATE))
    dt: Any = eqx.field(
        kw_only=True, converter=_numbers, metadata=is_a(Number("positive") | Numbers((None,), "positive"))
    )
    steps: int = eqx.field(kw_only=True, static=True, metadata=is_a(Whole(1) | Several(Whole(1), 1)))
    phases: tuple[int, ...] = eqx.field(default=(), kw_only=True, static=True, metadata=is_a(PHASES))
    later: tuple[System, ...] = eqx.field(default=(), kw_only=True, metadata=is_a(Several(SYSTEM)))
    cost: Cost = eqx.field(default_factory=Cost, kw_only=True, metadata=is_a(COST))
    goal: Goal = eqx.field(default_factory=Goal, kw_only=True, metadata=is_a(GOAL))
    bounds: Bound = eqx.field(default_factory=Bound, kw_only=True, metadata=is_a(BOUND))
    inputs: Spline = eqx.field(default_factory=Spline, kw_only=True, metadata=is_a(SPLINE))
    scheme: EnergyMomentum = eqx.field(
        default=EnergyMomentum(), kw_only=True, static=True, metadata=is_a(SCHEME)
    )
    parameters: tuple[FreeNumber, ...] = eqx.field(
        default=(), kw_only=True, converter=tuple, metadata=is_a(PARAMETERS)
    )
    free_time: Any = eqx.field(
        default=False, kw_only=True, static=True, converter=_hashable, metadata=is_a(TIMES)
    )

    makes_arrays: ClassVar[bool] = True

    def __post_init__(self):
        """Tell the phases from `steps`, and their systems from `system`."""
        systems: Any = self.system
        if isinstance(systems, tuple | list):
            self.system, *later = systems
            self.later = tuple(later)
        given: Any = self.steps
        if np.ndim(given):
            self.phases = tuple(int(count) for count in given)
            self.steps = sum(self.phases)
        else:
            self.phases = tuple(self.phases) or (int(given),)
        if len(self.phases) == 1:
            # A copy with another number of steps has that one.
            self.phases = (int(self.steps),)

    def __check_init__(self):
        """Refuse what is no problem."""
        check_systems(self.systems, self.phases)
        if not self.system.structure.inputs and not self.free:
            raise ValueError(
                "the system has no input channels, and nothing else is free; add a JointTorque or another "
                "actuator to the scene, or pass parameters"
            )
        count, _ = len(self.phases), self.channels
        if sum(self.phases) != self.steps:
            raise ValueError(
                f"steps is {self.steps}, and the phases have {self.phases}; pass the steps of each, as "
                f"steps={self.phases}"
            )
        if np.ndim(self.dt) and self.dt.shape[0] not in (count, self.steps):
            raise ValueError(
                f"dt has {self.dt.shape[0]} numbers; pass one, one for each of {count} phases or one for "
                f"each of {self.steps} steps"
            )
        for lower, upper in self._time_limits():
            if not 0 <= lower < (np.inf if upper is None else upper):
                raise ValueError(f"free_time is ({lower}, {upper}) s; pass 0 < lower < upper, or True")
        if self.scheme.max_events:
            raise ValueError(
                "OptimalControl: impacts that are located have no place among the equations of all steps; "
                "leave out max_events, or give the phases between impacts systems of their own"
            )
        furthest = max(carrier.furthest() for carrier in self.carriers)
        if furthest > self.steps:
            raise ValueError(
                f"goal.At: step {furthest} is beyond the last of {self.steps} steps; pass one of them"
            )
        if len(set(self.free)) != len(self.free):
            raise ValueError(f"what is free has the names {list(self.free)}; give each its own")
        if self.system.structure.inputs and not self.parameters:
            limited = bool(self.path_labels or self.goal.limits(self.final))
            refuse_endless_haste(self.cost, limited, [lower for lower, _ in self._time_limits()])
        refuse_contradictions(self.goal, self.bounds)
        if is_concrete(eqx.filter((self.system, self.state), eqx.is_array)):
            refuse_state(self.system, self.state)
            self._check_shapes()

    def _check_shapes(self) -> None:
        for phases in kinds(self.systems):
            self._check_steps(self.systems[phases[0]], like(self.systems, self.state, phases[0]))
        self._check_end(like(self.systems, self.state, len(self.later)))

    def _check_steps(self, system: System, state: State) -> None:
        u, zero, memory = jnp.zeros(self.driven), jnp.zeros(()), jnp.zeros(sum(self.memory_sizes))
        free = {name: zero for name in self.free}
        step = Step(jnp.zeros((), int), zero, state, state, u, jnp.zeros(self.looked_back), zero, free)
        if tuple(carrier.memory(system) for carrier in self.carriers) != self.memory_sizes:
            raise ValueError(
                "what is carried along for goals, costs and bounds has another size in the systems of other "
                "phases, as nc.goal.At(nc.goal.Rest(), ...) has where joints differ; ask for nc.goal.Motion "
                "of bodies or nc.goal.Rate of joints that all phases have"
            )
        cost = jax.eval_shape(lambda m: self.cost.of_step(system, self.memories(m)[1], step), memory)
        excess = jax.eval_shape(lambda m: self.path_excess(system, m, step), memory)
        if cost.shape != ():
            raise ValueError(f"the running cost has shape {cost.shape}; return a scalar")
        _agree("bounds", excess, self.path_labels[: len(self.path_labels) // self.stages])
        jax.eval_shape(lambda m: self.carried(system, m, step), memory)

    def _check_end(self, state: State) -> None:
        free, system = {name: jnp.zeros(()) for name in self.free}, self.final

        def end(memory: Array) -> tuple[Array, Array, Array]:
            ending = Ending(self.state, state, memory, free)
            goal, cost, _ = self.memories(memory)
            excess = self.goal.excess(system, ending._replace(memory=goal))
            missing = self.goal.missing(system, ending._replace(memory=goal))
            return missing, excess, self.cost.of_end(system, ending._replace(memory=cost))

        missing, beyond, terminal = jax.eval_shape(end, jnp.zeros(sum(self.memory_sizes)))
        if terminal.shape != ():
            raise ValueError(f"the cost of the end has shape {terminal.shape}; return a scalar")
        _agree("goal", missing, self.goal_labels)
        _agree("goal within limits", beyond, self.goal.limits(system))

    @property
    def systems(self) -> Systems:
        """Systems of all phases; one: that of all of them."""
        return (self.system, *self.later)

    @property
    def final(self) -> System:
        """System of the last phase: that of the end."""
        return self.systems[-1]

    @property
    def goal_labels(self) -> tuple[str, ...]:
        """Names of the conditions of the goal."""
        return self.goal.labels(self.final)

    @property
    def driven(self) -> int:
        """Number of input channels."""
        return len(self.system.structure.inputs)

    @property
    def channels(self) -> int:
        """Number of inputs that are decided: of channels, or of what channels share.

        Without any input there is one that acts on nothing.
        """
        return self.inputs.count(len(self.system.structure.inputs)) or 1

    @property
    def stages(self) -> int:
        """Number of stages of a step."""
        return self.scheme.stages

    @property
    def uniform(self) -> bool:
        """Whether there is one phase of equal steps."""
        return len(self.phases) == 1 and np.ndim(self.dt) == 0

    @property
    def even(self) -> bool:
        """Whether all steps of a phase are equal."""
        return np.ndim(self.dt) == 0 or self.dt.shape[0] == len(self.phases)

    @property
    def free_numbers(self) -> tuple[FreeNumber, ...]:
        """What is free besides inputs and times: the parameters, and what the cost adds to them."""
        return (*self.parameters, *self.cost.parameters())

    @property
    def times(self) -> int:
        """Number of free times."""
        return len(self.phases) if self.free_time else 0

    @property
    def free(self) -> tuple[str, ...]:
        """Names of what is free besides the inputs."""
        times = tuple(f"duration of phase {k + 1} [s]" for k in range(self.times))
        times = ("final time [s]",) if len(times) == 1 else times
        return (*times, *(number.name for number in self.free_numbers))

    @property
    def rates(self) -> tuple[str, ...]:
        """Names and units of the rates of the free motions, in the order of `nc.Guess(rates=...)`.

        Those of the first phase, where phases have systems of their own.

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
        found = [number.initial(self.system, self.state) for number in self.free_numbers]
        if self.uniform and self.free_time:
            found = [self.steps * jnp.asarray(self.dt, float), *found]
        elif self.free_time:
            found = [*durations(self.phases, self.dt), *found]
        values = jnp.stack(found) if found else jnp.zeros(0)
        return values, jnp.where(values == 0, 1.0, jnp.abs(values))

    def _time_limits(self) -> list[tuple[float, float | None]]:
        """Lower and upper limits of the free times."""
        if self.free_time is True or not self.free_time:
            return [(0.0, None)] * self.times
        if np.ndim(self.free_time) == 1:
            return [tuple(self.free_time)] * self.times
        if len(self.free_time) != self.times:
            raise ValueError(
                f"free_time has limits for {len(self.free_time)} phases; pass (lower, upper) for each of "
                f"{self.times}, or once for all"
            )
        return list(self.free_time)

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of what is free besides the inputs."""
        sides = [*self._time_limits(), *((number.lower, number.upper) for number in self.free_numbers)]
        lower = np.array([-np.inf if a is None else a for a, _ in sides], float)
        upper = np.array([np.inf if b is None else b for _, b in sides], float)
        return lower, upper

    def values(self, scaled: Float[Array, " p"]) -> Float[Array, " p"]:
        """Values of what is free from the solver's unknowns: changes in units of the scale."""
        reference, scale = self.references()
        return reference + scale * scaled

    def named(self, scaled: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        """The same by name."""
        return dict(zip(self.free, self.values(scaled))) if self.free else {}

    def applied(self, scaled: Float[Array, " p"]) -> tuple[System, Float[Array, ""]]:
        """The system and the step [s] at given values of what is free; of unequal steps their mean."""
        values = self.values(scaled)
        if self.uniform:
            dt = values[0] / self.steps if self.free_time else jnp.asarray(self.dt, float)
        else:
            dt = jnp.sum(self.durations(scaled)) / self.steps
        return changed(self.system, self.free_numbers, values[self.times :]), dt

    def applied_systems(self, scaled: Float[Array, " p"]) -> Systems:
        """Systems of all phases at given values of what is free."""
        values = self.values(scaled)[self.times :]
        return tuple(changed(system, self.free_numbers, values) for system in self.systems)

    def durations(self, scaled: Float[Array, " p"]) -> Float[Array, " phases"]:
        """Durations of all phases at given values of what is free [s]."""
        return self.values(scaled)[: self.times] if self.free_time else durations(self.phases, self.dt)

    def lengths(self, scaled: Float[Array, " p"]) -> Float[Array, " steps"]:
        """Durations of all steps at given values of what is free [s]."""
        if self.uniform:
            return jnp.full(self.steps, self.applied(scaled)[1])
        return mesh_of(self.phases, self.dt).share @ self.durations(scaled)

    def start(self, scaled: Float[Array, " p"]) -> State:
        """Initial state at given values of what is free."""
        numbers, values = self.free_numbers, self.values(scaled)[self.times :]
        return begun(changed(self.system, numbers, values), self.state, numbers, values)

    @property
    def carriers(self) -> tuple[Carrier, ...]:
        """What may ask for something that is carried along the motion, in the order of the memory."""
        return self.goal, self.cost, self.bounds

    @property
    def memory_sizes(self) -> tuple[int, ...]:
        """How many numbers are carried for each of them."""
        return tuple(carrier.memory(self.system) for carrier in self.carriers)

    @property
    def looked_back(self) -> int:
        """How many inputs of the step before are carried: all, or none if nobody asks for them."""
        wanted = any(carrier.looks_back() for carrier in self.carriers)
        return len(self.system.structure.inputs) if wanted else 0

    def memories(self, memory: Float[Array, " memory"]) -> list[Array]:
        """Memory of goal, cost and bounds."""
        return jnp.split(memory, np.cumsum(self.memory_sizes)[:-1])

    def carried(self, system: System, memory: Float[Array, " memory"], step: Step) -> Float[Array, " memory"]:
        """Memory after a step."""
        pairs = zip(self.carriers, self.memories(memory))
        return jnp.concatenate([carrier.carried(system, numbers, step) for carrier, numbers in pairs])

    def path_excess(self, system: System, memory: Array, step: Step) -> Float[Array, " n"]:
        """Excess over the bounds at the end of a step, or at its stages; memory is that at its start."""
        _, cost, bounds = self.memories(memory)
        steps = step.up_to_stages()
        found = [(self.bounds.of_step(system, bounds, s), self.cost.excess(system, cost, s)) for s in steps]
        return jnp.concatenate([part for both in found for part in both])

    @property
    def path_labels(self) -> tuple[str, ...]:
        """Names of these bounds."""
        return self.stages * (self.bounds.labels(self.system) + self.cost.labels())

    @property
    def end_labels(self) -> tuple[str, ...]:
        """Names of the bounds of what is free, and of the goal's limits."""
        lower, upper = self.limits()
        names = [f"{self.free[k]} above its lower bound" for k in np.flatnonzero(np.isfinite(lower))]
        names += [f"{self.free[k]} below its upper bound" for k in np.flatnonzero(np.isfinite(upper))]
        return (*names, *self.goal.limits(self.final))


def numeric(problem: OptimalControl) -> OptimalControl:
    """The problem with all its numbers as arrays, so that a changed number never compiles anew."""
    return jax.tree.map(lambda x: jnp.asarray(x, float) if isinstance(x, int | float) else x, problem)


PROBLEM = of("a problem, nc.OptimalControl(...)", OptimalControl)
"""What an argument may be."""
