"""Least squares on measured channels: scaled unknowns, runs of the solver, the noise of each channel."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from natcoord_jax.control.measurement import Predicted, Setting
from natcoord_jax.control.results import Outcome
from natcoord_jax.control.side_by_side import Ask, StoppedError
from natcoord_jax.core.checks import for_each
from natcoord_jax.core.results import REASONS, REMEDIES, Result
from natcoord_jax.core.state import State

FAR = 10.0
"""Ratio of positive bounds from which on an unknown is searched for by its logarithm."""
EXACT = 1e-7
"""Standard deviation of the noise, relative to the spread of a channel, below which data count as exact: what
is left then are tolerances of the solver and round-off."""
SETTLED = 0.01
"""Relative change of the noise from round to round at which weights are left as they are."""
ROUNDS = 10
"""Rounds of weighing channels by what they miss, at most."""
NEAR = 0.02
"""Distance from a bound, in deviations of the unknown alone, within which it is at the bound."""
OFF = 0.01
"""Distance from the optimum of the linearised problem, relative to the noise, at which it is reached: the
relative offset of Bates and Watts (1981), Technometrics 23, 179-183."""
TOLERANCE = 1e-10
"""Relative change of the sum of squares and of the unknowns that ends a run of the solver."""


class Scaling(NamedTuple):
    """Unknowns as the solver has them: z is zero where the search begins, and one is a large change.

    Of unknowns between positive bounds that are far apart z is the logarithm, of others the change in terms
    of the size, or of the distance of the bounds where that is zero.

    Attributes:
        names: of the unknowns: parameters, then those of the initial state, experiment by experiment.
        reference: where the search begins.
        size: what z is in terms of.
        logarithmic: whether z is the logarithm.
        lower: lower bounds.
        upper: upper bounds.
        shared: number of those that are the same in all experiments.
    """

    names: tuple[str, ...]
    reference: np.ndarray
    size: np.ndarray
    logarithmic: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    shared: int

    @classmethod
    def of(cls, setting: Setting, states: State, guess: dict[str, Any]) -> "Scaling":
        """Of a setting, with the initial states of all experiments, and other values to begin with by name.

        Raises:
            ValueError: for names that are not different, a guess of what is not unknown, or a value outside
                of its bounds.
        """
        count = len(states.t)
        # Those of the system once, then those of the initial state for each experiment.
        shared = sum(not number.starts for number in setting.numbers)
        read = [np.broadcast_to(n.initial(setting.system, states), count) for n in setting.numbers]
        every: list[tuple[Any, Any, str]] = [
            (number, values[0], "") for number, values in zip(setting.numbers[:shared], read)
        ]
        for k in range(count):
            tail = f", experiment {k}" if count > 1 else ""
            every += [(n, values[k], tail) for n, values in zip(setting.numbers[shared:], read[shared:])]
        names = [number.name + tail for number, _, tail in every]
        if len(set(names)) != len(names) or not names:
            raise ValueError(f"identify: the unknowns have the names {names}; pass some, each with its own")
        strange = sorted(set(guess) - set(names))
        if strange:
            raise ValueError(f"identify: guess has {strange[0]!r}; the unknowns are {', '.join(names)}")
        reference = np.array([float(guess.get(name, x)) for name, (_, x, _) in zip(names, every)])
        lower = np.array([-np.inf if n.lower is None else n.lower for n, _, _ in every])
        upper = np.array([np.inf if n.upper is None else n.upper for n, _, _ in every])
        for name, x, a, b in zip(names, reference, lower, upper):
            if not a <= x <= b:
                raise ValueError(
                    f"identify: {name!r} is {x:g} where the search begins, outside of its bounds {a:g} ... "
                    f"{b:g}; widen them, or begin within, with another system, `value` or `guess`"
                )
        logarithmic = (lower > 0) & (upper >= FAR * lower)
        size, range_ = np.abs(reference), upper - lower
        size = np.where(size > 0, size, np.where(np.isfinite(range_), range_, 1.0))
        return cls(tuple(names), reference, size, logarithmic, lower, upper, shared)

    def values(self, z: np.ndarray) -> np.ndarray:
        """Unknowns in their units."""
        with np.errstate(over="ignore"):
            exponential = self.reference * np.exp(np.where(self.logarithmic, z, 0.0))
        found = np.where(self.logarithmic, exponential, self.reference + self.size * z)
        return np.clip(found, self.lower, self.upper)

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Their derivatives by z."""
        return np.where(self.logarithmic, self.values(z), self.size)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of z."""
        return self._scaled(self.lower), self._scaled(self.upper)

    def _scaled(self, x: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.logarithmic, np.log(x / self.reference), (x - self.reference) / self.size)

    def scattered(self, starts: int, spread: float, seed: int) -> np.ndarray:
        """Where searches begin: zero, then random between two bounds, or about zero where there are not."""
        rng, (lower, upper) = np.random.default_rng(seed), self.bounds()
        between = np.isfinite(lower) & np.isfinite(upper)
        low, high = np.where(between, lower, 0.0), np.where(between, upper, 0.0)
        random = rng.uniform(low, high, (starts, len(low)))
        about = np.clip(spread * rng.standard_normal((starts, len(low))), lower, upper)
        z = np.where(between, random, about)
        z[0] = 0.0
        return z

    def by_experiment(self, z: np.ndarray, experiments: int) -> np.ndarray:
        """Values of the unknowns of each experiment (experiments, n)."""
        x = self.values(z)
        shared = np.repeat(x[None, : self.shared], experiments, axis=0)
        return np.concatenate([shared, x[self.shared :].reshape(experiments, -1)], axis=1)


class Measurement(NamedTuple):
    """What was measured.

    Attributes:
        values: (experiments, samples, channels), NaN where missing.
        present: whether each is there.
        channel: of each number that is there.
        spread: standard deviation of each channel about its mean; of a constant one its size.
        labels: names of the channels.
        noise: standard deviation of each channel that was given; None: none was.
    """

    values: np.ndarray
    present: np.ndarray
    channel: np.ndarray
    spread: np.ndarray
    labels: tuple[str, ...]
    noise: np.ndarray | None

    @classmethod
    def of(cls, values: np.ndarray, labels: tuple[str, ...], noise: object) -> "Measurement":
        """Of measured numbers (experiments, samples, channels).

        Raises:
            ValueError: for another number of channels than the sensors have, one without numbers, and a
                noise that is not positive.
        """
        if values.shape[2] != len(labels):
            raise ValueError(
                f"identify: measured has {values.shape[2]} channels, and the sensors {len(labels)}: "
                f"{', '.join(labels)}; make them agree"
            )
        present = np.isfinite(values)
        empty = [label for label, some in zip(labels, np.atleast_1d(present.any(axis=(0, 1)))) if not some]
        if empty:
            raise ValueError(
                f"identify: measured has no number at all of {', '.join(empty)}; leave it out of `sensors` "
                "and of `measured`"
            )
        if noise is not None:
            noise = np.asarray(for_each(noise, len(labels), "identify: noise", "channel"))
            if np.any(noise <= 0):
                raise ValueError(
                    f"identify: noise of a channel is {noise.min():g}; pass positive standard deviations, or "
                    "None, and it is estimated"
                )
        deviation, size = np.nanstd(values, axis=(0, 1)), np.nanmax(np.abs(values), axis=(0, 1))
        spread = np.where(deviation > EXACT * size, deviation, np.where(size > 0, size, 1.0))
        return cls(values, present, np.nonzero(present)[2], spread, labels, noise)  # pyright: ignore

    @property
    def sigma(self) -> np.ndarray:
        """What channels are weighed by at first."""
        return self.spread if self.noise is None else self.noise

    def left(self, missed: np.ndarray, unknowns: int) -> np.ndarray:
        """Standard deviation of what is left of each channel, as if each had its part of the unknowns."""
        squares = np.bincount(self.channel, missed**2, len(self.spread))
        counts, total = np.bincount(self.channel, minlength=len(self.spread)), len(missed)
        return np.sqrt(squares / counts * total / max(total - unknowns, 1))


@dataclass(frozen=True)
class At:
    """A point of the search.

    Attributes:
        z: scaled unknowns.
        missed: simulated less measured, of all numbers that are there.
        slopes: its derivatives by z.
        code: of the simulation that failed, or of all.
        sound: whether all simulations went well, and have derivatives.
    """

    z: np.ndarray
    missed: np.ndarray
    slopes: np.ndarray
    code: Result
    sound: bool

    @classmethod
    def of(cls, z: np.ndarray, data: Measurement, scaling: Scaling, found: Predicted) -> "At":
        """From what was predicted of all experiments."""
        channels, slopes = found.channels, found.slopes
        whole = np.zeros((*channels.shape, len(z)))
        shared, own = scaling.shared, slopes.shape[-1] - scaling.shared
        whole[..., :shared] = slopes[..., :shared]
        for k in range(len(whole)):
            first = shared + k * own
            whole[k, ..., first : first + own] = slopes[k, ..., shared:]
        missed = np.asarray((channels - data.values)[data.present])
        slopes = np.asarray(whole[data.present] * scaling.slopes(z))
        failed = [code for code in found.result if not Result(int(code)).ok]
        code = Result(int(failed[0])) if failed else Result.SUCCESSFUL
        sound = code.ok and bool(np.isfinite(missed).all() and np.isfinite(slopes).all())
        return cls(z, missed, slopes, code, sound)

    def weighted(self, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is missed and its derivatives, in units of the noise."""
        return self.missed / sigma, self.slopes / sigma[:, None]


