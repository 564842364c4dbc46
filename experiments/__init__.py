"""The laboratory: everything with a side effect, on top of the library `sndjax`. See `cli.py`."""
