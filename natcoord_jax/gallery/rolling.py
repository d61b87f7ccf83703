"""What rolls without slip."""

import math

import numpy as np

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example

TILT = math.pi / 10
"""Of the steering axis against the vertical [rad]."""
RADII = {"rear wheel": 0.3, "front wheel": 0.35}
"""[m]."""
BASE, TRAIL = 1.02, 0.08
"""Wheel base and trail [m]."""
# Centre of mass [m], mass [kg] and inertia [kg m^2]; x ahead, z up, but for the wheels, which have z along
# their axes.
PARTS = {
    "rear wheel": ((0.0, 0.0, 0.3), 2.0, (0.0603, 0.0603, 0.12)),
    "frame": ((0.3, 0.0, 0.9), 85.0, ((9.2, 0, -2.4), (0, 11.0, 0), (-2.4, 0, 2.8))),
    "fork": ((0.9, 0.0, 0.7), 4.0, ((0.05892, 0, 0.00756), (0, 0.06, 0), (0.00756, 0, 0.00708))),
    "front wheel": ((BASE, 0.0, 0.35), 3.0, (0.1405, 0.1405, 0.28)),
}

SEEN = {"frame": (nc.Ellipsoid, (0.2, 0.15, 0.4)), "fork": (nc.Box, (0.05, 0.05, 0.5))}
"""In pictures; the frame with its rider [m]."""


def bicycle(speed: float = 5.0, lean_rate: float = 0.1) -> Example:
    """The benchmark bicycle, without anyone steering: stable from 4.29 to 6.02 m/s.

    Data and eigenvalues of Meijaard, Papadopoulos, Ruina and Schwab, Proc. R. Soc. A 463 (2007) 1955-1982.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    bodies = {}
    for name, (place, mass, inertia) in PARTS.items():
        wheel = name in RADII
        shape, size = SEEN.get(name, (nc.Box, None))
        spin = speed / RADII[name] if wheel else 0.0
        bodies[name] = scene.add(
            nc.RigidBody(
                mass=mass,
                inertia=np.array(inertia),
                position=place,
                orientation=((1, 0, 0), math.pi / 2 if wheel else 0.0),
                velocity=np.array([speed, 0, 0]) + np.cross([lean_rate, 0, 0], place),
                angular_velocity=(lean_rate, spin, 0),
                shape=nc.Cylinder(RADII[name], 0.03) if wheel else shape(size),
                name=name,
            )
        )
    steering = (math.sin(TILT), 0, -math.cos(TILT))
    frame, fork = bodies["frame"], bodies["fork"]
    scene.add(nc.Revolute(frame, bodies["rear wheel"], axis=(0, 1, 0), name="rear hub"))
    scene.add(nc.Revolute(frame, fork, point=(BASE + TRAIL, 0, 0), axis=steering, name="head"))
    scene.add(nc.Revolute(fork, bodies["front wheel"], axis=(0, 1, 0), name="front hub"))
    road = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    for name, radius in RADII.items():
        wheel = bodies[name]
        disc = nc.Point(wheel), nc.Direction(wheel, (0, 1, 0))
        scene.add(nc.Rolling((*road, *disc), radius=radius, name=f"contact of the {name}"))
    system, state = scene.compile(assemble=True)
    facts = {
        "dofs": 3,
        "stable speeds": (4.29238253634111, 6.02426201538837),
        "mass": ((80.81722, 2.31941332208709), (2.31941332208709, 0.29784188199686)),
        "damping": ((0.0, 33.86641391492494), (-0.85035641456978, 1.68540397397560)),
        "gravity": ((-80.95, -2.59951685249872), (-2.59951685249872, -0.80329488458618)),
        "speed": ((0.0, 76.59734589573222), (0.0, 2.65431523794604)),
    }
    return Example("bicycle", "a bicycle that nobody steers", system, state, 0.005, 600, facts=facts)
