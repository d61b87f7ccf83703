"""What the hard cases share: runs at every order, and the statistics of a drift."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import pytest
from numpy.typing import NDArray

import natcoord_jax as nc

SECOND_AND_FOURTH = pytest.mark.parametrize("order", [2, 4])
"""The step of the paper, and the first scheme with kicks."""


def simulate(system: Any, state: Any, *, order: int = 2, **options: Any) -> nc.Trajectory:
    """A run with the energy-momentum scheme of an order."""
    return nc.simulate(system, state, scheme=nc.EnergyMomentum(order=order), **options)


OPTIMISED = {"xla_backend_optimization_level": 3}
"""What users run with. The suite compiles without (see `conftest.py`); steps then take ten times as long."""


def simulate_long(system: Any, state: Any, **options: Any) -> nc.Trajectory:
    """A run of so many steps that the time to compile an optimised program is won back."""
    run = jax.jit(lambda system, state: simulate(system, state, **options), compiler_options=OPTIMISED)
    trajectory = run(system, state)
    system.raise_on_failure(trajectory)
    return trajectory


def one_body(
    part: Any,
    gravity: Any = (0.0, 0.0, -9.81),
    joint: Any = nc.Spherical,
) -> Any:
    """A body on a joint at the origin (None: free); equal structure, hence a shared program."""
    scene = nc.Scene()
    scene.add(nc.Gravity(vector=gravity))
    body = scene.add(part)
    if joint is not None:
        scene.add(joint(nc.ground, body, (0.0, 0.0, 0.0), name="hinge"))
    return scene.compile()


@dataclass(frozen=True)
class Drift:
    """The steady part of an error that is sampled at equal intervals.

    An error that rounding makes is a random walk: its increments have no mean. The mean increment is the
    best estimate of the slope of a walk (a straight line fitted to the walk itself finds slopes where there
    are none), and it is known to the scatter of the increments over the root of their number.

    Attributes:
        rate: mean increment of a step.
        score: the mean increment in terms of its standard error; below three for a walk without drift.
        largest: largest error.
    """

    rate: float
    score: float
    largest: float

    @classmethod
    def of(cls, errors: NDArray, steps: int) -> "Drift":
        """Of errors sampled over so many steps."""
        increments = np.diff(errors)
        deviation = np.std(increments) / np.sqrt(len(increments))
        score = np.mean(increments) / deviation if deviation > 0 else 0.0
        return cls(float(errors[-1] - errors[0]) / steps, float(score), float(np.max(np.abs(errors))))
