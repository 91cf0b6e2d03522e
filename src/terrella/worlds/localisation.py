"""Arrival: where an episode stands that begins with one picture, and how deep it sees there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch

from ..space.camera import Intrinsics
from ..space.estimator import Estimator
from ..space.keyframes import Keyframes, look, retrieve
from ..space.recognise import recognise
from .parts import Absent

AWAY_M = 1000.0  # from the recordings, of a picture of elsewhere: nothing that they hold is seen from there
ALIKE, ALIKE_EDGES, KNOWN = 0.75, 0.3, 0.7  # a picture is of a remembered place from there up (see docs/lab/log.md)


@final
class NoEstimator(Absent):
    """Of a world that cannot see depth in a lone picture."""


@dataclass(frozen=True)
class Arrival:
    """pose [B, 7]; depth [B, H, W] metres; recognised bool [B]: the picture is of a place that memory holds."""

    pose: torch.Tensor
    depth: torch.Tensor
    recognised: torch.Tensor


def arrive(
    rgb: torch.Tensor,
    estimator: Estimator,
    memory: Keyframes,
    small: torch.Tensor,
    starts: Keyframes,
    camera: Intrinsics,
    sources: int,
) -> Arrival:
    """Pictures, uint8 [B, 3, H, W], in the place among `memory` (its `thumbnails` are `small`) where they were taken, or
    else in an empty corner of the world at the height of the `starts`; depth is memory's where it knows it, else the
    estimator's."""
    depth, recognised, poses = estimator.depth(rgb), [], []
    corner = starts.pose[:1].clone()
    corner[0, 0] = starts.pose[:, 0].max() + AWAY_M
    corner[0, 2] = starts.pose[:, 2].median()
    corner[0, 3:] = corner.new_tensor([1.0, 0, 0, 0])
    for view, picture in enumerate(rgb):
        place = recognise(picture, memory, small, camera, sources)
        known = place is not None and place.likeness > ALIKE and place.edges > ALIKE_EDGES and place.known > KNOWN
        recognised.append(known)
        poses.append(place.pose if place is not None and known else corner[0])
        if known:
            size = (rgb.shape[-2], rgb.shape[-1])
            picks = retrieve(memory, poses[-1][None], camera, size, sources)
            seen = look(memory, picks, poses[-1][None], camera, size, 1)
            depth[view] = torch.where(seen.known[0] > 0, seen.depth[0], depth[view])
    return Arrival(torch.stack(poses), depth, torch.tensor(recognised, device=rgb.device))
