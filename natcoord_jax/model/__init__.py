"""What a scene is compiled to: groups of equal kinds, numbering, the tree; data only."""
