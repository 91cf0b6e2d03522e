"""train estimator, train uncertainty and train objects: parts of a world that are trained on their own.

With an estimator a world can start from a single picture, and with an uncertainty it knows when it invents; `train video` ends
with both. Its objects may be trained on another recording.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from ...core.errors import DatasetError, TrainingError
from ...space.estimator import save_estimator
from ...space.keyframes import Keyframes
from ...worlds.folder import load_world, save_world
from ...worlds.learned import LearnedWorld
from ...worlds.objects import Billboards, BillboardsConfig
from ..objectives.estimator import estimator_errors, learn_estimator
from ..objectives.objects import learn_objects
from ..objectives.uncertainty import learn_uncertainty
from ..paired import fingerprint, open_paired
from ..recording import Box, Recording, box_of
from ..trainer import Report, Run


@dataclass(frozen=True)
class EstimatorTraining:
    """Settings of the training of a depth and odometry estimator."""

    # Height and width of the pictures. The estimator works at half of it.
    size: tuple[int, int] = (96, 128)
    steps: int = 2500  # Training steps.
    batch: int = 16  # Pictures per step.
    learning_rate: float = 3e-3  # Peak learning rate.
    keep_out: Box | None = None  # A box x0 y0 x1 y1 of the map in metres that training never sees.
    seed: int = 0  # Random seed.


def train_estimator(data: str | Path, out: str | Path, config: EstimatorTraining, report: Report) -> dict:
    """Trains an estimator on the recording `data` and writes it to `out`/estimator.safetensors, and its errors on held-out episodes
    and in the box that was kept out to `out`/estimator.json; returns these errors."""
    needs = ("rgb", "depth", "pose", "camera")
    why = "an estimator is learned from pictures, depth, poses and a camera"
    recording = Recording.open(data, config.size, report, config.keep_out, needs, why)
    run = Run.of(out, config, report, frames=recording.cache.length)
    estimator = learn_estimator(run, recording, config.steps, config.batch, config.learning_rate)
    facts = estimator_errors(estimator, recording.cache, list(recording.held_out), config.keep_out)
    save_estimator(estimator, run.out / "estimator.safetensors")
    (run.out / "estimator.json").write_text(json.dumps(facts, indent=1) + "\n")
    return {"estimator": str(run.out / "estimator.safetensors"), **facts}


@dataclass(frozen=True)
class SensesConfig:
    """Settings of the training of a world's estimator and uncertainty."""

    # Training steps of the depth and odometry estimator. 0 keeps the one that the world has, if any.
    estimator_steps: int = 2500
    # Predicted frames from which the uncertainty is learned. 0 keeps the one that the world has, if any.
    uncertainty_frames: int = 9000
    seed: int = 0  # Random seed.


def train_uncertainty(
    world: str | Path, data: str | Path, out: str | Path, config: SensesConfig, report: Report
) -> dict:
    """Gives the world in the folder `world` an estimator and an uncertainty, trained on its own recording `data`, and writes it to
    `out`/world; returns their facts. What was kept out of its training is kept out here, too."""
    learned = load_world(world)
    box = box_of(learned.about.card.get("keep_out"))
    pair = open_paired(learned, data, box, report)
    facts = {"world": fingerprint(learned.generator), "frames": pair.recording.cache.length}
    run = Run.of(out, config, report, **facts)
    sensing, facts = learn_senses(run, learned, pair.recording, box, config)
    save_world(sensing.replaced(card=facts), run.out / "world", remembered=world)
    return {"world": str(run.out / "world"), **facts}


def learn_senses(
    run: Run, world: LearnedWorld, recording: Recording, keep_out: Box | None, config: SensesConfig
) -> tuple[LearnedWorld, dict]:
    """`world` with an estimator, if it has geometry, and an uncertainty; and their facts for its card."""
    facts: dict[str, Any] = {}
    sensing = world
    if world.config.geometry and config.estimator_steps:
        estimator = learn_estimator(run, recording, config.estimator_steps)
        sensing = sensing.replaced(estimator=estimator)
        facts["estimator"] = {
            place: {name: round(value, 4) for name, value in errors.items()}
            for place, errors in estimator_errors(
                estimator, recording.cache, list(recording.held_out), keep_out
            ).items()
            if errors
        }
    if config.uncertainty_frames:
        try:
            uncertainty, figures = learn_uncertainty(run, sensing, recording, config.uncertainty_frames)
        except DatasetError as error:  # the world can be used without one
            return sensing, {**facts, "uncertainty": f"none: {error}"}
        facts["uncertainty"] = {name: round(value, 4) for name, value in figures.items()}
        sensing = sensing.replaced(uncertainty=uncertainty)
    return sensing, facts


@dataclass(frozen=True)
class ObjectsTraining:
    """Settings of the training of a world's objects."""

    steps: int = 2500  # Training steps.
    seed: int = 0  # Random seed.


def train_objects(
    world: str | Path, data: str | Path, out: str | Path, config: ObjectsTraining, report: Report
) -> dict:
    """Gives the world in the folder `world` the objects of the recording `data` in place of its own, and writes it to `out`/world;
    returns their facts."""
    learned = load_world(world)
    if not learned.config.moving:
        raise TrainingError(
            f"{learned.spec.name} knows no things that move; `terrella train video` makes worlds that do."
        )
    torch.manual_seed(config.seed)
    objects = Billboards(BillboardsConfig(learned.config.actions, learned.config.history))
    pair = open_paired(learned.replaced(objects=objects), data, None, report)
    recording = pair.recording
    run = Run.of(out, config, report, frames=recording.cache.length)
    objects.requires_grad_(True)
    starts = cast(Keyframes, learned.starts).pose
    facts = learn_objects(
        run, objects, recording, recording.dataset.rgb_at, starts, learned.config.camera, config.steps
    )
    save_world(learned.replaced(objects=objects, card=facts), run.out / "world", remembered=world)
    return {"world": str(run.out / "world"), **facts}
