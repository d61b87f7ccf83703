"""Beams: nodes with three directors, elements between them, and what they are attached to."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.interpolation import Interpolation, Material, RelativeMotion, apart
from natcoord_jax.bodies.reference_curve import ReferenceCurve, node_fractions, reference_curve
from natcoord_jax.bodies.sections import Section
from natcoord_jax.core.arguments import checked, is_a
from natcoord_jax.core.bodies import TRIAD, Body
from natcoord_jax.core.checks import numbers, require_double
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.handles import Handle
from natcoord_jax.core.kinds import BODY, NAME, FunctionOf, of
from natcoord_jax.core.markers import Attachment
from natcoord_jax.core.numeric import COMPONENTS, Directions, Number, Numbers, Vector, Whole
from natcoord_jax.core.recipe import Builder, Recipe, pose_of
from natcoord_jax.effects.materials import MASS

SECTION = of("nc.CircularSection(...), nc.Section.of_numbers(...) or another section", Section)
CURVE = Numbers((None, 3)) | FunctionOf("of arc length [m] to the position, together with length=")
ANGLE = FunctionOf("of arc length [m] to the angle [rad]")
LAW = FunctionOf("of the strains (6,) to the energy per length [J/m]")
INTERPOLATION = of("nc.RelativeMotion() or nc.DirectorInterpolation(order=...)", Interpolation)

FIT = 1e-9
"""Largest distance between a fraction and its node."""


@dataclass(frozen=True)
class BeamHandle:
    """A reference to a beam in a scene.

    Attributes:
        name: of the beam.
        nodes: handles of its nodes, in order: bodies like any other, for joints, loads, springs and sensors.
            An attached end is the body it is attached to.
        fractions: of the length, where the nodes are.
        elements: handles of its elements.
        outline: rim of the section (n, 2) [m], for pictures, or None.
        attachments: where the nodes are in the assembled pose, each with the triad d_1, d_2, d_3.
        shares: lengths that the nodes stand for (nodes,) [m].
    """

    name: str
    nodes: tuple[Handle, ...]
    fractions: tuple[float, ...]
    elements: tuple[Handle, ...]
    outline: Any = field(default=None, repr=False, compare=False)
    attachments: tuple[Attachment, ...] = field(default=(), repr=False, compare=False)
    shares: Any = field(default=None, repr=False, compare=False)

    @property
    def start(self) -> Handle:
        """The first node."""
        return self.nodes[0]

    @property
    def end(self) -> Handle:
        """The last node."""
        return self.nodes[-1]

    @checked("BeamHandle.at", fraction=Number())
    def at(self, fraction: float) -> Handle:
        """The node at a fraction of the length.

        Raises:
            ValueError: if there is none, with the remedy.
        """
        gaps = np.abs(np.asarray(self.fractions) - fraction)
        nearest = int(np.argmin(gaps))
        if gaps[nearest] > FIT:
            raise ValueError(
                f"beam {self.name!r} has no node at the fraction {fraction} [-] of its length; the nearest "
                f"is at {self.fractions[nearest]:.6g}: pass stations=({fraction},) to nc.Beam"
            )
        return self.nodes[nearest]


class Beam(Recipe):
    """Geometrically exact beam (Simo-Reissner) along a curve, unstressed as it is given.

    With mass lumped at the nodes the inertia of n equal elements about an end is by default too large by the
    factor 1 + 1 / (2 n^2), see `RelativeMotion`; with a consistent mass that of a straight beam is exact.

    Attributes:
        section: `Section`, d_1 and d_2 across, d_3 along the tangent.
        curve: points (k, 3) [m] that straight lines join, or a function of arc length [m] to position.
        elements: number of elements; stations may add some.
        length: [m], of a curve given as a function.
        second: where d_1 points at the start, as far as it is perpendicular to the tangent [-].
        twist: angle by which the section is turned about the tangent at the end [rad], growing linearly, or
            a function of arc length.
        start: handle of a body, or `ground`, that the first node is rigidly part of; None: a node of its own.
        end: the same of the last node.
        stations: fractions of the length at which nodes are wanted, to attach something to.
        mass: "lumped" at the nodes; or "consistent": that of the motion interpolated between them, linearly
            for `RelativeMotion`, which couples the accelerations of neighbours.
        damping: time t [s] of internal damping C_v = t C (Kelvin-Voigt); None: none.
        law: energy per length [J/m] as a function of the strains (6,), on top of the section's; None: none.
        interpolation: of which elements it is made; default `RelativeMotion()`, else
            `DirectorInterpolation(order)`.
        velocity: of the start [m/s].
        angular_velocity: of the beam as a rigid body [rad/s].
        name: unique name; nodes are called "name/node 0", elements "name/element 0" and so on.

    Example:
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import natcoord_jax as nc
        >>> scene = nc.Scene()
        >>> rope = nc.CircularSection(radius=0.01, E=1e6, density=1000.0)
        >>> cable = scene.add(nc.Beam(rope, [(0, 0, 0), (1, 0, 0)], elements=4, start=nc.ground))
        >>> gravity = scene.add(nc.Gravity())
        >>> system, state = scene.compile()
        >>> system.structure.dofs
        24
    """

    section: Section = eqx.field(metadata=is_a(SECTION))
    curve: Any = eqx.field(metadata=is_a(CURVE))
    elements: int = eqx.field(kw_only=True, static=True, metadata=is_a(Whole(1)))
    length: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("positive")))
    second: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Directions()))
    twist: Any = eqx.field(default=0.0, kw_only=True, metadata=is_a(Number() | ANGLE))
    start: Any = eqx.field(default=None, kw_only=True, metadata=is_a(BODY))
    end: Any = eqx.field(default=None, kw_only=True, metadata=is_a(BODY))
    stations: Sequence[float] = eqx.field(default=(), kw_only=True, metadata=is_a(Vector(None)))
    damping: Any = eqx.field(default=None, kw_only=True, metadata=is_a(Number("not negative")))
    mass: str = eqx.field(default="lumped", kw_only=True, static=True, metadata=is_a(MASS))
    law: Any = eqx.field(default=None, kw_only=True, metadata=is_a(LAW))
    interpolation: Interpolation = eqx.field(
        default=RelativeMotion(), kw_only=True, metadata=is_a(INTERPOLATION)
    )
    velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    angular_velocity: Any = eqx.field(default=(0.0, 0.0, 0.0), kw_only=True, metadata=is_a(COMPONENTS))
    name: str | None = eqx.field(default=None, kw_only=True, static=True, metadata=is_a(NAME))

    kind = "beam"

    def add_to(self, scene: Builder, name: str) -> BeamHandle:
        """Add nodes and elements.

        Raises:
            ValueError: for single precision, or for contradicting data, by name.
        """
        label = f"beam {name!r}"
        require_double(label)
        ends = node_fractions(self.elements, self.stations, label)
        fractions, spans = self.interpolation.refine(ends)
        curve = reference_curve(self.curve, fractions, self.length, self.second, self.twist, label)
        lumps = self.interpolation.lumps(curve.arc, spans)
        nodes = self._nodes(scene, curve, lumps, name, label)
        places = zip(nodes, apart(curve.points, len(nodes)), apart(curve.frames, len(nodes)))
        attachments = [Attachment(*place) for place in places]
        damping = None if self.damping is None else numbers(self.damping, (), f"{label}: damping", "s")
        material = Material(self.section, self.law, damping, self.mass)
        elements, others = self.interpolation.effects(material, attachments, curve, spans, name)
        handles = tuple(scene.add(element) for element in elements)
        for effect in others:
            scene.add(effect)
        places = tuple(float(x) for x in fractions)
        return BeamHandle(
            name, tuple(nodes), places, handles, self.section.outline, tuple(attachments), lumps
        )

    def _nodes(
        self, scene: Builder, curve: ReferenceCurve, lumps: Array, name: str, label: str
    ) -> list[Handle]:
        """Nodes of the beam's own, and the bodies that the ends are part of."""
        count = len(lumps)
        spin = numbers(self.angular_velocity, (3,), f"{label}: angular_velocity", "rad/s")
        drift = numbers(self.velocity, (3,), f"{label}: velocity", "m/s")
        if self.mass == "consistent":
            lumps = jnp.zeros_like(lumps)
        blocks, velocities = _lumps_and_velocities(self.section, lumps, curve.points, drift, spin)
        columns = (blocks, curve.points, curve.frames, velocities)
        held = {0: self.start, count - 1: self.end}
        nodes = []
        for i, (block, point, frame, velocity) in enumerate(zip(*(apart(x, count) for x in columns))):
            holder = held.get(i)
            if holder is None:
                node = Body(block, point, frame, velocity, spin, TRIAD, None, f"{name}/node {i}")
                nodes.append(scene.add(node))
            else:
                nodes.append(_hold(scene, holder, block, point, frame, label))
        return nodes


