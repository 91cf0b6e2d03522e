"""Paired: a finished world with a recording on which its training continues."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import nn

from ..core.errors import DatasetError
from ..data import Dataset, check_game
from ..worlds.learned import LearnedWorld
from .batches import Dream
from .feeds import place_feed
from .recording import INSTANCES, OBJECTS, THINGS, Box, Recording, box_of
from .sized_feed import Feed
from .trainer import Report


@dataclass(frozen=True)
class Paired:
    """A finished world with a recording that fits it."""

    world: LearnedWorld
    recording: Recording

    @property
    def device(self) -> torch.device:
        return self.world.device

    def feed(self, batch: int, dream: Dream | None = None) -> Feed:
        """Batches as in `train video` of a world with poses; with `dream`, some of the last frames are generated."""
        return place_feed(self.recording, self.world.memory.to("cpu"), self.world.config, batch, dream)


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


def fingerprint(generator: nn.Module) -> str:
    """A hash of the weights, by which a resumed run checks that it has the world that it began with."""
    digest = hashlib.sha256()
    for weight in generator.state_dict().values():
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
