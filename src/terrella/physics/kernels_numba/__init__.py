"""Compiled kernels of the guard, each tested against the laws themselves. They work on rows first .. last - 1 of a batch, without
Python's lock (space/views.py)."""
