"""The bodies of a tennis player, and the angles of their joints at the key poses of a forehand."""

from dataclasses import dataclass
from typing import Any

import numpy as np

MASS = 80.0
"""Of the player [kg]."""

TIMES = np.array([0.0, 1.1, 1.8, 2.0, 2.3, 3.0])
"""Of the key poses [s]: ready, backswing, start of the swing, impact, follow-through, end."""

IMPACT = 3
"""Number of that pose."""

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
