"""moving_lesson: what a batch teaches the generator of a place in which things move (worlds/moving.py)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from ..space.keyframes import Glimpse, Keyframes
from ..worlds.generator import THUMBNAIL, VideoConfig, context_thumbnail, decode_depth, encode_depth
from ..worlds.moving import Frame, carry_frames
from .samples import Dream, Lesson, Recording, draw, glimpse_of

OFTEN = (0.4, 0.3, 0.2, 0.1)  # the share of lessons in which 0, 1, 2, 3 frames are dreamt
COUNTS = 4.0  # a pixel of a thing counts for so many others more: else a far monster is cheaper to forget than to draw


def moving_lesson(
    recording: Recording,
    memory: Keyframes,
    config: VideoConfig,
    batch: int,
    rng: np.random.Generator,
    dream: Dream | None,
) -> Lesson:
    """Next frames of recorded places; of those shown the newest 0 to 3 are dreamt, each from those before it (none without
    `dream`), half of the last are worn, and in one sample of ten they are unknown."""
    dreamt = int(rng.choice(len(OFTEN), p=OFTEN)) if dream else 0
    shown = draw(recording, memory, config, batch, rng, back=len(OFTEN) + 1)
    last, earlier = (_frame(recording, shown.target - dreamt - age, config.objects) for age in (1, 2))
    for back in range(dreamt, 0, -1):
        rows = shown.target - back
        before = carry_frames(last, earlier, recording.pose(rows), config.camera)
        told = _told(recording, rows, last.rgb, config.history)
        asked = Lesson(glimpse_of(shown, rows, recording, config), before, told, before)
        clean = dream(asked)  # pyright: ignore[reportOptionalCall]
        rgb = ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        covered = _covered(recording, rows, config.objects)  # in a dream, too, cards cover what is drawn
        drawn = Frame(rgb, decode_depth(clean[:, 3]), clean[:, 4].sigmoid(), recording.pose(rows), covered)
        last, earlier = drawn, last
    last = last._replace(rgb=worn(last.rgb, rng))
    carried = carry_frames(last, earlier, recording.pose(shown.target), config.camera)
    carried = carried * torch.from_numpy(rng.random(batch) < 0.9)[:, None, None, None]
    things = recording.things(shown.target)
    coded = recording.rgb(shown.target).float() / 127.5 - 1
    truth = torch.cat([coded, encode_depth(recording.depth(shown.target))[:, None], things[:, None]], 1)
    told = _told(recording, shown.target, last.rgb, config.history)
    weight = 1 + COUNTS * torch.maximum(things, (carried[:, 5] > 0.5).float())[:, None]
    if config.objects:  # what cards cover is not to be drawn
        weight = weight * ~recording.covered(shown.target)[:, None]
    glimpse = glimpse_of(shown, shown.target, recording, config)
    lesson = Lesson(glimpse, carried, told, truth, weight / weight.mean())
    return mirrored(lesson, recording.cache.action_names) if rng.random() < 0.5 else lesson


def worn(rgb: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Frames uint8 [B, 3, H, W], half of them softer and noisier, as frames of a long dream are: what memory knows better
    should be taken from there."""
    share = torch.from_numpy(rng.random(len(rgb)) * (rng.random(len(rgb)) < 0.5)).float()[:, None, None, None]
    soft = F.avg_pool2d(rgb.float(), 3, 1, 1, count_include_pad=False)
    noise = torch.from_numpy(rng.standard_normal(rgb.shape, np.float32))
    return (rgb.float().lerp(soft, share) + 8 * share * noise).round().clamp(0, 255).to(torch.uint8)


def mirrored(lesson: Lesson, action_names: tuple[str, ...]) -> Lesson:
    """The same lesson in a mirror: what was done to the left is done to the right."""
    glimpse, mood_size = lesson.glimpse, 3 * THUMBNAIL[0] * THUMBNAIL[1]
    small = lesson.told[:, :mood_size].unflatten(1, (3, *THUMBNAIL)).flip(-1).flatten(1)
    acts = lesson.told[:, mood_size:].unflatten(1, (-1, len(action_names)))[..., other_side(action_names)].flatten(1)
    parts = [part.flip(-1) for part in (glimpse.rgb, glimpse.trust, glimpse.depth, glimpse.known)]
    weight = None if lesson.weight is None else lesson.weight.flip(-1)
    return Lesson(Glimpse(*parts), lesson.last.flip(-1), torch.cat([small, acts], 1), lesson.truth.flip(-1), weight)


def other_side(action_names: tuple[str, ...]) -> list[int]:
    """For each button the one that does the same in a mirror: that with LEFT and RIGHT exchanged in its name."""
    swap = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
    names = ["_".join(swap.get(word, word) for word in name.split("_")) for name in action_names]
    return [action_names.index(name) if name in action_names else at for at, name in enumerate(names)]


def _frame(recording: Recording, rows: np.ndarray, objects: bool) -> Frame:
    seen = recording.rgb(rows), recording.depth(rows), recording.things(rows), recording.pose(rows)
    return Frame(*seen, _covered(recording, rows, objects))


def _covered(recording: Recording, rows: np.ndarray, objects: bool) -> torch.Tensor:
    return recording.covered(rows) if objects else torch.zeros_like(recording.depth(rows), dtype=torch.bool)


def _told(recording: Recording, rows: np.ndarray, last: torch.Tensor, history: int) -> torch.Tensor:
    """The mood of the frames before `rows`, and the actions that led there, the newest last, none before the first."""
    wanted = rows[:, None] - history + np.arange(history)
    actions = recording.action(np.maximum(wanted, 0).ravel()).view(*wanted.shape, -1)
    known = torch.from_numpy(wanted >= recording.start[rows][:, None])[..., None]
    return torch.cat([context_thumbnail(last), torch.where(known, actions, 0.0).flatten(1)], 1)
