"""Pendulums and an oscillator: bodies on hinges that are fixed to the ground."""

import numpy as np

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example

GRAVITY = 9.81
"""[m/s^2]"""


def pendulum() -> Example:
    """A bar on a hinge, released horizontally (reference case R16)."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.80665)))
    inertia = (0.04, 0.1, 0.1)
    bar = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=(2, 0, 0), name="bar"))
    scene.add(nc.Revolute(nc.ground, bar, axis=(0, 1, 0), name="hinge"))
    system, state = scene.compile()
    facts = {
        "dofs": 1,
        "centre of mass": {0.5: (1.66080775374, 0, -1.11432383315), 5.0: (-1.99968386888, 0, -0.03555874755)},
    }
    return Example("pendulum", "a bar on a hinge", system, state, 0.01, 500, facts=facts)


def double_pendulum() -> Example:
    """Two uniform rods on hinges, released horizontally (reference case R13)."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    carrier = nc.ground
    for number in range(2):
        place = (float(number), 0, 0)
        # An ideal rod: no inertia about its own axis, which the hinges keep from spinning.
        rod = nc.RigidBody(
            mass=1.0,
            inertia=(0, 1 / 12, 1 / 12),
            com=(0.5, 0, 0),
            position=place,
            name=f"rod {number + 1}",
        )
        body = scene.add(rod)
        scene.add(nc.Revolute(carrier, body, point=place, axis=(0, 1, 0), name=f"hinge {number + 1}"))
        carrier = body
    system, state = scene.compile()
    facts = {
        "dofs": 2,
        "tip": {0.5: (1.2966885362, 0, -1.4057799232), 1.0: (-1.6621151358, 0, -1.0414666372)},
    }
    tip = nc.Point(carrier, (1.0, 0.0, 0.0), local=True)
    return Example(
        "double_pendulum", "two rods on hinges", system, state, 0.005, 400, facts=facts, traces=(tip,)
    )


def torsion_spring() -> Example:
    """A disc on a torsional spring that turns five times each way."""
    inertia, stiffness, turns = 2.0, 8.0, 5.0
    rate = np.sqrt(stiffness / inertia)
    amplitude = 2 * np.pi * turns
    scene = nc.Scene()
    disc = nc.RigidBody(
        mass=3.0, inertia=(1, 1, inertia), angular_velocity=(0, 0, rate * amplitude), name="disc"
    )
    hinge = scene.add(nc.Revolute(nc.ground, scene.add(disc), name="hinge"))
    scene.add(nc.JointSpring(hinge, stiffness=stiffness, name="spring"))
    system, state = scene.compile()
    facts = {"dofs": 1, "amplitude": amplitude, "angular frequency": rate}
    dt = 2 * np.pi / rate / 200
    return Example(
        "torsion_spring", "a disc on a torsional spring", system, state, float(dt), 400, facts=facts
    )
