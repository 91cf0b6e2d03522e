"""Localisation: the pose and depth of an episode that begins with one picture."""

from dataclasses import dataclass
from typing import final

import torch

from ..space.camera import Intrinsics
from ..space.estimator import Estimator
from ..space.keyframes import Keyframes, look, retrieve
from ..space.recognise import recognise
from .parts import Absent

AWAY_M = 1000.0  # from the recordings, where pictures of unknown places are put: no keyframe is seen from there
ALIKE, ALIKE_EDGES, KNOWN = 0.75, 0.3, 0.7  # likeness, edges and known share above which a place is recognised


@final
class NoEstimator(Absent):
    """Of a world that cannot estimate depth from a picture."""


@dataclass(frozen=True)
class Arrival:
    """Where B pictures were taken."""

    pose: torch.Tensor  # [B, 7]
    depth: torch.Tensor  # [B, H, W] metres
    recognised: torch.Tensor  # bool [B]: of a place that memory holds


def localise(
    rgb: torch.Tensor,
    estimator: Estimator,
    memory: Keyframes,
    small: torch.Tensor,
    starts: Keyframes,
    camera: Intrinsics,
    sources: int,
) -> Arrival:
    """Localises pictures uint8 [B, 3, H, W] among the keyframes `memory`, whose `thumbnails` are `small`; those that are not
    recognised are put far from it, at the height of the `starts`. Depth is memory's where known, else the estimator's."""
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
