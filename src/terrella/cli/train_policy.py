"""The commands `terrella train policy`, `train inverse` and `practise`."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..workflows.inverse import InverseConfig, train_inverse
from ..workflows.results import changed_settings, command
from ..workflows.train_policy import TrainPolicyConfig, train_policy
from ..workflows.verified_practice import VerifiedPracticeConfig, practise_by_rule
from .say import Json, RecordingName, playing, say, show


def policy(config: TrainPolicyConfig, world: Annotated[str | None, arg(name="in")] = None, json: Json = False) -> None:
    """Train a policy on imagined rollouts of a world, hundreds at once, or with --method imitation on the actions of a recording,
    and measure its return in the real environment. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        world: The world to practise in: a name of `terrella list`, the path of a checkpoint or run, or a simulator (gym:ID).
            Not for imitation.
    """
    trained = train_policy(world, config, progress=say)
    played = world or config.real
    show(trained, json, playing(played, trained.folder, config.environment) if played else "")


def inverse(data: RecordingName, config: InverseConfig, json: Json = False) -> None:
    """Learn from a few labelled episodes which action lies between observations, and label the others, with a calibrated confidence
    that weighs them in imitation. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: The recording to label: a folder, or an address.
    """
    trained = train_inverse(data, config, progress=say)
    recording, seen = trained.facts.get("recording"), changed_settings(config.training)
    options = {"from": recording, "out": f"{config.out}/policy", "sees": seen.get("sees")}
    options["picture_size"] = seen.get("picture_size")
    following = command("terrella", "train", "policy", method="imitation", **options) if recording else ""
    show(trained, json, following)


def practise(
    name: Annotated[str, Positional, arg(metavar="POLICY")],
    config: VerifiedPracticeConfig,
    world: Annotated[str, arg(name="in")],
    json: Json = False,
) -> None:
    """Fine-tune a policy inside a world by computed rewards, and print what that gained inside and in the real environment.

    Beside it a blind arm practises without seeing the world, and the actions that failed outside are replayed inside, where they
    must fail, too. A gain inside without one outside is a warning in the first line. Ctrl-C stops; the same command continues.

    Args:
        name: The folder of a policy by `train policy`, imitating or not.
        world: The world to practise in: a name of `terrella list`, the path of a checkpoint or run, or a simulator (gym:ID).
    """
    practised = practise_by_rule(name, world, config, progress=say)
    show(practised, json, _evaluating(practised.policy, world, config))


def _evaluating(policy: Path, world: str, config: VerifiedPracticeConfig) -> str:
    """The command that evaluates a practised policy by the same success; "" where `evaluate` has no such, for a goal of several
    parts."""
    if len(config.goal) + bool(config.success) > 1:
        return ""
    within = config.within if config.goal and config.within != VerifiedPracticeConfig.within else None
    options = {"in": world, "real": config.real, "goal": config.goal, "success": config.success, "within": within}
    options |= {"steps": config.steps, **changed_settings(config.environment), "best_of": (4, 16)}
    return command("terrella", "evaluate", policy, **options)
