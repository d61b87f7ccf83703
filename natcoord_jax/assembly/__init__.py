"""From effects to equations: groups of equal kinds, numbering of unknowns, sweeps along the tree."""

from natcoord_jax.assembly.system import System as System  # first: its methods live in modules that need it
