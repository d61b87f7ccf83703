"""How a beam is made of elements: which nodes they join, what inertia nodes carry, which effects they are."""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from natcoord_jax.bodies.reference_curve import ReferenceCurve
from natcoord_jax.bodies.sections import Section
from natcoord_jax.core.checks import is_concrete
from natcoord_jax.core.effect import Effect
from natcoord_jax.core.markers import Attachment
from natcoord_jax.effects.beams import BeamDamping, BeamElement, NonlinearBeamElement
from natcoord_jax.effects.beams.relative_motion import relative_motion, strains_of

Span = tuple[int, ...]
"""Nodes of an element, in order."""


class Material(eqx.Module):
    """What elements are made of.

    Attributes:
        section: stiffness and inertia.
        law: energy per length of the strains, on top of the linear one, or None.
        damping: time [s] that makes the viscosity from the stiffness, or None for no damping at all.
    """

    section: Section
    law: Any
    damping: Any


class Interpolation(eqx.Module):
    """Base of the ways in which a beam is made of elements."""

    @abc.abstractmethod
    def refine(self, ends: np.ndarray) -> tuple[np.ndarray, list[Span]]:
        """Fractions of all nodes, and the nodes of each element, from the fractions of element ends."""

    @abc.abstractmethod
    def lumps(self, arc: Float[Array, " n"], spans: list[Span]) -> Float[Array, " n"]:
        """Lengths of the beam [m] whose mass the nodes carry."""

    @abc.abstractmethod
    def effects(
        self,
        material: Material,
        nodes: Sequence[Attachment],
        curve: ReferenceCurve,
        spans: list[Span],
        name: str,
    ) -> tuple[list[Effect], list[Effect]]:
        """Elements, and the effects that come with them."""


def frames_of(curve: ReferenceCurve) -> Float[Array, "n 4 3"]:
    """Point and directors of every node in the unstressed shape."""
    return jnp.concatenate([curve.points[:, None], jnp.swapaxes(curve.frames, 1, 2)], axis=1)


def apart(stacked: Any, count: int) -> list[Any]:
    """Items of a stacked array; concrete ones without a call for each."""
    return list(np.asarray(stacked)) if is_concrete(stacked) else [stacked[i] for i in range(count)]


class RelativeMotion(Interpolation):
    """Two-node elements, strains from the relative motion of the nodes; see `BeamElement`.

    Mass is lumped at the nodes, by halves of the neighbouring elements.
    """

    def refine(self, ends: np.ndarray) -> tuple[np.ndarray, list[Span]]:
        """Nodes at the ends of the elements."""
        return ends, [(i, i + 1) for i in range(len(ends) - 1)]

    def lumps(self, arc: Array, spans: list[Span]) -> Array:
        """Half of each neighbouring element."""
        half = 0.5 * jnp.diff(arc)
        return jnp.zeros_like(arc).at[:-1].add(half).at[1:].add(half)

    def effects(
        self,
        material: Material,
        nodes: Sequence[Attachment],
        curve: ReferenceCurve,
        spans: list[Span],
        name: str,
    ) -> tuple[list[Effect], list[Effect]]:
        """One element between neighbours, and its damping if there is any."""
        lengths, frames = jnp.diff(curve.arc), frames_of(curve)
        pairs = jnp.stack([frames[:-1], frames[1:]], axis=1)
        references = jax.vmap(lambda x, length: strains_of(relative_motion(x), length))(pairs, lengths)
        stiffness, elements, dampings = material.section.stiffness, [], []
        rows = zip(spans, apart(lengths, len(spans)), apart(references, len(spans)))
        for number, ((a, b), length, reference) in enumerate(rows):
            given = {
                "markers": (nodes[a], nodes[b]),
                "name": f"{name}/element {number}",
                "length": length,
                "stiffness": stiffness,
                "reference": reference,
            }
            made = (
                BeamElement(**given)
                if material.law is None
                else NonlinearBeamElement(**given, law=material.law)
            )
            elements.append(made)
            if material.damping is not None:
                damper = {"length": length, "viscosity": material.damping * stiffness}
                dampings.append(BeamDamping((nodes[a], nodes[b]), f"{name}/damping {number}", **damper))
        return elements, dampings
