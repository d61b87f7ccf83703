"""A tennis player of nineteen rigid bodies whose joints are driven through a forehand."""

from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.effect import replace_fields

MASS = 80.0
"""Of the player [kg]."""

TIMES = np.array([0.0, 1.1, 1.8, 2.0, 2.3, 3.0])
"""Of the key poses [s]: ready, backswing, start of the swing, impact, follow-through, end."""

X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Segment:
    """A body of the player, standing upright with the arms stretched out sideways.

    Masses, centres and radii of gyration are those of P. de Leva, J. Biomech. 29 (1996) 1223, of men; neck
    and toes are taken from head and feet, and the trunk is split into three.

    Attributes:
        parent: name of the body that it hangs on.
        start: where its joint is [m].
        end: where it ends [m].
        mass: part of the whole [-].
        centre: of mass, as a part of the way from start to end [-].
        gyration: radii about two axes across it and the one along it, as parts of its length [-].
        axes: of the joint: none is that of the ground; the second one of two is fixed in the segment.
        angles: of the joint at the key poses [rad], one row for each axis.
        radius: for pictures [m].
    """

    parent: str
    start: tuple[float | int, ...]
    end: tuple[float | int, ...]
    mass: float
    centre: float
    gyration: tuple[float | int, ...]
    axes: tuple[Any, ...]
    angles: Any
    radius: float


def _still(*angles: float) -> tuple[tuple[float, ...], ...]:
    """Angles that stay."""
    return tuple((angle,) * len(TIMES) for angle in angles)


TRUNK, UPPER_ARM, FOREARM, HAND = (
    (0.328, 0.306, 0.169),
    (0.285, 0.269, 0.158),
    (0.276, 0.265, 0.121),
    (0.628, 0.513, 0.401),
)
THIGH, SHANK, FOOT, HEAD = (
    (0.329, 0.329, 0.149),
    (0.251, 0.246, 0.102),
    (0.257, 0.245, 0.124),
    (0.303, 0.315, 0.261),
)

PELVIS = (
    (0.0, -0.05, 0.0, 0.15, 0.3, 0.35),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (-0.3, -0.9, -0.85, -0.1, 0.4, 0.1),
)
"""Displacements forward and to the left [m], and the angle of the lower trunk about the vertical [rad]."""


def _leg(side: str, y: float, hip: tuple[float, float], knee: float) -> dict[str, Segment]:
    """Thigh, shank, foot and toes."""
    return {
        f"{side} thigh": Segment(
            "lower trunk", (0, y, 0.95), (0, y, 0.52), 0.1416, 0.4095, THIGH, (Y, X), _still(*hip), 0.07
        ),
        f"{side} shank": Segment(
            f"{side} thigh", (0, y, 0.52), (0, y, 0.1), 0.0433, 0.4395, SHANK, (Y,), _still(knee), 0.05
        ),
        f"{side} foot": Segment(
            f"{side} shank", (0, y, 0.1), (0.16, y, 0.04), 0.0117, 0.4415, FOOT, (Y,), _still(-0.2), 0.035
        ),
        f"{side} toes": Segment(
            f"{side} foot", (0.16, y, 0.04), (0.23, y, 0.03), 0.002, 0.5, FOOT, (Y,), _still(0.0), 0.025
        ),
    }


def _arm(side: str, sign: float, angles: dict[str, Any]) -> dict[str, Segment]:
    """Upper arm, forearm and hand, stretched out."""
    a, b, c, d = ((0.0, sign * y, 1.42) for y in (0.2, 0.5, 0.76, 0.86))
    return {
        f"{side} upper arm": Segment(
            "upper trunk", a, b, 0.0271, 0.5772, UPPER_ARM, (Z, X), angles["shoulder"], 0.045
        ),
        f"{side} forearm": Segment(
            f"{side} upper arm", b, c, 0.0162, 0.4574, FOREARM, (Z, Y), angles["elbow"], 0.035
        ),
        f"{side} hand": Segment(f"{side} forearm", c, d, 0.0061, 0.79, HAND, (Z, X), angles["wrist"], 0.03),
    }


