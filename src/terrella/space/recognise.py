"""Localisation: the pose of a single picture among posed keyframes, by similarity and then by reprojection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from .camera import Intrinsics, planar_pose, yaw
from .keyframes import Keyframes, look, retrieve

_SMALL = (12, 16)  # size of the thumbnails that are compared first
_CANDIDATES, _REFINED = 24, 6
_SEARCH = (24, 32)  # size of the views during the search
_FIRST_M, _FIRST_RAD, _ROUNDS = 0.5, 0.12, 6  # first steps of the search, halved in each round


@dataclass(frozen=True)
class RecognisedPose:
    """Where a picture was taken."""

    pose: torch.Tensor  # [7]
    likeness: float  # normalised correlation with memory's view from there, over its known pixels, at most 1
    edges: float  # the same of the differences between neighbouring pixels
    known: float  # the share of the view that memory knows


def thumbnails(rgb: torch.Tensor) -> torch.Tensor:
    """Pictures, uint8 [K, 3, H, W] -> thumbnails normalised in brightness and contrast [K, 3, *_SMALL]."""
    if not len(rgb):
        return torch.zeros(0, 3, *_SMALL)
    small = torch.cat([F.interpolate(part.float(), _SMALL, mode="area") for part in rgb.split(64)])
    small = small - small.mean((1, 2, 3), keepdim=True)
    return small / small.std((1, 2, 3), keepdim=True).clamp_min(1e-3)


def recognise(
    picture: torch.Tensor, memory: Keyframes, small: torch.Tensor, camera: Intrinsics, sources: int
) -> RecognisedPose | None:
    """The best pose for a level picture, uint8 [3, H, W], among `memory` with its `thumbnails`; None in an empty memory. Keyframes
    are compared under small turns of the camera, then a local search renders memory at each pose. The caller judges the
    likeness."""
    if not len(memory):
        return None
    views = [
        _View(memory, pose, camera, sources, _scaled(picture, _SEARCH))
        for pose in _candidates(thumbnails(picture[None])[0], memory, small, camera)
    ]
    views.sort(key=lambda view: -view.best)
    winner = max((view.refine() for view in views[:_REFINED]), key=lambda view: view.best)
    size = (picture.shape[-2], picture.shape[-1])
    last = _View(memory, winner.pose, camera, sources, _scaled(picture, size)).refine(_ROUNDS - 3)
    likeness, known = last.judge(last.pose)
    return RecognisedPose(last.pose, likeness, last.edges(last.pose), known)


def _candidates(
    tiny: torch.Tensor, memory: Keyframes, small: torch.Tensor, camera: Intrinsics
) -> Sequence[torch.Tensor]:
    """Poses of the keyframes most similar to `tiny`, each turned to the best alignment."""
    height, width = _SMALL
    scores, most = [], width * 3 // 8
    for shift in range(-most, most + 1):  # shifts the keyframe's picture to the right by `shift` columns
        mine, theirs = (
            tiny[..., max(shift, 0) : width + min(shift, 0)],
            small[..., max(-shift, 0) : width - max(shift, 0)],
        )
        overlap = mine.shape[-1] / width
        scores.append((mine * theirs).mean((1, 2, 3)) * overlap**0.5)
    best, shift = torch.stack(scores, 1).max(1)
    picks = best.topk(min(_CANDIDATES, len(best))).indices
    turn = torch.atan((shift[picks] - most) / (width * camera[0]))  # a turn to the left moves the picture to the right
    pose = memory.pose[picks]
    return list(planar_pose(pose[:, 0], pose[:, 1], pose[:, 2], yaw(pose) + turn))


class _View:
    """A pose during the search, with the keyframes that know its surroundings."""

    def __init__(self, memory: Keyframes, pose: torch.Tensor, camera: Intrinsics, sources: int, picture: torch.Tensor):
        self.camera, self.picture, self.pose = camera, picture, pose
        self.size = (picture.shape[-2], picture.shape[-1])
        self.memory, self.picks = memory, retrieve(memory, pose[None], camera, self.size, sources)
        self.best = self._score(pose)

    def judge(self, pose: torch.Tensor) -> tuple[float, float]:
        """The likeness, and the known share, of the keyframes' view from `pose`."""
        glimpse = look(self.memory, self.picks, pose[None], self.camera, self.size, 1)
        known = glimpse.known[0] > 0
        share = float(known.float().mean())
        if share < 0.05:
            return -1.0, share
        mine, theirs = self.picture[:, known], glimpse.rgb[0, 0][:, known]
        return _correlation(mine - mine.mean(), theirs - theirs.mean()), share

    def edges(self, pose: torch.Tensor) -> float:
        """The likeness of the differences between neighbouring pixels, at half the size."""
        glimpse = look(self.memory, self.picks, pose[None], self.camera, self.size, 1)
        half = [F.avg_pool2d(part, 2) for part in (self.picture, glimpse.rgb[0, 0], glimpse.known)]
        sure = half[2][0] == 1
        pairs = [[(part.diff(dim=axis) * _both(sure, axis - 1)) for part in half[:2]] for axis in (1, 2)]
        mine, theirs = (torch.cat([pair[which].flatten() for pair in pairs]) for which in (0, 1))
        return _correlation(mine, theirs)

    def refine(self, rounds: int = _ROUNDS) -> _View:
        """Moves to the best pose nearby, along either axis or turning, while that helps, then with half the step."""
        scale = 0.5 ** (_ROUNDS - rounds)
        metres, radians = _FIRST_M * scale, _FIRST_RAD * scale
        for _ in range(rounds):
            for _ in range(4):
                before = self.best
                for x, y, turn in ((metres, 0, 0), (0, metres, 0), (0, 0, radians)):
                    for sign in (1, -1):
                        self._try(sign * x, sign * y, sign * turn)
                if self.best <= before:
                    break
            metres, radians = metres / 2, radians / 2
        return self

    def _try(self, x: float, y: float, turn: float) -> None:
        at = self.pose
        pose = planar_pose(at[0] + x, at[1] + y, at[2], yaw(at) + turn)
        score = self._score(pose)
        if score > self.best:
            self.best, self.pose = score, pose

    def _score(self, pose: torch.Tensor) -> float:
        likeness, known = self.judge(pose)
        return likeness * min(1.0, known / 0.8)


def _correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-6))


def _both(sure: torch.Tensor, axis: int) -> torch.Tensor:
    """Whether a pixel and the next along `axis` are both valid."""
    length = sure.shape[axis] - 1
    return (sure.narrow(axis, 0, length) & sure.narrow(axis, 1, length)).float()


def _scaled(picture: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    return F.interpolate(picture[None].float() / 255, size, mode="area")[0]
