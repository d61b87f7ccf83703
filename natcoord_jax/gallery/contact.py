"""Bodies that bounce and collide."""

from typing import Any

import numpy as np

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example

GRAVITY = 9.81


def bouncing_ball(restitutions: tuple[float, ...] = (1.0, 0.8, 0.5)) -> Example:
    """Balls that are dropped on a floor and keep different parts of their speed at an impact."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    floor, radius, height = nc.Plane(normal=(0, 0, 1)), 0.1, 1.0
    speed = float(np.sqrt(2 * GRAVITY * height))
    for k, restitution in enumerate(restitutions):
        ball = scene.add(
            nc.RigidBody(
                shape=nc.Sphere(radius),
                density=200.0,
                position=(0.5 * k, 0, height + radius),
                angular_velocity=(0, 1.0, 0),
                name=f"ball {k + 1}",
            )
        )
        lossy: dict[str, Any] = {} if restitution == 1 else {"restitution": restitution, "speed": speed}
        scene.add(nc.Contact(ball, floor, stiffness=2e4, name=f"bounce {k + 1}", **lossy))
    fall = float(np.sqrt(2 * height / GRAVITY))
    facts = {"fall": fall, "apexes": tuple(e**2 * height for e in restitutions)}
    return Example("bouncing_ball", "balls on a floor", *scene.compile(), 1e-3, 2500, facts=facts)


def newton_cradle(balls: int = 5, raised: float = 0.8) -> Example:
    """A cradle: balls on rods that hang side by side with small gaps, the first one raised."""
    radius, length, gap = 0.1, 1.0, 1e-3
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    handles = []
    for k in range(balls):
        above = np.array([k * (2 * radius + gap), 0.0, 0.0])
        angle = raised if k == 0 else 0.0
        below = above - length * np.array([np.sin(angle), 0.0, np.cos(angle)])
        ball = scene.add(
            nc.RigidBody(shape=nc.Sphere(radius), density=7800.0, position=below, name=f"ball {k + 1}")
        )
        scene.add(nc.Revolute(nc.ground, ball, point=above, axis=(0, 1, 0), name=f"rod {k + 1}"))
        handles.append(ball)
    for k, (one, two) in enumerate(zip(handles, handles[1:])):
        scene.add(nc.Contact(one, two, stiffness=3e7, name=f"impact {k + 1}"))
    facts = {"height": length * (1 - np.cos(raised)), "angle": raised}
    return Example("newton_cradle", "a cradle of balls", *scene.compile(), 2e-4, 10000, facts=facts)


def tumbling_capsules() -> Example:
    """Capsules and balls that are thrown at each other in space."""
    scene, random = nc.Scene(), np.random.default_rng(3)
    handles = []
    for k in range(6):
        place = 0.6 * np.array([np.cos(k * np.pi / 3), np.sin(k * np.pi / 3), 0.15 * (-1) ** k])
        shape = nc.Capsule(radius=0.07, length=0.35) if k % 2 == 0 else nc.Sphere(0.12)
        body = nc.RigidBody(
            shape=shape,
            density=500.0,
            position=place,
            velocity=-1.5 * place,
            orientation=((1.0, 0.3, 0.2), 1.2 * k),
            angular_velocity=random.normal(size=3),
            name=f"{'capsule' if k % 2 == 0 else 'ball'} {k + 1}",
        )
        handles.append(scene.add(body))
    for i, one in enumerate(handles):
        for j, two in enumerate(handles[:i]):
            scene.add(nc.Contact(one, two, stiffness=3e4, name=f"impact {j + 1} {i + 1}"))
    return Example("tumbling_capsules", "capsules and balls", *scene.compile(), 2e-3, 1000)


def rattleback(spin: float = -5.0, tilt: float = 0.5) -> Example:
    """A stone that does not like to turn one way: it begins to rattle, and turns back.

    Half axes, moments and the product of inertia of T. R. Kane and D. A. Levinson, Realistic mathematical
    modeling of the rattleback, Int. J. Non-Linear Mechanics 17 (1982) 175-186.

    Args:
        spin: at the start [rad/s].
        tilt: about the long axis [degrees].
    """
    semi_axes, below = np.array([0.2, 0.03, 0.02]), 0.01
    inertia = np.array([[2.0, -0.2, 0.0], [-0.2, 16.0, 0.0], [0.0, 0.0, 17.0]]) * 1e-4
    angle = np.deg2rad(tilt)
    turned = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    height = float(np.linalg.norm(semi_axes * turned[2]))
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    stone = scene.add(
        nc.RigidBody(
            mass=1.0,
            inertia=inertia,
            position=(0, 0, height) - below * turned[:, 2],
            orientation=turned,
            angular_velocity=(0, 0, spin),
            name="stone",
        )
    )
    table = nc.Point(nc.ground), nc.Direction(nc.ground, (0, 0, 1))
    centre = nc.Point(stone, (0, 0, below), local=True)
    axes = (nc.Direction(stone, axis, local=True) for axis in np.eye(3))
    gap = nc.EllipsoidOnPlane(semi_axes=semi_axes)
    scene.add(nc.GapConstraint((*table, centre, *axes), gap, restitution=0.0, friction=1.0, name="table"))
    return Example("rattleback", "a rattleback", *scene.compile(), 2e-3, 6000, facts={"spin": spin})


def dice() -> Example:
    """Boxes that are thrown on a floor: they bounce, rub, tumble and come to rest."""
    scene, floor = nc.Scene(), nc.Plane(normal=(0, 0, 1))
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    throws = (
        ((0.0, 0.0, 0.3), (2.0, -1.0, 6.0)),
        ((0.3, 0.2, 0.45), (-4.0, 5.0, 3.0)),
        ((-0.3, 0.3, 0.6), (6.0, 3.0, -5.0)),
    )
    for k, (place, spin) in enumerate(throws):
        die = nc.RigidBody(
            shape=nc.Box((0.1, 0.1, 0.1)),
            density=600.0,
            position=place,
            velocity=(1.0, 0.4 * k - 0.3, 0.5),
            angular_velocity=spin,
            name=f"die {k + 1}",
        )
        scene.add(nc.Contact(scene.add(die), floor, restitution=0.4, friction=0.4, name=f"floor {k + 1}"))
    return Example("dice", "dice on a floor", *scene.compile(), 1e-3, 2000)


def colliding_blocks() -> Example:
    """Two rubber blocks collide face to face, corner first, nodes of each on the facets of the other."""
    scene, rubber = nc.Scene(), nc.Elastic(E=1e4, nu=0.3, density=1.0)
    tilt = (1.0, 0.6, 0.0), 0.29
    spin, middle = np.array([0.0, 0.3, 0.8]), np.array([1.0, 1.0, 0.3])
    one = scene.add(
        nc.Solid(
            nc.mesh.box((1, 1, 1), (2, 2, 2)),
            material=rubber,
            position=(0.02, 0.2, 0.19),
            orientation=tilt,
            velocity=(1.0, 0.5, -4.0),
            name="upper",
        )
    )
    other = scene.add(
        nc.Solid(
            nc.mesh.box((2, 2, 0.6), (2, 2, 1)),
            material=rubber,
            position=(-0.55, -0.45, -0.65),
            velocity=np.array([0, 0, 2.0]) - np.cross(spin, middle),
            angular_velocity=spin,
            name="lower",
        )
    )
    scene.add(nc.Contact(one.face("z0"), other.face("z1"), name="impact"))
    return Example("colliding_blocks", "rubber blocks that collide", *scene.compile(), 4e-3, 100)
