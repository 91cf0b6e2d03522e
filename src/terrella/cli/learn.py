"""The command `terrella learn`."""

from typing import Annotated

from tyro.conf import Positional, arg

from ..core.errors import TerrellaError
from ..workflows import learn as world_workflow
from ..workflows import practise as policy_workflow
from ..workflows.learn import LearnConfig
from ..workflows.opening import ControlsConfig
from ..workflows.results import command
from .say import Json, say, show


def learn(
    name: Annotated[str, Positional, arg(metavar="ENVIRONMENT")],
    config: LearnConfig,
    practise: bool = False,
    json: Json = False,
) -> None:
    """Learn a world of an environment, in one go: a script explores and records it, a world is trained on that, and scored.

    A trial of some seconds first says what the minutes will give. Stop it at any time; the same command continues. While it
    trains, `terrella play` plays the newest state of the world.

    Args:
        name: The environment (gym:CarRacing-v3, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or game (doom:my_way_home).
        practise: Learn a policy, too: collect with it, learn a latent world, practise in that, and again (see docs/practice.md).
    """
    if not practise:
        return show(world_workflow.learn(name, config, progress=say), json)
    if config.controls != ControlsConfig():
        raise TerrellaError("--keys, --action-names and --idle are for a person who plays; --practise takes none.")
    plain = LearnConfig()
    if any(getattr(config, name) != getattr(plain, name) for name in ("preset", "student", "batch", "compile", "half")):
        raise TerrellaError(
            "--preset, --student, --batch, --no-compile and --no-half are for worlds of pictures; --practise takes none."
        )
    shared = (config.minutes, config.out, config.frames, config.seed, config.environment, config.device)
    rounds = policy_workflow.PractiseConfig(*shared)
    practised = policy_workflow.practise(name, rounds, progress=say)
    show(practised, json, command("terrella", "play", practised.world, agent=practised.policy))
