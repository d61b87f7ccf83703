"""What is computed from systems and trajectories after a run."""

from natcoord_jax.analysis.accuracy import Accuracy, accuracy
from natcoord_jax.analysis.balance import Balance, balance

from natcoord_jax.analysis.statics import Equilibrium, equilibrium

__all__ = ["Accuracy", "Balance", "Equilibrium", "accuracy", "balance", "equilibrium"]
