"""Six rods on stiff springs, swinging slowly: a stiff problem, data in the format of `open_tree`.

The first rod hangs on the ground by a ball joint, each other one by a spring from the end of the one above to
its own. They hang straight down and turn as a whole at the start. The springs are stretched then as that
motion wants, and as it is even in time (run back and mirrored it is the same) so is their stretch: the fast
modes, up to 3.1 kHz, stay at rest but for terms of higher order.
"""

from typing import Any

NAME = "stiff_chain"
T_END = 2.0  # [s]
GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]
MOTORS = ()
SPIN = (0.0, 2.0, 3.0)  # [rad/s], about the ball joint: swing and turn of the rods about themselves
STIFFNESS = 1e8  # [N/m], of a steel rod of 8 mm and 0.1 m

_MASS, _LENGTH, _GAP = 1.0, 0.2, 0.1  # [kg], [m], [m]


def _rod(number) -> dict[str, Any]:
    """A rod of 0.2 m; only the first has a joint."""
    top = -number * (_LENGTH + _GAP)
    com = (0.0, 0.0, top - _LENGTH / 2)
    return dict(
        name=f"rod_{number + 1}",
        mass=_MASS,
        inertia=(4e-3, 4e-3, 1e-3),
        com=com,
        parent=None,
        joint="free" if number else "spherical",
        point=com if number else (0.0, 0.0, 0.0),
        axes=(),
        stiffness=0.0,
        damping=0.0,
        angular_velocity=SPIN,
    )


BODIES = [_rod(number) for number in range(6)]


def _spring(number) -> dict[str, Any]:
    """From the lower end of one rod to the upper of the next; it carries and turns what hangs below."""
    force = sum(b["mass"] * (-GRAVITY[2] - SPIN[1] ** 2 * b["com"][2]) for b in BODIES[number + 1 :])
    end = -number * (_LENGTH + _GAP) - _LENGTH
    return dict(
        body_a=number,
        point_a=(0.0, 0.0, end),
        body_b=number + 1,
        point_b=(0.0, 0.0, end - _GAP),
        stiffness=STIFFNESS,
        length=_GAP - force / STIFFNESS,
        damping=0.0,
    )


POINT_SPRINGS = [_spring(number) for number in range(5)]
