"""Ready problems of optimal control, with what is known of their solutions."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import natcoord_jax as nc
from natcoord_jax.bodies.rigid import orientation
from natcoord_jax.gallery.example import Example
from natcoord_jax.gallery.spacecraft import axes_of, spacecraft

GRAVITY = 9.81
"""[m/s^2]"""
POINT = (1e-9, 1e-9, 1e-9)
"""Inertia of a bob [kg m^2]."""
DISC = 1.0
"""Spin inertia of the wheels that turn a body [kg m^2]."""


def _least_effort(
    system: nc.System, state: nc.State, goal: Any, steps: int, t_end: float, **more: Any
) -> nc.OptimalControl:
    given = {"dt": t_end / steps, "steps": steps, "cost": nc.cost.Effort()} | more
    return nc.OptimalControl(system, state, goal=goal, **given)


def turn(
    steps: int = 40,
    *,
    inertia: Any = (1.0, 2.0, 3.0),
    axis: Any = (1.0, 1.0, 1.0),
    angle: float = np.pi / 2,
    t_end: float = 1.0,
    wheels: bool = False,
) -> nc.OptimalControl:
    """A free body turned from rest to rest by least effort, by external torques or by three wheels.

    About a principal axis the least integral of |u|^2 is 12 I^2 angle^2 / T^3. With inertia (1, 2, 3), 90
    degrees about (1, 1, 1) and T = 1 it is 120.852118 by external torques, and 129.028096 by wheels at zero
    momentum, the inertia then being that without the spin inertia of the wheels.
    """
    scene = nc.Scene()
    body = scene.add(nc.RigidBody(mass=10.0, inertia=inertia, name="body"))
    if wheels:
        for k, direction in enumerate(np.eye(3)):
            # Thin discs; what they add about the other axes is taken from the body below.
            moments = DISC / 2 * (1.0 + direction)
            wheel = scene.add(nc.RigidBody(mass=1.0, inertia=moments, name=f"wheel {k + 1}"))
            hinge = scene.add(nc.Revolute(body, wheel, axis=direction, name=f"hinge {k + 1}"))
            scene.add(nc.JointTorque(hinge, name=f"motor {k + 1}"))
    else:
        scene.add(nc.BodyTorqueInput(axes_of(body), name="torque"))
    system, state = scene.compile()
    if wheels:
        # Half of DISC in every second moment: what is left of the body is none by itself, the craft is one.
        rest = system.mass[0, 1:, 1:] - DISC / 2 * jnp.eye(3)
        system = dataclasses.replace(system, mass=system.mass.at[0, 1:, 1:].set(rest))
    goal = nc.goal.Attitude(body, orientation((axis, angle), "goal")) & nc.goal.Rest()
    return _least_effort(system, state, goal, steps, t_end)


def reorientation(
    steps: int = 100,
    *,
    axis: Any = (1.0, 2.0, -1.0),
    angle: float = np.pi / 2,
    t_end: float = 60.0,
    limit: float = 200.0,
    working: tuple[int, ...] = (1, 2, 3),
) -> nc.OptimalControl:
    """The paper's spacecraft turned from rest to rest by its wheels; those that do not work are locked."""
    example = spacecraft(working=working)
    goal = nc.goal.Attitude("base", orientation((axis, angle), "goal")) & nc.goal.Rest()
    bounds = nc.bounds.Input(-limit, limit)
    return _least_effort(example.system, example.state, goal, steps, t_end, bounds=bounds)


def reorientation_example() -> Example:
    """Rest-to-rest reorientation of the paper's spacecraft by its three wheels, with least effort."""
    problem = reorientation()
    return Example(
        name="reorientation",
        description="least-effort reorientation of the spacecraft by its wheels",
        system=problem.system,
        state=problem.state,
        dt=float(problem.dt),
        steps=problem.steps,
        facts={"dofs": 9, "constraints": 39},
        problem=lambda steps, dt: reorientation(steps, t_end=steps * dt),
    )


