"""The scorecard: measures the predictions of any World, and writes the result as JSON and as a page."""

from .album import Album
from .clips import Clip, check_recording, clips_from_cache, in_box, out_of_sight
from .exam import CLIPS, ENDINGS, LONG, Exam, ExamConfig
from .examine import PROBES, examine, most_clips_within, write_report
from .outcomes import clips_with_endings
from .page import page
from .scorecard import Row, Scorecard, place_label
from .strip import strip
from .verdict import as_dict, to_json, verdict

__all__ = ["CLIPS", "ENDINGS", "LONG", "PROBES", "Album", "Clip", "Exam", "ExamConfig", "Row", "Scorecard"]
__all__ += [
    "as_dict",
    "check_recording",
    "clips_from_cache",
    "examine",
    "in_box",
    "out_of_sight",
    "page",
    "clips_with_endings",
]
__all__ += ["strip", "most_clips_within", "to_json", "verdict", "place_label", "write_report"]
