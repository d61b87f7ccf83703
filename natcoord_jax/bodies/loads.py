"""Loads along beams, along the edges of shells, and on surfaces."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.bodies.mesh_handle import Edge, MeshHandle, Surface
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import numbers
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.kinds import FLAG, NAME, FunctionOf, of
from natcoord_jax.core.markers import Direction, Point
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads import (
    BodyTorque,
    FacePressure,
    FacePressure6,
    FacePressure8,
    FacePressure9,
    PointForce,
)
from natcoord_jax.effects.loads.point_loads import LOAD, EdgeSegment

BEAM = of("what scene.add(nc.Beam(...)) returned", BeamHandle)
PROFILE = FunctionOf("of the fraction of the length [-] to a factor [-]")


class Share(eqx.Module):
    """A node's share of a load that is a function of time; functions that are one for all nodes stay one.

    Attributes:
        function: of time [s] to the load per length.
        length: that the node stands for [m].
    """

    function: Callable[[Array], Any]
    length: Float[Array, ""]

    def __call__(self, t: Array) -> Array:
        """The share."""
        return self.length * jnp.asarray(self.function(t), float)


class LineLoad(Recipe):
    """Force and moment per length of a beam, dead or following its sections.

    Every node takes the load of the length that it stands for, as it has the mass of it: of an even load what
    the shape functions of the beam's elements give, of another to the order of a quadrature at the nodes.

    Attributes:
        beam: handle of the beam.
        force: shape (3,) [N/m], or a function of time [s] to it; None: none.
        moment: shape (3,) [N m/m], or a function of time [s] to it; None: none.
        profile: function of the fraction of the length [-] to a factor [-]; None: even.
        following: take components along d_1, d_2, d_3 of the section instead of the world's axes.
        name: unique name; the loads of nodes are called "name/force 0" and so on.

    Example:
        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene, section = nc.Scene(), nc.CircularSection(radius=0.01, E=1e9, density=1000.0)
        >>> rod = scene.add(nc.Beam(section, [(0, 0, 0), (1, 0, 0)], elements=4, start=nc.ground, name="rod"))
        >>> snow = scene.add(nc.LineLoad(rod, force=(0.0, 0.0, -2.0), name="snow"))
        >>> system, state = scene.compile()
    """

    beam: Any = eqx.field(static=True, metadata=is_a(BEAM))
    force: Any = eqx.field(default=None, kw_only=True, metadata=is_a(LOAD))
    moment: Any = eqx.field(default=None, kw_only=True, metadata=is_a(LOAD))
    profile: Callable[[float], Any] | None = eqx.field(default=None, kw_only=True, metadata=is_a(PROFILE))
    following: bool = eqx.field(default=False, kw_only=True, static=True, metadata=is_a(FLAG))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "line load"

    def add_to(self, scene: Builder, name: str) -> tuple[Handle, ...]:
        """Add the loads of all nodes that can move.

        Raises:
            ValueError: without force and moment, for another shape, or for something else than a beam.
        """
        label = f"line load {name!r}"
        if self.force is None and self.moment is None:
            raise ValueError(f"{label} has neither force [N/m] nor moment [N m/m]; pass one of them")
        added = []
        for k, attachment in enumerate(self.beam.attachments):
            if attachment.body == ground:
                continue
            factor = 1.0 if self.profile is None else self.profile(self.beam.fractions[k])
            length = jnp.asarray(self.beam.shares[k] * factor, float)
            axes = jnp.asarray(attachment.axes).T if self.following else np.eye(3)[:1]
            directions = tuple(Direction(attachment.body, axis) for axis in axes)
            if self.force is not None:
                force = self._share(self.force, length, f"{label}: force", "N/m")
                settings = {"following": self.following, "name": f"{name}/force {k}"}
                point = Point(attachment.body, attachment.point)
                markers = (point, *directions) if self.following else (point,)
                added.append(scene.add(PointForce(markers, force=force, **settings)))
            if self.moment is not None:
                moment = self._share(self.moment, length, f"{label}: moment", "N m/m")
                settings = {"following": self.following, "name": f"{name}/moment {k}"}
                added.append(scene.add(BodyTorque(directions, torque=moment, **settings)))
        return tuple(added)

    def _share(self, load: Any, length: Float[Array, ""], label: str, unit: str) -> Any:
        if callable(load):
            numbers(load(jnp.zeros(())), (3,), f"{label} at t = 0", unit)
            return Share(load, length)
        return length * numbers(load, (3,), label, unit)


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
