"""What there is to draw of a motion, as plain arrays: the description that figures, films and views share.

Everything is in world coordinates [m]; the leading axis t of arrays counts pictures. What is not there at a
time, such as a joint that closes later, is NaN then.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

STOPS = np.array(
    [
        (0.82, 0.86, 0.90), (0.93, 0.90, 0.72), (0.98, 0.83, 0.45), (0.98, 0.66, 0.27), (0.93, 0.44, 0.18),
        (0.80, 0.22, 0.15), (0.58, 0.08, 0.18), (0.35, 0.02, 0.20),
    ]
)  # fmt: skip
RARE = 0.995
"""Share of all values that the scale covers: a peak of an instant must not make all else pale."""


def limits(values: Float[np.ndarray, "..."]) -> tuple[float, float]:
    """Range of the scale: from zero where all values have one sign, without rare peaks, and never empty."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    least, most = (float(x) for x in np.quantile(known, (1 - RARE, RARE)))
    most = most if most > least else float(known.max())
    least, most = min(least, 0.0) if least > 0 or most > -least else least, max(most, 0.0)
    return (least, most) if most > least else (least, least + 1.0)


def along_map(values: Float[np.ndarray, " n"], every: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Colours of values on the scale of all values that there are."""
    least, most = limits(every)
    place = np.clip((np.nan_to_num(values) - least) / (most - least), 0, 1) * (len(STOPS) - 1)
    return np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, k]) for k in range(3)], axis=-1)


Colour = tuple[float, float, float]
T = TypeVar("T")

PALETTE: tuple[Colour, ...] = (
    (0.27, 0.48, 0.71), (0.93, 0.56, 0.23), (0.35, 0.63, 0.36), (0.80, 0.33, 0.34), (0.56, 0.47, 0.68),
    (0.55, 0.44, 0.38), (0.85, 0.53, 0.72), (0.75, 0.68, 0.28), (0.36, 0.68, 0.74), (0.50, 0.53, 0.56),
)  # fmt: skip
DARK, STEEL, RED, GREEN = (0.16, 0.18, 0.21), (0.42, 0.45, 0.49), (0.85, 0.16, 0.12), (0.05, 0.55, 0.25)


TRAVELS = 1.5
"""How many times its own size a motion goes, for the eye to go along."""


class Solid(NamedTuple):
    """A mesh that moves with a frame: a body, a joint, a spring between two points.

    Attributes:
        name: of the body; what belongs to none has the name of its part.
        kind: "body", "arm" from a body to its joints, "joint", "link" or "force".
        points: corners in the frame (n, 3).
        faces: numbers of those around each face.
        rows: origin and three vectors of the frame (t, 4, 3).
        colour: red, green, blue, 0 to 1.
        shade: brightness of each face (faces,).
        rigid: whether the vectors are of length one and at right angles.
        alpha: how opaque it is in figures and films, 0 to 1.
    """

    name: str
    kind: str
    points: np.ndarray
    faces: list[np.ndarray]
    rows: np.ndarray
    colour: Colour
    shade: np.ndarray
    rigid: bool = True
    alpha: float = 1.0

    @property
    def corners(self) -> np.ndarray:
        """Where the corners are (t, n, 3)."""
        return self.rows[:, :1] + self.points @ self.rows[:, 1:]


class Skin(NamedTuple):
    """A surface that changes its shape: a swept beam, shells, the outside of solids.

    Attributes:
        name: of the beam or the elements.
        points: corners (t, n, 3).
        faces: numbers of the four around each face (faces, 4).
        colour: where it has no values.
        values: of the faces (t, faces), or None.
        label: what these are, with their unit.
        edges: whether its mesh is drawn.
        alpha: as of a `Solid`.
    """

    name: str
    points: np.ndarray
    faces: np.ndarray
    colour: Colour
    values: np.ndarray | None = None
    label: str = ""
    edges: bool = True
    alpha: float = 1.0


class Trace(NamedTuple):
    """The path of a point (t, 3), drawn up to the time of the picture."""

    name: str
    points: np.ndarray
    colour: Colour


class Scenery(NamedTuple):
    """A motion, as it is drawn.

    Attributes:
        t: times (t,) [s].
        solids: in the order they are listed.
        skins: the same.
        traces: paths of chosen points.
        up: the direction against gravity (3,) [-].
        ground: height of the ground along `up` [m]; None: there is none, nothing falls.
        title: one line.
    """

    t: np.ndarray
    solids: list[Solid]
    skins: list[Skin]
    traces: list[Trace]
    up: np.ndarray
    ground: float | None
    title: str = ""

    @property
    def bodies(self) -> list[str]:
        """Names of what can be followed: bodies and surfaces."""
        named = [s.name for s in self.solids if s.kind == "body"] + [s.name for s in self.skins]
        return list(dict.fromkeys(named))

    @property
    def boxes(self) -> np.ndarray:
        """Lower and upper corner of the box around everything that moves, at each time (t, 2, 3)."""
        drawn = [s.corners for s in self.solids if s.kind != "force"] + [s.points for s in self.skins]
        if not drawn:
            return np.tile(np.array([[-1.0, -1, -1], [1, 1, 1]]), (len(self.t), 1, 1))
        lower = [np.where(np.isnan(x), np.inf, x).min(axis=1) for x in drawn]
        upper = [np.where(np.isnan(x), -np.inf, x).max(axis=1) for x in drawn]
        found = np.stack([np.min(lower, axis=0), np.max(upper, axis=0)], axis=1)
        # Of a run that broke down there is nothing to see at its end: then what was seen first.
        there = np.isfinite(found).all(axis=(1, 2))
        found[~there] = found[there][0] if there.any() else np.array([[-1.0, -1, -1], [1, 1, 1]])
        return found

    @property
    def extent(self) -> np.ndarray:
        """The box around all of it, over all times (2, 3)."""
        boxes = self.boxes
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @property
    def size(self) -> float:
        """Diagonal of that box [m]."""
        return float(np.linalg.norm(np.ptp(self.extent, axis=0))) or 1.0

    @property
    def reach(self) -> float:
        """Diagonal of the box around the largest of the pictures [m]."""
        return float(np.linalg.norm(np.ptp(self.boxes, axis=1), axis=1).max()) or 1.0

    @property
    def travels(self) -> bool:
        """Whether it goes so far that the eye has to go along."""
        return float(np.linalg.norm(np.ptp(self.boxes.mean(axis=1), axis=0))) > TRAVELS * self.reach

    def eye(self) -> np.ndarray:
        """Direction from which the motion is seen best: across the plane that it spreads in, and from above.

        Right-handed: to the right is a positive axis.
        """
        across = np.eye(3) - np.outer(self.up, self.up)
        spread = across * np.ptp(self.extent, axis=0) ** 2 @ across
        values, axes = np.linalg.eigh(spread + 1e-9 * self.size**2 * across - np.outer(self.up, self.up))
        normal = axes[:, 1]
        right = np.cross(self.up, normal)
        sign = 1.0 if right[np.abs(right).argmax()] > 0 else -1.0
        flat = values[1] < 0.05 * values[2]
        found = sign * normal - (0.3 if flat else 0.75) * sign * right + (0.3 if flat else 0.5) * self.up
        return found / np.linalg.norm(found)


def rounded(x: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(power * next(f for f in (1, 2, 5, 10) if f * power >= x * (1 - 1e-9)))


def joined(parts: Sequence[Scenery]) -> Scenery:
    """Phases one after the other; what a phase lacks is not there then."""
    if len(parts) == 1:
        return parts[0]
    counts = [len(part.t) for part in parts]
    solids = [
        _first(same)._replace(rows=_along([s and s.rows for s in same], counts))
        for same in _alike(parts, lambda part: part.solids)
    ]
    skins = [_joined_skin(same, counts) for same in _alike(parts, lambda part: part.skins)]
    traces = [
        _first(same)._replace(points=_along([s and s.points for s in same], counts))
        for same in _alike(parts, lambda part: part.traces)
    ]
    heights = [part.ground for part in parts if part.ground is not None]
    times = np.concatenate([part.t for part in parts])
    return Scenery(times, solids, skins, traces, parts[0].up, min(heights, default=None), parts[0].title)


def matched(runs: Sequence[Scenery]) -> list[Scenery]:
    """Runs of a batch with the same parts: what one lacks, as a force that never acts, is not there."""
    solids = [_filled(same) for same in _alike(runs, lambda run: run.solids)]
    skins = [_filled(same) for same in _alike(runs, lambda run: run.skins)]
    return [
        run._replace(solids=[same[k] for same in solids], skins=[same[k] for same in skins])
        for k, run in enumerate(runs)
    ]


def _filled(same: list) -> list:
    """With what is missing at all times instead of None."""
    first = _first(same)
    nowhere = {
        name: np.full_like(getattr(first, name), np.nan)
        for name in (("rows",) if isinstance(first, Solid) else ("points", "values"))
        if getattr(first, name) is not None
    }
    return [first._replace(**nowhere) if one is None else one for one in same]


def _joined_skin(same: list[Skin | None], counts: list[int]) -> Skin:
    first = _first(same)
    values = None
    if all(s is None or s.values is not None for s in same):
        values = _along([s and s.values for s in same], counts)
    return first._replace(points=_along([s and s.points for s in same], counts), values=values)


def _first(same: Iterable[T | None]) -> T:
    return next(s for s in same if s is not None)


def _alike(parts, pick) -> list[list]:
    """Parts of the same kind, name and number of points, one list each, with None where there is none."""
    found: dict = {}
    for number, part in enumerate(parts):
        seen: dict = {}
        for item in pick(part):
            key = (item.name, getattr(item, "kind", ""), item.points.shape[-2:])
            seen[key] = seen.get(key, -1) + 1
            found.setdefault((*key, seen[key]), [None] * len(parts))[number] = item
    return list(found.values())


def _along(arrays: list, counts: list[int]) -> np.ndarray:
    shape = next(a.shape[1:] for a in arrays if a is not None)
    return np.concatenate([np.full((n, *shape), np.nan) if a is None else a for a, n in zip(arrays, counts)])
