"""Pure functions without state: vectors, rotations, collocation, polar decomposition."""