def _hold(
    scene: Builder,
    holder: Handle,
    block: Float[Array, "4 4"],
    point: Float[Array, "3"],
    frame: Float[Array, "3 3"],
    label: str,
) -> Handle:
    """The body that an end is rigidly part of, now with the mass of the end."""
    body = pose_of(scene, holder, label)
    if body is None:
        return holder
    if not body.oriented:
        raise ValueError(
            f"{label}: an end cannot be rigidly part of {holder.name!r}, which has no orientation; "
            "join the end node to it by nc.Spherical"
        )
    scene.add_mass(holder, _carried_along(body.position, body.rotation, block, point, frame))
    return holder


@eager_numpy
def _lumps_and_velocities(
    section: Section, lumps: Array, points: Float[Array, "n 3"], drift: Array, spin: Array
) -> tuple[Float[Array, "n 4 4"], Float[Array, "n 3"]]:
    blocks = lumps[:, None, None] * section.lump(jnp.ones(()))
    return blocks, drift + jnp.cross(spin[None], points - points[0])


@eager_numpy
def _carried_along(position: Array, rotation: Array, block: Array, point: Array, frame: Array) -> Array:
    """Mass block of a node in the frame of the body that it is rigidly part of."""
    weights = jnp.zeros((4, 4)).at[0, 0].set(1.0).at[1:, 1:].set((rotation.T @ frame).T)
    weights = weights.at[0, 1:].set(rotation.T @ (point - position))
    return weights.T @ block @ weights
