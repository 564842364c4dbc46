"""Measurements of the cost of runs: time, operations, memory, sweeps, other projects.

Measures the other packages of the laboratory and must not change them.
"""