@dataclass(frozen=True)
class Fit:
    """How one run of the solver has ended.

    Attributes:
        at: the best point, or the first one where all was refused.
        cost: half the sum of the weighted squares there.
        outcome: how it ended.
        evaluations: how many points were looked at.
        refused: how many of them could not be simulated.
        reason: what was seen where it did not end well.
    """

    at: At
    cost: float
    outcome: Outcome
    evaluations: int
    refused: int = 0
    reason: str = ""


def searched(ask: Ask, first: At, scaling: Scaling, sigma: np.ndarray, most: int) -> Fit:
    """A run of SciPy's trust region reflective method, which keeps within bounds.

    It is SciPy's because bounds, ranks and refused points are its daily work; a solver in the compiled
    program would be faster by what Python takes between points, which is nothing beside the simulations.

    Args:
        ask: what belongs to a point.
        first: where it begins.
        scaling: of the unknowns.
        sigma: standard deviation of every number.
        most: points that may be looked at.
    """
    from scipy.optimize import least_squares

    looks, refused, last, best = 1, 0, first, (np.inf, first)

    def at(z: np.ndarray) -> At:
        nonlocal looks, refused, last, best
        if not np.array_equal(last.z, z):
            last = ask(z)
            looks += 1
            refused += not last.sound
            best = min(best, (cost(last), last), key=lambda pair: pair[0])
        return last

    def cost(here: At) -> float:
        return float(np.sum((here.missed / sigma) ** 2) / 2) if here.sound else np.inf

    def missed(z: np.ndarray) -> np.ndarray:
        here = at(z)
        return here.missed / sigma if here.sound else np.full(len(sigma), np.nan)

    if not first.sound:
        outcome = Outcome.SINGULAR if first.code.ok else Outcome.SIMULATION_FAILED
        return Fit(first, np.inf, outcome, 1, 1, _failure(first.code))
    best = cost(first), first
    try:
        # (Which moves a start from a bound inwards by a little.)
        end = least_squares(
            missed, first.z, lambda z: at(z).weighted(sigma)[1],  # pyright: ignore[reportArgumentType]
            bounds=scaling.bounds(), ftol=TOLERANCE, xtol=TOLERANCE, gtol=1e-8, max_nfev=most, method="trf",
        )  # fmt: skip
        outcome = Outcome.MAX_ITERATIONS if end.status == 0 else Outcome.OPTIMAL
    except StoppedError:
        outcome = Outcome.STOPPED
    return Fit(best[1], best[0], outcome, looks, refused)


