"""Sweeps by Hydra's multirun: the list of jobs, the state of each job, and how a job is run.

Every job is a separate process, started like `sndjax run`. A sweep reads the state of its jobs only
from their files.
"""
