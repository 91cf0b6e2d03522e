"""train uncertainty: a trained world learns to begin with a lone picture (an estimator), and to say when it invents (an
uncertainty). `train video` ends with both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import DatasetError
from ...worlds.folder import load_world, save_world
from ...worlds.learned import LearnedWorld
from ..objectives.estimator import learn_estimator, sight
from ..objectives.uncertainty import learn_uncertainty
from ..paired import fingerprint, paired
from ..recording import Box, Recording, box_of
from ..trainer import Report, Run


@dataclass(frozen=True)
class SensesConfig:
    """Settings of the training of a world's estimator and uncertainty.

    Args:
        estimator_steps: Training steps of the depth and odometry estimator. 0 keeps the one the world has, if any.
        uncertainty_frames: Predicted frames from which the uncertainty is learned. 0 keeps the one the world has, if any.
        seed: Random seed.
    """

    estimator_steps: int = 2500
    uncertainty_frames: int = 9000
    seed: int = 0


def train_uncertainty(
    world: str | Path, data: str | Path, out: str | Path, config: SensesConfig, report: Report
) -> dict:
    """Gives the world in the folder `world` an estimator and an uncertainty, learned from its own recording `data`, and writes
    it to `out`/world; returns its facts. What was kept out of its training is kept out here too."""
    learned = load_world(world)
    box = box_of(learned.about.card.get("keep_out"))
    pair = paired(learned, data, box, report)
    facts = {"world": fingerprint(learned.generator), "frames": pair.recording.cache.length}
    run = Run.of(out, config, report, **facts)
    sensing, facts = learn_senses(run, learned, pair.recording, box, config)
    save_world(sensing.replaced(card=facts), run.out / "world", remembered=world)
    return {"world": str(run.out / "world"), **facts}


def learn_senses(
    run: Run, world: LearnedWorld, recording: Recording, keep_out: Box | None, config: SensesConfig
) -> tuple[LearnedWorld, dict]:
    """`world` with an estimator (where it has geometry) and an uncertainty, and what its card says of them."""
    facts: dict[str, Any] = {}
    sensing = world
    if world.config.geometry and config.estimator_steps:
        estimator = learn_estimator(run, recording, config.estimator_steps)
        sensing = sensing.replaced(estimator=estimator)
        facts["estimator"] = {
            place: {name: round(value, 4) for name, value in errors.items()}
            for place, errors in sight(estimator, recording.cache, list(recording.held_out), keep_out).items()
            if errors
        }
    if config.uncertainty_frames:
        try:
            frames = config.uncertainty_frames
            uncertainty, found = learn_uncertainty(run, sensing, recording, frames)
        except DatasetError as error:  # the world is as good without it
            return sensing, {**facts, "uncertainty": f"none: {error}"}
        facts["uncertainty"] = {name: round(value, 4) for name, value in found.items()}
        sensing = sensing.replaced(uncertainty=uncertainty)
    return sensing, facts
