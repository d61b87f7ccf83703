"""Pressure on a shell or on faces of a solid."""

from typing import Any

import equinox as eqx

from natcoord_jax.bodies.continua import MeshHandle
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, FunctionOf, of
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads import FacePressure

SURFACE = of("what scene.add(nc.Shell(...)) or scene.add(nc.Solid(...)) returned", MeshHandle)


class Pressure(Recipe):
    """Pressure on a shell from the side of its directors, or on faces of a solid from outside, following it.

    Attributes:
        surface: handle of the shell or the solid.
        pressure: [N/m^2], or a function of time [s] to it; negative: it pulls.
        face: name of the faces of a solid in its mesh, as "x1"; None: all that are outside.
        name: of the load, for its account of work.

    Raises:
        ValueError: when it is added: for faces that there are not.

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

    surface: MeshHandle = eqx.field(static=True, metadata=is_a(SURFACE))
    pressure: Any = eqx.field(metadata=is_a(Number() | FunctionOf("of time [s] to the pressure")))
    face: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "pressure"

    def add_to(self, scene: Builder, name: str) -> Handle:
        """Add a load to every face."""
        mesh = self.surface.mesh
        if mesh.cells.shape[1] == 4:
            if self.face is not None:
                raise ValueError(f"pressure {name!r}: face is {self.face!r}; a shell has none to choose")
            faces = mesh.cells
        elif self.face is None:
            faces = mesh.outside
        elif self.face in mesh.faces:
            faces = mesh.faces[self.face]
        else:
            raise ValueError(
                f"pressure {name!r}: {self.surface.name!r} has no faces {self.face!r}; its mesh has "
                f"{sorted(mesh.faces)}"
            )
        return scene.add(FacePressure.on(self.surface.nodes, faces, pressure=self.pressure, name=name))
