"""What further training of a finished world shares: the world with a recording beside it, and what it leaves."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..core.errors import DatasetError, TrainingError
from ..core.world import World
from ..data import ClipCache, Dataset, split
from ..worlds.controls import Controls
from ..worlds.folder import Learned, save_world
from ..worlds.generator import Generator, channels_last
from ..worlds.history import HistoryWorld
from ..worlds.video import VideoWorld
from .lessons import Dream, recorded_lesson
from .samples import CAST, INSTANCES, THINGS, Box, Lesson, Recording, controls_of, usable_rows
from .strips import draw_strip
from .updates import Report, Updates


@dataclass(frozen=True)
class Beside:
    """A finished world with the part of a recording that it may be trained on."""

    world: Learned
    dataset: Dataset
    recording: Recording
    held_out: list[int]  # episodes

    @property
    def device(self) -> torch.device:
        return next(self.world.generator.parameters()).device

    def lesson(self, batch: int, rng: np.random.Generator, dream: Dream | None = None) -> Lesson:
        """A lesson as in `train video`; with `dream`, some of the frames shown are the generator's own."""
        memory = self.world.memory if isinstance(self.world, VideoWorld) else None
        return recorded_lesson(self.recording, memory, self.world.config, batch, rng, dream)


def beside(world: World, data: str | Path, keep_out: Box | None, report: Report) -> Beside:
    """Opens the recording `data` at the world's size. `keep_out` as in `train video`; None: what the world's card says.

    TrainingError for a world that is not learned; DatasetError where the recording does not fit the world.
    """
    if not isinstance(world, (VideoWorld, HistoryWorld)):
        raise TrainingError(
            f"{world.spec.name} is no world of pictures that was learned; `terrella train video` makes one."
        )
    config, dataset = world.config, Dataset(data)
    cache = ClipCache.open(dataset, config.size, lambda done, total: report(done, total, "building the clip cache"))
    if cache.rgb is None:
        raise DatasetError(f"{data} holds no pictures (rgb); {world.spec.name} is a world of pictures.")
    controls = world.controls if isinstance(world, HistoryWorld) else Controls.buttons(config.actions)
    found = controls_of(cache)
    if (found.kind, found.told) != (controls.kind, controls.told):
        raise DatasetError(
            f"{data} has actions ({found.kind}, {found.told}) that {world.spec.name} does not know "
            f"({controls.kind}, {controls.told}: {', '.join(world.spec.action_names)}); give a recording of the same game."
        )
    lacks = [
        name for name in (THINGS,) * config.moving + (CAST, INSTANCES) * config.objects if name not in cache.arrays
    ]
    if lacks:
        raise DatasetError(
            f"{data} does not tell of {', '.join(lacks)}, which {world.spec.name} is shown; record them."
        )
    if config.geometry and (cache.depth is None or cache.pose is None):
        raise DatasetError(f"{data} lacks the depth or the poses that {world.spec.name} is shown; record them as well.")
    train, held_out = split(len(cache.episodes))
    start = np.zeros(cache.length, np.int64)
    for first, last in cache.episodes:
        start[first:last] = first
    said = world.spec.card.get("keep_out")
    box = keep_out
    if box is None and isinstance(said, (list, tuple)):
        box = (float(said[0]), float(said[1]), float(said[2]), float(said[3]))
    if box is not None and cache.pose is None:
        raise DatasetError(f"{data} has no poses, so no part of its map can be kept out; drop --keep-out.")
    usable = usable_rows(cache, train, box, config.camera)
    if usable.sum() < 64:
        raise DatasetError(f"{data} leaves {usable.sum()} frames to train on; record more, or a smaller keep_out.")
    return Beside(world, dataset, Recording(cache, start, usable, controls), held_out)


def with_generator(world: Learned, generator: Generator, steps: int, card: dict) -> Learned:
    """The same world around another generator, which draws a frame in `steps`; `card` is added to its facts. Its doubt is
    left out, for it knew the errors of the old one: `terrella train senses` learns another."""
    fresh = world.with_senses(world.estimator if isinstance(world, VideoWorld) else None, None)
    fresh.generator = channels_last(copy.deepcopy(generator).eval().requires_grad_(False))
    fresh.config = replace(world.config, steps=steps)
    kept = {name: value for name, value in world.spec.card.items() if name != "uncertainty"}
    fresh.spec = replace(fresh.spec, card={**kept, **card})
    return fresh


def fingerprint(generator: Generator) -> str:
    """Of its weights, so that a run goes on only with the world that it began from."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def recipe_of(config, world: Learned, dataset: Dataset) -> dict:
    """What must not change within a run; where and how often it is saved may."""
    fixed = {k: v for k, v in asdict(config).items() if k not in ("save_every_s", "strip_every_s", "device")}
    return {**fixed, "world": fingerprint(world.generator), "frames": dataset.length}


def leave(beside: Beside, world: Learned, old: Learned, updates: Updates) -> None:
    """The world in the run's folder, and a strip of the old world's dream above the new one's."""
    save_world(world, updates.out / "world", dict(world.spec.card))
    path = updates.out / f"strip-{updates.facts['step']:06d}.png"
    draw_strip((old, world), beside.recording, beside.held_out, path)
