"""Ties between meshes that do not match."""

from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.bodies.mesh_handle import Surface
from natcoord_jax.bodies.mortar import overlap
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.cells import pieces
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, of
from natcoord_jax.core.nodes import NodeUnion
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
