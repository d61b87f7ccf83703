"""How a beam is made of elements: which nodes they join, what inertia nodes carry, which effects they are."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.reference_curve import ReferenceCurve
from natcoord_jax.bodies.sections import Section
from natcoord_jax.core.arguments import Part, is_a
from natcoord_jax.core.checks import as_array, is_concrete
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.kinds import Choice
from natcoord_jax.core.markers import Attachment
from natcoord_jax.effects.beams import (
    BeamDamping,
    BeamElement,
    DirectorDamping,
    DirectorElement,
    NonlinearBeamElement,
)
from natcoord_jax.effects.beams.directors import director_strains
from natcoord_jax.effects.beams.relative_motion import relative_motion, strains_of
from natcoord_jax.maths.lagrange import LOBATTO, gauss_legendre, lagrange, lobatto

HALF_TURN = -0.99
"""Cosine of the turn over an element below which it is half a turn, nearly: 172 degrees."""

COILED = 0.2
"""Distance of the ends of an element over its length below which it is a coil; half a circle has 0.64."""

Span = tuple[int, ...]
"""Nodes of an element, in order."""


class Material(eqx.Module):
    """What elements are made of.

    Attributes:
        section: stiffness and inertia.
        law: energy per length of the strains, on top of the linear one, or None.
        damping: time [s] that makes the viscosity from the stiffness, or None for no damping at all.
        mass: "lumped", which the nodes have, or "consistent", which the elements bring.
    """

    section: Section
    law: Any
    damping: Any
    mass: str = eqx.field(static=True)

    def inertias(
        self, lengths: Float[Array, " e"], overlaps: Float[np.ndarray, "k k"]
    ) -> Float[Array, "e k 4 k 4"] | None:
        """Consistent masses of elements of so many lengths [m]; None: masses are lumped.

        Args:
            lengths: of the elements.
            overlaps: integrals of the products of the shape functions over a unit of length.
        """
        return _inertias(self.section, lengths, overlaps) if self.mass == "consistent" else None


@eager_numpy
def _inertias(section: Section, lengths: Array, overlaps: Any) -> Float[Array, "e k 4 k 4"]:
    return (
        lengths[:, None, None, None, None] * overlaps[:, None, :, None] * section.lump(jnp.ones(()))[:, None]
    )


class Interpolation(Part):
    """Base of the ways in which a beam is made of elements, with nodes at their Gauss-Lobatto points.

    Class attributes:
        order: one less than the nodes of an element.
    """

    order: ClassVar[int] = 1

    def refine(self, ends: np.ndarray) -> tuple[np.ndarray, list[Span]]:
        """Fractions of all nodes, and the nodes of each element, from the fractions of element ends."""
        inner = lobatto(self.order)[0][:-1]
        pieces = [a + (b - a) * inner for a, b in zip(ends, ends[1:])]
        p = self.order
        spans = [tuple(range(p * e, p * e + p + 1)) for e in range(len(pieces))]
        return np.concatenate([*pieces, ends[-1:]]), spans

    def lumps(self, arc: Float[Array, " n"], spans: list[Span]) -> Float[Array, " n"]:
        """Lengths of the beam [m] whose mass the nodes carry: Gauss-Lobatto weights times the elements'."""
        return _shares(arc, self.order, np.array(spans))

    def effects(
        self,
        material: Material,
        nodes: Sequence[Attachment],
        curve: ReferenceCurve,
        spans: list[Span],
        name: str,
    ) -> tuple[list[Effect], list[Effect]]:
        """Elements, and their damping if there is any."""
        kind, damping = self.kinds(material, name)
        shapes, lengths, references = self.shaped(curve, spans, name)
        stiffness, elements, dampings = material.section.stiffness, [], []
        inertias = material.inertias(lengths, _overlaps(self.order))
        rows = zip(spans, shapes, *(apart(x, len(spans)) for x in (references, inertias)))
        for number, (span, shape, reference, inertia) in enumerate(rows):
            markers = tuple(nodes[i] for i in span)
            made = {"stiffness": stiffness, "reference": reference, "inertia": inertia}
            elements.append(kind(markers, name=f"{name}/element {number}", **shape, **made))
            if material.damping is not None:
                loss = {"name": f"{name}/damping {number}", "viscosity": material.damping * stiffness}
                dampings.append(damping(markers, **shape, **loss))
        return elements, dampings

    @abc.abstractmethod
    def kinds(self, material: Material, name: str) -> tuple[Callable[..., Effect], Callable[..., Effect]]:
        """What makes an element, and its damping."""

    @abc.abstractmethod
    def shaped(
        self, curve: ReferenceCurve, spans: list[Span], name: str
    ) -> tuple[list[dict[str, Any]], Float[Array, " e"], Float[Array, "e *p 6"]]:
        """What elements and their damping know of their shape; lengths [m], and unstressed strains."""


def frames_of(curve: ReferenceCurve) -> Float[Array, "n 4 3"]:
    """Point and directors of every node in the unstressed shape."""
    return jnp.concatenate([curve.points[:, None], jnp.swapaxes(curve.frames, 1, 2)], axis=1)


def apart(stacked: Any, count: int) -> list[Any]:
    """Items of a stacked array, or nothing of each; concrete ones without compiled calls."""
    if stacked is None:
        return [None] * count
    if is_concrete(stacked):
        return [as_array(x) for x in np.asarray(stacked)]
    return [stacked[i] for i in range(count)]


