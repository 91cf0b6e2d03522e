"""Other formats and mixing robots: MCAP, Minari, HDF5, rollouts, videos and images in and out; merging; watching live."""

from .convert import open_source, write_source

__all__ = ["open_source", "write_source"]
