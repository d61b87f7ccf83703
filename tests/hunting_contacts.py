"""Random contacts for the hunt: of what is driven, hard and soft; meshes; and scenes of any size."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from hunting_effects import STEPS, Chance, pushed

import natcoord_jax as nc


class Shake(eqx.Module):
    """A prescribed coordinate that rests, then goes to and fro."""

    size: Any
    rate: Any
    begin: Any

    def __call__(self, t):
        return self.size * (1.0 - jnp.cos(self.rate * jnp.maximum(t - self.begin, 0.0)))


def _none() -> tuple:
    return (np.zeros((STEPS, 0)),)


def bouncing(rng: Chance, stiffness: Any = None):
    """Two balls that hit each other and a plane with friction."""
    scene, dt = nc.Scene(), rng.step(0.01)
    scene.add(nc.Gravity())
    law: dict[str, Any] = {"friction": rng.size(0.05, 1.0)}
    law |= (
        {"restitution": rng.uniform(0.1, 0.9)} if stiffness is None else {"stiffness": rng.size(*stiffness)}
    )
    floor, last = nc.Plane(normal=np.array([0.2, 0.1, 1.0]) + 0.1 * rng.normal(size=3)), None
    for k in range(2):
        moving = {"velocity": rng.normal(size=3) - (0, 0, 1), "angular_velocity": 5.0 * rng.normal(size=3)}
        place = (0.15 * rng.uniform(), 0.0, 0.12 + 0.25 * k)
        ball = nc.RigidBody(shape=nc.Sphere(0.1), density=500.0, position=place, **moving, name=f"ball {k}")
        ball = scene.add(ball)
        scene.add(nc.Contact(ball, floor, **law, name=f"floor {k}"))
        if last is not None:
            scene.add(nc.Contact(last, ball, **law, name="balls"))
        last = ball
    system, state = scene.compile()
    return (system,), state, pushed(rng, system, state)[0], _none(), dt


def shaken(rng: Chance, stiffness: Any = None):
    """A mass on a plate that a drive shakes to and fro and that stands still at first."""
    scene, dt = nc.Scene(), rng.step(0.01)
    scene.add(nc.Gravity())
    plate = scene.add(nc.RigidBody(mass=2.0, inertia=(0.1, 0.1, 0.1), name="plate"))
    track = scene.add(nc.Prismatic(nc.ground, plate, axis=(1, 0, 0), name="track"))
    size, rate, begin = rng.size(0.01, 0.3), rng.size(5.0, 40.0), rng.time(dt)
    scene.add(nc.Drive(track, function=Shake(size, rate, begin), name="drive"))
    box = scene.add(nc.PointMass(mass=rng.uniform(0.5, 2.0), velocity=(rng.normal(), 0, 0), name="box"))
    law: dict[str, Any] = dict(friction=rng.size(0.05, 1.0))
    law |= {} if stiffness is None else dict(stiffness=rng.size(*stiffness))
    scene.add(nc.Contact(box, nc.Plane(normal=(0, 0, 1), body=plate), **law, name="contact"))
    system, state = scene.compile()
    return (system,), state, pushed(rng, system, state, 0.3)[0], _none(), dt


def _flying(rng: Chance, make: Any, speed: float):
    scene = nc.Scene()
    scene.add(nc.Gravity())
    make(scene)
    system, state = scene.compile()
    return (system,), *pushed(rng, system, state, speed), _none(), rng.step(0.005)


def sheet(rng: Chance):
    """A plate of four shells, clamped at an edge."""
    material = nc.Elastic(E=rng.size(1e6, 1e8), nu=rng.uniform(0.0, 0.4), density=1000.0)

    def make(scene: nc.Scene) -> None:
        shell = nc.Shell(nc.mesh.rectangle((0.4, 0.3), (2, 2)), thickness=0.01, material=material)
        plate = scene.add(shell)
        scene.add(nc.Clamp(nc.ground, plate.set("left")))

    return _flying(rng, make, 0.3)


def block(rng: Chance):
    """Two bricks of rubber that fly and turn."""
    material = nc.Elastic(E=rng.size(1e5, 1e7), nu=rng.uniform(0.1, 0.4), density=1000.0)

    def make(scene: nc.Scene) -> None:
        scene.add(nc.Solid(nc.mesh.box((0.4, 0.2, 0.2), (2, 1, 1)), material=material))

    return _flying(rng, make, 1.0)


def sized(rng: Chance):
    """A pendulum on a spring between stops, of lengths between a micrometre and ten kilometres."""
    scene, length = nc.Scene(), rng.size(1e-6, 1e4)
    gravity = 9.81 * length  # (times stay: seconds)
    scene.add(nc.Gravity(vector=(0.0, 0.3 * gravity, -gravity)))
    mass, com = rng.size(1e-6, 1e6), 0.3 * length * rng.direction()
    inertia = 0.05 * mass * length**2 * rng.uniform(0.8, 1.2, 3)
    body = scene.add(nc.RigidBody(mass=mass, inertia=inertia, com=com, name="a"))
    hinge = scene.add(nc.Revolute(nc.ground, body, axis=(1, 0, 0)))
    energy = mass * length**2
    scene.add(nc.JointStops(hinge, lower=-0.1, upper=0.1, stiffness=rng.size(1e2, 1e5) * energy))
    scene.add(nc.JointDamper(hinge, damping=rng.size(1e-2, 1.0) * energy))
    ends = nc.Point(nc.ground, (0, 0, -length)), nc.Point(body, 2.0 * com)
    scene.add(nc.Spring(ends, stiffness=rng.size(1.0, 1e3) * mass, length=0.3 * length))
    system, state = scene.compile()
    begun = [system.with_coordinate(state, hinge, 0.0, rate=rng.normal()) for _ in range(2)]
    return (system,), *begun, _none(), rng.step()


soft_bouncing = partial(bouncing, stiffness=(1e3, 1e6))
soft_shaken = partial(shaken, stiffness=(1e4, 1e6))
