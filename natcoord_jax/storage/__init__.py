"""What outlives the process: described structures with their arrays, and states as they are made."""

from natcoord_jax.storage.archive import load, save

__all__ = ["load", "save"]