def beanie(
    steps: int = 40, *, inertias: tuple[float, float] = (1.0, 3.0), angle: float = 1.0, t_end: float = 1.0
):
    """Two bodies at zero momentum joined by one hinge (Elroy's beanie): least effort to a relative angle.

    The least integral of u^2 is 12 J^2 angle^2 / T^3 with J = I1 I2 / (I1 + I2).
    """
    scene = nc.Scene()
    bodies = [
        scene.add(nc.RigidBody(mass=1.0, inertia=(1.0 + i, 1.0 + i, i), name=f"body {k + 1}"))
        for k, i in enumerate(inertias)
    ]
    hinge = scene.add(nc.Revolute(*bodies, name="hinge"))
    scene.add(nc.JointTorque(hinge, name="motor"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(hinge, angle) & nc.goal.Rest()
    return _least_effort(system, state, goal, steps, t_end)


def two_masses(steps: int = 60, *, fastest: bool = False, t_end: float = 6.0) -> nc.OptimalControl:
    """Two masses of 1 kg on a spring of 1 N/m, a force on the first: from 0 to 1 m, rest to rest.

    Least effort in 6 s: 0.2271424. Least time with |u| <= 1: 4.21786651 s, with switches at 1.00268, 2.10893
    and 3.21519 s.
    """
    scene = nc.Scene()
    masses, slides = [], []
    for k in range(2):
        place = (float(k), 0.0, 0.0)
        body = nc.RigidBody(
            mass=1.0, inertia=(1, 1, 1), shape=nc.Box((0.3, 0.3, 0.3)), position=place, name=f"mass {k + 1}"
        )
        masses.append(scene.add(body))
        slide = nc.Prismatic(nc.ground, masses[-1], point=place, axis=(1, 0, 0), name=f"slide {k + 1}")
        slides.append(scene.add(slide))
    ends = tuple(nc.Point(mass, (0.0, 0.0, 0.0), local=True) for mass in masses)
    scene.add(nc.Spring(ends, stiffness=1.0, length=1.0, name="spring"))
    scene.add(nc.JointForce(slides[0], name="push"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(slides[0], 1.0) & nc.goal.Coordinate(slides[1], 1.0) & nc.goal.Rest()
    timed = {"cost": nc.cost.Duration(), "bounds": nc.bounds.Input(-1.0, 1.0), "free_time": (1.0, 20.0)}
    return _least_effort(system, state, goal, steps, t_end, **(timed if fastest else {}))


class TangentialForce(nc.Force):
    """Force u (y, -x) on a point, the control of a pendulum in Cartesian coordinates.

    Attributes:
        markers: the point.
    """

    kind = "tangential force"
    inputs = 1

    def load(self, x: Array, rate: Array, inputs: Array, t: Array) -> nc.Load:
        """At right angles to the rod, in proportion to its length."""
        return nc.Load(inputs[0] * jnp.stack([x[0, 1], -x[0, 0], jnp.zeros(())])[None], None)


def point_pendulum(steps: int = 60, *, t_end: float = 3.0) -> nc.OptimalControl:
    """A pendulum as a point on a massless rod, with its multiplier (example 10.103 of Betts' collection).

    x'' = -2 lam x + u y, y'' = -g - 2 lam y - u x, x^2 + y^2 = 1, from (1, 0) at rest to x = x' = 0 at 3 s;
    an extremal of the integral of u^2 is 12.8738850 (hanging), others have 76.552 and 94.119, and one that
    ends upright has 6.467.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, -GRAVITY, 0.0)))
    bob = scene.add(nc.PointMass(mass=1.0, position=(1.0, 0.0, 0.0), name="bob"))
    scene.add(nc.Distance(nc.ground, bob, point=(1.0, 0.0, 0.0), name="rod"))
    scene.add(TangentialForce((nc.Point(bob, (0.0, 0.0, 0.0), local=True),), name="push"))
    system, state = scene.compile()
    goal = nc.goal.Equal(
        lambda state: jnp.stack([state.q[0, 0], state.v[0, 0]]), "x and x' [m, m/s]", count=2
    )
    return _least_effort(system, state, goal, steps, t_end)


def cart_pole(steps: int = 100, *, t_end: float = 2.0, turn: float = np.pi) -> nc.OptimalControl:
    """A pole on a cart swung up while the cart moves by 1 m, |f| <= 20 N, |x| <= 2 m, by least effort.

    The least integral of f^2 that is published is 58.8839; an extremal with 57.9448 is known.
    """
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=(0.0, 0.0, -GRAVITY)))
    cart = scene.add(
        nc.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), shape=nc.Box((0.3, 0.2, 0.1)), name="cart")
    )
    pole = scene.add(nc.RigidBody(mass=0.3, inertia=POINT, com=(0.0, 0.0, -0.5), name="pole"))
    rail = scene.add(nc.Prismatic(nc.ground, cart, axis=(1, 0, 0), name="rail"))
    hinge = scene.add(nc.Revolute(cart, pole, axis=(0, -1, 0), name="hinge"))
    scene.add(nc.JointForce(rail, name="push"))
    system, state = scene.compile()
    goal = nc.goal.Coordinate(rail, 1.0) & nc.goal.Coordinate(hinge, turn) & nc.goal.Rest()
    bounds = nc.bounds.Input(-20.0, 20.0) & nc.bounds.Coordinate(-2.0, 2.0, joint=rail)
    return _least_effort(system, state, goal, steps, t_end, bounds=bounds)
