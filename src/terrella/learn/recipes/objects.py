"""train objects: a finished world learns from another recording what its things look like and do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from ...core.errors import TrainingError
from ...space.keyframes import Keyframes
from ...worlds.folder import load_world, save_world
from ...worlds.objects import Objects, ObjectsConfig
from ..objectives.objects import learn_objects
from ..paired import paired
from ..trainer import Report, Run


@dataclass(frozen=True)
class ObjectsTraining:
    """Settings of the training of a world's objects.

    Args:
        steps: Training steps.
        seed: Random seed.
    """

    steps: int = 2500
    seed: int = 0


def train_objects(
    world: str | Path, data: str | Path, out: str | Path, config: ObjectsTraining, report: Report
) -> dict:
    """Gives the world in the folder `world` the objects of the recording `data`, in place of its own, and writes it to
    `out`/world; returns its facts."""
    learned = load_world(world)
    if not learned.config.moving:
        raise TrainingError(
            f"{learned.spec.name} knows of no things that move; `terrella train video` makes worlds that do."
        )
    torch.manual_seed(config.seed)
    objects = Objects(ObjectsConfig(learned.config.actions, learned.config.history))
    pair = paired(learned.replaced(objects=objects), data, None, report)
    recording = pair.recording
    run = Run.of(out, config, report, frames=recording.cache.length)
    objects.requires_grad_(True)
    starts = cast(Keyframes, learned.starts).pose
    facts = learn_objects(
        run, objects, recording, recording.dataset.rgb_at, starts, learned.config.camera, config.steps
    )
    save_world(learned.replaced(objects=objects, card=facts), run.out / "world", remembered=world)
    return {"world": str(run.out / "world"), **facts}
