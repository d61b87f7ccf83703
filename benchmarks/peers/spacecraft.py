"""The free-floating spacecraft with three motor-driven wheels (paper, 8.1, table 1): data and exact solution.

Same format as `open_tree` (SI units); the joint "free" leaves the base unconstrained. A motor turns its wheel
with a constant torque and the base with the opposite one. At rest at t = 0.
"""

import numpy as np

NAME = "spacecraft"
T_END = 5.0  # [s]
GRAVITY = (0.0, 0.0, 0.0)  # [m/s2]
POINT_SPRINGS = ()

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def _inertia(euler):
    """Principal inertia [kg m2] from the diagonal of the Euler tensor, the integral of x x^T dm [kg m2]."""
    return (euler[1] + euler[2], euler[0] + euler[2], euler[0] + euler[1])


def _wheel(name, distance, axis, euler):
    """A wheel on a revolute joint at `distance` [m] from the centre of the base along `axis`."""
    centre = tuple(distance * x for x in axis)
    return dict(
        name=name,
        mass=424.1150,
        inertia=_inertia(euler),
        com=centre,
        parent=0,
        joint="revolute",
        point=centre,
        axes=(axis,),
        stiffness=0.0,
        damping=0.0,
    )


BODIES = [
    dict(
        name="base",
        mass=1005.3096,
        inertia=_inertia((89.3609, 201.0619, 357.4434)),
        com=(0.0, 0.0, 0.0),
        parent=None,
        joint="free",
        point=(0.0, 0.0, 0.0),
        axes=(),
        stiffness=0.0,
        damping=0.0,
    ),
    _wheel("wheel_1", 0.9167, _X, (8.8357, 106.0288, 106.0288)),
    _wheel("wheel_2", 1.25, _Y, (106.0288, 8.8357, 106.0288)),
    _wheel("wheel_3", 1.5833, _Z, (106.0288, 106.0288, 8.8357)),
]
MOTORS = ((1, 200.0), (2, 200.0), (3, 200.0))


def exact_state(time: float) -> dict:
    """The exact solution, in closed form.

    The wheels are symmetric about their axles, so the inertia of the craft is constant in the base, and the
    angular momentum stays zero. Without it there are no gyroscopic terms: wheel k has the axial momentum
    u_k t, and the base turns about a fixed axis at a rate proportional to t. (A code in minimal coordinates
    therefore finds energy and rates almost exactly at any step size; the orientation tells such codes apart.)

    Args:
        time: [s].

    Returns:
        kinetic_energy [J], base_angular_velocity [rad/s], base_rotation (3, 3), base_position [m].
    """
    masses = np.array([body["mass"] for body in BODIES])
    places = np.array([body["com"] for body in BODIES])
    centre = masses @ places / masses.sum()
    total = np.zeros((3, 3))
    for body, mass, place in zip(BODIES, masses, places - centre, strict=True):
        total += np.diag(body["inertia"]) + mass * (place @ place * np.eye(3) - np.outer(place, place))
    axial = np.array([body["inertia"][k] for k, body in enumerate(BODIES[1:])])
    momentum = np.array([torque for _, torque in MOTORS]) * time
    rate = -np.linalg.solve(total - np.diag(axial), momentum)
    kinetic = 0.5 * rate @ (total - np.diag(axial)) @ rate + 0.5 * np.sum(momentum**2 / axial)
    speed = np.linalg.norm(rate)
    axis, angle = rate / speed if speed else rate, 0.5 * speed * time
    skew = np.cross(np.eye(3), axis)  # skew @ x = axis x x
    turn = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    return {
        "kinetic_energy": float(kinetic),
        "base_angular_velocity": rate.tolist(),
        "base_rotation": turn.tolist(),
        "base_position": (centre - turn @ centre).tolist(),
    }
