"""Machine code of our own for programs of small arrays."""
