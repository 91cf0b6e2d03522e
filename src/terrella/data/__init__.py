"""Recordings: LeRobot v3.0 reader and crash-safe writer, the recorder, clips for training. Only `record` and its options need
torch; they are imported when they are first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .coverage import Coverage, measure_coverage
from .dataset import Dataset
from .format import Layout
from .game import check_game
from .meta import Episode
from .recorder import Recorder
from .source import Readings, Sensor, Source, Take
from .training.cache import ClipCache, split
from .training.clips import Clips, ClipsConfig

if TYPE_CHECKING:
    from .recording import RecordOptions, record

__all__ = [
    "ClipCache", "Clips", "ClipsConfig", "Coverage", "Dataset", "Episode", "Layout", "Readings", "RecordOptions",
    "Recorder", "Sensor", "Source", "Take", "check_game", "measure_coverage", "record", "split",
]  # fmt: skip


def __getattr__(name: str):
    if name not in ("RecordOptions", "record"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.recording"), name)
