"""Loads along the edges of shells."""

from typing import Any

import equinox as eqx
import numpy as np

from natcoord_jax.bodies.mesh_handle import Edge
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import FLAG, NAME, of
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads.edges import LOAD, EdgeSegment

EDGE = of("an edge of a shell, as plate.edge('right')", Edge)


class EdgeLoad(Recipe):
    """Force and moment per length of an edge of a shell, dead or following it.

    Attributes:
        edge: as plate.edge("right").
        force: shape (3,) [N/m], or a function of time [s] to it; None: none.
        moment: shape (3,) [N m/m], or a function of time [s] to it; None: none. Shells carry none about
            their directors: of a following moment the third component has to be zero, of another what is
            along the directors is left out.
        following: take components along the edge, outwards in the surface and normal to it, instead of the
            world's axes.
        name: of the load, for its account of work.

    Raises:
        ValueError: when it is added: without force and moment, or for a moment about the directors.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> metal = nc.Elastic(E=1e9, density=1000.0)
        >>> plate = scene.add(nc.Shell(nc.mesh.rectangle((1.0, 0.5), (4, 2)), thickness=0.01, material=metal))
        >>> held = scene.add(nc.Clamp(nc.ground, plate.set("left")))
        >>> rolled = scene.add(nc.EdgeLoad(plate.edge("right"), moment=(-10.0, 0.0, 0.0), following=True))
        >>> system, state = scene.compile()
        >>> end = nc.equilibrium(system, state).state
        >>> round(float(system.sense(end, plate.nearest((1.0, 0.0, 0.0))).position[2]), 4)
        0.0599
    """

    edge: Edge = eqx.field(static=True, metadata=is_a(EDGE))
    force: Any = eqx.field(default=None, kw_only=True, metadata=is_a(LOAD))
    moment: Any = eqx.field(default=None, kw_only=True, metadata=is_a(LOAD))
    following: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "edge load"

    def add_to(self, scene: Builder, name: str) -> Handle:
        """Add a load to every side of a cell on the edge."""
        if self.force is None and self.moment is None:
            raise ValueError(
                f"edge load {name!r} has neither force [N/m] nor moment [N m/m]; pass one of them"
            )
        if self.following and self.moment is not None and not callable(self.moment):
            drilling = np.asarray(self.moment)[2]
            if drilling != 0:
                raise ValueError(
                    f"edge load {name!r}: its moment has {drilling:g} N m/m about the directors, which "
                    "shells do not carry; pass zero as the third component"
                )
        given = {key: value for key in ("force", "moment") if (value := getattr(self, key)) is not None}
        load = EdgeSegment.on(
            self.edge.handle.nodes, self.edge.sides, following=self.following, name=name, **given
        )
        return scene.add(load)
