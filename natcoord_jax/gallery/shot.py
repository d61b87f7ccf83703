"""A shot: a player whose swing makes the ball land where it should."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.gallery.player import Motion, placed_by, swings
from natcoord_jax.gallery.segments import SEGMENTS
from natcoord_jax.gallery.tennis import GRAVITY, HAND, HIT, Assembled, assembled
from natcoord_jax.reading.sensors import joint_coordinates

START = HIT - 0.002
"""Of the run [s]."""

STEP, STEPS = 1e-4, 90
"""Of the impact [s]: it lasts some five milliseconds."""

SPEED, FACE, SIDE = ("right upper arm", 0), ("right forearm", 1), ("right hand", 0)
"""Coordinates of joints that a swing changes at the impact: the rate of the shoulder, and two angles."""


@dataclass(frozen=True)
class Shot:
    """A player, a racket and a ball that comes, and what becomes of it with a swing.

    A swing is three coefficients of the splines of the forehand, as changes at the impact: of the rate at
    which the shoulder turns forward [rad/s], and of the angles of forearm and wrist [rad], by which the face
    of the racket opens and turns to the side.

    Attributes:
        before: what is assembled for the forehand as it is.
    """

    before: Assembled

    def started(self, swing: Float[Array, "3"]) -> tuple[nc.System, nc.State]:
        """System and state of a swing; the racket moves with the hand as a rigid body at first."""
        system, forehand = self.before.system, swings()
        motion = forehand | {
            SPEED: forehand[SPEED].with_impact(rate=swing[0]),
            FACE: forehand[FACE].with_impact(swing[1]),
            SIDE: forehand[SIDE].with_impact(swing[2]),
        }
        coordinates = self.before.state.coordinates
        for segment, k in (SPEED, FACE, SIDE):
            of_drive = {f"function.{x}": getattr(motion[segment, k], x) for x in ("values", "rates")}
            system = system.set(f"{segment} drive {k + 1}", **of_drive)
            place = joint_coordinates(system, f"{segment} joint")[1][k]
            change = motion[segment, k](jnp.asarray(START)) - forehand[segment, k](jnp.asarray(START))
            coordinates = coordinates.at[place].add(change)
        q, v = jax.jvp(lambda t: self._rows(motion, t), (jnp.asarray(START),), (jnp.asarray(1.0),))
        # The bodies of the player and the racket, which hits.
        balls = {node.name for node in self.before.ball.nodes}
        hits = np.array([name not in balls for name in system.structure.bodies])[:, None, None]
        found = {
            "q": jnp.where(hits, q, self.before.state.rows).reshape(-1, 3),
            "v": jnp.where(hits, v, self.before.state.row_rates).reshape(-1, 3),
        }
        return system, replace_fields(self.before.state, coordinates=coordinates, **found)

    def _rows(self, motion: Motion, t: Float[Array, ""]) -> Float[Array, "bodies 4 3"]:
        """Rows of all bodies as a motion has them at a time [s]; racket and ball move with the hand."""
        now, names = placed_by(motion, t), [*SEGMENTS]
        turns, shifts = [], []
        for name in names:
            was = self.before.player.placed[name]
            turns.append(now[name].rotation @ was.rotation.T)
            shifts.append(now[name].shift - turns[-1] @ was.shift)
        bodies = self.before.system.structure.bodies
        which = np.array([names.index(name if name in SEGMENTS else HAND) for name in bodies])
        moved = jnp.einsum("bij,brj->bri", jnp.stack(turns)[which], self.before.state.rows)
        return moved.at[:, 0].add(jnp.stack(shifts)[which])

    def run(self, swing: Float[Array, "3"], **options: Any) -> nc.Trajectory:
        """The impact; `options` go to `nc.simulate`."""
        return nc.simulate(*self.started(swing), dt=STEP, steps=STEPS, **options)

    def flight(self, trajectory: nc.Trajectory) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Place [m] and velocity [m/s] of the centre of mass of the ball after the impact."""
        system = self.before.system
        numbers = np.array([system.body_index(node) for node in self.before.ball.nodes])
        mass = system.mass[numbers, 0, 0]
        share = mass / jnp.sum(mass)
        return share @ trajectory.q[-1][4 * numbers], share @ trajectory.states.v[-1][4 * numbers]

    def landing(self, swing: Float[Array, "3"]) -> Float[Array, "3"]:
        """Where the ball lands [m], ahead and to the left, and how fast [m/s], without drag of the air."""
        place, velocity = self.flight(self.run(swing, throw=False))
        rise = velocity[2]
        fall = jnp.sqrt(rise**2 + 2 * GRAVITY * place[2])
        speed = jnp.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + fall**2)
        return jnp.append(place[:2] + velocity[:2] * (rise + fall) / GRAVITY, speed)


def shot(count: int = 2, incoming: float = 15.0) -> Shot:
    """The tennis player of `tennis`, from shortly before the impact on.

    Args:
        count: of cells of the ball along each edge of the cube that its mesh is made of.
        incoming: speed of the ball [m/s].
    """
    return Shot(assembled(count, incoming, START))