SWING = {
    "shoulder": ((0.8, -0.3, -0.35, 0.3, 1.3, 0.9), (0.9, 0.6, 0.75, 0.5, 0.1, 0.7)),
    "elbow": ((1.2, 0.7, 0.8, 0.35, 1.0, 1.2), (0.0, -0.1, -0.2, -0.25, -0.4, 0.0)),
    "wrist": ((-0.2, -0.8, -1.0, -0.5, 0.3, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
}
"""Of the arm with the racket: forwards and down, forwards and turning, forwards and down."""

BALANCE = {
    "shoulder": ((-0.8, -1.2, -0.9, 0.2, 0.1, -0.5), (-0.7, -0.2, -0.3, -0.9, -1.1, -0.9)),
    "elbow": ((-1.0, -0.3, -0.5, -1.2, -1.3, -1.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "wrist": _still(0.0, 0.0),
}
"""Of the other one."""

SEGMENTS: dict[str, Segment] = {
    "lower trunk": Segment("ground", (0, 0, 0.92), (0, 0, 1.06), 0.1117, 0.5, TRUNK, (), PELVIS, 0.13),
    "middle trunk": Segment(
        "lower trunk", (0, 0, 1.06), (0, 0, 1.24), 0.1633, 0.5, TRUNK, (Z,),
        ((0.0, -0.25, -0.25, 0.0, 0.2, 0.1),), 0.12,
    ),
    "upper trunk": Segment(
        "middle trunk", (0, 0, 1.24), (0, 0, 1.48), 0.1596, 0.5, TRUNK, (Z, Y),
        ((0.0, -0.35, -0.35, 0.05, 0.3, 0.1), (0.15, 0.1, 0.1, 0.1, 0.1, 0.15)), 0.14,
    ),
    "neck": Segment(
        "upper trunk", (0, 0, 1.48), (0, 0, 1.56), 0.0094, 0.5, HEAD, (Z,),
        ((0.15, 0.7, 0.7, 0.0, -0.4, -0.1),), 0.05,
    ),
    "head": Segment(
        "neck", (0, 0, 1.56), (0, 0, 1.8), 0.06, 0.5002, HEAD, (Z, Y),
        ((0.15, 0.75, 0.7, 0.05, -0.4, -0.1), (-0.1, 0.0, 0.0, 0.0, 0.0, -0.1)), 0.09,
    ),
    **_arm("right", -1.0, SWING),
    **_arm("left", 1.0, BALANCE),
    **_leg("right", -0.1, (0.25, 0.2), 0.35),
    **_leg("left", 0.1, (-0.45, -0.2), 0.4),
}  # fmt: skip


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


def rates_at_poses(values: Float[np.ndarray, " poses"]) -> Float[np.ndarray, " poses"]:
    """Slopes of a smooth curve through key poses; zero at both ends."""
    spans = np.diff(TIMES)
    slopes = np.diff(values) / spans
    inner = (spans[1:] * slopes[:-1] + spans[:-1] * slopes[1:]) / (spans[1:] + spans[:-1])
    return np.concatenate([[0.0], inner, [0.0]])


def swings() -> dict[tuple[str, int], Swing]:
    """Of every coordinate, by segment and number."""
    return {
        (name, k): Swing(row, rates_at_poses(np.asarray(row, float)), 0.0)
        for name, segment in SEGMENTS.items()
        for k, row in enumerate(segment.angles)
    }


def turned(axis: np.ndarray, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about a unit axis (Rodrigues)."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@dataclass(frozen=True)
class Placement:
    """How a body has moved from where it stands upright: x -> rotation x + shift."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, x: Any) -> np.ndarray:
        """Place of a point."""
        return self.rotation @ np.asarray(x, float) + self.shift


def placements(t: float) -> dict[str, Placement]:
    """Of all segments at a time [s]: forward kinematics."""
    found: dict[str, Placement] = {}
    motion = swings()
    for name, segment in SEGMENTS.items():
        q = [float(motion[name, k](jnp.asarray(t))) for k in range(len(segment.angles))]
        start = np.asarray(segment.start, float)
        if segment.parent == "ground":
            rotation = turned(Z, q[2])
            found[name] = Placement(rotation, start - rotation @ start + np.array([q[0], q[1], 0.0]))
            continue
        above = found[segment.parent]
        turn = np.linalg.multi_dot([np.eye(3), *(turned(a, x) for a, x in zip(segment.axes, q)), np.eye(3)])
        rotation = above.rotation @ turn
        found[name] = Placement(rotation, above(start) - rotation @ start)
    return found


def twist_of(name: str, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity at the origin [m/s] and angular velocity [rad/s] of a segment at a time [s], to 1e-8."""
    step = 1e-5
    before, here, after = (placements(t + dt)[name] for dt in (-step, 0.0, step))
    turning = (after.rotation - before.rotation) @ here.rotation.T / (2 * step)
    spin = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
    return (after.shift - before.shift) / (2 * step) - np.cross(spin, here.shift), spin


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
