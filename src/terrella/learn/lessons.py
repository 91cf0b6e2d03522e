"""What a batch teaches the generator: a view of a place from its keyframes, or the next frame from the last ones.

`Dream` lets the generator under training dream the frame before the target, so that it learns to go on from its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..space.keyframes import Keyframes
from ..worlds.history import past
from ..worlds.video import VideoConfig, decode_depth, encode_depth
from .samples import Lesson, Recording, carried, draw, glimpse_of

# Dream(lesson without truth) -> clean frames [B, 4, H, W] in the generator's code
Dream = Callable[[Lesson], torch.Tensor]


def place_lesson(
    recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, rng: np.random.Generator, dream: Dream
) -> Lesson:
    """Views of recorded places; the last frame is recorded in half of the lessons, else dreamt."""
    shown = draw(recording, memory, config, batch, rng)
    rgb, depth = recording.rgb(shown.before), recording.depth(shown.before)
    if rng.random() < 0.5:
        glimpse, earlier = glimpse_of(shown, shown.before, recording, config), shown.before - 1
        known = recording.rgb(earlier), recording.depth(earlier)
        last = carried(*known, earlier, shown.before, glimpse, recording, config)
        clean = dream(Lesson(glimpse, _now_and_then(last, 0.5, rng), last))
        rgb, depth = _pixels(clean), decode_depth(clean[:, 3])
    glimpse = glimpse_of(shown, shown.target, recording, config)
    last = carried(rgb, depth, shown.before, shown.target, glimpse, recording, config)
    truth = torch.cat([_coded(recording.rgb(shown.target)), encode_depth(recording.depth(shown.target))[:, None]], 1)
    return Lesson(glimpse, _now_and_then(last, 0.9, rng), truth)


def history_lesson(
    recording: Recording, config: VideoConfig, batch: int, rng: np.random.Generator, dream: Dream
) -> Lesson:
    """Next frames; the newest frame shown is recorded in half of the lessons, else dreamt from those before it."""
    slots = config.slots
    rows = recording.usable & (np.arange(len(recording.usable)) - recording.start > slots)
    target = rng.choice(np.flatnonzero(rows), batch)
    back = target[:, None] - 1 - np.arange(slots)
    frames = _frames(recording, back)
    if rng.random() < 0.5:
        earlier = past(_frames(recording, back - 1))
        nothing = torch.zeros(batch, 4, *config.size)
        clean = dream(Lesson(earlier, nothing, nothing, _actions(recording, back - 1)))
        frames = torch.cat([_pixels(clean)[:, None], frames[:, 1:]], 1)
    glimpse = past(frames)
    truth = torch.cat([_coded(recording.rgb(target)), encode_depth(glimpse.depth)[:, None]], 1)
    return Lesson(glimpse, torch.zeros_like(truth), truth, _actions(recording, back))


def _now_and_then(last: torch.Tensor, often: float, rng: np.random.Generator) -> torch.Tensor:
    return last * torch.from_numpy(rng.random(len(last)) < often)[:, None, None, None]


def _frames(recording: Recording, rows: np.ndarray) -> torch.Tensor:
    flat = recording.rgb(rows.ravel())
    return flat.view(*rows.shape, *flat.shape[1:])


def _actions(recording: Recording, rows: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(recording.cache.action[rows.ravel()], np.float32)).view(len(rows), -1)


def _coded(rgb: torch.Tensor) -> torch.Tensor:
    return rgb.float() / 127.5 - 1


def _pixels(clean: torch.Tensor) -> torch.Tensor:
    return ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
