"""What the hard cases share: runs at an order, what they have lost, and the statistics of a drift."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import tolerances as tol
from accounts import Account
from numpy.typing import NDArray

import natcoord_jax as nc


def orders(**lanes: Any) -> pytest.MarkDecorator:
    """The step of the paper (`second`), the first scheme with kicks (`fourth`), by the lane of each.

    Args:
        lanes: name of the mark by the order; "" for the default lane. Orders that are not named are
            exhaustive.
    """
    names = {"second": 2, "fourth": 4}
    marks = {name: lanes.get(name, "exhaustive") for name in names}
    return pytest.mark.parametrize(
        "order",
        [pytest.param(names[n], marks=[getattr(pytest.mark, m)] if m else []) for n, m in marks.items()],
    )


def simulate(system: Any, state: Any, *, order: int = 2, **options: Any) -> nc.Trajectory:
    """A run with the energy-momentum scheme of an order."""
    return nc.simulate(system, state, scheme=nc.EnergyMomentum(order=order), **options)


def losses(laws: Account, **bounds: float) -> dict[str, float]:
    """What a run has lost beyond its bounds, by law; nothing for a run that obeys all of them.

    Args:
        laws: account of the run.
        bounds: of `energy`, `constraint` and `turned`, where they are others than those of all scenes.
    """
    energy, constraint = bounds.get("energy", tol.ENERGY), bounds.get("constraint", tol.CONSTRAINT)
    errors = {
        "energy": (laws.energy_error, energy),
        "directors": (laws.directors, constraint),
        "joints": (laws.joints, constraint),
    }
    lost = {law: error for law, (error, bound) in errors.items() if not error <= bound}
    if not laws.turned >= bounds.get("turned", 1.0):
        lost["angle turned, so that nothing is tested"] = laws.turned
    return lost


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
        scene.add(joint(nc.ground, body, point=(0.0, 0.0, 0.0), name="hinge"))
    return scene.compile()


BLOCKS = 25


@dataclass(frozen=True)
class Drift:
    """The steady part of an error sampled at equal intervals: the slope of a straight line through it.

    An error that rounding makes is a walk: its increments have no mean, and a line finds a slope all the
    same, far above what the scatter about the line tells. The slope is a weighted sum of the increments;
    were they independent, its variance would be theirs times the sum of the squares of the weights. They
    are not, as rounding repeats itself with the motion: the variance is taken from means over blocks,
    each many times as long as they are alike.

    Attributes:
        rate: slope per step.
        error: its standard error.
        largest: largest error.
    """

    rate: float
    error: float
    largest: float

    @property
    def score(self) -> float:
        """The slope in terms of its standard error: below three for a walk without drift."""
        return self.rate / self.error if self.error > 0 else 0.0

    @classmethod
    def of(cls, errors: NDArray, steps: int) -> "Drift":
        """Of errors sampled over so many steps."""
        samples = len(errors) - 1
        times = np.linspace(-0.5, 0.5, samples + 1) * steps
        increments = np.diff(errors)
        weights = np.cumsum(times[:0:-1])[::-1] / np.sum(times**2)
        length = samples // BLOCKS
        means = increments[: BLOCKS * length].reshape(BLOCKS, length).mean(axis=1)
        variance = length * np.var(means, ddof=1)
        error = np.sqrt(variance * np.sum(weights**2))
        return cls(float(weights @ increments), float(error), float(np.max(np.abs(errors))))
