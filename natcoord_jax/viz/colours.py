"""Colours of values: pale where there is nothing, over yellow and red to dark, ever darker."""

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
