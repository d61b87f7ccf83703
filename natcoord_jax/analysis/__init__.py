"""What is computed from systems and trajectories after a run."""

from natcoord_jax.analysis.accuracy import Accuracy, accuracy
from natcoord_jax.analysis.balance import Balance, balance

__all__ = ["Accuracy", "Balance", "accuracy", "balance"]
