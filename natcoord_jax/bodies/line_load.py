"""Loads along a beam: forces and moments per length."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.beam import BeamHandle
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import numbers
from natcoord_jax.core.handles import Handle, ground
from natcoord_jax.core.kinds import FLAG, NAME, FunctionOf, of
from natcoord_jax.core.markers import Direction, Point
from natcoord_jax.core.numeric import COMPONENTS
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads import BodyTorque, PointForce

BEAM = of("what scene.add(nc.Beam(...)) returned", BeamHandle)
LOAD = COMPONENTS | FunctionOf("of time [s] to three numbers")
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
