"""The process and the machine: errors, files, signals, child processes, the display, versions.

Knows nothing of the project above it: no configuration, no run directory, no agent. Importing it
imports no jax, so that invalid input is reported without delay.
"""
