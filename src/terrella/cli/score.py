"""The command `terrella score`."""

from tyro.conf import Positional

from ..workflows import score as workflow
from .say import Json, say, show


def score(name: Positional[str], config: workflow.ScoreConfig, json: Json = False) -> None:
    """Compare a world's predictions with a recording: pictures, states, poses, rewards, memory, speed.

    Figures are kept in the folder as they come; the same command goes on where it was stopped.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
    """
    show(workflow.score(name, config, progress=say), json)