def finished(ask: Ask, fit: Fit, scaling: Scaling, data: Measurement, most: int) -> tuple[Fit, np.ndarray]:
    """The best run, its channels weighed by their noise, and the noise of each channel.

    Where no noise was given, that of each channel is what it misses, and the run goes on with these weights
    until they settle: then it is the maximum of the likelihood for normal noise of unknown deviations.
    """
    count, floor, sigma = len(scaling.names), EXACT * data.spread, data.sigma
    for _ in range(ROUNDS if data.noise is None else 0):
        now = np.maximum(data.left(fit.at.missed, count), 1e-12 * data.spread)
        change = np.max(np.abs(np.log(np.maximum(now, floor) / np.maximum(sigma, floor))))
        alike, sigma = len(now) == 1 or change < SETTLED, now
        if alike or fit.outcome is not Outcome.OPTIMAL:
            break
        again = searched(ask, fit.at, scaling, np.maximum(sigma, floor)[data.channel], most)
        fit = replace(
            again, evaluations=again.evaluations + fit.evaluations, refused=again.refused + fit.refused
        )
    each = np.maximum(sigma, floor)[data.channel]
    at_bound = sides(fit.at, scaling, each)
    if np.any(at_bound):
        z = np.where(at_bound < 0, scaling.bounds()[0], np.where(at_bound > 0, scaling.bounds()[1], fit.at.z))
        try:
            there = ask(z)
            fit = replace(fit, at=there) if there.sound else fit
        except StoppedError:
            fit = replace(fit, outcome=Outcome.STOPPED)
    if fit.outcome is Outcome.OPTIMAL and not _reached(fit.at, scaling, each):
        reason = "the slope does not vanish where the solver made no progress any more"
        if fit.refused:
            reason += f"; {fit.refused} points could not be simulated"
        fit = replace(fit, outcome=Outcome.STALLED, reason=reason)
    missed = fit.at.missed / sigma[data.channel]
    return replace(fit, cost=float(missed @ missed / 2)), sigma


