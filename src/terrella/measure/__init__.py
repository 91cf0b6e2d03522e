"""The scorecard: asks any World what its predictions are worth, and writes the answer as JSON and as a page."""

from .album import Album
from .clips import Clip, check_recording, clips_from_cache, in_box, out_of_sight
from .encoder import FrameEncoder, frame_features, shipped_encoder
from .exam import CLIPS, ENDINGS, LONG, Exam, ExamConfig, Probe
from .examine import PROBES, examine, write_report
from .frechet import clip_features, frechet, frechet_interval
from .outcomes import Passage, passages
from .page import page
from .scorecard import Bar, Row, Scorecard, as_dict, to_json, worst_of
from .statistics import Figure
from .strip import strip
from .verdict import verdict

__all__ = [
    "CLIPS",
    "ENDINGS",
    "LONG",
    "PROBES",
    "Album",
    "Bar",
    "Clip",
    "Exam",
    "ExamConfig",
    "Figure",
    "FrameEncoder",
    "Passage",
    "Probe",
    "Row",
    "Scorecard",
    "as_dict",
    "check_recording",
    "clip_features",
    "clips_from_cache",
    "examine",
    "frame_features",
    "frechet",
    "frechet_interval",
    "in_box",
    "out_of_sight",
    "page",
    "passages",
    "shipped_encoder",
    "strip",
    "to_json",
    "verdict",
    "worst_of",
    "write_report",
]
