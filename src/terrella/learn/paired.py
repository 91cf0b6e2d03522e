"""Paired: a finished world with a recording on which it goes on learning, and what further training leaves behind."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ..core.errors import DatasetError
from ..space.keyframes import Keyframes
from ..worlds.folder import save_world
from ..worlds.generator import Generator
from ..worlds.learned import LearnedWorld
from .batches import Batch, Dream
from .feeds import frames_feed
from .history_batches import clips_at, history_batch
from .recording import INSTANCES, OBJECTS, THINGS, Box, Recording, box_of
from .strips import draw_strip
from .trainer import Feed, Now, Report

TRANSIENT = ("save_every_s", "strip_every_s", "device")  # settings that may change within a run


@dataclass(frozen=True)
class Paired:
    """A finished world with the part of a recording that it may be trained on."""

    world: LearnedWorld
    recording: Recording

    @property
    def device(self) -> torch.device:
        return self.world.device

    @property
    def memory(self) -> Keyframes | None:
        return self.world.memory.to("cpu") if self.world.config.geometry else None

    def feed(self, batch: int, seed: int, dream: Dream | None = None) -> Feed:
        """Batches as in `train video`; with `dream`, some of the frames shown are the generator's own."""
        return frames_feed(self.recording, self.memory, self.world.config, batch, seed, dream)

    def real(self, batch: int, now: Now) -> Batch:
        """One batch of recorded frames, drawn at random."""
        if self.memory is not None:
            return self.feed(batch, 0).batch(now)
        config, recording = self.world.config, self.recording
        clips = clips_at(recording, config, batch, now.rng)
        return history_batch(clips, self.world.controls, config, now, None)


def paired(world: LearnedWorld, data: str | Path, keep_out: Box | None, report: Report) -> Paired:
    """Opens the recording `data` at the world's size. `keep_out` as in `train video`; None: what the world's card says.

    DatasetError where the recording does not fit the world.
    """
    config, name, controls = world.config, world.spec.name, world.controls
    needs = ("rgb", *("depth", "pose") * config.geometry, *(THINGS,) * config.moving)
    needs += (OBJECTS, INSTANCES) * config.objects
    box = box_of(world.about.card.get("keep_out")) if keep_out is None else keep_out
    recording = Recording.open(data, config.size, report, box, needs, f"{name} is shown that: record it as well")
    found = recording.controls
    if found is None or (found.kind, found.numbers) != (controls.kind, controls.numbers):
        raise DatasetError(
            f"{data} has other actions than {name}, which takes {controls.numbers} {controls.kind} "
            f"({', '.join(world.spec.action_names)}); give a recording of the same game."
        )
    return Paired(world, replace(recording, controls=controls).enough())


def with_generator(world: LearnedWorld, generator: Generator, steps: int, card: dict) -> LearnedWorld:
    """The same world around a copy of another generator, which draws a frame in `steps`; `card` is added to its facts. Its
    uncertainty is left out, for it knew the errors of the old one: `terrella train uncertainty` learns another."""
    fresh = copy.deepcopy(generator)
    return world.replaced(generator=fresh, steps=steps, uncertainty=None, card={"uncertainty": None, **card})


def fingerprint(generator: Generator) -> str:
    """Of its weights, so that a run goes on only with the world that it began from."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def recipe_of(config: Any, pair: Paired, **more: Any) -> Mapping[str, Any]:
    """What must not change within a run; where and how often it is saved may."""
    fixed = {name: value for name, value in asdict(config).items() if name not in TRANSIENT}
    return {**fixed, "world": fingerprint(pair.world.generator), "frames": pair.recording.cache.length, **more}


def keep_world(pair: Paired, world: LearnedWorld, out: Path, step: int) -> None:
    """The world in the run's folder, and a strip of the old world's dream above the new one's."""
    save_world(world, out / "world")
    draw_strip((pair.world, world), pair.recording, out / f"strip-{step:06d}.png")
