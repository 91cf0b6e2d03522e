"""train objects: a finished world learns from another recording what its things look like and do."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ...core.errors import TrainingError
from ...worlds.folder import load_world, save_again
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
    learned: Any = load_world(world)
    if not learned.config.moving:
        raise TrainingError(
            f"{learned.spec.name} knows of no things that move; `terrella train video` makes worlds that do."
        )
    learned.config = replace(learned.config, objects=True)
    pair = paired(learned, data, None, report)
    recipe = {**asdict(config), "frames": pair.recording.cache.length}
    torch.manual_seed(config.seed)
    objects = Objects(ObjectsConfig(learned.config.actions, learned.config.history))
    run = Run(Path(out), recipe, report, config.seed)
    rgb, starts = pair.recording.dataset.rgb_at, learned.starts.pose
    facts = learn_objects(run, objects, pair.recording, rgb, starts, learned.config.camera, config.steps)
    learned.objects = objects
    save_again(learned, run.out / "world", {**learned.spec.card, **facts}, world)
    return {"world": str(run.out / "world"), **facts}
