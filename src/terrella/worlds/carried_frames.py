"""The last two frames carried into a view by their own depth, and which pixels of a frame stand still: keyframes hold those,
and monsters, shots and doors are known from the last frames alone."""

from typing import NamedTuple

import torch
import torch.nn.functional as F

from ..core.backend import kernels_do
from ..space.camera import Intrinsics
from ..space.reproject import carry_things, least_around

PLANES = 6  # planes that `carry_frames` adds to the last frame's colour and trust


class Frame(NamedTuple):
    """B frames as they were seen: rgb uint8 [B, 3, H, W]; depth [B, H, W] metres; things [B, H, W] in 0..1, where something may
    move or vanish; pose [B, 7]; covered bool [B, H, W], what a painted billboard (worlds/objects.py) hides."""

    rgb: torch.Tensor
    depth: torch.Tensor
    things: torch.Tensor
    pose: torch.Tensor
    covered: torch.Tensor


def covered_pixels(instances: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """The pixels bool [B, H, W] that billboards cover: those of `instances` [B, H, W], and the `things` [B, H, W] around them,
    since the pixels of their rim are mixed."""
    shown = (instances > 0).float()
    around = -least_around(-shown) if kernels_do(shown) else F.max_pool2d(shown, 3, 1, 1)
    return torch.maximum(shown, around * (things > 0.5)) > 0


def static_depth(depth: torch.Tensor, things: torch.Tensor) -> torch.Tensor:
    """Depth [B, H, W] as a keyframe keeps it: 0 (unknown) where `things` are."""
    return torch.where(things > 0.5, 0.0, depth)


def carry_frames(last: Frame, earlier: Frame, pose: torch.Tensor, camera: Intrinsics) -> torch.Tensor:
    """The last two frames as they would look from `pose` [B, 7] if only the camera had moved: [B, 4 + PLANES, H, W] = colour in
    [0, 1] and trust of the last, its depth in metres and its things, colour and trust of the one before."""
    rgb, depth, things, at, covered = map(torch.cat, zip(last, earlier))
    now, before = carry_things(rgb, depth, things, covered, at, torch.cat([pose, pose]), camera).chunk(2)
    return torch.cat([now, before[:, :4]], 1)
