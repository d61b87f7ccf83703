"""What joins meshes that do not match, and edges of shells at an angle."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from natcoord_jax.bodies.mesh_handle import Surface
from natcoord_jax.bodies.mortar import overlap
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.bodies import TRIAD, Body
from natcoord_jax.core.cells import pieces
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.nodes import Clamp, NodeSet, NodeUnion
from natcoord_jax.core.numeric import COMPONENTS, Numbers
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.constraints import PointSum

SURFACE = of("faces of a solid or a shell, as block.face('x1') or shell.face()", Surface)

LEAST = 1e-9
"""Weight in a sum, relative to the largest, below which a node has no part in it."""

FAR = 0.2
"""Distance of the surfaces, in terms of the extent of the first one, beyond which they do not meet."""


class Tie(Recipe):
    """Two surfaces that stay together, whose meshes need not match.

    The means of both displacements, weighted by the shape functions of the first surface, are the same
    (mortar method). Nodes of the first surface are put on the second before anything else is made of them:
    so the equations are homogeneous, and angular momentum is kept exactly on curved surfaces, too. Take the
    finer mesh as the first one.

    Attributes:
        one: faces of a solid or a shell.
        other: faces of another one, which cover the first ones.
        name: of the tie.

    Raises:
        ValueError: when it is added: for surfaces that do not meet, with a node.

    Source: M. A. Puso, Int. J. Numer. Methods Eng. 59 (2004) 315-336, for the integrals.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> rubber = nc.Elastic(E=1e6, nu=0.3, density=1000.0)
        >>> coarse = scene.add(nc.Solid(nc.mesh.box((1, 1, 1), (1, 1, 1)), material=rubber))
        >>> fine = nc.mesh.box((1, 1, 1), (2, 2, 2))
        >>> fine = scene.add(nc.Solid(fine, material=rubber, position=(1, 0, 0)))
        >>> tied = scene.add(nc.Tie(fine.face("x0"), coarse.face("x1")))
        >>> scene.compile()[0].structure.dofs
        78
    """

    one: Surface = eqx.field(static=True, metadata=is_a(SURFACE))
    other: Surface = eqx.field(static=True, metadata=is_a(SURFACE))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "tie"

    def add_to(self, scene: Builder, name: str) -> Handle:
        """Put the nodes of the first surface on the second, and add an equation for each."""
        (slaves, one), (masters, two) = (_numbered(s) for s in (self.one, self.other))
        if not is_concrete(slaves.positions, masters.positions):
            raise ValueError(
                f"tie {name!r}: where its surfaces are must not be traced; make the scene outside"
            )
        places = np.asarray(slaves.positions), np.asarray(masters.positions)
        met = overlap(places[0], one, places[1], two)
        area = met.own.sum(axis=1)
        if not np.all(area > LEAST * area.max(initial=0.0)):
            node = int(slaves.numbers[np.argmin(area)])
            raise ValueError(
                f"tie {name!r}: the surfaces do not meet at node {node} of {self.one.handle.name!r}; the "
                "second surface must cover the first one"
            )
        moved = np.linalg.solve(met.own, met.other @ places[1])
        away = np.linalg.norm(moved - places[0], axis=1)
        extent = float(np.ptp(places[0], axis=0).max())
        if away.max() > FAR * extent:
            node = int(slaves.numbers[np.argmax(away)])
            raise ValueError(
                f"tie {name!r}: the surfaces are {away.max():.3g} m apart at node {node} of "
                f"{self.one.handle.name!r}; place one on the other"
            )
        scene.move_nodes(slaves, moved)
        weights = np.concatenate([met.own, -met.other], axis=1) / area[:, None]
        nodes, factors = _sparse(weights)
        union = NodeUnion((slaves, masters))
        return scene.add(PointSum.on(union, nodes, each={"weights": factors}, name=name))


def _numbered(surface: Surface) -> tuple[Any, np.ndarray]:
    """Nodes of a surface, and its faces by their numbers among them."""
    if surface.faces.shape[1] in (6, 8):
        raise ValueError(
            f"tie: faces of {surface.handle.name!r} have {surface.faces.shape[1]} nodes; only those of four "
            "or nine are tied; take hexahedra of 8 or 27 nodes, as nc.mesh.box(..., element='hexahedron27')"
        )
    # Of nine nodes: the four pieces between neighbours, on which positions are taken as bilinear.
    four = np.array([piece for face in surface.faces.tolist() for piece in pieces(tuple(face))])
    used, faces = np.unique(four, return_inverse=True)
    return surface.handle.nodes[used], faces.reshape(four.shape)


def _sparse(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the entries of each row, as many for all, and the entries; those that fill up are zero."""
    there = np.abs(weights) > LEAST * np.abs(weights).max()
    most = int(there.sum(axis=1).max())
    columns = np.argsort(~there, axis=1, kind="stable")[:, :most]
    columns = np.where(np.take_along_axis(there, columns, axis=1), columns, columns[:, :1])
    entries = np.take_along_axis(np.where(there, weights, 0.0), columns, axis=1)
    # What fills up repeats the first column; it counts once.
    entries[:, 1:] = np.where(columns[:, 1:] == columns[:, :1], 0.0, entries[:, 1:])
    # Small entries that were left out must not tear the sum from zero.
    entries[:, 0] -= entries.sum(axis=1)
    return columns, entries


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
