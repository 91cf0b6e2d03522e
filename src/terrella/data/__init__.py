"""Recordings: LeRobot v3.0 reader and crash-safe writer, clips for training, other formats, merging, doctor."""

from .care.doctor import Fault, doctor
from .care.repair import repair
from .convert import open_source, write_source
from .dataset import Dataset
from .episodes import Episode
from .explore import Explorer
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
    "Explorer",
    "Fault",
    "Layout",
    "Readings",
    "Recorder",
    "Sensor",
    "Source",
    "Take",
    "doctor",
    "open_source",
    "record",
    "repair",
    "repair",
    "split",
    "write_source",
]
