"""A shot: a racket on a driven hand hits a ball, which lands where the swing makes it."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.bodies.mesh_handle import MeshHandle
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.gallery.racket import (
    RADIUS,
    SEMI_AXES,
    THICKNESS,
    Racket,
    add_ball,
    add_racket,
    clamped_racket,
    inflated_ball,
    with_part,
)
from natcoord_jax.maths.rotations import from_rotation_vector

GRIP, THROAT = np.array([0.0, 0.45, 1.0]), np.array([0.0, 0.17, 1.0])
"""Of the racket, whose head is about a point one metre above the origin [m]."""

AHEAD, TURNING = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
"""Direction of the swing, and the axis about which an open face turns upwards."""

CLEARANCE = 0.005
"""Between ball and strings at the start [m]."""

GRAVITY = 9.81
"""[m/s^2]; in the few milliseconds of the impact there is none."""

STEP, STEPS = 1e-4, 90
"""Of the impact [s]: six milliseconds, and what the ball needs to get there and away."""


class Steadily(eqx.Module):
    """A coordinate that changes steadily.

    Attributes:
        start: where it starts [m or rad].
        rate: [m/s or rad/s].
    """

    start: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, float))
    rate: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, float))

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The coordinate."""
        return self.start + self.rate * t


@dataclass(frozen=True)
class Shot:
    """A racket and a ball that comes, and what becomes of it with a swing.

    A swing is the speed of the racket [m/s] and the angle by which its face is open [rad].

    Attributes:
        system: compiled system.
        state: at the start, the face upright and at rest.
        ball: its handle.
        racket: its handles.
    """

    system: nc.System
    state: nc.State
    ball: MeshHandle
    racket: Racket

    def started(self, swing: Float[Array, "2"]) -> tuple[nc.System, nc.State]:
        """System and state of a swing, which moves as a rigid body at first."""
        speed, angle = swing
        names = self.system.structure.bodies
        balls = {node.name for node in self.ball.nodes}
        swung = np.array([name not in balls for name in names])[:, None, None]
        turned = np.array([name not in balls | {"carriage"} for name in names])[:, None, None]
        # Places turn about the grip, directors about themselves.
        about = np.zeros((4, 3))
        about[0] = GRIP
        rows = self.state.rows
        turn = from_rotation_vector(angle * TURNING)
        q = jnp.where(turned, (rows - about) @ turn.T + about, rows)
        ahead = np.zeros((4, 3))
        ahead[0] = AHEAD
        v = jnp.where(swung, speed * ahead, self.state.row_rates)
        system = self.system.set("swing", **{"function.rate": speed})
        system = system.set("face", **{"function.start": angle})
        # Of the slider and the hinge.
        found = {"q": q.reshape(-1, 3), "v": v.reshape(-1, 3), "coordinates": jnp.stack([0.0 * angle, angle])}
        return system, replace_fields(self.state, **found)

    def run(self, swing: Float[Array, "2"], **options: Any) -> nc.Trajectory:
        """The impact; `options` go to `nc.simulate`."""
        return nc.simulate(*self.started(swing), dt=STEP, steps=STEPS, **options)

    def flight(self, trajectory: nc.Trajectory) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Place [m] and velocity [m/s] of the centre of mass of the ball after the impact."""
        numbers = np.array([self.system.body_index(node) for node in self.ball.nodes])
        mass = self.system.mass[numbers, 0, 0]
        share = mass / jnp.sum(mass)
        return share @ trajectory.q[-1][4 * numbers], share @ trajectory.states.v[-1][4 * numbers]

    def landing(self, swing: Float[Array, "2"]) -> Float[Array, "2"]:
        """Where the ball lands ahead of the racket [m] and how fast [m/s], without drag of the air."""
        place, velocity = self.flight(self.run(swing, throw=False))
        rise = velocity[2]
        fall = jnp.sqrt(rise**2 + 2 * GRAVITY * place[2])
        speed = jnp.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + fall**2)
        return jnp.stack([place[0] + velocity[0] * (rise + fall) / GRAVITY, speed])


def shot(count: int = 2, incoming: float = 15.0) -> Shot:
    """A ball that comes to a racket on a hand, which is driven along a line with an open face.

    Args:
        count: of cells of the ball along each edge of the cube that its mesh is made of.
        incoming: speed of the ball [m/s].
    """
    scene = nc.Scene()
    solid = {"mass": 0.5, "inertia": (5e-4,) * 3, "position": GRIP}
    carriage = scene.add(nc.RigidBody(**solid, name="carriage"))
    hand = scene.add(nc.RigidBody(**solid, name="hand"))
    slider = scene.add(nc.Prismatic(nc.ground, carriage, point=GRIP, axis=AHEAD))
    hinge = scene.add(nc.Revolute(carriage, hand, point=GRIP, axis=TURNING))
    scene.add(nc.Drive(slider, function=Steadily(0.0, 0.0), name="swing"))
    scene.add(nc.Drive(hinge, function=Steadily(0.0, 0.0), name="face"))
    racket = add_racket(scene, hand, np.asarray, GRIP, THROAT, (0, 0, 1))
    place = THROAT - np.array([0.0, SEMI_AXES[0], 0.0]) + (RADIUS + 0.5 * THICKNESS + CLEARANCE) * AHEAD
    ball = add_ball(scene, count, position=place)
    given = {"stiffness": 1e5, "candidates": 9, "one_pass": True}
    scene.add(nc.Contact(ball.surface("outside"), racket.bed, name="impact", **given))
    system, state = scene.compile()
    parts = (
        clamped_racket(np.asarray, GRIP, THROAT, (0, 0, 1)),
        inflated_ball(count, place, -incoming * AHEAD),
    )
    for part in parts:
        state = with_part(state, system, part)
    return Shot(system, state, ball, racket)
