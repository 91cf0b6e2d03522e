"""The scorecard: asks any World what its dreams are worth, and writes the answer as JSON and as a page."""

from .album import Album
from .bars import Bar, bars
from .clips import Clip, clips_from_cache, in_box, out_of_sight
from .closure import Closure, closure, key_way, walk_way, yaw_way
from .drift import Drift, drift
from .encoder import FrameEncoder, frame_features, shipped_encoder
from .endurance import Endurance, long_rollout
from .examine import ExamConfig, examine, write_report
from .frechet import clip_features, frechet, frechet_interval
from .page import page
from .scorecard import Scorecard, ScoreConfig, as_dict, score, to_json
from .speed import Speed, speed
from .statistics import Figure
from .strip import strip

__all__ = [
    "Album",
    "Bar",
    "Clip",
    "Closure",
    "Drift",
    "Endurance",
    "ExamConfig",
    "Figure",
    "FrameEncoder",
    "ScoreConfig",
    "Scorecard",
    "Speed",
    "as_dict",
    "bars",
    "clip_features",
    "clips_from_cache",
    "closure",
    "drift",
    "examine",
    "frame_features",
    "frechet",
    "frechet_interval",
    "in_box",
    "key_way",
    "long_rollout",
    "out_of_sight",
    "page",
    "score",
    "shipped_encoder",
    "speed",
    "strip",
    "to_json",
    "walk_way",
    "write_report",
    "yaw_way",
]
