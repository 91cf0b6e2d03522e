"""Paired: a finished world with a recording on which it goes on learning."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ..core.errors import DatasetError
from ..data import Dataset, check_game
from ..space.keyframes import Keyframes
from ..worlds.generator import UNet
from ..worlds.learned import LearnedWorld
from .batches import Batch, Dream
from .feeds import frames_feed
from .history_batches import clips_at, history_batch
from .recording import INSTANCES, OBJECTS, THINGS, Box, Recording, box_of
from .trainer import Feed, Now, Report


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
    dataset = Dataset(data)
    if doubt := check_game(dataset, world.spec):
        report(0, 1, doubt)
    recording = Recording.open(dataset, config.size, report, box, needs, f"{name} is shown that: record it as well")
    found = recording.controls
    if found is None or (found.kind, found.numbers) != (controls.kind, controls.numbers):
        raise DatasetError(
            f"{data} has other actions than {name}, which takes {controls.numbers} {controls.kind} "
            f"({', '.join(world.spec.action_names)}); give a recording of the same game."
        )
    return Paired(world, replace(recording, controls=controls).enough())


def fingerprint(generator: UNet) -> str:
    """Of its weights, so that a run goes on only with the world that it began from."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
