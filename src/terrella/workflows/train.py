"""`train_video` and `train_latent`: a recording becomes a world; `adapt`: a world goes on learning on another."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..learn.devices import describe_device
from ..learn.recipes import latent, video
from ..learn.recipes.adapt import AdaptConfig
from ..learn.recipes.adapt import adapt as adapted
from .opening import device_of, load_named
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


def adapt(
    world: str,
    data: str | Path,
    out: str | Path,
    config: AdaptConfig | None = None,
    *,
    keep: str | Path | None = None,
    progress: Progress = silent,
) -> TrainResult:
    """Adapts the world named `world`, a learned one, to the body or camera of the recording `data`. keep: a
    recording that it was trained on, of which half of each batch is made. The facts have the open-loop errors before and after;
    the run is in `out`."""
    settings, opened = config or AdaptConfig(), load_named(world, "cpu")
    return run_recipe(lambda report: adapted(opened, data, out, settings, report, keep), progress, run=out)


def run_recipe(recipe: Callable[[Report], Mapping[str, Any]], progress: Progress, **facts: Any) -> TrainResult:
    """Runs a recipe of the room `learn` as a stage of its own."""
    with stage("training", progress) as report:
        return TrainResult({**facts, **recipe(report)})
