"""A look, after a run, at what effects do not see though they should, and how far joints turn in a step."""

import warnings

import jax
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.state import State, Trajectory
from natcoord_jax.model.groups import Group
from natcoord_jax.model.model import Model
from natcoord_jax.model.rows import group_places, over_states, rows_with_ground
from natcoord_jax.system import System

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
            seen = {said: np.asarray(x) for said, x in look(system, states).items() if np.any(x)}
            for said, x in seen.items():
                step, number = np.argwhere(x)[0]
                name = system.structure.bodies[int(np.asarray(group.bodies)[number].reshape(-1)[0])]
                warnings.warn(
                    f"{group.names[number]!r}: {name!r} {said}, first at t = {float(states.t[step]):.6g} s",
                    stacklevel=3,
                )
            if seen:
                break


FAR = 1.0
"""Turn in a step [rad] up to which nothing is said: the rate is off by a tenth at order two."""

SAME = 0.03
"""Difference of rate and gain, relative, from which on they tell different things: a drive's are the same."""

MODEST = 0.35
"""Turn in a step [rad] that is advised at order two, with the rate within 1 %; above `FAR`, within 0.2 %."""


def _turns(system: System, trajectory: Trajectory, every: int) -> Float[np.ndarray, " coordinates"]:
    """Largest change in a step of the joint angles [rad], zero for displacements."""
    angles = np.zeros(len(system.structure.coordinates), bool)
    for group in system.coordinates:
        if group.axis.unit == "rad":
            angles[np.asarray(group.index)] = True
    if not angles.any():
        return np.zeros(0)
    values = np.asarray(trajectory.states.coordinates)
    changes = np.abs(np.diff(values, axis=0)) / every
    return np.where(angles, np.max(changes, axis=0, where=np.isfinite(changes), initial=0.0), 0.0)


def warn_of_far_turns(system: System, trajectory: Trajectory, dt: Float[Array, ""], every: int) -> None:
    """Warn of a joint that turns so far in a step that its rate and its angle tell different things.

    Over a step of one stage at the rate r, a body turns by the angle 2 atan(r h / 2): kept are energy and
    momenta, thus the rate, not the phase.

    Args:
        system: that ran.
        trajectory: what came of it; inside of a transformation nothing is looked at.
        dt: step [s].
        every: steps between saved states.
    """
    if not is_concrete(trajectory.states.coordinates, dt, system.coordinates):
        return
    turns, stages = _turns(system, trajectory, every), trajectory.scheme.stages
    for worst in np.argsort(-turns):
        turn, step, (name, number) = float(turns[worst]), float(dt), system.structure.coordinates[worst]
        if turn <= FAR:
            return
        rates = np.abs(np.asarray(system.rate(trajectory, name, index=number)))
        gained, shown = turn / step, float(np.max(rates, where=np.isfinite(rates), initial=0.0))
        if abs(shown - gained) > SAME * gained:
            break
    else:
        return
    several = sum(joint == name for joint, _ in system.structure.coordinates) > 1
    angle = f"the angle {number} of joint {name!r}" if several else f"joint {name!r}"
    fitting = (MODEST if stages == 1 else FAR) / max(shown, gained)
    higher = " or a scheme of higher order" if stages == 1 else ""
    warnings.warn(
        f"{angle} turns by {turn:.3g} rad in a step of {step:.4g} s, too far for order "
        f"{trajectory.scheme.order}: the rate shows {shown:.4g} rad/s where the angle gains {gained:.4g} "
        f"rad/s; take dt = {fitting:.2g} s{higher}",
        stacklevel=3,
    )
