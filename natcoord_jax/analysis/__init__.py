"""What is computed from systems and trajectories after a run."""

from natcoord_jax.analysis.balance import Balance as Balance, balance as balance
