"""What a batch teaches the generator of a place in which things move (worlds/carried_frames.py)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from ..space.keyframes import Glimpse, Keyframes
from ..worlds.carried_frames import Frame, carry_frames
from ..worlds.config import THUMBNAIL, VideoConfig
from ..worlds.controls import BUTTONS
from ..worlds.generator import Conditioning, context_thumbnail, decode_depth, encode_depth, pixels
from .batches import Batch, Dream, Views, coded
from .recording import Recording
from .trainer import Now

OFTEN = (0.4, 0.3, 0.2, 0.1)  # the share of batches in which 0, 1, 2, 3 frames are dreamt
COUNTS = 4.0  # a pixel of a thing counts for so many others more: else a far monster is cheaper to forget than to draw


def moving_batch(
    recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, now: Now, dream: Dream | None
) -> Batch:
    """Next frames of recorded places; of those shown the newest 0 to 3 are dreamt, each from those before it (none without
    `dream`), half of the last are worn, and in one sample of ten they are unknown."""
    rng = now.rng
    dreamt = int(rng.choice(len(OFTEN), p=OFTEN)) if dream else 0
    views = Views.drawn(recording, memory, config, batch, rng, back=len(OFTEN) + 1)
    last, earlier = (_frame(recording, views.target - dreamt - age, config.objects) for age in (1, 2))
    for back in range(dreamt, 0, -1):
        rows = views.target - back
        before = carry_frames(last, earlier, recording.pose(rows), config.camera)
        asked = Conditioning(views.glimpse(rows), before, _context(recording, rows, last.rgb, config.history))
        clean = dream(asked, now)  # pyright: ignore[reportOptionalCall]
        covered = _covered(recording, rows, config.objects)  # in a dream, too, billboards cover what is drawn
        things = clean[:, 4].sigmoid()
        drawn = Frame(pixels(clean), decode_depth(clean[:, 3]), things, recording.pose(rows), covered)
        last, earlier = drawn, last
    last = last._replace(rgb=worn(last.rgb, rng))
    carried = carry_frames(last, earlier, recording.pose(views.target), config.camera)
    carried = carried * torch.from_numpy(rng.random(batch) < 0.9)[:, None, None, None]
    things, depth = recording.things(views.target), encode_depth(recording.depth(views.target))
    truth = torch.cat([coded(recording.rgb(views.target)), depth[:, None], things[:, None]], 1)
    weight = 1 + COUNTS * torch.maximum(things, (carried[:, 5] > 0.5).float())[:, None]
    if config.objects:  # what billboards cover is not to be drawn
        weight = weight * ~recording.covered(views.target)[:, None]
    context = _context(recording, views.target, last.rgb, config.history)
    found = Batch(Conditioning(views.glimpse(views.target), carried, context), truth, weight / weight.mean())
    symmetric = recording.controls is None or recording.controls.kind == BUTTONS  # else who knows what left is
    return mirrored(found, recording.cache.action_names) if rng.random() < 0.5 and symmetric else found


def worn(rgb: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Frames uint8 [B, 3, H, W], half of them softer and noisier, as frames of a long dream are: what memory knows better
    should be taken from there."""
    share = torch.from_numpy(rng.random(len(rgb)) * (rng.random(len(rgb)) < 0.5)).float()[:, None, None, None]
    soft = F.avg_pool2d(rgb.float(), 3, 1, 1, count_include_pad=False)
    noise = torch.from_numpy(rng.standard_normal(rgb.shape, np.float32))
    return (rgb.float().lerp(soft, share) + 8 * share * noise).round().clamp(0, 255).to(torch.uint8)


def mirrored(batch: Batch, action_names: tuple[str, ...]) -> Batch:
    """The same batch in a mirror: what was done to the left is done to the right."""
    glimpse, last, context = batch.shown.glimpse, batch.shown.last, batch.shown.context
    cut = 3 * THUMBNAIL[0] * THUMBNAIL[1]
    small = context[:, :cut].unflatten(1, (3, *THUMBNAIL)).flip(-1).flatten(1)
    acts = context[:, cut:].unflatten(1, (-1, len(action_names)))[..., other_side(action_names)].flatten(1)
    parts = [part.flip(-1) for part in (glimpse.rgb, glimpse.trust, glimpse.depth, glimpse.known)]
    weight = None if batch.weight is None else batch.weight.flip(-1)
    shown = Conditioning(Glimpse(*parts), last.flip(-1), torch.cat([small, acts], 1))
    return Batch(shown, batch.truth.flip(-1), weight)


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


def _context(recording: Recording, rows: np.ndarray, last: torch.Tensor, history: int) -> torch.Tensor:
    """The thumbnail of the frames before `rows`, and the actions that led there, the newest last, none before the first."""
    acts = recording.actions_before(rows, np.arange(history, 0, -1))
    return torch.cat([context_thumbnail(last), acts.flatten(1)], 1)
