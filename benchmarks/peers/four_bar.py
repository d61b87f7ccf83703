"""A row of two four-bars that passes a singular configuration (reference case R04): data as in `open_tree`.

Three uprights turn on the ground, two bars join their tips; all move in the plane across z, at 1 m/s at the
tips at the start. As a tree a bar hangs on the upright to its left; the hinges to its right close the loops.
`velocity` [m/s] is that of the centre of mass at the start, `angular_velocity` [rad/s] that of the body.

A closing joint is a dict with kind, body_a, body_b (indices into BODIES, None: the ground), point [m] and
axes as for the joint of a body, and `independent`: which of the constraints, three translations and three
rotations in a frame whose third axis is that of the hinge, are left when the redundant ones are dropped.
"""

NAME = "four_bar"
T_END = 2.0  # [s]
GRAVITY = (0.0, -9.81, 0.0)  # [m/s2]
POINT_SPRINGS = ()
MOTORS = ()

_SPEED = 1.0  # [m/s] of the tips
_AXIS = (0.0, 0.0, 1.0)


def _rod(name, inertia, com, parent, point, velocity, rate):
    """A uniform rod of 1 kg and 1 m."""
    return dict(
        name=name,
        mass=1.0,
        inertia=inertia,
        com=com,
        parent=parent,
        joint="revolute",
        point=point,
        axes=(_AXIS,),
        stiffness=0.0,
        damping=0.0,
        velocity=velocity,
        angular_velocity=(0.0, 0.0, rate),
    )


def _upright(number):
    """Not ideal: codes refuse bodies without inertia about an axis. The motion is plane."""
    x = float(number)
    inertia, velocity = (1 / 12, 1e-3, 1 / 12), (_SPEED / 2, 0.0, 0.0)
    return _rod(f"upright_{number}", inertia, (x, 0.5, 0.0), None, (x, 0.0, 0.0), velocity, -_SPEED)


def _bar(number):
    """It moves without turning."""
    x = float(number)
    inertia, velocity = (1e-3, 1 / 12, 1 / 12), (_SPEED, 0.0, 0.0)
    return _rod(f"bar_{number}", inertia, (x + 0.5, 1.0, 0.0), number, (x, 1.0, 0.0), velocity, 0.0)


def bodies_of(bars):
    """The uprights, then the bars."""
    return [_upright(k) for k in range(bars + 1)] + [_bar(k) for k in range(bars)]


def loops_of(bars):
    """The hinge at the right end of each bar."""
    return [
        dict(
            kind="revolute",
            body_a=k + 1,
            body_b=bars + 1 + k,
            point=(k + 1.0, 1.0, 0.0),
            axes=(_AXIS,),
            independent=(1, 1, 0, 0, 0, 0),
        )
        for k in range(bars)
    ]


BODIES, LOOPS = bodies_of(2), loops_of(2)
