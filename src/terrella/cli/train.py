"""The commands that train. Imported only when one of them is asked for: their settings live in rooms slow to import."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from .. import progress
from ..learn.distil import DistilConfig, distil
from ..learn.estimator import EstimatorTraining, train_eye
from ..learn.latent_actions import LatentConfig, train_latent_actions
from ..learn.objects import ThingsConfig, train_things
from ..learn.self_forcing import DreamsConfig, train_dreams
from ..learn.senses import SensesConfig, train_senses
from ..learn.train_video import TrainConfig, train_video
from ..library import folder_of
from .named import Device, load_named
from .say import Json, result

VIDEO, EYE, SENSES, LATENT, DISTIL, DREAMS, THINGS = (
    TrainConfig(),
    EstimatorTraining(),
    SensesConfig(),
    LatentConfig(),
    DistilConfig(),
    DreamsConfig(),
    ThingsConfig(),
)


def video(data: Positional[Path], out: Path, config: TrainConfig = VIDEO, json: Json = False) -> None:
    """Train a world of pictures on a recording; the same command goes on where it was stopped.

    Args:
        data: Folder of the dataset.
        out: Folder of the run: checkpoint, log, and pictures of truth against dream.
    """
    with progress.shown("training") as report:
        facts = train_video(data, out, config, report)
    result({"run": str(out), **(facts or {})}, json)


def estimator(data: Positional[Path], out: Path, config: EstimatorTraining = EYE, json: Json = False) -> None:
    """Train an eye that sees depth in one picture, and motion between two, on any recording with depth and poses.

    Args:
        data: Folder of the dataset.
        out: Folder for eye.safetensors and eye.json, its errors on the episodes kept out.
    """
    with progress.shown("training") as report:
        facts = train_eye(data, out, config, report)
    result(facts, json)


def senses(name: Positional[str], data: Path, out: Path, config: SensesConfig = SENSES, json: Json = False) -> None:
    """Give a trained world an eye for lone pictures and a doubt that says when it invents (train video ends with them).

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        data: The recording that it was trained on.
        out: Folder for the world with its senses.
    """
    with progress.shown("training") as report:
        facts = train_senses(folder_of(name), data, out, config, report)
    result(facts, json)


def things(name: Positional[str], data: Path, out: Path, config: ThingsConfig = THINGS, json: Json = False) -> None:
    """Teach a trained world what its things do from another recording: more fights make better monsters in minutes.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        data: Folder of a recording of the same game that tells things apart.
        out: Folder for the world with its new cast.
    """
    with progress.shown("training") as report:
        facts = train_things(folder_of(name), data, out, config, report)
    result(facts, json)


def latent_actions(data: Positional[Path], out: Path, config: LatentConfig = LATENT, json: Json = False) -> None:
    """Learn a few actions from pictures alone; `terrella data label` then writes them into a recording.

    Args:
        data: Folder of the dataset; its own actions, if it has any, are not looked at.
        out: Folder of the run: checkpoint, log, and pictures of truth, inferred and random actions.
    """
    with progress.shown("training") as report:
        facts = train_latent_actions(data, out, config, report)
    result({"run": str(out), **(facts or {})}, json)


def few_steps(
    name: Positional[str],
    data: Path,
    out: Path,
    config: DistilConfig = DISTIL,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Teach a world that draws a frame in many steps (`train video --flow-steps 8`) to draw it in one or two.

    Args:
        name: The world that teaches: what `terrella list` shows, or a path.
        data: Folder of a recording of the same game.
        out: Folder of the run: checkpoint, log, and pictures of truth against dream.
    """
    with progress.shown("training") as report:
        facts = distil(load_named(name, device), data, out, config, report)
    result({"run": str(out), **facts}, json)


def dreams(
    name: Positional[str],
    data: Path,
    out: Path,
    config: DreamsConfig = DREAMS,
    teacher: str | None = None,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Go on training a world inside its own dreams, so that long play drifts less.

    Args:
        name: The world: what `terrella list` shows, or a path.
        data: Folder of a recording of the same game.
        out: Folder of the run: checkpoint, log, and pictures of truth, the old dream and the new.
        teacher: A world that draws a frame in many steps, of which the dreams should be as sharp: see `train distil`.
    """
    master = None if teacher is None else load_named(teacher, device)
    with progress.shown("training") as report:
        facts = train_dreams(load_named(name, device), data, out, config, report, master)
    result({"run": str(out), **facts}, json)
