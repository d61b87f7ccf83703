"""What is computed from systems and trajectories after a run."""

from natcoord_jax.analysis.balance import Balance, balance

__all__ = ["Balance", "balance"]
