"""The commands `terrella train policy` and `train inverse`."""

from typing import Annotated

from tyro.conf import arg

from ..workflows.inverse import InverseConfig, train_inverse
from ..workflows.results import command
from ..workflows.train_policy import TrainPolicyConfig, train_policy
from .say import Json, RecordingName, say, show


def policy(config: TrainPolicyConfig, world: Annotated[str | None, arg(name="in")] = None, json: Json = False) -> None:
    """Train a policy on imagined rollouts of a world, hundreds at once, or with --method imitation on the actions of a recording,
    and measure its return in the real environment. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        world: The world to practise in: a name of `terrella list`, the path of a checkpoint or run, or a simulator (gym:ID).
            Not for imitation.
    """
    trained = train_policy(world, config, progress=say)
    played = world or config.real
    show(trained, json, command("terrella", "play", played, agent=trained.folder) if played else "")


def inverse(data: RecordingName, config: InverseConfig, json: Json = False) -> None:
    """Learn from a few labelled episodes which action lies between observations, and label the others, with a calibrated confidence
    that weighs them in imitation. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: The recording to label: a folder, or an address.
    """
    trained = train_inverse(data, config, progress=say)
    recording, out = trained.facts.get("recording"), f"{config.out}/policy"
    following = (
        command("terrella", "train", "policy", method="imitation", out=out, **{"from": recording}) if recording else ""
    )
    show(trained, json, following)
