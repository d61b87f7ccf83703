"""Folds: edges of shells that are joined at an angle."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import TRIAD, Body
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.nodes import Clamp, NodeSet
from natcoord_jax.core.numeric import COMPONENTS, Numbers
from natcoord_jax.core.recipe import Builder, Recipe

EDGE = of("nodes of a shell, as plate.set('right')", NodeSet)

NEAR = 1e-6
"""Distance of nodes, in terms of the extent of the edge, up to which they are at the same place."""


class Fold(Recipe):
    """Two edges of shells that stay together at the angle at which they are assembled.

    Every pair of nodes is fixed to a body without mass of its own that turns about all axes and carries both
    directors. Where shells go on straight, or nearly, it has next to no inertia about the director: make one
    shell of them.

    Attributes:
        one: nodes of the edge of a shell.
        other: those of another at the same places.
        velocity: of these nodes (3,) or (n, 3), in the order of `one` [m/s].
        angular_velocity: [rad/s].
        name: of the bodies, "name[0]" and so on; what is added is a tuple of them.

    Raises:
        ValueError: when it is added: for a node of one edge that has none of the other at its place.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene, mesh = nc.Scene(), nc.mesh.rectangle((1.0, 0.5), (4, 2))
        >>> given = {"thickness": 0.01, "material": nc.Elastic(E=1e7, nu=0.3, density=1000.0)}
        >>> floor = scene.add(nc.Shell(mesh, **given))
        >>> up = (0, 1, 0), -3.14159265358979 / 2
        >>> wall = scene.add(nc.Shell(mesh, position=(1, 0, 0), orientation=up, **given))
        >>> corner = scene.add(nc.Fold(floor.set("right"), wall.set("left")))
        >>> scene.compile()[0].structure.dofs
        138
    """

    one: NodeSet = eqx.field(static=True, metadata=is_a(EDGE))
    other: NodeSet = eqx.field(static=True, metadata=is_a(EDGE))
    velocity: Any = eqx.field(
        default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS | Numbers((None, 3)))
    )
    angular_velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "fold"

    def add_to(self, scene: Builder, name: str) -> tuple[Handle, ...]:
        """Add the bodies, and clamp the nodes of the shells to them."""
        if not is_concrete(self.one.positions, self.other.positions):
            raise ValueError(f"fold {name!r}: places of its nodes are traced; compile outside of jit")
        place, other = (np.asarray(x.positions) for x in (self.one, self.other))
        away = np.linalg.norm(place[:, None] - other, axis=2)
        nearest, size = np.argmin(away, axis=1), max(float(np.ptp(place, axis=0).max()), 1e-300)
        missed = np.min(away, axis=1) > NEAR * size
        if missed.any() or len(place) != len(other):
            where = np.round(place[np.argmax(np.min(away, axis=1))], 6).tolist()
            raise ValueError(
                f"fold {name!r}: {self.one!r} and {self.other!r} are not at the same places, as at {where} "
                "[m]; pass edges whose nodes match, or join them by nc.Tie"
            )
        speeds = np.broadcast_to(np.asarray(self.velocity, float), place.shape)
        corners = []
        for k, m in enumerate(nearest):
            moving = as_array(speeds[k], float), as_array(self.angular_velocity, float)
            pose = as_array(place[k], float), jnp.eye(3)
            corner = Body(jnp.zeros((4, 4)), *pose, *moving, TRIAD, None, f"{name}[{k}]")
            corners.append(scene.add(corner))
            for edge, number in ((self.one, k), (self.other, int(m))):
                scene.add(Clamp(corners[-1], edge[number : number + 1]))
        return tuple(corners)
