"""Compiled kernels, each tested against a slow twin or plain geometry. A kernel works on one view, or on the views first .. last -
1 of a batch, without Python's lock (space/views.py)."""
