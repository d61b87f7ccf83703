"""The table of what accuracy costs in time."""

from dataclasses import asdict, dataclass, field
from typing import Any

TARGETS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
"""Errors for which the cheapest run is named."""


@dataclass(frozen=True)
class Row:
    """One run.

    Attributes:
        order: of the scheme.
        steps: number of steps.
        error: of the first quantity at the end time, against the reference, in its own unit.
        errors: of all quantities, by name.
        wall_s: median time of the run, compiled [s].
        newton: Newton iterations per step.
        drift: largest change of energy less work, over up to `SAMPLES` equally spaced times, relative to the
            largest sum of the energies and works.
        result: "successful", or why the run ended early.
        note: why the error does not fall any more, or "".
    """

    order: int
    steps: int
    error: float
    errors: dict[str, float]
    wall_s: float
    newton: float
    drift: float
    result: str = "successful"
    note: str = ""


@dataclass(frozen=True)
class Accuracy:
    """Errors and times of a scene over steps and orders.

    Attributes:
        t_end: end time [s].
        rows: one a run, by order and number of steps.
        reference_error: of the reference: the largest difference between two fine runs of the highest order,
            and between those of two orders.
        reference: order and steps of the reference.
        compile_s: time of compilation by order [s], not part of any other time.
        targets: errors that `cheapest` is printed for.
    """

    t_end: float
    rows: tuple[Row, ...]
    reference_error: float
    reference: tuple[int, int]
    compile_s: dict[int, float]
    targets: tuple[float, ...] = field(default=TARGETS)

    def cheapest(self, error: float) -> Row | None:
        """The fastest run with at most this error; None if there is none, or the reference is no better."""
        good = [r for r in self.rows if r.result == "successful" and r.error <= error]
        return min(good, key=lambda r: r.wall_s) if good and error >= self.reference_error else None

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        cheapest = {f"{target:g}": self.cheapest(target) for target in self.targets}
        return {
            "t_end": self.t_end,
            "rows": [asdict(row) for row in self.rows],
            "compile_s": sum(self.compile_s.values()),
            "compile_s_by_order": {str(k): v for k, v in self.compile_s.items()},
            "reference_error": self.reference_error,
            "reference": {"order": self.reference[0], "steps": self.reference[1]},
            "cheapest": {k: row and {"order": row.order, "steps": row.steps} for k, row in cheapest.items()},
        }

    def __str__(self) -> str:
        widths = {"order": 5, "steps": 7, "error": 9, "time": 10, "µs/step": 8, "Newton": 6, "drift": 8}
        lines = [" ".join(f"{name:>{width}}" for name, width in widths.items())]
        for r in self.rows:
            said = r.note if r.result == "successful" else r.result
            lines.append(
                f"{r.order:>5} {r.steps:>7} {r.error:>9.2g} {1e3 * r.wall_s:>7.3g} ms "
                f"{1e6 * r.wall_s / r.steps:>8.3g} {r.newton:>6.2f} {r.drift:>8.1g}  {said}".rstrip()
            )
        lines.append(f"reference: order {self.reference[0]}, {self.reference[1]} steps, "
                     f"good to {self.reference_error:.1g}")  # fmt: skip
        lines.append("compiled in " + ", ".join(f"{s:.1f} s (order {k})" for k, s in self.compile_s.items()))
        for target in self.targets:
            best = self.cheapest(target)
            found = f"order {best.order}, {best.steps} steps, {1e3 * best.wall_s:.3g} ms" if best else "none"
            lines.append(f"cheapest for an error of {target:g}: {found}")
        return "\n".join(lines)
