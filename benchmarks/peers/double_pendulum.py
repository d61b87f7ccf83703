"""Two uniform rods on hinges, released horizontally (reference case R13): data as in `open_tree`."""

NAME = "double_pendulum"
T_END = 1.0  # [s]
GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]
POINT_SPRINGS = ()
MOTORS = ()


def _rod(number):
    """Not ideal: codes refuse bodies without inertia about an axis. The motion is plane."""
    return dict(
        name=f"rod_{number + 1}",
        mass=1.0,
        inertia=(1e-3, 1 / 12, 1 / 12),
        com=(number + 0.5, 0.0, 0.0),
        parent=number - 1 if number else None,
        joint="revolute",
        point=(float(number), 0.0, 0.0),
        axes=((0.0, 1.0, 0.0),),
        stiffness=0.0,
        damping=0.0,
    )


BODIES = [_rod(0), _rod(1)]
