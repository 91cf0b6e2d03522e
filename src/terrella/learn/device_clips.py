"""Clips on a device: a recording lies there as uint8, and training clips are chosen, cut and augmented there."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np
import torch

from ..core.errors import DatasetError
from ..space.recall import KEPT
from .moves import StitchedEpisodes
from .objectives.flow_frames import CHANGED, LONE, EarlierFrames, FlowClips, memory_shown, preference
from .recording import Recording
from .train_step import TrainStep

ROWS = 2048  # that are copied to the device at a time
ROOM = 0.5  # the part of the free memory that a recording may take


def bytes_of(recording: Recording, stitched: StitchedEpisodes | None) -> int:
    """Of the pictures of a recording, and of the ground below them."""
    grounds = () if stitched is None else stitched.grounds.values()
    return int(np.prod(recording.cache.rgb.shape)) + sum(ground.numel() for ground in grounds)


class DeviceClips:
    """Batches of clips of slots + rollout rows, preferring those that change more, as FlowClipMaker does; a clip is drawn
    with replacement. Without a wait for the device."""

    def __init__(
        self,
        recording: Recording,
        slots: int,
        rollout: int,
        device: torch.device,
        grounds: DeviceGrounds | None = None,
        recalls: bool = False,
    ):
        self.slots, self.size, self.grounds = slots, 1, grounds
        shape = recording.cache.rgb.shape
        self.frames = torch.empty(shape[0], 3, *shape[1:3], dtype=torch.uint8, device=device)
        changes = torch.zeros(shape[0], device=device)  # the part of the pixels that differ from the row before
        for first in range(0, shape[0], ROWS):
            part = slice(first, min(first + ROWS, shape[0]))
            self.frames[part] = recording.rgb(np.arange(part.start, part.stop)).to(device)
            before = self.frames[max(part.start - 1, 0) : part.stop - 1] if first else self.frames[part].roll(1, 0)
            changes[part] = _changed(before, self.frames[part])
        self.actions = recording.action(np.arange(shape[0])).to(device)
        rows = recording.rows_within(slots - 1, rollout)  # the last of a history
        if not len(rows):
            raise DatasetError(f"no episode has the {slots + rollout} rows that a clip has; record longer ones.")
        self.rows = torch.from_numpy(rows).to(device)
        start = torch.from_numpy(recording.start).to(device)
        self.past = EarlierFrames(start, self.frames.__getitem__) if recalls else None
        self.window = torch.arange(1 - slots, rollout + 1, device=device)
        weight = preference(changes[self.rows[:, None] + self.window[slots:]].amax(1))
        self.upto = (weight / weight.sum()).cumsum(0)

    def sized(self, size: int) -> DeviceClips:
        """The same recording, in batches of `size` clips."""
        other = copy.copy(self)
        other.size = size
        return other

    def batch(self, now: TrainStep) -> FlowClips:
        picks = torch.searchsorted(self.upto, now.rand(self.size)).clamp_max(len(self.rows) - 1)
        rows = self.rows[picks][:, None] + self.window
        frames, actions = self.frames[rows], self.actions[rows]
        lone = (now.rand(self.size) < LONE)[:, None] & (self.window < 0)
        frames = torch.where(lone[..., None, None, None], frames[:, self.slots - 1 : self.slots], frames)
        actions = actions.masked_fill(lone[..., None], 0)
        grounds = self.grounds
        memory = None if grounds is None else grounds.memory(rows[:, self.slots :], now.rand(self.size))
        kept = () if self.past is None else self.past.before(rows[:, 0], now.rand(self.size, KEPT + 1))
        return FlowClips(frames, actions, memory, *kept)

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass


class DeviceGrounds:
    """What the episodes of a recording scrolled over, in one tensor on a device, and what it knows of pictures. over: bool [H, W],
    what does not scroll."""

    def __init__(self, stitched: StitchedEpisodes, over: torch.Tensor, device: torch.device):
        numbers, grounds = list(stitched.grounds), list(stitched.grounds.values())
        sizes = [ground[0].numel() for ground in grounds]
        self.pixels = torch.cat([ground.flatten(1) for ground in grounds], 1).T.contiguous().to(device)  # [n, 4]
        facts = torch.zeros(
            int(stitched.episode.max()) + 2, 3, dtype=torch.int64
        )  # where one begins, its height and width
        for number, begins, ground in zip(numbers, np.cumsum([0, *sizes[:-1]]), grounds):
            facts[number] = torch.tensor([begins, *ground.shape[1:]])
        self.facts = facts.to(device)  # the last, of no episode, is empty
        self.place, self.episode, self.over = (part.to(device) for part in (stitched.place, stitched.episode, over))

    def memory(self, rows: torch.Tensor, kind: torch.Tensor) -> torch.Tensor:
        """Of the pictures of `rows` int64 [B, T], what is known when they are drawn: uint8 [B, T, 4, H, W]. kind [B], uniform in
        0..1: how much of it."""
        height, width = self.over.shape
        begins, tall, wide = self.facts[self.episode[rows]][..., None, None].unbind(2)
        x = self.place[rows][..., :1, None] + torch.arange(width, device=rows.device)
        y = self.place[rows][..., 1:, None] + torch.arange(height, device=rows.device)[:, None]
        inside = (x >= 0) & (x < wide) & (y >= 0) & (y < tall)
        known = self.pixels[torch.where(inside, begins + y * wide + x, 0)] * inside[..., None]
        return known.movedim(-1, 2) * memory_shown(self.place, rows, self.over, kind)[:, :, None]


def _changed(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The part of the pixels of uint8 [N, 3, H, W] by which pictures differ: [N]."""
    return ((one.int() - other.int()).abs().amax(1) > CHANGED).float().mean((1, 2))
