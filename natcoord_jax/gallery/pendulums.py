"""Single bodies that spin, and pendulums and an oscillator on hinges that are fixed to the ground."""

import numpy as np

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example


def heavy_top() -> Example:
    """A fast top on a ball joint under gravity (reference case R01)."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    top = nc.RigidBody(
        mass=15.0,
        inertia=(0.234375, 0.46875, 0.234375),
        com=(0, 1, 0),
        angular_velocity=(0, 150, -4.61538),
        name="top",
    )
    body = scene.add(top)
    scene.add(nc.Spherical(nc.ground, body, point=(0, 0, 0), name="tip"))
    facts = {
        "dofs": 3,
        "energy": 5435.6967908655,
        "centre of mass": {
            0.2: (0.60555056, 0.59895768, -0.52398303),
            2.0: (-0.15041682, -0.72416559, -0.67302227),
        },
    }
    centre = nc.Point(body, (0, 1, 0), local=True)
    return Example(
        "heavy_top", "a fast top under gravity", *scene.compile(), 0.001, 2000, facts=facts, traces=(centre,)
    )


def fast_top() -> Example:
    """A top at 10 000 rad/s, released without precession: it nods by hundred-thousandths of a radian."""
    mass, arm, along, across, tilt, spin = 1.0, 0.1, 2e-3, 1.1e-2, np.pi / 3, 1e4
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    top = nc.RigidBody(
        mass=mass,
        inertia=(across - mass * arm**2, across - mass * arm**2, along),
        com=(0, 0, arm),
        orientation=((1.0, 0.0, 0.0), tilt),
        angular_velocity=(0, -spin * np.sin(tilt), spin * np.cos(tilt)),
        name="top",
    )
    scene.add(nc.Spherical(nc.ground, scene.add(top), point=(0, 0, 0), name="tip"))
    nutation, precession = along * spin / across, mass * 9.81 * arm / (along * spin)
    facts = {
        "dofs": 3,
        "spin": spin,  # [rad/s]
        "nutation": nutation,  # [rad/s]
        "precession": precession,  # [rad/s], the mean
        "nodding": 2.0 * precession * np.sin(tilt) / nutation,  # [rad], from end to end
    }
    return Example("fast_top", "a top at 10 000 rad/s", *scene.compile(), 5e-6, 1000, facts=facts)


def free_body() -> Example:
    """A body spinning freely, without symmetry (reference case R10)."""
    scene = nc.Scene()
    scene.add(nc.RigidBody(mass=1.0, inertia=(6, 8, 3), angular_velocity=(10, 20, 20), name="body"))
    facts = {
        "dofs": 6,
        "angular momentum": (60.0, 160.0, 60.0),
        "body rates": {
            0.45: (-7.721113013, 20.449278379, 20.792006422),
            1.0: (11.407086549, 19.658211246, 19.388210365),
        },
    }
    return Example("free_body", "a freely spinning body", *scene.compile(), 0.005, 200, facts=facts)


def dzhanibekov() -> Example:
    """A body spinning about its middle axis, which turns over again and again (reference case R12)."""
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=1.0, inertia=(1, 2, 3), angular_velocity=(1e-3, 5, 1e-3), name="body"))
    facts = {
        "dofs": 6,
        "body rates": {
            3.0: (-2.021466641, 4.573147015, 1.167094595),
            5.0: (-0.147191765, -4.997833089, 0.084985128),
        },
    }
    return Example(
        "dzhanibekov",
        "unstable spin about the middle axis",
        *scene.compile(),
        0.01,
        1000,
        facts=facts,
        traces=(nc.Point(body, (0, 3.0, 0), local=True),),
    )


GRAVITY = 9.81
"""[m/s^2]"""


def pendulum() -> Example:
    """A bar on a hinge, released horizontally (reference case R16)."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.80665)))
    inertia = (0.04, 0.1, 0.1)
    bar = scene.add(nc.RigidBody(mass=1.0, inertia=inertia, com=(2, 0, 0), name="bar"))
    scene.add(nc.Revolute(nc.ground, bar, axis=(0, 1, 0), name="hinge"))
    facts = {
        "dofs": 1,
        "centre of mass": {0.5: (1.66080775374, 0, -1.11432383315), 5.0: (-1.99968386888, 0, -0.03555874755)},
    }
    return Example("pendulum", "a bar on a hinge", *scene.compile(), 0.01, 500, facts=facts)


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
    facts = {
        "dofs": 2,
        "tip": {0.5: (1.2966885362, 0, -1.4057799232), 1.0: (-1.6621151358, 0, -1.0414666372)},
    }
    tip = nc.Point(carrier, (1.0, 0.0, 0.0), local=True)
    return Example(
        "double_pendulum", "two rods on hinges", *scene.compile(), 0.005, 400, facts=facts, traces=(tip,)
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
    facts = {"dofs": 1, "amplitude": amplitude, "angular frequency": rate}
    dt = 2 * np.pi / rate / 200
    return Example(
        "torsion_spring", "a disc on a torsional spring", *scene.compile(), float(dt), 400, facts=facts
    )
