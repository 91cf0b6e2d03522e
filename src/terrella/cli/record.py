"""The commands `terrella record ...`."""

from ..workflows.collect import CollectConfig, CollectResult, DoomRecordConfig, collect, collect_doom
from ..workflows.recording_facts import describe as described  # noqa: F401  its former name and place
from ..workflows.results import command, folder_name
from .say import Json, WorldName, say, show


def record_doom(config: DoomRecordConfig, json: Json = False) -> None:
    """Record the game Doom: pictures, depth, camera pose, actions and rewards."""
    show(recorded := collect_doom(config, progress=say), json, _training(recorded))


def record_world(name: WorldName, config: CollectConfig, json: Json = False) -> None:
    """Record any world: a Gymnasium environment (gym:CartPole-v1, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or a learned world.

    Args:
        name: The environment (gym:ID), a name of `terrella list`, or the path of a checkpoint or run.
    """
    show(recorded := collect(name, config, progress=say), json, _training(recorded, config.policy or ""))


def _training(recorded: CollectResult, policy: str = "") -> str:
    """The command that learns from a recording: of a teacher a policy, otherwise a world, of pictures where it has any."""
    out = f"runs/{folder_name(recorded.dataset.name)}"
    if policy.partition(":")[0] == "teacher":
        return command("terrella", "train", "policy", method="imitation", **{"from": recorded.dataset}, out=out)
    return command("terrella", "train", "video" if "look" in recorded.facts else "latent", recorded.dataset, out=out)
