"""Optimal control with a flexible body: an arm brings the plug of a cable to its socket.

Three links in a horizontal plane, moved by motors. From the plug a cable runs in half a circle to a clamp.
The plug goes from rest to rest, to another place and angle, by least effort and such that the cable hangs
there as it does in equilibrium, and at rest.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.state import State
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.panel_slew import Still
from natcoord_jax.system import System

UPPER, FORE = 0.4, 0.35
"""Lengths of the links [m]."""
TIP = 0.1
"""From wrist to the end of the plug [m]."""
START = (0.7, -0.8)
"""Directions of the links at the start [rad]; the plug's is 0."""
RADIUS = 0.2
"""Of the cable's half circle [m]."""
SOCKET = (0.06, -0.1, -0.3)
"""Where the plug goes from its start: place [m], angle [rad]."""
STAGES = 10
"""Parts in which the arm moves to the socket while equilibria are followed."""


def _turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


ELBOW = _turned(START[0]) @ [UPPER, 0.0, 0.0]
WRIST = ELBOW + _turned(START[1]) @ [FORE, 0.0, 0.0]


def joint_angles() -> Float[np.ndarray, "3"]:
    """Coordinates of shoulder, elbow and wrist with the plug in its socket [rad]."""
    x, y, angle = SOCKET
    wrist = WRIST + [TIP + x, y, 0.0] - _turned(angle) @ [TIP, 0.0, 0.0]
    reach = np.hypot(wrist[0], wrist[1])
    elbow = -np.arccos((reach**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE))
    shoulder = np.arctan2(wrist[1], wrist[0]) - np.arctan2(FORE * np.sin(elbow), UPPER + FORE * np.cos(elbow))
    first, second = START
    return np.array([shoulder - first, elbow - (second - first), angle - (shoulder + elbow) + second])


class Arm(NamedTuple):
    """The arm with its cable."""

    system: System
    state: State
    joints: list[Handle]
    cable: nc.BeamHandle


def arm(elements: int = 3, *, driven: bool = False, stiffness: Any = 0.03) -> Arm:
    """The scene; its joints have motors, or drives that bring the plug to the socket within a second.

    Args:
        elements: of the cable.
        driven: whether joints are driven.
        stiffness: of the cable against bending and torsion [N m^2].
    """
    scene = nc.Scene()
    bodies = [
        scene.add(
            nc.RigidBody(
                mass=m,
                inertia=inertia,
                com=com,
                position=at,
                orientation=o,
                shape=nc.Box((2 * com[0], 0.05, 0.05)),  # drawn more slender than its inertia says
                name=name,
            )
        )
        for name, m, inertia, com, at, o in (
            ("upper arm", 3.0, (0.01, 0.05, 0.05), (UPPER / 2, 0, 0), np.zeros(3), _turned(START[0])),
            ("forearm", 2.0, (0.01, 0.03, 0.03), (FORE / 2, 0, 0), ELBOW, _turned(START[1])),
            ("plug", 0.8, (5e-3, 5e-3, 5e-3), (0.04, 0, 0), WRIST, np.eye(3)),
        )
    ]
    places = (("shoulder", np.zeros(3)), ("elbow", ELBOW), ("wrist", WRIST))
    angles = joint_angles()
    joints = []
    for k, (name, place) in enumerate(places):
        parent = bodies[k - 1] if k else nc.ground
        joint = scene.add(nc.Revolute(parent, bodies[k], point=place, axis=(0, 0, 1), name=name))
        if driven:
            scene.add(nc.Drive(joint, function=lambda t, k=k: t * angles[k], name=f"drive of {name}"))
        else:
            scene.add(nc.JointTorque(joint, name=f"motor of {name}"))
        joints.append(joint)
    section = nc.Section.of_numbers(EA=100.0, GA=100.0, EI=stiffness, GJ=stiffness, density=0.35, rotary=5e-4)
    middle = WRIST + [TIP, -RADIUS, 0.0]

    def half_circle(s: Array) -> Array:
        return jnp.asarray(middle) + RADIUS * jnp.array([jnp.sin(s / RADIUS), jnp.cos(s / RADIUS), 0.0])

    cable = scene.add(
        nc.Beam(
            section,
            half_circle,
            length=RADIUS * np.pi,
            elements=elements,
            start=bodies[-1],
            end=nc.ground,
            damping=0.005,
            name="cable",
        )
    )
    # The drives go at constant speed, of which a load path sees the places only.
    return Arm(*scene.compile(assemble=driven), joints, cable)


class Hanging(Still):
    """Nodes of the cable at given places and rest, in the plane; both in [m]."""

    def residual(self, system: System, state: State) -> Float[Array, " c"]:
        """Two of three components."""
        return super().residual(system, state).reshape(-1, 3)[:, :2].reshape(-1)


def problem(
    steps: int = 40, *, t_end: float = 1.0, elements: int = 3, weight: float = 20.0
) -> nc.OptimalControl:
    """Least effort from rest to rest, the plug in its socket.

    Args:
        steps: of the motion.
        t_end: its time [s].
        elements: of the cable.
        weight: of what the cable is away from its equilibrium at the end [N^2 m^2 s/m^2].
    """
    free, driven = arm(elements), arm(elements, driven=True)
    stages = jnp.linspace(1.0 / STAGES, 1.0, STAGES)
    rest = nc.equilibrium(driven.system, driven.state, stages).state
    there = nc.transfer(driven.system, rest, free.system, onto=free.state)[1]
    rows = tuple(4 * free.system.body_index(node) for node in free.cable.nodes[1:-1])
    hanging = Hanging(there.q[np.array(rows)], rows)
    goals = [nc.goal.Coordinate(joint, angle) for joint, angle in zip(free.joints, joint_angles())]
    goal = goals[0] & goals[1] & goals[2]
    for joint in free.joints:
        goal = goal & nc.goal.Rate(joint)
    return nc.OptimalControl(
        free.system,
        free.state,
        dt=t_end / steps,
        steps=steps,
        cost=nc.cost.Effort() + nc.cost.Missed(hanging, weight=weight),
        goal=goal,
    )


def along_a_smooth_path(problem: nc.OptimalControl) -> Float[Array, "steps inputs"]:
    """Torques that bring the plug to its socket with joint angles that are polynomials of time [N m]."""
    x = np.linspace(0.0, 1.0, problem.steps + 1)[1:, None]
    path = (10 * x**3 - 15 * x**4 + 6 * x**5) * joint_angles()
    return nc.inverse_dynamics(problem.system, problem.state, path, dt=problem.dt)[0]


def plugging(elements: int = 3) -> Example:
    """Least-effort motion of an arm that plugs in a flexible cable, which is at rest at the end.

    Args:
        elements: of the cable.
    """
    free = arm(elements)
    return Example(
        name="plugging",
        description="an arm plugs in a flexible cable by least effort",
        system=free.system,
        state=free.state,
        dt=0.025,
        steps=40,
        facts={"dofs": 3 + 6 * (elements - 1)},
        problem=lambda steps, dt: problem(steps, t_end=steps * dt, elements=elements),
        guess=along_a_smooth_path,
        beams=(free.cable,),
    )
