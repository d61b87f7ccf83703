"""Inverse dynamics: inputs that make joint coordinates follow a path, exactly for the discrete motion."""

from collections.abc import Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.core.arguments import checked
from natcoord_jax.core.compiled import briefly
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import JOINT_NAME, Several
from natcoord_jax.core.numeric import Numbers
from natcoord_jax.core.state import STATE, State
from natcoord_jax.maths.collocation import gauss
from natcoord_jax.mechanics.equations import prepare, starting
from natcoord_jax.model.model import SYSTEM
from natcoord_jax.stepping.checked import STEP
from natcoord_jax.stepping.step import end_of_step
from natcoord_jax.system import System

MIDPOINT = gauss(1)
LEAST_ROUNDS, MOST_ROUNDS = 3, 30
"""Newton corrections of a step."""
ACCURACY = 1e-8
"""Part of the loads that inputs may leave unbalanced before the path counts as impossible."""


class _Search(eqx.Module):
    """Where Newton's iteration for the unknowns and the inputs of a step stands.

    Attributes:
        y: unknowns of the step.
        u: inputs.
        correction: the last one.
        before: the one before it.
        left: residual before the last correction relative to its terms, in the norm of the energy.
        reach: change of the coordinates at the end of the step per input.
        count: corrections so far.
    """

    y: Float[Array, " unknowns"]
    u: Float[Array, " inputs"]
    correction: Float[Array, ""]
    before: Float[Array, ""]
    left: Float[Array, ""]
    reach: Float[Array, "c inputs"]
    count: Int[Array, ""]

    @property
    def unfinished(self) -> Array:
        """While loads are out of balance, then while corrections shrink, down to round-off."""
        open_still = (self.left > ACCURACY) | (self.correction < 0.5 * self.before)
        return (self.count < LEAST_ROUNDS) | (open_still & (self.count < MOST_ROUNDS))


class _Step(eqx.Module):
    """The equations of one step, with the inputs among the unknowns and coordinates that are wanted."""

    system: System
    state: State
    h: Float[Array, ""]
    wanted: Float[Array, " c"]
    places: Int[Array | np.ndarray, " c"]
    start_cache: Any

    def equations(self, u: Array) -> Any:
        """With given inputs."""
        return prepare(self.system, self.state, u, self.h, MIDPOINT, self.start_cache)

    def end(self, y: Array, u: Array) -> tuple[Array, Array, State]:
        """Residual of the equations, the size of its terms, and the state that follows."""
        equations = self.equations(u)
        found = equations.evaluate(y)
        after, _ = end_of_step(equations, found)
        return found.residual, found.size, after

    def solver(self, y: Array, u: Array) -> Any:
        """Factors of the Jacobian with respect to the unknowns, in the form chosen at compile."""
        equations = self.equations(u)
        return equations.factorised(equations.jacobian(y))[0]

    def trip(self, search: _Search) -> _Search:
        """One correction: inputs change so that with what follows from them the path is met."""
        y, u = search.y, search.u
        residual, size, after = self.end(y, u)
        by_input = jax.jacfwd(lambda u: self.equations(u).residual(y)[0])(u)
        columns = jnp.concatenate([residual[:, None], by_input], axis=1)
        answers = jax.vmap(self.solver(y, u).solve, in_axes=1, out_axes=1)(columns)

        def along(direction: Array) -> Array:
            def reached(y: Array) -> Array:
                return self.end(y, u)[2].coordinates[self.places]

            return jax.jvp(reached, (y,), (direction,))[1]

        reach = jax.vmap(along, in_axes=1, out_axes=1)(answers)
        gap = after.coordinates[self.places] - self.wanted
        change = jnp.linalg.lstsq(reach[:, 1:], gap - reach[:, 0])[0]
        moved = answers[:, 0] + answers[:, 1:] @ change
        left = jnp.sqrt(jnp.abs(residual @ answers[:, 0])) / jnp.where(size > 0, size, 1.0)
        correction = jnp.max(jnp.abs(moved), initial=0.0)
        sizes = correction, search.correction, left
        return _Search(y - moved, u + change, *sizes, -reach[:, 1:], search.count + 1)


class Followed(eqx.Module):
    """A path that was followed, step by step.

    Attributes:
        inputs: of the steps.
        states: at their ends.
        reach: change of the coordinates at the end of a step per input.
        left: what stays unbalanced, relative.
        missed: by how much the coordinates miss the path [rad or m].
    """

    inputs: Float[Array, "*steps inputs"]
    states: State
    reach: Float[Array, "*steps c inputs"]
    left: Float[Array, "*steps"]
    missed: Float[Array, "*steps"]


