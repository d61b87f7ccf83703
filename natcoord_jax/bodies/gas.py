"""Gas in a closed surface of shells, and of faces of solids."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from natcoord_jax.bodies.loads import SURFACE
from natcoord_jax.bodies.mesh_handle import MeshHandle
from natcoord_jax.core.arguments import is_a
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import NAME, Several
from natcoord_jax.core.nodes import NodeUnion
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.recipe import Builder, Recipe
from natcoord_jax.effects.loads import EnclosedGas
from natcoord_jax.effects.loads.gas import ATMOSPHERE, enclosed_volume
from natcoord_jax.maths.places import places


class Gas(Recipe):
    """A gas enclosed by a shell, by faces of a solid, or by several of these that meet at their edges.

    It has the pressure p_0 (V_0 / V)^exponent, with the volume V that is enclosed. It has no mass. Energy,
    momentum and angular momentum are exact, at steps of any size, with schemes of order two.

    Attributes:
        surface: handle of a shell, faces of a solid (block.face("cavity")), or a tuple of such: of a shell
            the directors point outwards.
        gauge_pressure: above the ambient one [N/m^2], at the volume V_0.
        ambient: constant pressure around it [N/m^2].
        exponent: 1: it stays as warm as it is; 1.4: air that has no time to; 0: a constant pressure [-].
        volume: V_0 [m^3]; default: that of the assembled pose.
        name: of the gas, for its energy and its sensor: `system.sense(trajectory, gas).pressure`, `.volume`.

    Raises:
        ValueError: when it is added: for a surface that is not closed, with an edge of one face only; that is
            in several pieces; or whose faces are in turn one way and the other.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> rubber = nc.Elastic(E=5e6, nu=0.45, density=1100.0)
        >>> ball = scene.add(nc.Shell(nc.mesh.sphere(0.033, 3), thickness=3.5e-3, material=rubber))
        >>> air = scene.add(nc.Gas(ball, gauge_pressure=83e3))
        >>> system, state = scene.compile()
        >>> inflated = nc.equilibrium(system, state, steps=1).state
        >>> bool(system.sense(inflated, air).pressure < 83e3)
        True
    """

    surface: Any = eqx.field(static=True, metadata=is_a(SURFACE | Several(SURFACE)))
    gauge_pressure: Any = eqx.field(kw_only=True, metadata=is_a(Number()))
    ambient: Any = eqx.field(default=ATMOSPHERE, kw_only=True, metadata=is_a(Number("not negative")))
    exponent: Any = eqx.field(default=1.0, kw_only=True, metadata=is_a(Number("not negative")))
    volume: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "gas"

    def add_to(self, scene: Builder, name: str) -> Handle:
        """Add the gas on all nodes of the surface."""
        given = self.surface if isinstance(self.surface, tuple | list) else (self.surface,)
        surfaces = [s.face() if isinstance(s, MeshHandle) else s for s in given]
        faces, used = [], []
        for surface in surfaces:
            own, local = np.unique(surface.faces, return_inverse=True)
            faces.append(local.reshape(surface.faces.shape) + sum(map(len, used)))
            used.append(own)
        nodes = NodeUnion(tuple(s.handle.nodes[own] for s, own in zip(surfaces, used)))
        table = np.concatenate(faces)
        positions = [s.handle.nodes.positions for s in surfaces]
        if is_concrete(positions):
            x = np.concatenate([np.asarray(p)[own] for p, own in zip(positions, used)])
            table = _outward(x, table, name, tuple(s.handle.name for s in surfaces))
        law = {key: getattr(self, key) for key in ("gauge_pressure", "ambient", "exponent", "volume")}
        numbers = np.arange(len(nodes))[None]
        return scene.add(EnclosedGas.on(nodes, numbers, faces=table.astype(np.int32), name=name, **law))


def _outward(
    x: np.ndarray, faces: Int[np.ndarray, "f 4"], name: str, parts: tuple[str, ...]
) -> Int[np.ndarray, "f 4"]:
    """Faces counter-clockwise as seen from outside of what they enclose: those of a cavity are not.

    Raises:
        ValueError: for a surface that is not closed, or not one.
    """
    where = places(x)[faces]
    starts, ends = where.reshape(-1), np.roll(where, -1, axis=1).reshape(-1)
    edges = np.stack([starts, ends], axis=1)[starts != ends]
    said = f"gas {name!r}: the surface of {' and '.join(map(repr, parts))}"
    _, number, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    twice = np.flatnonzero(count[number.reshape(-1)] > 1)
    if twice.size:
        a, b = (np.round(x[k], 6).tolist() for k in edges[twice[0]])
        raise ValueError(
            f"{said} has faces in turn one way and the other at the edge {a} to {b}: list all the same"
        )
    known = {tuple(edge) for edge in edges.tolist()}
    open_ = [edge for edge in known if edge[::-1] not in known]
    if open_:
        a, b = (np.round(x[k], 6).tolist() for k in min(open_))
        raise ValueError(
            f"{said} is not closed: {len(open_)} edges are of one face only, as that from {a} to {b} [m]; "
            "close it, or pass what closes it, too, as a tuple"
        )
    reached = {int(where[0, 0])}
    neighbours: dict[int, list[int]] = {}
    for a, b in known:
        neighbours.setdefault(a, []).append(b)
    front = list(reached)
    while front:
        fresh = {b for a in front for b in neighbours[a]} - reached
        reached |= fresh
        front = list(fresh)
    if len(reached) < len(neighbours):
        raise ValueError(
            f"{said} is in several pieces; pass the one that encloses the gas, as block.face('cavity')"
        )
    return faces if float(enclosed_volume(jnp.asarray(x), jnp.asarray(faces))) > 0 else faces[:, ::-1]
