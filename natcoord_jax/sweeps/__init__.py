"""Sweeps: one function of thousands to billions of variants, stored as they are made."""

from natcoord_jax.sweeps.run import sweep
from natcoord_jax.sweeps.table import Sweep

__all__ = ["Sweep", "sweep"]
