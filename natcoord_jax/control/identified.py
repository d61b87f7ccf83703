"""What an identification returns: values, how well they are known, and what the data do not tell."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from natcoord_jax.control.fitting import EXACT, Fit, Measurement, Scaling, sides
from natcoord_jax.control.initial import changed
from natcoord_jax.control.measurement import Setting, of_one
from natcoord_jax.control.results import OUTCOMES, Outcome
from natcoord_jax.core.arguments import checked
from natcoord_jax.core.eager_numpy import eager_numpy
from natcoord_jax.core.kinds import Concrete
from natcoord_jax.core.numeric import Number
from natcoord_jax.core.state import State
from natcoord_jax.system import System

SILENT = 1e-10
"""Effect of an unknown on the measured channels, relative to that of others, below which it has none."""
DEPENDENT = 1e-7
"""Singular value of the unit columns of the Jacobian, relative to the largest, below which columns depend on
each other: the accuracy of the derivatives of stiff systems."""
PART = 1e-3
"""Part of an unknown in a combination from which on it counts."""
CLOSE = 0.95
"""Correlation from which on `explain` tells of it."""
MOST = 5
"""Correlations that it tells of."""
ADVICE = {
    Outcome.MAX_ITERATIONS: "allow more evaluations, or begin elsewhere",
    Outcome.SIMULATION_FAILED: "or begin with other values",
    Outcome.SINGULAR: "begin with other values, and look for functions that are not smooth there",
    Outcome.STALLED: "begin elsewhere, or with several starts",
    Outcome.UNDETERMINED: "leave out one unknown of each combination that is named, or measure a motion that "
    "tells them apart",
}
"""What to do."""


class Start(NamedTuple):
    """How the search from one of the starts has ended.

    Attributes:
        values: where, by name.
        cost: half the sum of squares there, weighed by the noise that was given, or by the spread of each
            channel; infinite where the start could not be simulated.
        outcome: how.
        evaluations: how many points were looked at.
    """

    values: dict[str, float]
    cost: float
    outcome: Outcome
    evaluations: int


class Identified(eqx.Module):
    """The end of an identification, reached or not.

    Attributes:
        system: with the values found.
        state: initial state with the values found; of several experiments along a leading axis.
        values: of the unknowns by name, in their units.
        deviations: their standard deviations, to first order, as if there were no bounds; infinite of what
            the data do not determine.
        names: of the unknowns, in the order of `covariance`.
        covariance: of the values (unknowns, unknowns).
        noise: standard deviation of each channel (channels,), as given, or estimated from what is left.
        left: root mean square of what is left of each channel, of as many numbers as are not taken by
            unknowns; beside a noise that was given it should be as large.
        labels: names of the channels.
        residuals: simulated less measured, of the shape of what was measured; NaN where that is missing.
        memory: correlation of what is left of each channel from one sample to the next: zero, but for
            3 / sqrt(samples), where noise is all that is left.
        freedom: measured numbers less unknowns.
        cost: half the sum of squares in units of the noise.
        at_bounds: unknowns that a bound holds, "lower" or "upper".
        undetermined: combinations of unknowns that the channels do not depend on: changes that go together,
            by name, in their units.
        code: how it ended, see `outcome`.
        reason: what was seen where it did not end well.
        evaluations: how many points were looked at from the best start.
        refused: how many of them could not be simulated.
        starts: how the searches have ended, one for each start.
    """

    system: System
    state: State
    values: dict[str, float]
    deviations: dict[str, float]
    names: tuple[str, ...] = eqx.field(static=True)
    covariance: np.ndarray
    noise: np.ndarray
    left: np.ndarray
    labels: tuple[str, ...] = eqx.field(static=True)
    residuals: np.ndarray
    memory: np.ndarray
    freedom: int
    cost: float
    at_bounds: dict[str, str]
    undetermined: list[dict[str, float]]
    code: int
    reason: str
    evaluations: int
    refused: int
    starts: tuple[Start, ...]
    scaling: Scaling = eqx.field(repr=False)
    estimated: bool

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return Outcome(int(self.code))

    @property
    def ok(self) -> bool:
        """Whether the optimum is reached, and the data determine all unknowns."""
        return self.outcome.ok

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the values (unknowns, unknowns); NaN with what the data do not determine."""
        size = np.array([self.deviations[name] for name in self.names])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(np.isfinite(size), self.covariance / size / size[:, None], np.nan)

    @checked("Identified.interval", level=Concrete(Number(above=0.0, below=1.0)))
    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of the unknowns by name, each for itself.

        They are those of the linearised problem, by the distribution of Student where the noise is estimated,
        and by the normal one where it was given. Of unknowns that are searched for by their logarithms they
        are those of the logarithm; all are cut at the bounds.

        Args:
            level: probability [-] with which they cover the true value.
        """
        from scipy.stats import norm, t

        share = 0.5 + 0.5 * level
        wide = t.ppf(share, self.freedom) if self.estimated else norm.ppf(share)
        s = self.scaling
        values = np.array([self.values[name] for name in self.names])
        size = wide * np.array([self.deviations[name] for name in self.names])
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            factor = np.exp(np.where(s.logarithmic, size / np.abs(values), 0.0))
            low = np.where(s.logarithmic, values / factor, values - size)
            high = np.where(s.logarithmic, values * factor, values + size)
        pairs = zip(np.clip(low, s.lower, s.upper).tolist(), np.clip(high, s.lower, s.upper).tolist())
        return dict(zip(self.names, pairs))

    def explain(self) -> str:
        """How it ended, and a table of the values, in words; with what casts doubt on them."""
        count = int(np.isfinite(self.residuals).sum())
        text = f"{OUTCOMES[self.outcome]} after {self.evaluations} evaluations"
        if self.evaluations == 1 and not np.isfinite(self.cost):
            text = "the motion could not be simulated where the search begins"
        text += f"; {self.reason}" if self.reason else ""
        text += f"; {ADVICE[self.outcome]}" if self.outcome in ADVICE else ""
        if not np.isfinite(self.cost):
            return text
        lines = [f"{text}\n{count} measured numbers, {len(self.names)} unknowns, cost {self.cost:.6g}"]
        wide, intervals = max(map(len, self.names)), self.interval()
        lines.append(f"  {'':{wide}} {'value':>12} {'deviation':>12}  95 %")
        for name in self.names:
            low, high = intervals[name]
            row = f"  {name:{wide}} {self.values[name]:>12.6g} {self.deviations[name]:>12.3g}"
            bound = f"  at its {self.at_bounds[name]} bound" if name in self.at_bounds else ""
            lines.append(f"{row}  {low:.6g} ... {high:.6g}{bound}")
        for combination in self.undetermined:
            together = ", ".join(f"{name} changes by {change:+.3g}" for name, change in combination.items())
            lines.append(f"  not determined: no channel sees that {together}")
        lines += self._doubts()
        if len(self.starts) > 1:
            costs = sorted(start.cost for start in self.starts)
            near = sum(cost <= costs[0] * 1.001 for cost in costs)
            lines.append(
                f"  {near} of {len(costs)} starts ended at the least cost, the worst at {costs[-1]:.4g}"
            )
        return "\n".join(lines)

    def _doubts(self) -> list[str]:
        """Noise of the channels, and what speaks against the deviations."""
        lines = []
        close = np.triu(np.nan_to_num(self.correlation), 1)
        pairs = sorted(zip(*np.nonzero(np.abs(close) > CLOSE)), key=lambda pair: -abs(close[pair]))
        for i, j in pairs[:MOST]:
            lines.append(f"  {self.names[i]} and {self.names[j]} are correlated by {close[i, j]:.3f}")
        if len(pairs) > MOST:
            lines.append(f"  and {len(pairs) - MOST} more pairs by more than {CLOSE}")
        counts = np.isfinite(self.residuals).reshape(-1, len(self.labels)).sum(axis=0)
        for label, noise, left, memory, n in zip(self.labels, self.noise, self.left, self.memory, counts):
            line = f"  noise of {label}: {noise:.4g}" + (", estimated" if self.estimated else ", given")
            if not self.estimated and not 0.8 < left / noise < 1.25:
                line += f"; what is left is {left:.4g}"
            if abs(memory) > max(3.0 / np.sqrt(n), 0.2):
                line += (
                    f"; what is left is correlated by {memory:.2f} from sample to sample: it is not noise "
                    "alone, so that the model lacks something, and deviations are too small"
                )
            lines.append(line)
        return lines


def concluded(
    setting: Setting,
    scaling: Scaling,
    data: Measurement,
    states: State,
    fit: Fit,
    noise: np.ndarray,
    fits: list[Fit],
) -> Identified:
    """What the user sees of a fit.

    Args:
        setting: what was simulated.
        scaling: of the unknowns.
        data: what was measured.
        states: initial states of all experiments.
        fit: the best one.
        noise: standard deviation of each channel.
        fits: of all starts.
    """
    at, count = fit.at, len(scaling.names)
    residuals = np.full(data.values.shape, np.nan)
    residuals[data.present] = at.missed
    sound, outcome, undetermined = bool(np.isfinite(fit.cost)), fit.outcome, []
    covariance, held = np.full((count, count), np.nan), np.zeros(count)
    if sound:
        sigma = np.maximum(noise, EXACT * data.spread if data.noise is None else 0.0)[data.channel]
        covariance, directions = spread_of(at.weighted(noise[data.channel])[1])
        held = sides(at, scaling, sigma)
        size = scaling.slopes(at.z)
        covariance = covariance * size * size[:, None]
        for direction in directions * size:
            changes = zip(scaling.names, direction, size)
            undetermined.append({n: float(f"{x:.6g}") for n, x, s in changes if abs(x) > PART * s})
    if undetermined and outcome is Outcome.OPTIMAL:
        outcome = Outcome.UNDETERMINED
    values = scaling.values(at.z)
    system, start = _at(setting, states, scaling.by_experiment(at.z, len(states.t)))
    several = len(states.t) > 1
    return Identified(
        system=system,
        state=start if several else of_one(start, 0),
        values=dict(zip(scaling.names, values.tolist())),
        deviations=dict(zip(scaling.names, np.sqrt(np.diag(covariance)).tolist())),
        names=scaling.names,
        covariance=covariance,
        noise=noise,
        left=data.left(at.missed, count),
        labels=data.labels,
        residuals=residuals if several else residuals[0],
        # (What is left of exact data are tolerances, which follow the motion.)
        memory=np.where(noise > EXACT * data.spread, _memory(residuals), 0.0),
        freedom=len(at.missed) - count,
        cost=fit.cost,
        at_bounds={n: "lower" if k < 0 else "upper" for n, k in zip(scaling.names, held) if k},
        undetermined=undetermined,
        code=int(outcome),
        reason=fit.reason,
        evaluations=fit.evaluations,
        refused=fit.refused,
        starts=tuple(
            Start(dict(zip(scaling.names, scaling.values(f.at.z).tolist())), f.cost, f.outcome, f.evaluations)
            for f in fits
        ),
        scaling=scaling,
        estimated=data.noise is None,
    )


@eager_numpy
def _at(setting: Setting, states: State, values: Any) -> tuple[System, State]:
    """The system and the initial states with values of the unknowns (experiments, n)."""
    system = changed(setting.system, setting.numbers, values[0])
    return system, jax.vmap(lambda state, x: setting.at(state, x)[1])(states, jnp.asarray(values))


def spread_of(slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of unknowns, and the directions in which nothing changes (k, n), their largest entry one.

    The covariance is the inverse of J^T J, J the derivatives of the weighted channels, with infinite
    variances of the unknowns that such a direction changes (Seber and Wild 1989, section 2.1).
    """
    norms = np.linalg.norm(slopes, axis=0)
    loud = norms > SILENT * np.max(norms)
    size = np.where(loud, norms, 1.0)
    _, s, vt = np.linalg.svd(np.where(loud, slopes / size, 0.0), full_matrices=False)
    known = s > DEPENDENT * np.max(s)
    rows = vt[known] / size
    covariance = (rows / s[known, None] ** 2).T @ rows
    directions = vt[~known] / size
    directions /= np.max(np.abs(directions), axis=1, keepdims=True, initial=0.0)
    lost = np.any(np.abs(vt[~known]) > PART, axis=0)
    covariance[lost] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance, directions


def _memory(residuals: np.ndarray) -> np.ndarray:
    """Correlation of what is left from one sample to the next, of each channel."""
    pairs = np.stack([residuals[:, 1:], residuals[:, :-1]])
    pairs = np.where(np.isfinite(pairs).all(axis=0), pairs, 0.0)
    size = np.sqrt(np.prod((pairs**2).sum(axis=(1, 2)), axis=0))
    return np.prod(pairs, axis=0).sum(axis=(0, 1)) / np.where(size > 0, size, 1.0)
