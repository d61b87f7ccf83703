"""From effects to equations: groups of equal kinds, numbering of unknowns, sweeps along the tree."""
