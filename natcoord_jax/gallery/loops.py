"""Mechanisms that close loops, among them two whose constraints are redundant, and a bicycle."""

import math

import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import Handle
from natcoord_jax.gallery.example import Example
from natcoord_jax.maths.rotations import frame_from_axis


def _rod(scene: nc.Scene, name: str, start, end, *, rate=0.0, velocity=(0.0, 0.0, 0.0)) -> Handle:
    """Ideal rod of 1 kg with its reference point at `start`, turning about z with `rate` [rad/s]."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    length = float(np.linalg.norm(end - start))
    moment = length**2 / 3  # of a uniform rod about its end
    rod = nc.RigidBody(
        mass=1.0,
        second_moment=moment * np.outer(along, along),
        com=0.5 * length * along,
        position=start,
        velocity=velocity,
        angular_velocity=(0, 0, rate),
        name=name,
    )
    return scene.add(rod)


def four_bar(bars: int = 2) -> Example:
    """A row of four-bars that passes a singular configuration (reference case R04).

    Args:
        bars: number of loops; `bars + 1` rods turn on the ground, joined at their tips by `bars` rods.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, -9.81, 0)))
    z, speed = (0, 0, 1), 1.0
    uprights = []
    for k in range(bars + 1):
        upright = _rod(scene, f"upright {k}", (k, 0, 0), (k, 1, 0), rate=-speed)
        scene.add(nc.Revolute(nc.ground, upright, point=(k, 0, 0), axis=z, name=f"foot {k}"))
        uprights.append(upright)
    for k in range(bars):
        bar = _rod(scene, f"bar {k}", (k, 1, 0), (k + 1, 1, 0), velocity=(speed, 0, 0))
        scene.add(nc.Revolute(uprights[k], bar, point=(k, 1, 0), axis=z, name=f"left pin {k}"))
        scene.add(nc.Revolute(uprights[k + 1], bar, point=(k + 1, 1, 0), axis=z, name=f"right pin {k}"))
    facts = {
        "dofs": 1,
        "tip": {1.0: (-0.1950203, -0.9807992, 0), 2.0: (0.0578157958, 0.9983272679, 0)},
    }
    return Example("four_bar", "a row of four-bars", *scene.compile(), 0.01, 200, facts=facts)


def bricard() -> Example:
    """Bricard's mechanism: six hinges in space that move although counting says they cannot (R06)."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], float)
    axes = np.eye(3)[[1, 2, 0, 1, 2, 0]]
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, -9.81, 0)))
    carrier = nc.ground
    for k in range(5):
        start, end = corners[k], corners[k + 1]
        # Third body axis along the rod, a solid of 0.1 m x 0.1 m x 1 m.
        orientation = np.asarray(eager_numpy(frame_from_axis)(end - start)).T
        rod = nc.RigidBody(
            shape=nc.Box((0.1, 0.1, 1.0)),
            density=100.0,
            com=(0, 0, 0.5),
            position=start,
            orientation=orientation,
            name=f"rod {k + 1}",
        )
        body = scene.add(rod)
        scene.add(nc.Revolute(carrier, body, point=start, axis=axes[k], name=f"hinge {k + 1}"))
        carrier = body
    scene.add(nc.Revolute(nc.ground, carrier, point=corners[5], axis=axes[5], name="hinge 6"))
    facts = {
        "dofs": 1,
        "energy": -29.43,
        "corner 3": {0.5: (0.96828368, -1.22462516, 0.75014661), 1.0: (0.51050146, -1.6491676, 0.14012311)},
    }
    return Example("bricard", "Bricard's mechanism", *scene.compile(), 0.01, 200, facts=facts)


def slider_crank() -> Example:
    """A slider-crank in space, driven by a motor, its rod on a ball and a cardan joint."""
    pivot, pin, slide = np.array([0, 0.1, 0.12]), np.array([0, 0.1, 0.2]), np.array([0.2, 0, 0])
    along = (slide - pin) / np.linalg.norm(slide - pin)
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -9.81)))
    crank = scene.add(
        nc.RigidBody(
            mass=0.12,
            inertia=(1e-4, 1e-4, 1e-5),
            com=(0, 0, 0.04),
            shape=nc.Cylinder(0.008, 0.08),
            position=pivot,
            name="crank",
        )
    )
    rod = scene.add(
        nc.RigidBody(
            mass=0.5,
            inertia=(4e-3, 4e-3, 4e-4),
            com=(0, 0, 0.15),
            shape=nc.Cylinder(0.008, 0.3),
            position=pin,
            orientation=np.asarray(eager_numpy(frame_from_axis)(along)).T,
            name="rod",
        )
    )
    block = scene.add(
        nc.RigidBody(shape=nc.Box((0.06, 0.04, 0.04)), density=7800.0, position=slide, name="slider")
    )
    hinge = scene.add(nc.Revolute(nc.ground, crank, point=pivot, axis=(1, 0, 0), name="hinge"))
    scene.add(nc.Spherical(crank, rod, point=pin, name="ball"))
    scene.add(nc.Prismatic(nc.ground, block, point=slide, axis=(1, 0, 0), name="guide"))
    # The cross turns about the slider's vertical and about an axis across the rod.
    across = np.cross((0, 0, 1), along)
    scene.add(nc.Universal(block, rod, point=slide, axis=(0, 0, 1), second=across, name="cardan"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    return Example(
        "slider_crank",
        "a slider-crank in space",
        *scene.compile(),
        0.002,
        500,
        control=lambda t: jnp.full((t.shape[0], 1), 0.3),
        facts={"dofs": 1},
    )


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
    facts = {
        "dofs": 3,
        "stable speeds": (4.29238253634111, 6.02426201538837),
        "mass": ((80.81722, 2.31941332208709), (2.31941332208709, 0.29784188199686)),
        "damping": ((0.0, 33.86641391492494), (-0.85035641456978, 1.68540397397560)),
        "gravity": ((-80.95, -2.59951685249872), (-2.59951685249872, -0.80329488458618)),
        "speed": ((0.0, 76.59734589573222), (0.0, 2.65431523794604)),
    }
    return Example(
        "bicycle", "a bicycle that nobody steers", *scene.compile(assemble=True), 0.005, 600, facts=facts
    )
