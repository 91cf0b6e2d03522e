"""What a batch teaches the generator: a view of a place from its keyframes, or the next frame from the last ones.

`Dream` lets the generator under training dream the frame before the target, so that it learns to go on from its own.
"""

from __future__ import annotations

import numpy as np
import torch

from ..space.keyframes import Glimpse, Keyframes
from ..worlds.generator import THUMBNAIL, VideoConfig, context_thumbnail, decode_depth, encode_depth
from ..worlds.history import past
from .moving import moving_lesson
from .samples import Dream, Lesson, Recording, carried, draw, glimpse_of

DREAMT, OFTEN = (0, 1, 2, 4), (0.4, 0.3, 0.2, 0.1)  # frames of a history that are dreamt, and in what share of lessons
CHANGED = 20.0  # see `changing`


def recorded_lesson(
    recording: Recording,
    memory: Keyframes | None,
    config: VideoConfig,
    batch: int,
    rng: np.random.Generator,
    dream: Dream | None,
) -> Lesson:
    """A batch for a world of this kind: with a `memory` it is a place, where things may move; without, a history."""
    if memory is None:
        return history_lesson(recording, config, batch, rng, dream)
    of_place = moving_lesson if config.moving else place_lesson
    return of_place(recording, memory, config, batch, rng, dream)


def place_lesson(
    recording: Recording,
    memory: Keyframes,
    config: VideoConfig,
    batch: int,
    rng: np.random.Generator,
    dream: Dream | None,
) -> Lesson:
    """Views of recorded places; the last frame is recorded in half of the lessons, else dreamt (never without `dream`)."""
    shown = draw(recording, memory, config, batch, rng)
    rgb, depth = recording.rgb(shown.before), recording.depth(shown.before)
    if dream and rng.random() < 0.5:
        glimpse, earlier = glimpse_of(shown, shown.before, recording, config), shown.before - 1
        known = recording.rgb(earlier), recording.depth(earlier)
        last = carried(*known, earlier, shown.before, glimpse, recording, config)
        clean = dream(Lesson(glimpse, _now_and_then(last, 0.5, rng), context_thumbnail(known[0]), last))
        rgb, depth = _pixels(clean), decode_depth(clean[:, 3])
    glimpse = glimpse_of(shown, shown.target, recording, config)
    last = carried(rgb, depth, shown.before, shown.target, glimpse, recording, config)
    truth = torch.cat([_coded(recording.rgb(shown.target)), encode_depth(recording.depth(shown.target))[:, None]], 1)
    return varied(Lesson(glimpse, _now_and_then(last, 0.9, rng), context_thumbnail(rgb), truth), rng)


def varied(lesson: Lesson, rng: np.random.Generator) -> Lesson:
    """The same lesson in a mirrored world (half of the time) with other colours (likewise): one map has few rooms, and
    the look of a new one should be taken from what is seen of it, not from the rooms of the recording."""
    glimpse, colours = lesson.glimpse, torch.arange(3)
    if rng.random() < 0.5:
        colours = torch.from_numpy(rng.permutation(3))
    pixels = torch.cat([colours, torch.tensor([3])])
    thumbnail = lesson.told.unflatten(1, (3, *THUMBNAIL))[:, colours]
    parts = [glimpse.rgb[:, :, colours], glimpse.trust, glimpse.depth, glimpse.known]
    parts += [lesson.last[:, pixels], thumbnail, lesson.truth[:, pixels]]
    if rng.random() < 0.5:
        parts = [part.flip(-1) for part in parts]
    return Lesson(Glimpse(*parts[:4]), parts[4], parts[5].flatten(1), parts[6])


def history_lesson(
    recording: Recording,
    config: VideoConfig,
    batch: int,
    rng: np.random.Generator,
    dream: Dream | None,
) -> Lesson:
    """Next frames; of those that are shown the newest 0 to 4 are dreamt, each from those before it (none without `dream`).

    Before an episode's first frame it stood still, and nobody acted. Pixels that change count for more.
    """
    dreamt = int(rng.choice(DREAMT, p=OFTEN)) if dream else 0
    since = np.arange(len(recording.usable)) - recording.start
    target = rng.choice(np.flatnonzero(recording.usable & (since > dreamt)), batch)
    frames = _frames(recording, _before(recording, target - dreamt, config.slots))
    for row in (target - dreamt + step for step in range(dreamt)):
        nothing = torch.zeros(batch, 4, *config.size)
        clean = dream(Lesson(past(frames), nothing, _told(recording, row, frames), nothing))  # pyright: ignore[reportOptionalCall]
        frames = torch.cat([_pixels(clean)[:, None], frames[:, :-1]], 1)
    glimpse, found = past(frames), recording.rgb(target)
    truth = torch.cat([_coded(found), encode_depth(glimpse.depth)[:, None]], 1)
    weight = changing(found, torch.stack([frames[:, 0], recording.rgb(target - 1)], 1))
    return Lesson(glimpse, torch.zeros_like(truth), _told(recording, target, frames), truth, weight)


def changing(found: torch.Tensor, before: torch.Tensor, often: float = CHANGED) -> torch.Tensor:
    """How much each pixel of the frames `found` (uint8 [B, 3, H, W]) counts, 1 in the mean: [B, 1, H, W]. One that differs
    from any of the frames `before` (uint8 [B, n, 3, H, W]) counts for 1 + `often` of the others: else a ball of two pixels
    is cheaper to forget than to follow."""
    moved = (found[:, None].int() - before.int()).abs().amax((1, 2)) > 20
    weight = 1 + often * moved[:, None].float()
    return weight / weight.mean()


def _before(recording: Recording, rows: np.ndarray, count: int) -> np.ndarray:
    """The `count` rows before each of `rows`, the newest first, none before its episode began: [n, count]."""
    return np.maximum(rows[:, None] - 1 - np.arange(count), recording.start[rows][:, None])


def _now_and_then(last: torch.Tensor, often: float, rng: np.random.Generator) -> torch.Tensor:
    return last * torch.from_numpy(rng.random(len(last)) < often)[:, None, None, None]


def _frames(recording: Recording, rows: np.ndarray) -> torch.Tensor:
    flat = recording.rgb(rows.ravel())
    return flat.view(*rows.shape, *flat.shape[1:])


def _told(recording: Recording, rows: np.ndarray, frames: torch.Tensor) -> torch.Tensor:
    """The mood of the newest of `frames` [B, slots, ...] and the actions that led to `rows` and the frames before them."""
    wanted = rows[:, None] - 1 - np.arange(frames.shape[1])
    began = wanted < recording.start[rows][:, None]
    actions = recording.action(np.maximum(wanted, 0).ravel()).view(*wanted.shape, -1)
    actions = torch.where(torch.from_numpy(began)[..., None], 0.0, actions)
    return torch.cat([context_thumbnail(frames[:, 0]), actions.flatten(1)], 1)


def _coded(rgb: torch.Tensor) -> torch.Tensor:
    return rgb.float() / 127.5 - 1


def _pixels(clean: torch.Tensor) -> torch.Tensor:
    return ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
