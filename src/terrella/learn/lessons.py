"""What a batch teaches the generator: a view of a place from its keyframes, or the next frame from the last ones.

`Dream` lets the generator under training dream the frame before the target, so that it learns to go on from its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..space.keyframes import Glimpse, Keyframes
from ..worlds.history import past
from ..worlds.video import MOOD, VideoConfig, decode_depth, encode_depth, mood
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
        clean = dream(Lesson(glimpse, _now_and_then(last, 0.5, rng), mood(known[0]), last))
        rgb, depth = _pixels(clean), decode_depth(clean[:, 3])
    glimpse = glimpse_of(shown, shown.target, recording, config)
    last = carried(rgb, depth, shown.before, shown.target, glimpse, recording, config)
    truth = torch.cat([_coded(recording.rgb(shown.target)), encode_depth(recording.depth(shown.target))[:, None]], 1)
    return varied(Lesson(glimpse, _now_and_then(last, 0.9, rng), mood(rgb), truth), rng)


def varied(lesson: Lesson, rng: np.random.Generator) -> Lesson:
    """The same lesson in a mirrored world (half of the time) with other colours (likewise): one map has few rooms, and
    the look of a new one should be taken from what is seen of it, not from the rooms of the recording."""
    glimpse, colours = lesson.glimpse, torch.arange(3)
    if rng.random() < 0.5:
        colours = torch.from_numpy(rng.permutation(3))
    pixels = torch.cat([colours, torch.tensor([3])])
    thumbnail = lesson.told.unflatten(1, (3, *MOOD))[:, colours]
    parts = [glimpse.rgb[:, :, colours], glimpse.trust, glimpse.depth, glimpse.known]
    parts += [lesson.last[:, pixels], thumbnail, lesson.truth[:, pixels]]
    if rng.random() < 0.5:
        parts = [part.flip(-1) for part in parts]
    return Lesson(Glimpse(*parts[:4]), parts[4], parts[5].flatten(1), parts[6])


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
        clean = dream(Lesson(earlier, nothing, _told(recording, back - 1, frames[:, 1]), nothing))
        frames = torch.cat([_pixels(clean)[:, None], frames[:, 1:]], 1)
    glimpse = past(frames)
    truth = torch.cat([_coded(recording.rgb(target)), encode_depth(glimpse.depth)[:, None]], 1)
    return Lesson(glimpse, torch.zeros_like(truth), _told(recording, back, frames[:, 0]), truth)


def _now_and_then(last: torch.Tensor, often: float, rng: np.random.Generator) -> torch.Tensor:
    return last * torch.from_numpy(rng.random(len(last)) < often)[:, None, None, None]


def _frames(recording: Recording, rows: np.ndarray) -> torch.Tensor:
    flat = recording.rgb(rows.ravel())
    return flat.view(*rows.shape, *flat.shape[1:])


def _told(recording: Recording, rows: np.ndarray, newest: torch.Tensor) -> torch.Tensor:
    """The mood of the newest frame and the actions of `rows` [B, slots]."""
    actions = torch.from_numpy(np.asarray(recording.cache.action[rows.ravel()], np.float32)).view(len(rows), -1)
    return torch.cat([mood(newest), actions], 1)


def _coded(rgb: torch.Tensor) -> torch.Tensor:
    return rgb.float() / 127.5 - 1


def _pixels(clean: torch.Tensor) -> torch.Tensor:
    return ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
