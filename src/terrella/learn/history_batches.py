"""What a batch teaches a generator that sees the last frames and actions alone: made of clips of a recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from ..worlds.config import VideoConfig
from ..worlds.controls import Controls
from ..worlds.frame_history import past
from ..worlds.generator import Conditioning, context_thumbnail, encode_depth, pixels
from .batches import Batch, Dream, coded
from .recording import Recording
from .trainer import Now

DREAMT, OFTEN = (0, 1, 2, 4), (0.4, 0.3, 0.2, 0.1)  # frames of a history that are dreamt, and in what share of batches
CHANGED = 20.0  # see `changing`
STILL = 0.05  # the share of clips that are shown as if an episode began with them: play begins with a lone frame, too


def clip_length(config: VideoConfig) -> int:
    """Rows of a clip: a history, what may be dreamt after it, and the frame to draw."""
    return config.slots + max(DREAMT) + 1


def clips_at(recording: Recording, config: VideoConfig, batch: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Clips for `history_batch` drawn at random, of rows that training may see."""
    length = clip_length(config)
    whole = recording.usable & (np.arange(len(recording.usable)) - recording.start >= length - 1)
    rows = rng.choice(np.flatnonzero(whole), batch)[:, None] + np.arange(1 - length, 1)
    arrays = {"rgb": recording.cache.rgb, "action": recording.cache.action}
    return {
        name: np.asarray(array[rows.ravel()]).reshape(*rows.shape, *array.shape[1:]) for name, array in arrays.items()
    }


def history_batch(
    clips: Mapping[str, np.ndarray], controls: Controls, config: VideoConfig, now: Now, dream: Dream | None
) -> Batch:
    """Next frames; of those that are shown the newest 0 to 4 are dreamt, each from those before it (none without `dream`).

    clips: rgb uint8 [B, T, H, W, 3], action [B, T, ...] and perhaps instruction [B, T, D]. Before an episode's first frame
    it stood still, and nobody acted. Pixels that change count for more.
    """
    rgb = torch.from_numpy(np.ascontiguousarray(clips["rgb"])).permute(0, 1, 4, 2, 3)
    batch, length = rgb.shape[:2]
    actions = controls.encode(torch.from_numpy(np.array(clips["action"], np.float32)).flatten(0, 1))
    actions = actions.unflatten(0, (batch, length))
    dreamt = int(now.rng.choice(DREAMT, p=OFTEN)) if dream else 0
    begins = now.rng.random(batch) < STILL
    target = np.where(begins, now.rng.integers(dreamt + 1, length, batch), length - 1)
    index, newest = np.arange(batch), np.arange(config.slots)
    shown = np.maximum(target[:, None] - dreamt - 1 - newest, 0)
    frames = rgb[index[:, None], shown]
    for rows in (target - dreamt + step for step in range(dreamt)):
        nothing = torch.zeros(batch, 4, *config.size)
        asked = Conditioning(past(frames), nothing, _context(actions, rows, frames))
        clean = dream(asked, now)  # pyright: ignore[reportOptionalCall]
        frames = torch.cat([pixels(clean)[:, None], frames[:, :-1]], 1)
    glimpse, found = past(frames), rgb[index, target]
    truth = torch.cat([coded(found), encode_depth(glimpse.depth)[:, None]], 1)
    weight = changing(found, torch.stack([frames[:, 0], rgb[index, target - 1]], 1))
    context = _context(actions, target, frames)
    wanted = clips.get("instruction")
    instruction = None if wanted is None else torch.from_numpy(np.array(wanted[:, -1], np.float32))
    return Batch(Conditioning(glimpse, torch.zeros_like(truth), context), truth, weight, instruction)


def changing(found: torch.Tensor, before: torch.Tensor, often: float = CHANGED) -> torch.Tensor:
    """How much each pixel of the frames `found` (uint8 [B, 3, H, W]) counts, 1 in the mean: [B, 1, H, W]. One that differs
    from any of the frames `before` (uint8 [B, n, 3, H, W]) counts for 1 + `often` of the others: else a ball of two pixels
    is cheaper to forget than to follow."""
    moved = (found[:, None].int() - before.int()).abs().amax((1, 2)) > 20
    weight = 1 + often * moved[:, None].float()
    return weight / weight.mean()


def _context(actions: torch.Tensor, rows: np.ndarray, frames: torch.Tensor) -> torch.Tensor:
    """The thumbnail of the newest of `frames` [B, slots, ...] and the actions [B, T, A] that led to `rows` [B] of the clips
    and the frames before them, the newest first; none before the clip."""
    wanted = rows[:, None] - 1 - np.arange(frames.shape[1])
    led = actions[np.arange(len(rows))[:, None], np.maximum(wanted, 0)]
    led = torch.where(torch.from_numpy(wanted >= 0)[..., None], led, 0.0)
    return torch.cat([context_thumbnail(frames[:, 0]), led.flatten(1)], 1)
