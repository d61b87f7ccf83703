"""Peer codes of the benchmarks: the same models, described once as data, in Exudyn, MuJoCo and MJX."""
