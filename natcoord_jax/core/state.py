"""State of a system and trajectory of a rollout: plain data."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.bodies import by_node
from natcoord_jax.core.checks import is_concrete, numbers
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.core.kinds import of, short


class State(eqx.Module):
    """State of a system at one time.

    Attributes:
        t: time [s].
        q: rows of all bodies: reference points [m] and directors [-], four rows a body.
        v: their velocities [1/s times that], as the scheme carries them on: after energy-momentum steps of
            order two with small parts across the constraints; `System.tangent` leaves them out.
        coordinates: joint coordinates, angles counted on over many turns [rad, m].
        rates: stored rates of rotors (armature) [rad/s, m/s].
        work: work done so far by each input, load, damper and drive [J].
        dissipated: energy that a dissipative scheme has taken out so far [J]; None before it is used.
        held: which joint coordinates (first row) and which of their rates (second) `with_coordinate` has set,
            1 or 0: `assemble` keeps these where the constraints allow it, and forgets them. None: none; a
            tree without drives and couplings never has any.
        contacts: of each contact without a stiffness, or with friction, the impulses so far of steps and of
            impacts at their ends [N s], and the number of impacts, as `nc.contacts` reads them; None: there
            are no such contacts. Of a scheme that locates impacts also how many of them it has located.
        elapsed: time since the start of the step at hand, of a scheme that locates impacts [s]; zero in what
            is saved. None: of others.
    """

    t: Float[Array, "*batch"]
    q: Float[Array, "*batch rows 3"]
    v: Float[Array, "*batch rows 3"]
    coordinates: Float[Array, "*batch coordinates"]
    rates: Float[Array, "*batch rotors"]
    work: Float[Array, "*batch works"]
    dissipated: Float[Array, "*batch"] | None = None
    held: Float[Array, "*batch 2 coordinates"] | None = None
    contacts: Float[Array, "*batch contacts counts"] | None = None
    elapsed: Float[Array, "*batch"] | None = None

    @property
    def rows(self) -> Float[Array, "*batch bodies 4 3"]:
        """Rows body by body: the reference point [m], then the directors [-]."""
        return by_node(self.q)

    @property
    def row_rates(self) -> Float[Array, "*batch bodies 4 3"]:
        """Velocities of the rows body by body, as `v` has them."""
        return by_node(self.v)

    def at_time(self, t: Any) -> "State":
        """The same positions and velocities at another time, from which a simulation then starts.

        Drives ask for other coordinates there: pass it through `nc.assemble` where there are any.

        Args:
            t: [s].

        Raises:
            ValueError: for what is no finite number.

        Example:
            >>> import jax; jax.config.update("jax_enable_x64", True)
            >>> import natcoord_jax as nc
            >>> scene = nc.Scene()
            >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 2.0, 3.0)))
            >>> system, state = scene.compile()
            >>> float(nc.simulate(system, state.at_time(2.0), dt=0.5, steps=2).t[-1])
            3.0
        """
        return replace_fields(self, t=numbers(t, jnp.shape(self.t), "state: t", "s"))


class Trajectory(eqx.Module):
    """States at the saved times, and what happened on the way.

    It counts and is indexed along the first axis, as its times are: `trajectory[k].t` is `trajectory.t[k]`.
    So a trajectory has as many items as saved states, an index gives a state, and a slice a trajectory of
    the states that it picks (with the inputs of the last step before each; codes and counts stay those of
    the run, `steps_taken` less the intervals cut off at the ends). Of a batch the items are the lanes.

    Attributes:
        states: saved states, the initial one first; leading axis `saved`.
        inputs: inputs of the steps before each saved state, shape (saved - 1, inputs); with `save_every`
            larger than one, those of the last step of each interval. The mean of inputs given at stages.
            Beyond the end of a run that failed, those of the step that failed.
        result: result code (see `Result`); 0 is successful.
        failed_step: index of the step that failed or ended the run, or the number of steps.
        failed_time: time [s] at the start of the (sub)step that failed, or the end time.
        failed_part: number of the unknown with the largest correction in the last attempt that failed, named
            by `System.explain`; -1 where the run went well, -2 less the number of an element that was turned
            inside out.
        residual: size of that residual, or the largest accepted one (relative).
        steps_taken: accepted (sub)steps.
        steps_rejected: (sub)steps that were repeated in shorter ones.
        iterations: Newton iterations summed over all attempts.
        iterations_max: largest number in one attempt.
        scheme: that made it (static).

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> ball = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0)))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=0.5, steps=10)
        >>> len(trajectory), float(trajectory[-1].q[0, 0])
        (11, 5.0)
        >>> later = trajectory[5:]
        >>> later.t.tolist(), float(later[0].t)
        ([2.5, 3.0, 3.5, 4.0, 4.5, 5.0], 2.5)
        >>> [float(state.q[0, 0]) for state in trajectory[::5]]
        [0.0, 2.5, 5.0]
    """

    states: State
    inputs: Float[Array, "*batch saved inputs"]
    result: Int[Array, "*batch"]
    failed_step: Int[Array, "*batch"]
    failed_time: Float[Array, "*batch"]
    failed_part: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]
    steps_taken: Int[Array, "*batch"]
    steps_rejected: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    iterations_max: Int[Array, "*batch"]
    scheme: Any = eqx.field(static=True, default=None)

    def __len__(self) -> int:
        return self.t.shape[0]

    def __iter__(self) -> Iterator[Any]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, index: Any) -> Any:
        """A state or a trajectory, of a batch always a trajectory.

        Raises:
            IndexError: for a place beyond the ends, or a slice of nothing.
            TypeError: for what is neither a number nor a slice.
        """
        if isinstance(index, bool) or not isinstance(index, int | np.integer | slice):
            raise TypeError(f"trajectory: index {short(index)} is no place; pass a whole number or a slice")
        if not isinstance(index, slice) and not -len(self) <= int(index) < len(self):
            raise IndexError(f"trajectory: there is no item {index}; it has {len(self)}")
        places = range(len(self))[index]
        if isinstance(places, range) and not places:
            raise IndexError(f"trajectory: nothing is in {index}; it has {len(self)} items")
        if self.t.ndim > 1:
            return _picked(self, places)
        states = _picked(self.states, places)
        if not isinstance(places, range):
            return states
        if places.step < 0:
            raise IndexError("trajectory: a slice may not go backwards, times increase; pass a positive step")
        before = range(places[0] + places.step - 1, places[-1], places.step)
        # (States after the end of a run repeat the last one, and are no steps.)
        made = (np if is_concrete(self.t) else jnp).diff(self.t) > 0
        cut = made.sum() - made[places[0] : places[-1]].sum()
        return dataclasses.replace(
            self, states=states, inputs=_picked(self.inputs, before), steps_taken=self.steps_taken - cut
        )

    @property
    def t(self) -> Float[Array, "*batch saved"]:
        """Saved times [s]."""
        return self.states.t

    @property
    def q(self) -> Float[Array, "*batch saved rows 3"]:
        """Saved rows."""
        return self.states.q

    @property
    def v(self) -> Float[Array, "*batch saved rows 3"]:
        """Saved velocities of the rows, as the scheme carries them on; see `System.tangent`."""
        return self.states.v


def _picked(tree: Any, places: int | range) -> Any:
    """Items of all arrays along the first axis."""
    if isinstance(places, range):
        places = slice(places.start, places.stop, places.step)  # pyright: ignore[reportAssignmentType]
    return jax.tree.map(lambda x: x[places], tree)


STATE = of("a state, as scene.compile() returned it with the system", State)
TRAJECTORY = of("a trajectory, as nc.simulate(...) returned it", Trajectory)
MOTION = of("a state or a trajectory", State, Trajectory)
"""What arguments may be."""
