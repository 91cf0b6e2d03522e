"""`train_video` and `train_latent`: a recording becomes a world."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..learn.devices import describe_device
from ..learn.recipes import latent, video
from .opening import device_of
from .progress import Progress, Report, silent, stage
from .results import jsonable


@dataclass(frozen=True)
class TrainResult:
    """A training run."""

    facts: Mapping[str, Any]
    """run (its folder), step, minutes, the losses, and the world, policy or file that it wrote."""

    def to_json(self) -> dict[str, Any]:
        return jsonable(self.facts)

    def summary(self) -> str:
        facts = {**self.facts}
        verdict = [facts.pop("verdict")] if "verdict" in facts else []
        return "\n".join([*verdict, *(f"{name}: {value}" for name, value in facts.items())])


def train_video(
    data: str | Path, out: str | Path, config: video.TrainConfig | None = None, *, progress: Progress = silent
) -> TrainResult:
    """Trains a playable world on the recording `data`, a folder or an address. The run is in the folder `out`; `load(out)` opens
    its world. The same call continues where an earlier one was stopped."""
    settings = config or video.TrainConfig()
    return run_recipe(lambda report: video.train_video(data, out, settings, report, say=progress), progress, run=out)


def train_latent(
    data: str | Path, out: str | Path, config: latent.LatentTraining | None = None, *, progress: Progress = silent
) -> TrainResult:
    """Trains a latent world on the recording `data`, with pictures, state vectors or both: it predicts a latent instead of pixels.
    The same call continues where an earlier one was stopped."""
    settings = config or latent.LatentTraining()
    progress(f"It trains on {describe_device(device_of(settings.device))}.")
    return run_recipe(lambda report: latent.train_latent(data, out, settings, report), progress, run=out)


def run_recipe(recipe: Callable[[Report], Mapping[str, Any]], progress: Progress, **facts: Any) -> TrainResult:
    """Runs a recipe of the room `learn` as a stage of its own."""
    with stage("training", progress) as report:
        return TrainResult({**facts, **recipe(report)})