def sides(at: At, scaling: Scaling, sigma: np.ndarray) -> np.ndarray:
    """Of each unknown -1 if its lower bound holds it, 1 if its upper one does, and 0 if none."""
    missed, slopes = at.weighted(sigma)
    push, sharp, (lower, upper) = slopes.T @ missed, np.linalg.norm(slopes, axis=0), scaling.bounds()
    reach = NEAR / np.maximum(sharp, 1e-300)
    low, high = at.z - lower <= reach, upper - at.z <= reach
    return np.where(low & (push > 0), -1, np.where(high & (push < 0), 1, 0))


def _reached(at: At, scaling: Scaling, sigma: np.ndarray) -> bool:
    """Whether what is free is at the optimum, to a part of the noise."""
    missed, slopes = at.weighted(sigma)
    slopes = slopes[:, sides(at, scaling, sigma) == 0]
    if not slopes.shape[1]:
        return True
    step = np.linalg.lstsq(slopes, missed, rcond=1e-7)[0]
    size = max(1.0, float(np.linalg.norm(missed)) / np.sqrt(max(len(missed) - slopes.shape[1], 1)))
    return bool(np.linalg.norm(slopes @ step) <= OFF * size * np.sqrt(slopes.shape[1]))


def _failure(code: Result) -> str:
    """What was seen where a simulation failed."""
    if code.ok:
        return "the channels are not finite, or have no derivatives"
    return f"{REASONS[code]}; {REMEDIES[code]}" if code in REMEDIES else REASONS[code]
