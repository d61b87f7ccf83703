"""A look, after a run, at what effects do not see though they should."""

import warnings

import jax
import numpy as np

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, over_states, rows_with_ground

AT_ONCE = 10_000
"""Instances of all states that are looked at in one piece, for memory."""


def _uncovered(system: Model, group: Group, state: State) -> dict[str, jax.Array]:
    rows = rows_with_ground(state.q)[group.bodies]
    return jax.vmap(lambda effect, place, x: effect.uncovered(place, x))(
        group.effect, group_places(system, group), rows
    )


def warn_of_uncovered(system: Model, trajectory: Trajectory) -> None:
    """Warn of the first instance of each effect that does not see what it should, and of when.

    Args:
        system: that ran.
        trajectory: what came of it; inside of a transformation nothing is looked at.
    """
    if not is_concrete(trajectory.states, system) or trajectory.t.ndim != 1:
        return
    for group in system.effects:
        if type(group.effect).uncovered is Effect.uncovered:
            continue
        look = over_states(lambda system, state, group=group: _uncovered(system, group, state))
        part = max(1, AT_ONCE // group.count)
        for start in range(0, len(trajectory.t), part):
            states = jax.tree.map(lambda x, k=slice(start, start + part): x[k], trajectory.states)
            found = {said: np.asarray(x) for said, x in look(system, states).items()}
            seen = {said: x for said, x in found.items() if x.any()}
            for said, x in seen.items():
                step, number = np.argwhere(x)[0]
                name = system.structure.bodies[int(np.asarray(group.bodies)[number].reshape(-1)[0])]
                warnings.warn(
                    f"{group.names[number]!r}: {name!r} {said}, first at t = {float(states.t[step]):.6g} s",
                    stacklevel=3,
                )
            if seen:
                break
