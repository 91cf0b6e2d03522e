"""Recordings: LeRobot v3.0 reader and crash-safe writer, the recorder, clips for training."""

from .dataset import Dataset
from .episodes import Episode
from .format import Layout
from .record import record
from .recorder import Recorder
from .source import Readings, Sensor, Source, Take
from .training.cache import ClipCache, split
from .training.clips import Clips

__all__ = [
    "ClipCache",
    "Clips",
    "Dataset",
    "Episode",
    "Layout",
    "Readings",
    "Recorder",
    "Sensor",
    "Source",
    "Take",
    "record",
    "split",
]
