"""Chains that are hard on a solver: stiff springs, and masses of very different sizes."""

import numpy as np

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""


def stiff_chain(rods: int = 6, stiffness: float = 1e8) -> Example:
    """A chain of rods on springs as stiff as steel, which swings slowly.

    The first rod hangs on the ground by a ball joint, each other one by a spring on the one above it.
    They hang straight down and turn as a whole at the start. The springs are stretched as that motion
    wants, so that the fast modes, up to some kHz, stay at rest but for terms of higher order.

    Args:
        rods: number of rods, of 1 kg and 0.2 m, with gaps of 0.1 m between them.
        stiffness: of the springs [N/m]; by default that of a steel rod of 8 mm and 0.1 m.
    """
    mass, length, gap, spin = 1.0, 0.2, 0.1, np.array([0.0, 2.0, 3.0])
    middles = -np.arange(rods) * (length + gap) - length / 2
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    bodies = []
    for k, middle in enumerate(middles):
        place = np.array([0.0, 0.0, middle])
        rod = nc.RigidBody(
            mass=mass,
            inertia=(4e-3, 4e-3, 1e-3),
            position=place,
            velocity=np.cross(spin, place),
            angular_velocity=spin,
            name=f"rod {k + 1}",
        )
        bodies.append(scene.add(rod))
    scene.add(nc.Spherical(nc.ground, bodies[0], point=(0, 0, 0), name="hook"))
    for k in range(rods - 1):
        below = middles[k + 1 :]
        force = mass * np.sum(GRAVITY - spin[1] ** 2 * below)  # carries and turns what hangs below
        end = middles[k] - length / 2
        ends = nc.Point(bodies[k], (0, 0, end)), nc.Point(bodies[k + 1], (0, 0, end - gap))
        name = f"spring {k + 1}"
        scene.add(nc.Spring(ends, name=name, stiffness=stiffness, length=gap - force / stiffness))
    facts = {"dofs": 6 * rods - 3}
    return Example("stiff_chain", "rods on stiff springs", *scene.compile(), 0.004, 500, facts=facts)


def mass_ladder(ratio: float = 1e4, links: int = 5, joint: type[nc.Revolute] = nc.Revolute) -> Example:
    """A chain on hinges whose masses and inertias grow from link to link by one factor.

    Args:
        ratio: mass of the last link, the first being of 1 kg.
        links: number of links, two at least.
        joint: kind of the hinges.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    carrier = nc.ground
    for k in range(links):
        mass, place = ratio ** (k / (links - 1)), np.array([0.4 * k, 0.0, 0.0])
        link = nc.RigidBody(
            mass=mass,
            inertia=mass * np.array([0.01, 0.02, 0.025]),
            com=(0.2, 0.02, -0.01),
            position=place,
            name=f"link {k + 1}",
        )
        body = scene.add(link)
        axis = (0, 0.8, 0.6) if k % 2 else (0, 1, 0)
        scene.add(joint(carrier, body, point=place, axis=axis, name=f"hinge {k + 1}"))
        carrier = body
    facts = {"dofs": links}
    return Example("mass_ladder", f"{links} links of growing mass", *scene.compile(), 0.005, 200, facts=facts)
