"""Beams: a soft rope, a cantilever, a boom in free flight."""

import jax.numpy as jnp
import numpy as np

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
    system, state = scene.compile()
    facts = {"beam": beam, "tip of 64 elements of another code": {0.5: (-0.1994, 0, -0.9487)}}
    return Example("rope", "a soft rope on a pin", system, state, 1e-3, 500, facts=facts)


def cantilever(elements: int = 16) -> Example:
    """A clamped rod, released horizontally."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0, 0, -GRAVITY)))
    section = nc.CircularSection(**CANTILEVER)
    line = [(0, 0, 0), (1, 0, 0)]
    beam = scene.add(nc.Beam(section, line, elements=elements, start=nc.ground, name="rod"))
    system, state = scene.compile()
    return Example("cantilever", "a clamped rod", system, state, 2e-3, 500, facts={"beam": beam})


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
    system, state = scene.compile()
    facts = {"beam": beam, "momentum": (20.0, 0.0, 0.0)}
    return Example("flying_spaghetti", "a free beam in flight", system, state, 0.1, 150, facts=facts)
