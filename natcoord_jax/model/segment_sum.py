"""Adding up what many entries have for few receivers."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from natcoord_jax.maths.indices import INDICES

ROW = 4
"""Entries that a receiver adds up at once."""


class SegmentSum(eqx.Module):
    """How bodies (or other receivers) add up what is meant for them.

    Receivers gather, since scattering would not compile into one kernel. Where one of them has many entries
    these are added up in rows first, so that the others need little padding.

    Attributes:
        entries: of each row, padded with the number of entries.
        rows: of each receiver, padded with the number of rows; None: every receiver has one.
    """

    entries: Int[np.ndarray, "rows _"] = eqx.field(**INDICES)
    rows: Int[np.ndarray, "receivers _"] | None = eqx.field(**INDICES)

    @classmethod
    def of(cls, receivers: np.ndarray, count: int) -> "SegmentSum":
        """Collection for the receivers of all entries; what goes beyond the last one falls away."""
        flat = np.asarray(receivers).reshape(-1)
        order = np.argsort(flat, kind="stable")
        own = np.split(order, np.searchsorted(flat[order], np.arange(1, count + 1)))[:count]
        if max(map(len, own), default=0) <= ROW:
            return cls(_padded(own, len(flat)), None)
        pieces = [[entries[k : k + ROW] for k in range(0, len(entries), ROW)] for entries in own]
        ends = np.cumsum([len(rows) for rows in pieces])
        numbers = [np.arange(end - len(rows), end) for rows, end in zip(pieces, ends)]
        return cls(_padded([row for rows in pieces for row in rows], len(flat)), _padded(numbers, ends[-1]))

    def collect(self, loads: Float[Array, "entries *rest"]) -> Float[Array, "receivers *rest"]:
        """Sum of the loads of each receiver."""
        found = _gathered(loads, self.entries)
        return found if self.rows is None else _gathered(found, self.rows)


def _padded(lists: list[np.ndarray], padding: int | np.integer) -> np.ndarray:
    most = max(map(len, lists), default=0)
    rows = [np.concatenate([x, np.full(most - len(x), padding)]) for x in lists]
    return np.array(rows, np.int32).reshape(len(lists), most)


def _gathered(values: Array, index: np.ndarray) -> Array:
    padded = jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])
    return jnp.sum(padded[index], axis=1)
