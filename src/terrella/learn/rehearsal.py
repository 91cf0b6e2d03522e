"""Rehearsal: batches of two recordings at once, so that a network that learns the one does not forget the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TypeVar

import torch

from .sized_feed import Feed
from .train_step import TrainStep

Clips = TypeVar("Clips")


class Rehearsal:
    """Each batch is one of `new` and one of `kept`, joined: instances of one dataclass of tensors."""

    def __init__(self, new: Feed, kept: Feed):
        self.new, self.kept = new, kept

    def batch(self, now: TrainStep) -> object:
        return joined(self.new.batch(now), self.kept.batch(now))

    def state(self) -> dict:
        return {"new": self.new.state(), "kept": self.kept.state()}

    def resume(self, state: Mapping) -> None:
        self.new.resume(state["new"])
        self.kept.resume(state["kept"])


def joined(one: Clips, other: Clips) -> Clips:
    """The rows of both; a field that one of them lacks is None."""
    parts = {}
    for name in (part.name for part in fields(one)):  # type: ignore[arg-type]
        both = getattr(one, name), getattr(other, name)
        parts[name] = None if any(part is None for part in both) else torch.cat(both)
    return type(one)(**parts)
