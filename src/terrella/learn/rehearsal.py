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
    """Each batch is one of `new` and one of `kept`, joined: instances of one dataclass of tensors. interleaved: their rows in
    turn, for objectives that treat the first rows of a batch otherwise. every: one batch in `every` has rows of `kept`, the
    others two of `new`."""

    def __init__(self, new: Feed, kept: Feed, interleaved: bool = False, every: int = 1):
        self.new, self.kept, self.interleaved, self.every = new, kept, interleaved, every

    def batch(self, now: TrainStep) -> object:
        other = self.new if now.step % self.every else self.kept
        return joined(self.new.batch(now), other.batch(now), self.interleaved)

    def state(self) -> dict:
        return {"new": self.new.state(), "kept": self.kept.state()}

    def resume(self, state: Mapping) -> None:
        self.new.resume(state["new"])
        self.kept.resume(state["kept"])


def joined(one: Clips, other: Clips, interleaved: bool = False) -> Clips:
    """The rows of both; a field that one of them lacks is None."""
    parts = {}
    for name in (part.name for part in fields(one)):  # type: ignore[arg-type]
        both = getattr(one, name), getattr(other, name)
        if any(part is None for part in both):
            parts[name] = None
        else:
            parts[name] = torch.stack(both, 1).flatten(0, 1) if interleaved else torch.cat(both)
    return type(one)(**parts)
