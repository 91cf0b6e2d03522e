"""train estimator: depth in one picture and motion between two, from any recording with depth and poses."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from ...space.estimator import save_estimator
from ..objectives.estimator import learn_estimator, sight
from ..recording import Box, Recording
from ..trainer import Report, Run

NEEDS = ("rgb", "depth", "pose", "camera")


@dataclass(frozen=True)
class EstimatorTraining:
    """Settings of the training of a depth and odometry estimator.

    Args:
        size: Height and width of the pictures. The estimator looks at half of them.
        steps: Training steps.
        batch: Pictures per step.
        learning_rate: Highest learning rate.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees.
        seed: Random seed.
    """

    size: tuple[int, int] = (96, 128)
    steps: int = 2500
    batch: int = 16
    learning_rate: float = 3e-3
    keep_out: Box | None = None
    seed: int = 0


def train_estimator(data: str | Path, out: str | Path, config: EstimatorTraining, report: Report) -> dict:
    """Trains an estimator on the recording `data` and writes it to `out`/estimator.safetensors, its errors on held-out
    episodes and in the box kept out to `out`/estimator.json; these are returned."""
    why = "an estimator is learned from pictures, depth, poses and a camera"
    recording = Recording.open(data, config.size, report, config.keep_out, NEEDS, why)
    run = Run.of(out, config, report, frames=recording.cache.length)
    estimator = learn_estimator(run, recording, config.steps, config.batch, config.learning_rate)
    facts = sight(estimator, recording.cache, list(recording.held_out), config.keep_out)
    save_estimator(estimator, run.out / "estimator.safetensors")
    (run.out / "estimator.json").write_text(json.dumps(facts, indent=1) + "\n")
    return {"estimator": str(run.out / "estimator.safetensors"), **facts}