class RelativeMotion(Interpolation):
    """Two-node elements, strains from the relative motion of the nodes; see `BeamElement`.

    Mass is lumped at the nodes, by halves of the neighbouring elements. Mass and centre of mass are exact;
    the inertia [kg m^2] of n equal elements of a straight beam is m l^2 / 3 (1 + 1 / (2 n^2)) about an end
    and m l^2 / 12 (1 + 2 / n^2) about the middle: half as much again, and three times, with one element,
    0.5 % and 2 % more with ten.
    """

    def kinds(self, material: Material, name: str) -> tuple[Callable[..., Effect], Callable[..., Effect]]:
        """With an energy of the strains, if there is a law."""
        nonlinear = partial(NonlinearBeamElement, law=material.law)
        return BeamElement if material.law is None else nonlinear, BeamDamping

    def shaped(
        self, curve: ReferenceCurve, spans: list[Span], name: str
    ) -> tuple[list[dict[str, Any]], Float[Array, " e"], Float[Array, "e 6"]]:
        """One element between neighbours."""
        lengths, references = _strains_of_pairs(curve)
        _check_turns(curve, name)
        return [{"length": x} for x in apart(lengths, len(spans))], lengths, references


@eager_numpy
def _strains_of_pairs(curve: ReferenceCurve) -> tuple[Float[Array, " e"], Float[Array, "e 6"]]:
    """Lengths between neighbouring nodes, and strains of their unstressed shape."""
    lengths, frames = jnp.diff(curve.arc), frames_of(curve)
    pairs = jnp.stack([frames[:-1], frames[1:]], axis=1)
    return lengths, jax.vmap(lambda x, length: strains_of(relative_motion(x), length))(pairs, lengths)


def _check_turns(curve: ReferenceCurve, name: str) -> None:
    """Nodes of an element are less than half a turn apart, which is all that their frames can tell.

    Raises:
        ValueError: for others, naming the element.
    """
    if not is_concrete(curve):
        return
    frames, points = np.asarray(curve.frames), np.asarray(curve.points)
    cosines = 0.5 * (np.einsum("nij,nij->n", frames[:-1], frames[1:]) - 1.0)
    straight = np.linalg.norm(np.diff(points, axis=0), axis=1) / np.diff(np.asarray(curve.arc))
    bent = (cosines < HALF_TURN) | (straight < COILED)
    if bent.any():
        raise ValueError(
            f"beam {name!r}: the curve turns by half a turn or more over element {int(np.argmax(bent))}; "
            "pass more elements, or stations= at its corners"
        )


@eager_numpy
def _shares(arc: Float[Array, " n"], order: int, spans: Any) -> Float[Array, " n"]:
    shares = jnp.diff(arc[::order])[:, None] * jnp.asarray(lobatto(order)[1])
    return jnp.zeros_like(arc).at[spans].add(shares)


def _overlaps(order: int) -> Float[np.ndarray, "k k"]:
    """Integrals of the products of the Lagrange functions over a unit of length."""
    points, shares = gauss_legendre(order + 1)
    values = lagrange(lobatto(order)[0], points)[0]
    return (values.T * shares) @ values


@eager_numpy
def _interpolated(curve: ReferenceCurve, order: int, spans: Any) -> tuple[Array, Array, Array, Array]:
    """Values of the Lagrange functions at the points of integration; slopes, weights and strains by element.

    Slopes are along the beam, weights those of the points, strains those of the unstressed shape.
    """
    points, shares = gauss_legendre(order)
    values, unit_slopes = lagrange(lobatto(order)[0], points)
    lengths, frames = jnp.diff(curve.arc[::order]), frames_of(curve)
    slopes = jnp.asarray(unit_slopes) / lengths[:, None, None]
    weights = lengths[:, None] * jnp.asarray(shares)
    values = jnp.asarray(values)
    references = jax.vmap(lambda x, b: director_strains(x, values, b))(frames[spans], slopes)
    return values, slopes, weights, references


class DirectorInterpolation(Interpolation):
    """Elements over two to four nodes that interpolate points and directors; see `DirectorElement`.

    Nodes are at Gauss-Lobatto points of the elements, and the mass is lumped there with the weights of that
    rule, which keeps the order of convergence of the elements: from order two on the inertia of a straight
    beam is exact, at order one it is that of `RelativeMotion`.

    Attributes:
        order: of the Lagrange functions: 1, 2 or 3.

    Raises:
        ValueError: for another order.

    Example:
        >>> import natcoord_jax as nc
        >>> nc.DirectorInterpolation(order=2).order
        2
    """

    order: int = eqx.field(  # pyright: ignore[reportIncompatibleVariableOverride]
        default=1, static=True, metadata=is_a(Choice(tuple(LOBATTO)))
    )

    def kinds(self, material: Material, name: str) -> tuple[Callable[..., Effect], Callable[..., Effect]]:
        """Linear ones.

        Raises:
            ValueError: for an energy law of the strains, which only `RelativeMotion` takes.
        """
        if material.law is not None:
            raise ValueError(f"beam {name!r}: law= needs interpolation=nc.RelativeMotion()")
        return DirectorElement, DirectorDamping

    def shaped(
        self, curve: ReferenceCurve, spans: list[Span], name: str
    ) -> tuple[list[dict[str, Any]], Float[Array, " e"], Float[Array, "e p 6"]]:
        """One element over each span."""
        values, slopes, weights, references = _interpolated(curve, self.order, np.array(spans))
        pairs = zip(*(apart(x, len(spans)) for x in (slopes, weights)))
        shapes = [{"values": values, "slopes": slope, "weights": weight} for slope, weight in pairs]
        return shapes, jnp.sum(weights, axis=1), references
