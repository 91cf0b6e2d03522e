"""Policies and planners over any World."""

from .explorer import Explorer

__all__ = ["Explorer"]
