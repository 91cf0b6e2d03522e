"""The command `terrella check`."""

from ..workflows.check import CheckConfig
from ..workflows.check import check as run_check
from ..workflows.results import command
from .say import Json, WorldName, say, show


def check(world: WorldName, config: CheckConfig, json: Json = False) -> None:
    """Check which laws of physics a world's predictions keep: bodies that overlap or vanish, energy from nothing, wrong gravity.

    Tolerances are calibrated on the recording, so that the truth itself passes. A folder receives a page with plots and the worst
    rollout, and all figures.

    Args:
        world: The world to check: a name of `terrella list`, or a path.
    """
    show(run_check(world, config, progress=say), json, command("terrella", "score", world, data=config.data))
