"""Learned worlds: one architecture, one file."""
