"""Recordings: LeRobot v3.0 reader and crash-safe writer, the recorder, clips for training.

Nothing here needs torch but `record`, which is fetched when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .channels import check_game
from .coverage import Coverage, coverage
from .dataset import Dataset
from .format import Layout
from .meta import Episode
from .recorder import Recorder
from .source import Readings, Sensor, Source, Take
from .training.cache import ClipCache, split
from .training.clips import Clips

if TYPE_CHECKING:
    from .recording import record

__all__ = [
    "ClipCache",
    "Clips",
    "Coverage",
    "Dataset",
    "Episode",
    "Layout",
    "Readings",
    "Recorder",
    "Sensor",
    "Source",
    "Take",
    "check_game",
    "coverage",
    "record",
    "split",
]


def __getattr__(name: str):
    if name != "record":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return import_module(f"{__name__}.recording").record
