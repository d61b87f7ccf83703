"""Benchmarks: what accuracy costs in time, beside other codes, and how time grows with the bodies."""
