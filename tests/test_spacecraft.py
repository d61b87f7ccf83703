"""The spacecraft of the paper (8.1): both torque formulas, against two independent prototypes.

From rest, three motors of 200 N m over 5 s in N steps. The table holds the digits on which the prototypes
agree; `digits` is half a unit of the last one.
"""

import numpy as np
import pytest
from tolerances import SPACECRAFT_MOMENTUM

from natcoord_jax import gallery
from natcoord_jax.gallery.spacecraft import compare_torques

#  N: J_3(5) covariant (70), T(5) contravariant (61), T(5) covariant (70), each with half a last digit
TABLE = {
    5: ((-336, 0.5), (7208.728, 0.0005), (3103.4, 0.05)),
    10: ((-212, 0.5), (7626.4, 0.05), (4926.3, 0.05)),
    20: ((-91.3, 0.05), (7788.9, 0.05), (6584.6, 0.05)),
    40: ((-28.6, 0.05), (7825.0, 0.05), (7443.3, 0.05)),
    80: ((-7.65, 0.005), (7833.428, 0.0005), (7730.8, 0.05)),
}
FINE = (1000, 7836.16535, 0.000005)
CONVERGED = 7836.18288  # Runge-Kutta of order 4, independent of this library [J]


@pytest.fixture(scope="module")
def runs():
    """Rollouts of both formulas for all N, one compiled program."""
    return {(run.formula, run.steps): run for run in compare_torques(tuple(TABLE))}


@pytest.mark.parametrize("steps", TABLE)
def test_energy_with_contravariant_torques(runs, steps):
    value, digit = TABLE[steps][1]
    assert abs(runs["contravariant", steps].energy[-1] - value) <= digit


@pytest.mark.parametrize("steps", TABLE)
def test_energy_with_covariant_torques(runs, steps):
    value, digit = TABLE[steps][2]
    assert abs(runs["covariant", steps].energy[-1] - value) <= digit


@pytest.mark.parametrize("steps", TABLE)
def test_covariant_torques_break_the_balance_of_angular_momentum(runs, steps):
    value, digit = TABLE[steps][0]
    assert abs(runs["covariant", steps].angular_momentum[-1] - value) <= digit


@pytest.mark.parametrize("steps", TABLE)
def test_contravariant_torques_keep_angular_momentum(runs, steps):
    assert np.max(np.abs(runs["contravariant", steps].angular_momentum)) <= SPACECRAFT_MOMENTUM


def test_all_components_of_angular_momentum_and_the_converged_energy():
    steps, energy, digit = FINE
    example = gallery.load("spacecraft")
    trajectory = example.simulate(steps=steps, dt=5.0 / steps)
    system = example.system
    assert np.max(np.abs(system.angular_momentum(trajectory))) <= SPACECRAFT_MOMENTUM
    assert abs(float(system.energy(trajectory).total[-1]) - energy) <= digit
    # Richardson's formula for order two leaves the fourth order of the coarse run, a hundredth of the gap
    coarse = TABLE[80][1][0]
    assert abs(energy + (energy - coarse) / ((steps / 80) ** 2 - 1) - CONVERGED) < 0.02 * (CONVERGED - energy)
