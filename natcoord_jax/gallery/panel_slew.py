"""Optimal control with shells: a spacecraft is turned from rest to rest, and its panels rest as well.

Three torques on a rigid hub, a flexible panel on either side. The least effort for a rigid spacecraft
leaves the panels swinging; here the cost has how far they are from flat and from rest at the end, too.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import natcoord_jax as nc
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.nodes import NodeSet
from natcoord_jax.core.state import State
from natcoord_jax.gallery.example import Example
from natcoord_jax.maths.rotations import from_axis_angle
from natcoord_jax.system import System

SIZE, THICKNESS = (1.5, 0.5), 0.05
"""Of a panel [m]."""
CORE = nc.Elastic(E=2e6, nu=0.3, density=60.0)
"""A light and soft core: 3 kg/m^2, and half a swing a second, as of large panels."""
AXIS, ANGLE = (1.0, 2.0, -1.0), np.pi / 2
"""Of the turn; its angle [rad]."""
STILL = 0.1
"""Time in which velocities of the panels count as distances [s]."""


class NoSpin(nc.goal.Goal):
    """No angular momentum: with panels that are flat and at rest, nothing turns."""

    def residual(self, system: System, state: State) -> Float[Array, "3"]:
        """Angular momentum about the origin [N m s]."""
        return system.angular_momentum(state)

    def labels(self, system: System) -> tuple[str, ...]:
        """Three components."""
        return tuple(f"angular momentum, {axis} [N m s]" for axis in "xyz")


class Still(nc.goal.Goal):
    """Nodes of the panels at given places and at rest; both in [m].

    Attributes:
        places: of the nodes (nodes, 3) [m].
        rows: of the nodes in q and v.
    """

    places: Any
    rows: tuple[int, ...] = eqx.field(static=True)

    def residual(self, system: System, state: State) -> Float[Array, " c"]:
        """Distances, and velocities times `STILL`."""
        at = np.array(self.rows)
        return jnp.concatenate([state.q[at] - self.places, STILL * state.v[at]]).reshape(-1)


def craft(counts: tuple[int, int] = (2, 1)) -> tuple[System, State, Handle, list[NodeSet]]:
    """The spacecraft, its hub, and the nodes of the panels that are free.

    Args:
        counts: of elements along and across a panel.
    """
    scene = nc.Scene()
    hub = scene.add(nc.RigidBody(shape=nc.Box((0.5, 0.5, 0.5)), density=400.0, name="hub"))
    given = {"thickness": THICKNESS, "material": CORE}
    mesh, free = nc.mesh.rectangle(SIZE, counts), []
    for side, sign, turn in (("left", -1, np.pi), ("right", 1, 0.0)):
        corner = sign * np.array([0.25, -0.25, 0.0])
        panel = nc.Shell(mesh, position=corner, orientation=((0, 0, 1), turn), **given, name=side)
        nodes, root = scene.add(panel), mesh.sets["left"]
        scene.add(nc.Clamp(hub, nodes.set("left")))
        free.append(nodes.nodes[np.setdiff1d(np.arange(len(mesh.nodes)), root)])
    scene.add(nc.BodyTorqueInput(tuple(nc.Direction(hub, axis) for axis in np.eye(3)), name="torque"))
    return *scene.compile(), hub, free


def problem(
    steps: int = 40, *, t_end: float = 4.0, counts: tuple[int, int] = (2, 1), weight: float = 1e4
) -> nc.OptimalControl:
    """Least effort from rest to rest.

    Args:
        steps: of the motion.
        t_end: its time [s].
        counts: of elements along and across a panel.
        weight: of what the panels are away from being flat and at rest at the end [N^2 m^2 s/m^2].
    """
    system, state, hub, free = craft(counts)
    turn = np.asarray(from_axis_angle(jnp.array(AXIS) / np.linalg.norm(AXIS), jnp.asarray(ANGLE)))
    rows = tuple(4 * system.body_index(node) for nodes in free for node in nodes)
    flat = Still(state.q[np.array(rows)] @ turn.T, rows)
    return nc.OptimalControl(
        system,
        state,
        dt=t_end / steps,
        steps=steps,
        cost=nc.cost.Effort() + nc.cost.Missed(flat, weight=weight),
        goal=nc.goal.Attitude(hub, turn) & NoSpin(),
    )


def as_a_rigid_body(problem: nc.OptimalControl) -> Float[Array, "steps inputs"]:
    """Torques that turn a rigid spacecraft by least effort, were it about a principal axis [N m]."""
    rows = np.asarray(problem.state.rows)
    second = np.einsum("bix,bij,bjy->xy", rows, np.asarray(problem.system.mass), rows)
    inertia = np.trace(second) * np.eye(3) - second
    t = (np.arange(problem.steps) + 0.5) / problem.steps
    spin = ANGLE * np.array(AXIS) / np.linalg.norm(AXIS)
    return jnp.asarray(6 * (1 - 2 * t)[:, None] * (inertia @ spin) / (problem.steps * problem.dt) ** 2)


def panel_slew(counts: tuple[int, int] = (2, 1)) -> Example:
    """Least-effort turn of a spacecraft with two flexible panels, which are at rest at the end.

    Args:
        counts: of elements along and across a panel.
    """
    system, state, _, _ = craft(counts)
    return Example(
        name="panel_slew",
        description="a spacecraft with flexible panels turned by least effort",
        system=system,
        state=state,
        dt=0.1,
        steps=40,
        facts={"dofs": 6 + 2 * 5 * counts[0] * (counts[1] + 1)},
        problem=lambda steps, dt: problem(steps, t_end=steps * dt, counts=counts),
        guess=as_a_rigid_body,
    )
