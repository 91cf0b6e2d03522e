"""Paired: a finished world with a recording on which its training continues."""

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
from .trainer import Feed, Report, TrainStep


@dataclass(frozen=True)
class Paired:
    """A finished world with a recording that fits it."""

    world: LearnedWorld
    recording: Recording

    @property
    def device(self) -> torch.device:
        return self.world.device

    @property
    def memory(self) -> Keyframes | None:
        return self.world.memory.to("cpu") if self.world.config.geometry else None

    def feed(self, batch: int, seed: int, dream: Dream | None = None) -> Feed:
        """Batches as in `train video`; with `dream`, some of the last frames are generated."""
        return frames_feed(self.recording, self.memory, self.world.config, batch, seed, dream)

    def real(self, batch: int, now: TrainStep) -> Batch:
        """One batch of recorded frames, drawn at random."""
        if self.memory is not None:
            return self.feed(batch, 0).batch(now)
        config, recording = self.world.config, self.recording
        clips = clips_at(recording, config, batch, now.rng)
        return history_batch(clips, self.world.controls, config, now, None)


def open_paired(world: LearnedWorld, data: str | Path, keep_out: Box | None, report: Report) -> Paired:
    """Opens the recording `data` at the world's size. `keep_out` as in `train video`; None: as on the world's card. DatasetError if
    the recording does not fit the world."""
    config, name, controls = world.config, world.spec.name, world.controls
    needs = ("rgb", *("depth", "pose") * config.geometry, *(THINGS,) * config.moving)
    needs += (OBJECTS, INSTANCES) * config.objects
    box = box_of(world.about.card.get("keep_out")) if keep_out is None else keep_out
    dataset = Dataset(data)
    if warning := check_game(dataset, world.spec):
        report(0, 1, warning)
    recording = Recording.open(dataset, config.size, report, box, needs, f"{name} observes that: record it as well")
    recorded = recording.controls
    if recorded is None or (recorded.kind, recorded.numbers) != (controls.kind, controls.numbers):
        raise DatasetError(
            f"{data} has other actions than {name}, which takes {controls.numbers} {controls.kind} "
            f"({', '.join(world.spec.action_names)}); give a recording of the same game."
        )
    return Paired(world, replace(recording, controls=controls).require_rows())


def fingerprint(generator: UNet) -> str:
    """A hash of the weights, by which a resumed run checks that it has the world that it began with."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
