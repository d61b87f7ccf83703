"""What the sensor of a beam element shows."""

import equinox as eqx
from jaxtyping import Array, Float


class BeamReadings(eqx.Module):
    """Strains and section forces of beam elements, about the axes d_1, d_2, d_3 of the section.

    Attributes:
        strain: Gamma_1, Gamma_2 (shear), Gamma_3 (stretch) [-] and K_1, K_2 (curvature), K_3 (twist) [1/m],
            zero in the unstressed shape; of director elements at each Gauss point.
        resultant: forces N_1, N_2, N_3 [N] and moments M_1, M_2, M_3 [N m], energy-conjugate to them.
        energy: strain energy [J].
    """

    strain: Float[Array, "*shape 6"]
    resultant: Float[Array, "*shape 6"]
    energy: Float[Array, "*elements"]
