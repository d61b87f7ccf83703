"""What shell elements tell of themselves."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from natcoord_jax.effects.materials import Sheet


class ShellReadings(eqx.Module):
    """What goes on in an element of a shell, in its middle, along its own axes 1 and 2.

    The first axis bisects between the side from the first node to the second and what the other sides ask
    for; the director is on the side of positive thickness.

    Attributes:
        strain: of the mid-surface 11, 22, and the angle 12 [-].
        curvature: of the mid-surface, by which strains grow along the director [1/m].
        shear: angles 13 and 23 between director and surface [-].
        resultants: membrane forces per length 11, 22, 12 [N/m].
        moments: per length [N].
        shear_forces: per length [N/m].
        stress: 11, 22, 12 at the surfaces on the sides against and along the director [N/m^2].
        energy: stored [J].
    """

    strain: Float[Array, "*t 3"]
    curvature: Float[Array, "*t 3"]
    shear: Float[Array, "*t 2"]
    resultants: Float[Array, "*t 3"]
    moments: Float[Array, "*t 3"]
    shear_forces: Float[Array, "*t 2"]
    stress: Float[Array, "*t 2 3"]
    energy: Float[Array, "*t"]


def readings_of(
    sheet: Sheet,
    half: Any,
    offset: Any,
    strain: Array,
    curvature: Array,
    shear: Array,
    energy: Array,
    pull: Any,
) -> ShellReadings:
    """Resultants and stresses of strains.

    Args:
        sheet: of the element, about its nodes.
        half: of the thickness [m].
        offset: of the middle of the thickness from the nodes [m].
        strain: of the surface of the nodes.
        curvature: [1/m].
        shear: [-].
        energy: [J].
        pull: resultants that are there without strain [N/m].
    """
    sides = offset - half, offset + half
    stress = [face @ (strain + z * curvature) + pull / (2 * half) for z, face in zip(sides, sheet.faces)]
    resultants = sheet.membrane @ strain + sheet.coupling @ curvature + pull
    moments = sheet.coupling @ strain + sheet.bending @ curvature + offset * pull
    return ShellReadings(
        strain, curvature, shear, resultants, moments, sheet.shear @ shear, jnp.stack(stress), energy
    )
