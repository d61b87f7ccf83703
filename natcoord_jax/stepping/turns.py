"""A look, after a run, at how far joints turn in a step."""

import warnings

import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.state import Trajectory
from natcoord_jax.system import System

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
