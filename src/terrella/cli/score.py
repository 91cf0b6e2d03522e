"""The command `terrella score`."""

from ..workflows import score as workflow
from ..workflows.results import command
from .say import Json, WorldName, say, show


def score(name: WorldName, config: workflow.ScoreConfig, json: Json = False) -> None:
    """Compare a world's predictions with a recording: pictures, states, poses, rewards, memory, speed.

    Figures are saved as they are measured; the same command continues.

    Args:
        name: A name of `terrella list`, or the path of a checkpoint or run.
    """
    show(workflow.score(name, config, progress=say), json, command("terrella", "play", name))
