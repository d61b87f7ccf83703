"""Contact between surfaces."""

from natcoord_jax.effects.contact.boxes import CornersOnBox as CornersOnBox
from natcoord_jax.effects.contact.boxes import EdgesOnEdges as EdgesOnEdges
from natcoord_jax.effects.contact.boxes import SphereOnBox as SphereOnBox
from natcoord_jax.effects.contact.capsules import CapsuleContacts as CapsuleContacts
from natcoord_jax.effects.contact.discrete_gap import DiscreteGap as DiscreteGap
from natcoord_jax.effects.contact.frictional_node import FrictionalNodeOnFacets as FrictionalNodeOnFacets
from natcoord_jax.effects.contact.frictional_potential import FrictionalGapPotential as FrictionalGapPotential
from natcoord_jax.effects.contact.gap import Gap as Gap
from natcoord_jax.effects.contact.gap_constraint import GapConstraint as GapConstraint
from natcoord_jax.effects.contact.gap_potential import GapPotential as GapPotential
from natcoord_jax.effects.contact.law import damping_of as damping_of
from natcoord_jax.effects.contact.mortar_gap import MortarGap as MortarGap
from natcoord_jax.effects.contact.node_on_facets import NodeOnFacets as NodeOnFacets
from natcoord_jax.effects.contact.pairs import CapsuleOnCapsule as CapsuleOnCapsule
from natcoord_jax.effects.contact.pairs import DiscOnPlane as DiscOnPlane
from natcoord_jax.effects.contact.pairs import EllipsoidOnPlane as EllipsoidOnPlane
from natcoord_jax.effects.contact.pairs import SphereOnPlane as SphereOnPlane
from natcoord_jax.effects.contact.pairs import SphereOnSphere as SphereOnSphere