@briefly
def _followed(
    system: System, state: State, path: Float[Array, "steps c"], places: Any, dt: Array
) -> Followed:
    channels = len(system.structure.inputs)
    big, nought = jnp.asarray(jnp.inf), jnp.array(0)

    def body(state: State, wanted: Array) -> tuple:
        start_cache = starting(system, state, MIDPOINT, later=True)
        step = _Step(system, state, dt, wanted, places, start_cache)
        u = jnp.zeros(channels)
        reach = jnp.zeros((len(places), channels))
        start = _Search(step.equations(u).guess(), u, big, big, big, reach, nought)
        found = jax.lax.while_loop(lambda s: s.unfinished, lambda s: step.trip(s), start)
        following = step.end(found.y, found.u)[2]
        missed = jnp.max(jnp.abs(following.coordinates[places] - wanted), initial=0.0)
        return following, Followed(found.u, following, found.reach, found.left, missed)

    return jax.lax.scan(body, state, path)[1]


def places_of(system: System, joints: Sequence[Handle | str] | None) -> np.ndarray:
    """Coordinates of some joints, in their order, or of all."""
    every = system.structure.coordinates
    if joints is None:
        return np.arange(len(every))
    names = [system.structure.joints[system.joint_index(joint)] for joint in joints]
    return np.array([i for name in names for i, (owner, _) in enumerate(every) if owner == name], int)


@checked()
def inverse_dynamics(
    system: Annotated[System, SYSTEM],
    state: Annotated[State, STATE],
    coordinates: Annotated[Any, Numbers((None, None))],
    *,
    dt: Annotated[Any, STEP],
    joints: Annotated[Sequence[Handle | str] | None, Several(JOINT_NAME, 1)] = None,
) -> tuple[Float[Array, "steps inputs"], State]:
    """Inputs that make joint coordinates follow a path, exactly for the energy-momentum step (57).

    `nc.simulate` with these inputs reproduces the path to round-off, as long as the motion itself does not
    amplify round-off; over many seconds of an unstable one (a robot that carries its arm upright) it takes
    feedback, see `nc.computed_torque`.

    Parts without inputs (beams, passive joints, free bodies) move as they must: inputs and motion are found
    together, step by step. A path of coordinates that inputs act on directly is always possible; what
    follows it at a distance may be violent.

    Args:
        system: compiled system with as many inputs as coordinates are prescribed.
        state: initial state; its coordinates are where the path starts.
        coordinates: joint coordinates at the end of every step, shape (steps, coordinates), in the order of
            `system.structure.coordinates`, or of `joints` [rad, counted on over many turns, or m].
        dt: step [s].
        joints: handles or names of the joints whose coordinates are prescribed; default all.

    Returns:
        Inputs (steps, inputs) [N, N m], and the states at the ends of the steps.

    Raises:
        ValueError: for a wrong shape, or a path that the inputs cannot bring about.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> disc = scene.add(nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 2.0)))
        >>> hinge = scene.add(nc.Revolute(nc.ground, disc))
        >>> motor = scene.add(nc.JointTorque(hinge, name="motor"))
        >>> system, state = scene.compile()
        >>> path = jnp.linspace(0.0, 1.0, 11)[1:, None] ** 3
        >>> inputs, _ = nc.inverse_dynamics(system, state, path, dt=0.1)
        >>> trajectory = nc.simulate(system, state, dt=0.1, inputs=inputs)
        >>> bool(abs(trajectory.states.coordinates[1:] - path).max() < 1e-12)
        True
    """
    found = followed(system, state, coordinates, dt, places_of(system, joints))
    return found.inputs, found.states


def followed(system: System, state: State, coordinates: Any, dt: Any, places: np.ndarray) -> Followed:
    """A path of the coordinates at given places in the state, followed; see `inverse_dynamics`.

    Raises:
        ValueError: for a wrong shape, or a path that the inputs cannot bring about.
    """
    path = jnp.asarray(coordinates, float)
    if path.ndim != 2 or path.shape[1] != len(places) or path.shape[0] == 0:
        names = ["{} [{}]".format(*system.structure.coordinates[i]) for i in places]
        raise ValueError(f"coordinates has shape {path.shape}; pass (steps, {len(places)}) for {names}")
    found = _followed(system, state, path, places, jnp.asarray(dt, float))
    left, missed = np.asarray(found.left), np.asarray(found.missed)
    fine = (left < ACCURACY) & (missed < ACCURACY)
    if not np.all(fine):
        step = int(np.argmin(fine))
        raise ValueError(
            f"the inputs {list(system.structure.inputs)} cannot bring about the path in step "
            f"{step}: {left[step]:.1e} of the loads stay unbalanced and the coordinates "
            f"miss it by {missed[step]:.1e} rad or m; every coordinate of the path needs an input that "
            "acts on it (leave out others by joints=), and the path must obey the constraints"
        )
    return found
