"""The commands `terrella train ...`."""

from collections.abc import Callable
from typing import Annotated

from tyro.conf import arg

from ..learn.devices import describe_device, device_named
from ..learn.recipes.adapt import AdaptConfig
from ..learn.recipes.goals import GoalTraining, train_goals
from ..learn.recipes.latent import LatentTraining
from ..learn.recipes.latent_actions import LatentActionsConfig, train_latent_actions
from ..learn.recipes.parts import (
    EstimatorTraining,
    ObjectsTraining,
    SensesConfig,
    train_estimator,
    train_objects,
    train_uncertainty,
)
from ..learn.recipes.post_training import DistilConfig, DreamsConfig, distil, train_dreams
from ..learn.recipes.video import TrainConfig
from ..library import folder_of
from ..workflows.opening import Device, load_named
from ..workflows.progress import Report
from ..workflows.results import command, folder_name
from ..workflows.train import adapt as adapt_world
from ..workflows.train import run_recipe, train_latent, train_video
from ..worlds.folder import load_world
from ..worlds.learned import LearnedWorld
from .say import Json, RecordingName, WorldName, say, show


def video(data: RecordingName, out: str, config: TrainConfig, json: Json = False) -> None:
    """Train a playable world on a recording. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: The recording: a folder, or an address (hf://..., s3://...).
        out: Folder of the run: the world, a log, and pictures of truth and prediction.
    """
    show(train_video(data, out, config, progress=say), json, command("terrella", "score", out, data=data, quick=True))


def latent(data: RecordingName, out: str, config: LatentTraining, json: Json = False) -> None:
    """Train a latent world on a recording with pictures, state vectors or both: it predicts a latent instead of pixels, for
    thousands of rollouts at once. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        data: The recording: a folder, or an address (hf://..., s3://...).
        out: Folder of the run: the world, a log, validation.json, and pictures of truth and prediction.
    """
    show(train_latent(data, out, config, progress=say), json, _practising(out, data))


def goals(
    world: Annotated[str, arg(name="in")],
    recording: Annotated[str, arg(name="from")],
    out: str,
    config: GoalTraining,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Train a policy that reaches goals in a latent world without a search, by hindsight relabelling: each state that an episode
    reached is a goal for the actions before it. Takes a minute or two; the same command continues.

    Args:
        world: The latent world, a run of `train latent`.
        recording: The recording on which it was trained.
        out: Folder of the run. `terrella plan --agent OUT` and `--proposal OUT` use the policy.
    """
    inside = load_named(world, device)
    _shown(lambda report: train_goals(inside, world, recording, out, config, report), json, run=out)


def adapt(
    name: WorldName,
    data: Annotated[str, arg(name="from")],
    out: str,
    config: AdaptConfig,
    keep: Annotated[str | None, arg(metavar="RECORDING")] = None,
    json: Json = False,
) -> None:
    """Adapt a world to another body or camera: it goes on learning on a recording of minutes. Stop it with Ctrl-C at any time; the
    same command continues.

    Args:
        name: A learned world: a run of `train latent` or `train video`, or its folder. One with depth and poses has the places
            of the new recording from then on.
        data: A recording of the other body or camera, with the same channels and as many actions.
        out: Folder of the run; the adapted world is in OUT/world.
        keep: A recording that the world was trained on. Half of the clips are of it (of frames a quarter), so that less
            is forgotten, and how much is forgotten is measured.
    """
    result = adapt_world(name, data, out, config, keep=keep, progress=say)
    show(result, json, _practising(out, data) if result.facts["latent"] else _playing(out))


def estimator(data: RecordingName, out: str, config: EstimatorTraining, json: Json = False) -> None:
    """Train a depth and odometry estimator on a recording with depth and poses: depth from one picture, motion from two.

    Args:
        data: The recording: a folder, or an address.
        out: Folder for estimator.safetensors, and estimator.json with its errors on held-out episodes.
    """
    _shown(lambda report: train_estimator(data, out, config, report), json)


def uncertainty(name: WorldName, data: str, out: str, config: SensesConfig, json: Json = False) -> None:
    """Train a world's estimator, so that it can start from a single picture, and its uncertainty, the error to expect. `train
    video` ends with both.

    Args:
        name: The world: a name that `terrella list` shows, or a folder.
        data: The recording that it was trained on.
        out: Folder of the run; the world is in OUT/world.
    """
    _shown(lambda report: train_uncertainty(folder_of(name), data, out, config, report), json, _playing(out))


def objects(name: WorldName, data: str, out: str, config: ObjectsTraining, json: Json = False) -> None:
    """Train a world's objects on another recording: how they look, move, change and vanish. Takes minutes.

    Args:
        name: The world: a name that `terrella list` shows, or a folder.
        data: A recording of the same game with the identity of each object.
        out: Folder of the run; the world is in OUT/world.
    """
    _shown(lambda report: train_objects(folder_of(name), data, out, config, report), json, _playing(out))


def latent_actions(data: RecordingName, out: str, config: LatentActionsConfig, json: Json = False) -> None:
    """Learn a few latent actions from pictures alone. `terrella data label` then writes them into a recording.

    Args:
        data: The recording: a folder, or an address. Its own actions, if it has any, are not used.
        out: Folder of the run: checkpoint, log, and pictures of true, inferred and random actions.
    """
    copy = f"{folder_name(data)}-labelled" if "://" in data else f"{data.rstrip('/')}-labelled"
    following = command("terrella", "data", "label", out, data, out=copy)
    _shown(lambda report: train_latent_actions(data, out, config, report), json, following)


def few_steps(
    name: WorldName,
    data: str,
    out: str,
    config: DistilConfig,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Distil a world into one that is faster to play. With depth: a world that draws a frame in many steps (`train video
    --flow-steps 8`) into one that needs one or two. Without: a larger network (`train video --preset medium`) into a small one.

    Args:
        name: The teacher: a name that `terrella list` shows, or a folder.
        data: A recording of the same game.
        out: Folder of the run: the world, a log, and pictures of truth and prediction.
    """
    _shown(lambda report: distil(_learned(name, device), data, out, config, report), json, _playing(out), run=out)


def dreams(
    name: WorldName,
    data: str,
    out: str,
    config: DreamsConfig,
    teacher: str | None = None,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Continue training a world on its own predictions (self forcing), so that long play drifts less.

    Args:
        name: The world: a name that `terrella list` shows, or a folder.
        data: A recording of the same game.
        out: Folder of the run: the world, a log, and pictures of truth, the old prediction and the new.
        teacher: A world that draws a frame in many steps, as in `train distil`: its frames are the target
            distribution.
    """
    master = None if teacher is None else _learned(teacher, device)
    _shown(
        lambda report: train_dreams(_learned(name, device), data, out, config, report, master),
        json,
        _playing(out),
        run=out,
    )


def _shown(recipe: Callable[[Report], dict], json: bool, following: str = "", **facts: str) -> None:
    show(run_recipe(recipe, say, **facts), json, following)


def _practising(out: str, data: str) -> str:
    """The command that trains a policy in a latent world: for its reward, or without one for goals."""
    kind = "policy" if "reward" in load_named(out, "cpu").spec.channels else "goals"
    return command("terrella", "train", kind, out=f"{out.rstrip('/')}-{kind}", **{"in": out, "from": data})


def _playing(out: str) -> str:
    return command("terrella", "play", out)


def _learned(name: str, device: str) -> LearnedWorld:
    chosen = str(device_named(device))
    say(f"{name} trains on {describe_device(chosen)}.")
    return load_world(folder_of(name), device=chosen)
