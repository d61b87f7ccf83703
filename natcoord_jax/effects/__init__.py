"""The effects: one small file each. The core knows their kinds, not their names."""
