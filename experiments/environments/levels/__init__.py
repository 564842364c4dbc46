"""Fixed levels: one level of MiniGrid, the same in every episode, stepped inside jax.

A level is read from the package `minigrid` once, as numbers; its rules are written again in jax and
tested against the package step by step. This room knows no agent and no run.
"""
