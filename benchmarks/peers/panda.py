"""An arm with seven axes as plain data that any code can build from: masses, frames, postures, limits."""

import math

LINKS = (
    (4.97, (0.0039, 0.0021, -0.0476), (0.7034, 0.7066, 0.0091)),
    (0.647, (-0.0031, -0.0287, 0.0035), (0.0080, 0.0281, 0.0260)),
    (3.229, (0.0275, 0.0392, -0.0665), (0.0372, 0.0362, 0.0108)),
    (3.588, (-0.0532, 0.1044, 0.0275), (0.0259, 0.0196, 0.0283)),
    (1.226, (-0.0120, 0.0411, -0.0384), (0.0355, 0.0295, 0.0086)),
    (1.667, (0.0601, -0.0141, -0.0105), (0.0020, 0.0044, 0.0054)),
    (0.735, (0.0105, -0.0043, 0.0616), (0.0125, 0.0100, 0.0048)),
)
"""Mass [kg], centre of mass [m] and principal inertia [kg m^2] of the links: C. Gaz et al., IEEE Robotics and
Automation Letters 4 (2019), rounded, products of inertia left out."""
FRAMES = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)
"""Modified Denavit-Hartenberg parameters of its joints: length, offset [m], twist [rad]."""
START = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
END = (1.2, 0.3, -0.5, -1.4, 0.4, 2.2, 0.2)
"""Postures at rest [rad]."""
LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Of the torques [N m]."""
RATES = 100.0
"""Weight of the squares of the rates beside those of the torques [N^2 m^2 s^2]: without it the least effort
is that of an arm that whips at 50 rad/s and more, of which there are many ways."""
T_END = 1.5  # [s]
GRAVITY = 9.81  # [m/s2]
