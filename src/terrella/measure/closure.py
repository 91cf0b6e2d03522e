"""Closure: turn the camera away and back again; does the world still hold what it showed before?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..core.errors import ObservationError
from ..core.world import World, make_rng
from .clips import Clip
from .fidelity import psnr
from .roll import fold_context
from .statistics import Figure, mean_interval

STATIC_DB = 20.0  # a far view this like the first one means that the picture hardly turned at all


@dataclass(frozen=True)
class Closure:
    """Yaw 0 - far - 0. closed: PSNR of the last frame against the first; far: of the view at the far end against the
    first. void: the far views are not different (PSNR >= 20 dB), so `closed` proves nothing. `picture` holds the
    first clip's frames, uint8 [5, H, W, 3]: first, half way out, far, half way back, last."""

    arm: str
    place: str
    far_deg: float
    step_deg: float
    steps: int
    closed: Figure
    far: Figure
    void: bool
    picture: np.ndarray = field(repr=False, compare=False)


def closure(
    world: World,
    clips: Sequence[Clip],
    rng: torch.Generator,
    arm: str = "",
    place: str = "",
    far_deg: float = 180.0,
    step_deg: float = 3.0,
    batch: int = 8,
) -> Closure:
    """From each clip's context, turns the camera by pose-only evidence in small steps to `far_deg` and back.

    The first frame is what the world shows after its context (for most worlds the observed frame itself), so the last,
    dreamt frame is held against the strictest reference. ObservationError where the world takes no poses.
    """
    if "pose" not in world.spec.observes:
        raise ObservationError(f"{world.spec.name} does not observe 'pose', so nothing can turn its camera.")
    half = math.ceil(far_deg / step_deg)
    path = [far_deg * step / half for step in (*range(1, half + 1), *range(half - 1, -1, -1))]
    marks = (half // 2, half, len(path) - half // 2)
    size, seed = min(batch, world.spec.max_batch or batch), int(torch.randint(2**31 - 1, (1,), generator=rng).item())
    closed, away, picture = [], [], []
    for start in range(0, len(clips), size):
        own = make_rng(seed + start)
        state = fold_context(world, clips[start : start + size], own)
        seen = world.render(state, ("rgb", "pose"))
        first, pose = seen["rgb"].cpu(), seen["pose"]
        shown = [first[0]]
        for number, turn in enumerate(path, start=1):
            state = world.observe({"pose": turned(pose, math.radians(turn))}, state, own)
            if number in marks or number == len(path):
                frame = world.render(state, ("rgb",))["rgb"].cpu()
                shown.append(frame[0])
                if number == half:
                    away.append(psnr(frame, first))
        closed.append(psnr(frame, first))
        picture = picture or shown
    far, last = torch.cat(away), torch.cat(closed)
    figures = mean_interval(last, rng), mean_interval(far, rng)
    void = bool(far.mean() >= STATIC_DB)
    return Closure(arm, place, far_deg, far_deg / half, len(path), *figures, void, torch.stack(picture).numpy())


def turned(pose: torch.Tensor, angle_rad: float) -> torch.Tensor:
    """Poses [B, 7] turned about the world's vertical by `angle_rad`, counter-clockwise from above; the place stays."""
    c, s = math.cos(angle_rad / 2), math.sin(angle_rad / 2)
    w, x, y, z = pose[:, 3:].unbind(-1)
    around = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    return torch.cat([pose[:, :3], around], -1)
