"""Cameras of one body whose fields of view overlap: where one sees what another sees, and pictures that agree there."""

from collections.abc import Sequence
from typing import NamedTuple, final

import torch
import torch.nn.functional as F
from torch import nn

from .camera import Intrinsics, project, unproject

DISTANT_M = 1000.0  # what is seen is taken to be so far away


class MountedCamera(NamedTuple):
    """A pinhole camera on a body."""

    intrinsics: Intrinsics
    mount: tuple[float, ...]  # T_body_cam, 7 numbers: metres and a quaternion


def seen_by(other: MountedCamera, one: MountedCamera, size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the pixels of camera `one`, whose pictures have `size`, the image coordinates [H, W, 2] in 0..1 at which `other` sees the
    same direction, and bool [H, W]: whether it sees it."""
    points = unproject(torch.full(size, DISTANT_M), torch.tensor(one.mount), one.intrinsics)
    at, depth = project(points.flatten(0, 1), torch.tensor(other.mount), other.intrinsics)
    seen = (depth > 0) & (at > 0).all(1) & (at < 1).all(1)
    return at.view(*size, 2), seen.view(size)


@final
class Blend(nn.Module):
    """Makes pictures [B, C, H, W] of several cameras, side by side, agree: where a pixel's direction is seen by another camera as
    well, both show a mixture of the two, the more of one the further it is from its edge. Nearby things, which cameras that stand
    apart see in other directions, are mixed as well.

    Of cameras whose pictures of `size` lie side by side, from the left."""

    other: (
        torch.Tensor
    )  # [1, H, W, 2] in -1..1: where the other camera's picture is looked up; its own place without one
    own: torch.Tensor  # [H, W], the share of the pixel's own colour: 1 without another camera

    def __init__(self, cameras: Sequence[MountedCamera], size: tuple[int, int]):
        super().__init__()
        (height, width), whole = size, size[1] * len(cameras)
        v, u = (torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width
        within = torch.stack([u.expand(height, width), v[:, None].expand(height, width)], 2)
        places, shares = [], []
        for number, one in enumerate(cameras):
            inner, place = torch.zeros(size), _side_by_side(within, number, width, whole)
            for at, other in enumerate(cameras):
                looked, seen = seen_by(other, one, size)
                deep = torch.where(seen, _from_edge(looked), 0.0) * (at != number)
                place = torch.where((deep > inner)[..., None], _side_by_side(looked, at, width, whole), place)
                inner = torch.maximum(inner, deep)
            places.append(place)
            shares.append(_from_edge(within) / (_from_edge(within) + inner))
        self.register_buffer("other", 2 * torch.cat(places, 1)[None] - 1, persistent=False)
        self.register_buffer("own", torch.cat(shares, 1), persistent=False)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return torch.lerp(self._of_other(pictures, "bilinear"), pictures, self.own)

    def noise(self, noise: torch.Tensor) -> torch.Tensor:
        """Noise of the pictures' shape of which both cameras have the same; not mixed, so that it stays as strong."""
        return torch.where(self.own < 0.5, self._of_other(noise, "nearest"), noise)

    def _of_other(self, pictures: torch.Tensor, mode: str) -> torch.Tensor:
        grid = self.other.expand(len(pictures), -1, -1, -1)
        return F.grid_sample(pictures, grid, mode, "border", align_corners=False)


def _from_edge(at: torch.Tensor) -> torch.Tensor:
    """How far image coordinates [H, W, 2] in 0..1 are from the nearest edge, above 0."""
    return torch.minimum(at, 1 - at).amin(2).clamp_min(1e-3)


def _side_by_side(at: torch.Tensor, number: int, width: int, whole: int) -> torch.Tensor:
    """Image coordinates [H, W, 2] of a camera's picture as those of all pictures; the next picture is not looked into."""
    x = (at[..., 0] * width).clamp(0.5, width - 0.5) + number * width
    return torch.stack([x / whole, at[..., 1]], 2)
