"""Recognising a place: where among posed keyframes a lone picture was taken, found by likeness, proven by reprojection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from .camera import Intrinsics, planar_pose, yaw
from .keyframes import Keyframes, look, retrieve

_SMALL = (12, 16)  # of the pictures that are compared at first
_CANDIDATES, _REFINED = 24, 6
_SEARCH = (24, 32)  # size of the views while a pose is searched
_FIRST_M, _FIRST_RAD, _ROUNDS = 0.5, 0.12, 6  # of the search, whose steps are halved in each round


@dataclass(frozen=True)
class RecognisedPose:
    """Where a picture was taken: pose [7], how alike memory's view from there is (normalised correlation of the known
    pixels, at most 1) and its edges are (that of their differences), and the share of it that is known."""

    pose: torch.Tensor
    likeness: float
    edges: float
    known: float


def thumbnails(rgb: torch.Tensor) -> torch.Tensor:
    """Pictures, uint8 [K, 3, H, W] -> tiny ones of one brightness and contrast [K, 3, *_SMALL]."""
    if not len(rgb):
        return torch.zeros(0, 3, *_SMALL)
    small = torch.cat([F.interpolate(part.float(), _SMALL, mode="area") for part in rgb.split(64)])
    small = small - small.mean((1, 2, 3), keepdim=True)
    return small / small.std((1, 2, 3), keepdim=True).clamp_min(1e-3)


def recognise(
    picture: torch.Tensor, memory: Keyframes, small: torch.Tensor, camera: Intrinsics, sources: int
) -> RecognisedPose | None:
    """The best pose for a level picture, uint8 [3, H, W], among `memory` with its `thumbnails`; None in an empty memory.

    Keyframes are compared with the picture as it would be with the camera turned a little; the best are searched around, each
    time rendering what memory knows. Whether what is found is the place is for the caller to say, from its likeness.
    """
    if not len(memory):
        return None
    views = [
        _View(memory, pose, camera, sources, _scaled(picture, _SEARCH))
        for pose in _candidates(thumbnails(picture[None])[0], memory, small, camera)
    ]
    views.sort(key=lambda view: -view.best)
    winner = max((view.searched() for view in views[:_REFINED]), key=lambda view: view.best)
    size = (picture.shape[-2], picture.shape[-1])
    last = _View(memory, winner.pose, camera, sources, _scaled(picture, size)).searched(_ROUNDS - 3)
    likeness, known = last.judged(last.pose)
    return RecognisedPose(last.pose, likeness, last.edges(last.pose), known)


def _candidates(
    tiny: torch.Tensor, memory: Keyframes, small: torch.Tensor, camera: Intrinsics
) -> Sequence[torch.Tensor]:
    """Poses of the keyframes that look most like `tiny`, turned as far as makes them most alike."""
    height, width = _SMALL
    scores, most = [], width * 3 // 8
    for shift in range(-most, most + 1):  # the keyframe's picture moved to the right by `shift` columns
        mine, theirs = (
            tiny[..., max(shift, 0) : width + min(shift, 0)],
            small[..., max(-shift, 0) : width - max(shift, 0)],
        )
        overlap = mine.shape[-1] / width
        scores.append((mine * theirs).mean((1, 2, 3)) * overlap**0.5)
    best, shift = torch.stack(scores, 1).max(1)
    picks = best.topk(min(_CANDIDATES, len(best))).indices
    turn = torch.atan((shift[picks] - most) / (width * camera[0]))  # to the left brings the picture to the right
    pose = memory.pose[picks]
    return list(planar_pose(pose[:, 0], pose[:, 1], pose[:, 2], yaw(pose) + turn))


class _View:
    """A pose under search, with the keyframes that know its surroundings."""

    def __init__(self, memory: Keyframes, pose: torch.Tensor, camera: Intrinsics, sources: int, picture: torch.Tensor):
        self.camera, self.picture, self.pose = camera, picture, pose
        self.size = (picture.shape[-2], picture.shape[-1])
        self.memory, self.picks = memory, retrieve(memory, pose[None], camera, self.size, sources)
        self.best = self._score(pose)

    def judged(self, pose: torch.Tensor) -> tuple[float, float]:
        """Likeness and known share of what the keyframes show from `pose`."""
        glimpse = look(self.memory, self.picks, pose[None], self.camera, self.size, 1)
        known = glimpse.known[0] > 0
        share = float(known.float().mean())
        if share < 0.05:
            return -1.0, share
        mine, theirs = self.picture[:, known], glimpse.rgb[0, 0][:, known]
        return _correlation(mine - mine.mean(), theirs - theirs.mean()), share

    def edges(self, pose: torch.Tensor) -> float:
        """Likeness of the differences between neighbours, at half the size."""
        glimpse = look(self.memory, self.picks, pose[None], self.camera, self.size, 1)
        half = [F.avg_pool2d(part, 2) for part in (self.picture, glimpse.rgb[0, 0], glimpse.known)]
        sure = half[2][0] == 1
        pairs = [[(part.diff(dim=axis) * _both(sure, axis - 1)) for part in half[:2]] for axis in (1, 2)]
        mine, theirs = (torch.cat([pair[which].flatten() for pair in pairs]) for which in (0, 1))
        return _correlation(mine, theirs)

    def searched(self, rounds: int = _ROUNDS) -> _View:
        """Moved to the best pose in reach: along either axis or turning, as far as it helps, then half as far."""
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
        likeness, known = self.judged(pose)
        return likeness * min(1.0, known / 0.8)


def _correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-6))


def _both(sure: torch.Tensor, axis: int) -> torch.Tensor:
    """Where a pixel and its next along `axis` are both sure."""
    length = sure.shape[axis] - 1
    return (sure.narrow(axis, 0, length) & sure.narrow(axis, 1, length)).float()


def _scaled(picture: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    return F.interpolate(picture[None].float() / 255, size, mode="area")[0]
