"""The compiled kernels of this room, one file a subject; tests hold each against a slow, obvious twin or plain geometry.

A kernel works on one view, or on the views first .. last - 1 of a batch, and holds no lock of Python's: see space/views.py.
"""
