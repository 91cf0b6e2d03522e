"""The senses of a trained world: an eye, so that it can begin with a lone picture, and a doubt, so that it says when it
invents. `train video` ends with them; `train senses` gives them to a world that has none."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import DatasetError, TrainingError
from ..data import ClipCache, Dataset, split
from ..space.estimator import load_estimator, save_estimator
from ..worlds.folder import Learned, load_world, save_again
from ..worlds.video import VideoWorld
from .estimator import EstimatorTraining, learn_estimator, recording_of, sight
from .samples import Recording, controls_of
from .uncertainty import DoubtTraining, learn_uncertainty
from .updates import Report


@dataclass(frozen=True)
class SensesConfig:
    """Settings of the training of a world's senses.

    Args:
        estimator_steps: Training steps of the eye; with 0 the world keeps the one it has, if any.
        uncertainty_frames: Dreamt frames that the doubt learns from; with 0 the world keeps the one it has, if any.
        seed: Of everything random.
    """

    estimator_steps: int = 2500
    uncertainty_frames: int = 9000
    seed: int = 0


def train_senses(world: str | Path, data: str | Path, out: str | Path, config: SensesConfig, report: Report) -> dict:
    """Gives the world in the folder `world` senses, learned from its own recording `data`, and writes it to `out` (which may
    be `world`); returns its facts. What was kept out of its training is kept out here too."""
    learned = load_world(world)
    dataset, size = Dataset(data), learned.config.size
    cache = ClipCache.open(dataset, size, lambda done, total: report(done, total, "building the clip cache"))
    if cache.rgb is None or cache.action.shape[1] != learned.config.actions and isinstance(learned, VideoWorld):
        raise TrainingError(f"{data} is no recording of {learned.spec.name}: its pictures or actions are others.")
    box: Any = learned.spec.card.get("keep_out")
    posed = cache.depth is not None and cache.pose is not None and bool(cache.world.get("camera"))
    if isinstance(learned, VideoWorld) and not posed:
        raise DatasetError(f"{data} lacks depth, poses or a camera, from which {learned.spec.name} was learned.")
    train, held_out = split(len(cache.episodes))
    recording = recording_of(cache, train, tuple(box) if box and posed else None, controls_of(cache))
    told = json.dumps([config.estimator_steps, config.seed, box, cache.length, [list(span) for span in cache.episodes]])
    mark = hashlib.sha256(told.encode() + np.ascontiguousarray(cache.pose).tobytes()) if posed else hashlib.sha256()
    keep = Path(out) / f"eye-{mark.hexdigest()[:12]}.safetensors.partial"  # of these settings and this recording alone
    sensing, facts = learn_senses(learned, recording, held_out, tuple(box) if box else None, config, report, keep)
    save_again(sensing, out, {**learned.spec.card, **facts}, world)
    keep.unlink(missing_ok=True)
    return {"world": str(out), **facts}


def learn_senses(
    world: Learned,
    recording: Recording,
    held_out: list[int],
    keep_out,
    config: SensesConfig,
    report: Report,
    keep: Path,
) -> tuple[Learned, dict]:
    """`world` with an eye (where it has geometry) and a doubt, and what its card says of them. The eye is kept in the file
    `keep` as soon as it is learned: a run that is stopped goes on from there."""
    facts: dict[str, Any] = {}
    estimator = world.estimator if isinstance(world, VideoWorld) else None
    if isinstance(world, VideoWorld) and config.estimator_steps:
        if keep.exists():
            estimator = load_estimator(keep)
        else:
            estimator = learn_estimator(
                recording, EstimatorTraining(steps=config.estimator_steps, keep_out=keep_out, seed=config.seed), report
            )
            keep.parent.mkdir(parents=True, exist_ok=True)
            save_estimator(estimator, keep)
        facts["eye"] = {
            place: {name: round(value, 4) for name, value in errors.items()}
            for place, errors in sight(estimator, recording.cache, held_out, keep_out).items()
            if errors
        }
    sensing = world.with_senses(estimator, world.uncertainty)
    if config.uncertainty_frames:
        try:
            horizon, steps = (
                min(64, max(8, config.uncertainty_frames // 40)),
                min(1500, max(20, config.uncertainty_frames // 6)),
            )
            settings = DoubtTraining(config.uncertainty_frames, horizon, steps=steps, seed=config.seed)
            uncertainty, found = learn_uncertainty(world.with_senses(estimator, None), recording, settings, report)
        except DatasetError as error:  # the world is as good without it
            return sensing, {**facts, "uncertainty": f"none: {error}"}
        facts["uncertainty"] = {name: round(value, 4) for name, value in found.items()}
        sensing = sensing.with_senses(estimator, uncertainty)
    return sensing, facts
