"""Scenes that several test files share: equal structure, hence shared compiled programs."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import natcoord_jax as nc

JOINTS = {
    "fixed": nc.Fixed,
    "spherical": nc.Spherical,
    "revolute": nc.Revolute,
    "universal": nc.Universal,
    "cylindrical": nc.Cylindrical,
    "prismatic": nc.Prismatic,
    "planar": nc.Planar,
    "screw": nc.Screw,
    "distance": nc.Distance,
}

AXIS = (1.0, 2.0, 2.0)
SECOND = (2.0, 1.0, -2.0)
SPECIAL = {
    nc.Screw: {"pitch": 0.4},
    nc.Distance: {"parent_point": (0.0, 0.1, -1.2)},
}


def with_multipliers(joint: type) -> type:
    """The same joint without a description of its free motion: it keeps its multipliers, as in a loop."""
    return type(f"{joint.__name__}WithMultipliers", (joint,), {"free": False})


def pair(
    joint: type,
    *,
    gravity: Any = 9.81,
    hanging: Any = 60.0,
    between: Any = 30.0,
    coil: Any = 2.0,
    spin: Any = (0.6, -0.4, 2.0),
    mass: Any = 2.0,
    solver: str | None = None,
) -> tuple[Any, Any]:
    """Two unsymmetric bodies with a joint, hung by a spring at the origin, with a spring between them.

    Every coordinate of the joint has a spring of its own, `coil`. The second body's start twist is that of
    the first, so that velocities obey any joint; the stretched springs start their relative motion. Without
    `gravity` and `hanging` all momenta are conserved; with them, angular momentum about the vertical axis
    through the origin.
    """
    spin = jnp.asarray(spin, float)
    place = np.array([0.0, 0.0, -1.0]), np.array([0.5, 0.3, -1.6])
    drift = jnp.array([0.5, 0.2, 0.1])
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=jnp.array([0.0, 0.0, -1.0]) * gravity, name="gravity"))
    first = scene.add(
        nc.RigidBody(
            mass=mass,
            inertia=((0.30, 0.02, -0.01), (0.02, 0.40, 0.03), (-0.01, 0.03, 0.50)),
            com=(0.05, -0.03, 0.1),
            position=place[0],
            orientation=((1.0, 1.0, 0.0), 0.7),
            velocity=drift,
            angular_velocity=spin,
            name="first",
        )
    )
    second = scene.add(
        nc.RigidBody(
            mass=1.5,
            inertia=(0.20, 0.12, 0.25),
            com=(-0.02, 0.04, 0.03),
            position=place[1],
            orientation=(0.9, 0.1, -0.3, 0.2),
            velocity=drift + jnp.cross(spin, place[1] - place[0]),
            angular_velocity=spin,
            name="second",
        )
    )
    options = next((o for kind, o in SPECIAL.items() if issubclass(joint, kind)), {})
    hinge = scene.add(
        joint(first, second, point=(0.2, 0.1, -1.3), axis=AXIS, second=SECOND, name="joint", **options)
    )
    for number in range(len(joint.coordinates)):
        name = f"coil {number}"
        scene.add(nc.JointSpring(hinge, coordinate=number, stiffness=coil, rest=0.4, name=name))
    hang = (nc.Point(nc.ground), nc.Point(first, (0.1, 0.0, -0.6)))
    scene.add(nc.Spring(hang, name="hanging", stiffness=hanging, length=0.3))
    across = (nc.Point(first, (0.0, -0.4, -1.2)), nc.Point(second, (0.8, 0.4, -1.9)))
    scene.add(nc.Spring(across, name="between", stiffness=between, length=0.4))
    return scene.compile(solver=solver)
