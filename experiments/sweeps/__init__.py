"""Many runs by Hydra's multirun: which jobs there are, how far each is, how each is run.

Every job is a process of its own, started as `sndjax run` would be; a sweep knows its jobs by their
files only.
"""
