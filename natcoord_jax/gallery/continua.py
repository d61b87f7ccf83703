"""Beams; shells and solids in free flight, and wings of shells on a hub."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import natcoord_jax as nc
from natcoord_jax.gallery.example import Example

GRAVITY = 9.81
"""[m/s^2]"""

ROPE = {"radius": 0.01, "E": 1e6, "nu": 0.3, "density": 1000.0}
"""A metre of soft rubber [m, Pa, -, kg/m^3]."""

CANTILEVER = {"radius": 0.01, "E": 2e9, "nu": 0.3, "density": 1200.0}
"""A metre of plastic rod [m, Pa, -, kg/m^3]; the first frequency is 3.6 Hz."""


def rope(elements: int = 16) -> Example:
    """A soft rope on a pin, released horizontally."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    section = nc.CircularSection(**ROPE)
    beam = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=elements, name="rope"))
    scene.add(nc.Spherical(nc.ground, beam.start, name="pin"))
    facts = {"beam": beam, "tip of 64 elements of another code": {0.5: (-0.1994, 0, -0.9487)}}
    return Example("rope", "a soft rope on a pin", *scene.compile(), 1e-3, 500, facts=facts)


def cantilever(elements: int = 16) -> Example:
    """A clamped rod, released horizontally."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    section = nc.CircularSection(**CANTILEVER)
    line = [(0, 0, 0), (1, 0, 0)]
    beam = scene.add(nc.Beam(section, line, elements=elements, start=nc.ground, name="rod"))
    return Example("cantilever", "a clamped rod", *scene.compile(), 2e-3, 500, facts={"beam": beam})


def _pull(t):
    return jnp.where(t < 2.5, jnp.array([8.0, 0.0, 0.0]), 0.0)


def _turn(t):
    return jnp.where(t < 2.5, jnp.array([0.0, 0.0, -80.0]), 0.0)


def flying_spaghetti(elements: int = 10) -> Example:
    """A free beam that a force and a moment set in motion (reference case B17)."""
    section = nc.Section.of_numbers(EA=1e4, GA=1e4, EI=100.0, GJ=100.0, density=1.0, rotary=10.0)
    ends = [(0.0, 8.0, 0.0), (6.0, 0.0, 0.0)]
    scene = nc.Scene()
    beam = scene.add(nc.Beam(section, ends, elements=elements, second=(0, 0, 1), name="beam"))

    tip = nc.Point(beam.end, ends[1])
    axes = tuple(nc.Direction(beam.end, e) for e in np.eye(3))
    scene.add(nc.PointForce((tip,), force=_pull, name="force"))
    scene.add(nc.BodyTorque(axes, torque=_turn, name="moment"))
    facts = {"beam": beam, "momentum": (20.0, 0.0, 0.0)}
    return Example("flying_spaghetti", "a free beam in flight", *scene.compile(), 0.1, 150, facts=facts)


def flying_plate(counts: tuple[int, int] = (6, 3)) -> Example:
    """A rubber plate that tumbles and bends, of shell elements."""
    size, thickness = (1.0, 0.5), 0.05
    mesh = nc.mesh.rectangle(size, counts)
    # A bending wave on top of a spin about the middle; directors turn with the surface, near enough.
    spin, wave, speed = np.array([0.5, 0.3, 4.0]), 2 * np.pi / size[0], 3.0
    velocity = -np.broadcast_to(np.cross(spin, (0.5, 0.25, 0.0)), mesh.nodes.shape).copy()
    velocity[:, 2] += speed * np.cos(wave * mesh.nodes[:, 0])
    rubber = nc.Elastic(E=5e5, nu=0.3, density=1000.0)
    given = {"thickness": thickness, "material": rubber, "velocity": velocity, "angular_velocity": spin}
    scene = nc.Scene()
    scene.add(nc.Shell(mesh, **given, name="plate"))
    facts = {"dofs": 5 * len(mesh.nodes), "mass": 1000.0 * thickness * float(np.prod(size))}
    return Example("flying_plate", "a plate of shells", *scene.compile(), 1e-3, 1000, facts=facts)


def tumbling_block(counts: tuple[int, int, int] = (4, 2, 2)) -> Example:
    """A rubber block that tumbles and is stretched, of bricks."""
    size, spin = (1.0, 0.5, 0.5), np.array([0.5, 0.3, 4.0])
    mesh = nc.mesh.box(size, counts)
    velocity = -np.broadcast_to(np.cross(spin, (0.5, 0.25, 0.25)), mesh.nodes.shape).copy()
    velocity[:, 0] += 6.0 * (mesh.nodes[:, 0] - 0.5)
    rubber = nc.Elastic(E=1e5, nu=0.3, density=1000.0)
    scene = nc.Scene()
    scene.add(nc.Solid(mesh, material=rubber, velocity=velocity, angular_velocity=spin, name="block"))
    facts = {"dofs": 3 * len(mesh.nodes), "mass": 1000.0 * float(np.prod(size))}
    return Example("tumbling_block", "a block of bricks", *scene.compile(), 2e-3, 1000, facts=facts)


def solar_panels(counts: tuple[int, int] = (6, 2), torque: float = 2.0) -> Example:
    """A spacecraft with two flexible solar panels that is turned and stopped; the panels go on swinging."""
    size, scene = (1.5, 0.5), nc.Scene()
    hub = scene.add(nc.RigidBody(shape=nc.Box((0.5, 0.5, 0.5)), density=400.0, name="hub"))
    panel = nc.Elastic(E=3e8, nu=0.3, density=300.0)
    mesh = nc.mesh.rectangle(size, counts)
    for side, turn in (("left", np.pi), ("right", 0.0)):
        rotation = (0, 0, 1), turn
        corner = np.array([0.25, -0.25, 0.0]) * (1 if turn == 0 else -1)
        wing = nc.Shell(
            mesh, thickness=0.01, material=panel, position=corner, orientation=rotation, name=side
        )
        scene.add(nc.Clamp(hub, scene.add(wing).set("left")))
    axes = tuple(nc.Direction(hub, axis) for axis in np.eye(3))
    scene.add(nc.BodyTorqueInput(axes, name="torque"))

    def control(t: Array) -> Array:
        push = jnp.where(t < 1.0, torque, jnp.where(t < 2.0, -torque, 0.0))
        return jnp.stack([0.3 * push, push, 0.0 * push], axis=1)

    return Example(
        "solar_panels", "a spacecraft with flexible panels", *scene.compile(), 0.01, 400, control=control
    )


def inflated_ball(count: int = 4) -> Example:
    """A tennis ball of rubber, inflated by statics, that is thrown on the floor with a spin and bounces."""
    radius, thickness, height = 0.033, 3.5e-3, 0.05
    scene = nc.Scene()
    rubber = nc.Elastic(E=5e6, nu=0.45, density=1100.0)
    mesh = nc.mesh.sphere(radius, count)
    ball = scene.add(
        nc.Shell(mesh, thickness=thickness, material=rubber, position=(0, 0, height), name="ball")
    )
    scene.add(nc.Gas(ball, gauge_pressure=8e4, exponent=1.4, name="air"))
    scene.add(nc.Contact(ball, nc.Plane(), stiffness=2e4))
    system, state = scene.compile()
    state = nc.equilibrium(system, state, steps=1).state
    rows = state.rows
    arms = rows.at[:, 0].add(-jnp.mean(rows[:, 0], axis=0))
    rates = jnp.cross(jnp.array([0.0, 60.0, 0.0]), arms).at[:, 0].add(jnp.array([2.0, 0.0, -10.0]))
    state = eqx.tree_at(lambda s: (s.v, s.t), state, (rates.reshape(-1, 3), jnp.zeros(())))
    facts = {"dofs": 5 * len(mesh.nodes), "gauge_pressure": 8e4}
    return Example("inflated_ball", "a ball with gas that bounces", system, state, 5e-5, 400, facts=facts)
