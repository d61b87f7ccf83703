"""A tennis player of nineteen rigid bodies whose joints are driven through a forehand."""

from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields
from natcoord_jax.gallery.segments import IMPACT, MASS, SEGMENTS, TIMES, Segment, X, Y, Z
from natcoord_jax.maths.rotations import from_axis_angle


class Swing(eqx.Module):
    """Polynomials of degree five through key poses, with second derivatives that are zero at each.

    Attributes:
        values: at `TIMES` [rad or m].
        rates: there [rad/s or m/s].
        offset: value of the assembled pose, from which coordinates count.
    """

    values: Float[Array, " poses"] = eqx.field(converter=lambda x: jnp.asarray(x, float))
    rates: Float[Array, " poses"] = eqx.field(converter=lambda x: jnp.asarray(x, float))
    offset: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, float))

    def with_impact(self, value: Any = 0.0, rate: Any = 0.0) -> "Swing":
        """With so much more of the coordinate and its rate at the impact."""
        at = np.arange(len(TIMES)) == IMPACT
        return Swing(self.values + value * at, self.rates + rate * at, self.offset)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The coordinate."""
        times = jnp.asarray(TIMES)
        k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(TIMES) - 2)
        span = times[k + 1] - times[k]
        s = jnp.clip((t - times[k]) / span, 0.0, 1.0)
        rise = s**3 * (10 - 15 * s + 6 * s**2)
        ahead, behind = s - s**3 * (6 - 8 * s + 3 * s**2), -(s**3) * (4 - 7 * s + 3 * s**2)
        place = self.values[k] + (self.values[k + 1] - self.values[k]) * rise
        return place + span * (ahead * self.rates[k] + behind * self.rates[k + 1]) - self.offset


Motion = dict[tuple[str, int], Swing]
"""Coordinates of joints by segment and number."""


def rates_at_poses(values: Float[np.ndarray, " poses"]) -> Float[np.ndarray, " poses"]:
    """Slopes of a smooth curve through key poses; zero at both ends."""
    spans = np.diff(TIMES)
    slopes = np.diff(values) / spans
    inner = (spans[1:] * slopes[:-1] + spans[:-1] * slopes[1:]) / (spans[1:] + spans[:-1])
    return np.concatenate([[0.0], inner, [0.0]])


def swings() -> Motion:
    """Of every coordinate, by segment and number."""
    return {
        (name, k): Swing(row, rates_at_poses(np.asarray(row, float)), 0.0)
        for name, segment in SEGMENTS.items()
        for k, row in enumerate(segment.angles)
    }


class Placement(eqx.Module):
    """How a body has moved from where it stands upright: x -> rotation x + shift."""

    rotation: Float[Array | np.ndarray, "3 3"]
    shift: Float[Array | np.ndarray, "3"]

    def __call__(self, x: Any) -> Any:
        """Place of a point."""
        return self.rotation @ np.asarray(x, float) + self.shift


def placed_by(motion: Motion, t: Float[Array, ""]) -> dict[str, Placement]:
    """Of all segments at a time [s], as a motion has it: forward kinematics."""
    found: dict[str, Placement] = {}
    for name, segment in SEGMENTS.items():
        q = [motion[name, k](t) for k in range(len(segment.angles))]
        start = np.asarray(segment.start, float)
        if segment.parent == "ground":
            rotation = from_axis_angle(jnp.asarray(Z), q[2])
            found[name] = Placement(rotation, start - rotation @ start + q[0] * X + q[1] * Y)
            continue
        above = found[segment.parent]
        rotation = above.rotation
        for axis, angle in zip(segment.axes, q):
            rotation = rotation @ from_axis_angle(jnp.asarray(axis), angle)
        found[name] = Placement(rotation, above(start) - rotation @ start)
    return found


_placed_by = eqx.filter_jit(placed_by)


def placements(t: float) -> dict[str, Placement]:
    """Of all segments at a time [s] of the forehand, in numbers."""
    return jax.tree.map(np.asarray, _placed_by(swings(), jnp.asarray(t, float)))


def twist_of(name: str, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity at the origin [m/s] and angular velocity [rad/s] of a segment at a time [s], to 1e-8."""
    step = 1e-5
    before, here, after = (placements(t + dt)[name] for dt in (-step, 0.0, step))
    turning = (after.rotation - before.rotation) @ here.rotation.T / (2 * step)
    spin = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
    speed = np.asarray(after.shift - before.shift) / (2 * step)
    return speed - np.cross(spin, np.asarray(here.shift)), spin


@dataclass(frozen=True)
class Player:
    """Handles of a player.

    Attributes:
        bodies: by name.
        drives: by name and number of the coordinate.
        placed: where the bodies are at the start.
    """

    bodies: dict[str, Any]
    drives: dict[tuple[str, int], Any] = field(default_factory=dict)
    placed: dict[str, Placement] = field(default_factory=dict)


def add_player(scene: nc.Scene, start: float = 0.0) -> Player:
    """Add the bodies as they are at a time [s] of the forehand, their joints and drives."""
    placed, motion = placements(start), swings()
    player = Player({"ground": nc.ground}, {}, placed)
    for name, segment in SEGMENTS.items():
        body = scene.add(_body(name, segment, placed[name]))
        player.bodies[name] = body
        parent = player.bodies[segment.parent]
        joint = scene.add(_joint(name, segment, placed, parent, body))
        for k in range(len(segment.angles)):
            from_here = replace_fields(motion[name, k], offset=motion[name, k](jnp.asarray(start)))
            drive = nc.Drive(joint, function=from_here, coordinate=k, name=f"{name} drive {k + 1}")
            player.drives[name, k] = scene.add(drive)
    return player


def _body(name: str, segment: Segment, placed: Placement) -> Any:
    """One of the bodies, its third axis along it."""
    start, end = np.asarray(segment.start, float), np.asarray(segment.end, float)
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    across = np.cross(along, X if abs(along[0]) < 0.9 else Y)
    across = across / np.linalg.norm(across)
    frame = np.stack([across, np.cross(along, across), along], axis=1)
    mass = segment.mass * MASS
    thick = min(segment.radius, 0.45 * length)
    return nc.RigidBody(
        mass=mass,
        inertia=mass * (length * np.asarray(segment.gyration)) ** 2,
        position=placed(start + segment.centre * (end - start)),
        orientation=placed.rotation @ frame,
        shape=nc.Sphere(0.11) if name == "head" else nc.Capsule(radius=thick, length=length - thick),
        name=name,
    )


def _joint(name: str, segment: Segment, placed: dict[str, Placement], parent: Any, body: Any) -> Any:
    """The joint of a segment: in the plane of the floor, a hinge, or two axes that cross."""
    point, named = placed[name](segment.start), {"name": f"{name} joint"}
    if segment.parent == "ground":
        return nc.Planar(parent, body, point=point, axis=Z, second=X, **named)
    axis = placed[segment.parent].rotation @ segment.axes[0]
    if len(segment.axes) == 1:
        return nc.Revolute(parent, body, point=point, axis=axis, **named)
    second = placed[name].rotation @ segment.axes[1]
    return nc.Universal(parent, body, point=point, axis=axis, second=second, **named)
