"""Recordings: LeRobot v3.0 reader and crash-safe writer, clip cache, explorer, doctor."""

from .cache import ClipCache, split
from .dataset import Dataset, Episode
from .doctor import Fault, doctor
from .explore import Explorer
from .format import Layout
from .record import record
from .recorder import Recorder

__all__ = ["ClipCache", "Dataset", "Episode", "Explorer", "Fault", "Layout", "Recorder", "doctor", "record", "split"]
