"""Wrenches between two frames, and their derivatives by the motion of the bodies that the frames sit on.

An energy of relative rotation and place sees only what one frame does relative to the other: the
velocity of the second point for an observer who turns with the first frame, and the difference of the angular
velocities. Its forces are a pair, opposite to each other: six numbers instead of twelve.
"""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.core.motion import Motion, StepContext
from natcoord_jax.core.potential import Potential
from natcoord_jax.core.together import instances_last, place_together, steps_together
from natcoord_jax.maths.components import Triple, combination, rows_of, turned_midway
from natcoord_jax.xla.materialise import materialised

PLACES = np.array([0, 1, 2, 3, 4, 5, 0, 1, 2, 6, 7, 8])
"""Rows and columns of both bodies' wrenches and twists: of nine numbers, the first three serve both."""

BY_TWIST = np.repeat([-1.0, 1.0, 1.0, 1.0], 3)
"""Signs of the columns: velocities act by that of the second body less that of the first."""

OF_WRENCH = np.repeat([1.0, 1.0, -1.0, 1.0], 3)
"""Signs of the rows: forces are opposite."""


class Expanded(Potential):
    """A potential between two attachments that gives gradient and curvature of its energy together."""

    @abc.abstractmethod
    def expansion(self, invariants: Float[Array, "7 *n"]) -> tuple[Array, Array]:
        """Gradient (7, n) and second derivatives (7, 7, n) of the energy by `relative_motion`."""


class Pair:
    """Two frames on two bodies during a step of one stage, as functions of the twists.

    Attributes:
        arms: from the bodies' reference points to the frames' points, at the start of the step [m].
        axes: of the frames, at the start of the step.
        apart: from the reference point of the first body to that of the second, at the start [m].
        h: step [s].
    """

    def __init__(self, x: Float[Array, "2 4 3 n"], start: Float[Array, "2 4 3 n"], h: Any):
        points = Triple.of(start[0, 0]), Triple.of(start[1, 0])
        self.arms = [Triple.of(x[side, 0]) - points[side] for side in range(2)]
        self.axes = [[Triple.of(x[side, i]) for i in (1, 2, 3)] for side in range(2)]
        self.apart, self.h = points[1] - points[0], h

    def _turned(self, side: int, spin: Triple) -> tuple[Triple, list[Triple]]:
        half = spin * (0.5 * self.h)
        return materialised(
            (turned_midway(half, self.arms[side]), [turned_midway(half, d) for d in self.axes[side]])
        )

    def wrenches(self, drift: Triple, spins: tuple[Triple, Triple], gradient: Any) -> Float[Array, "9 n"]:
        """Force and torque on the first body, torque on the second, about their reference points.

        Args:
            drift: velocity of the second reference point less that of the first [m/s].
            spins: angular velocities [rad/s].
            gradient: of the energy by the invariants (7, n), a function of their steps.
        """
        (arm_a, (a1, a2, a3)), (arm_b, (b1, b2, b3)) = (self._turned(k, spin) for k, spin in enumerate(spins))
        # From the first reference point to the second frame's point, as in the middle of the step.
        reach = self.apart + drift * (0.5 * self.h) + arm_b
        relative = spins[0] - spins[1]
        moving = drift + spins[1].cross(arm_b) - spins[0].cross(reach)
        turning = materialised(
            [
                a3.cross(b2) - a2.cross(b3),
                a1.cross(b3) - a3.cross(b1),
                a2.cross(b1) - a1.cross(b2),
                a1.cross(b1) + a2.cross(b2) + a3.cross(b3),
            ]
        )
        reach, moving = materialised((reach, moving))
        rates = [g.dot(relative) for g in turning] + [a.dot(moving) for a in (a1, a2, a3)]
        given = materialised(gradient(materialised(rows_of(*rates) * self.h)))
        torque = combination(list(given[:4]), turning)
        force = combination(list(given[4:]), [a1, a2, a3])
        torque, force = materialised((torque, force))
        return rows_of(force, reach.cross(force) - torque, torque - arm_b.cross(force))


def tangents_of_pairs(
    potential: Expanded, place: Array, motion: Motion, now: StepContext
) -> Float[Array, "n 2 1 6 2 1 6"]:
    """Derivatives of the wrenches of a potential between two attachments by the twists, for one stage.

    Exact in the geometry; the gradient of the energy is that in the middle of the step, and linear in the
    steps of the invariants.
    """
    potential, place, start = instances_last((potential, place, motion.start))
    x, rows = place_together(place, start), instances_last((motion.rows, motion.rates), 1)
    begun = potential.invariants(x)
    steps = steps_together(potential, *(place_together(place, r) for r in (rows[0], now.h * rows[1])))
    steps = materialised(steps[0])
    middle, curvature = materialised(potential.expansion(begun + 0.5 * steps))
    pair = Pair(x, start, now.h)
    drift = Triple.of(rows[1][0, 1, 0] - rows[1][0, 0, 0])
    spin = jnp.moveaxis(motion.spin[0], 0, -1)

    def gradient(moved: Float[Array, "7 n"]) -> Float[Array, "7 n"]:
        return middle + 0.5 * jnp.sum(curvature * (moved - steps), axis=1)

    like = jnp.zeros_like(spin[0, 0])
    given = drift, (Triple.of(spin[0]), Triple.of(spin[1]))

    def wrenches(drift: Triple, spins: tuple[Triple, Triple]) -> Float[Array, "9 n"]:
        return pair.wrenches(drift, spins, gradient)

    def along(unit: Float[Array, "9"]) -> Float[Array, "9 n"]:
        drift, first, second = (Triple.of(unit[k : k + 3, None] + like) for k in (0, 3, 6))
        return jax.jvp(wrenches, given, (drift, (first, second)))[1]

    # One program for all nine columns, though a velocity turns nothing: three times the size would compile
    # for longer than it saves.
    found = jax.vmap(along)(jnp.eye(9, dtype=like.dtype))
    every = found[PLACES][:, PLACES] * BY_TWIST[:, None, None] * OF_WRENCH[:, None]
    return jnp.moveaxis(every, (2, 1, 0), (0, 1, 2)).reshape(-1, 2, 1, 6, 2, 1, 6)
