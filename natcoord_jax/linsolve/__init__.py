"""Linear solvers inside the Newton step; they know matrices and blocks, nothing else."""
