"""Contact between surfaces."""

from natcoord_jax.effects.contact.boxes import CornersOnBox, EdgesOnEdges, SphereOnBox
from natcoord_jax.effects.contact.capsules import CapsuleContacts
from natcoord_jax.effects.contact.discrete_gap import DiscreteGap
from natcoord_jax.effects.contact.frictional_node import FrictionalNodeOnFacets
from natcoord_jax.effects.contact.frictional_potential import FrictionalGapPotential
from natcoord_jax.effects.contact.gap import Gap
from natcoord_jax.effects.contact.gap_constraint import GapConstraint
from natcoord_jax.effects.contact.gap_potential import GapPotential
from natcoord_jax.effects.contact.mortar_gap import MortarGap
from natcoord_jax.effects.contact.node_on_facets import NodeOnFacets
from natcoord_jax.effects.contact.pairs import (
    CapsuleOnCapsule,
    DiscOnPlane,
    EllipsoidOnPlane,
    SphereOnPlane,
    SphereOnSphere,
)

__all__ = [
    "CapsuleContacts",
    "CapsuleOnCapsule",
    "CornersOnBox",
    "DiscOnPlane",
    "DiscreteGap",
    "EdgesOnEdges",
    "EllipsoidOnPlane",
    "FrictionalGapPotential",
    "FrictionalNodeOnFacets",
    "Gap",
    "GapConstraint",
    "GapPotential",
    "MortarGap",
    "NodeOnFacets",
    "SphereOnBox",
    "SphereOnPlane",
    "SphereOnSphere",
]
