"""Pressure on a shell or on faces of a solid."""

from typing import Any

import equinox as eqx

from natcoord_jax.bodies.mesh_handle import MeshHandle, Surface
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, FunctionOf, of
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads import FacePressure, FacePressure6, FacePressure8, FacePressure9

SURFACE = of("what scene.add(nc.Shell(...)) or nc.Solid(...) returned, or faces of it", MeshHandle, Surface)

LOADS = {4: FacePressure, 6: FacePressure6, 8: FacePressure8, 9: FacePressure9}
"""By the number of nodes of a face."""


class Pressure(Recipe):
    """Pressure on a shell from the side of its directors, or on faces of a solid from outside, following it.

    Attributes:
        surface: handle of the shell or the solid, for all that is outside, or faces, as block.face("x1").
        pressure: [N/m^2], or a function of time [s] to it; negative: it pulls.
        name: of the load, for its account of work.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> foil = nc.Elastic(E=1e6, nu=0.3, density=1000.0)
        >>> ball = scene.add(nc.Shell(nc.mesh.sphere(0.1, 3), thickness=1e-3, material=foil))
        >>> inside = scene.add(nc.Pressure(ball, -200.0))
        >>> system, state = scene.compile()
        >>> trajectory = nc.simulate(system, state, dt=1e-4, steps=5)
        >>> bool(system.work(trajectory)["pressure 1"][-1] > 0)
        True
    """

    surface: MeshHandle | Surface = eqx.field(static=True, metadata=is_a(SURFACE))
    pressure: Any = eqx.field(metadata=is_a(Number() | FunctionOf("of time [s] to the pressure")))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "pressure"

    def add_to(self, scene: Builder, name: str) -> Handle:
        """Add a load to every face."""
        surface = self.surface.face() if isinstance(self.surface, MeshHandle) else self.surface
        nodes = surface.handle.nodes
        load = LOADS[surface.faces.shape[1]]
        return scene.add(load.on(nodes, surface.faces, pressure=self.pressure, name=name))
