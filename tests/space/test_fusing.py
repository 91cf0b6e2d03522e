"""Fusing pictures into Gaussians: what is missing appears, what has gone fades, what is right stays; each law can fail."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from terrella.space.fitting import psnr
from terrella.space.fusing import fuse
from terrella.space.raster import Gaussians, join, rasterise
from terrella.space.raster.gaussians import plain_sh

from .test_fitting import LENS, room, views

ROOM = 6000  # room for new ones


def padded(scene: Gaussians, trust: float = 50.0):
    none = torch.zeros(ROOM, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(ROOM, 1)
    blank = Gaussians(none, quats, none + 1e-3, torch.zeros(ROOM), none[:, None])
    weight = torch.cat([torch.full((len(scene),), trust), torch.zeros(ROOM)])
    return join([scene, blank]), weight, torch.arange(len(scene), len(scene) + ROOM)


def fed(scene, weight, spare, seen):
    for rgb, depth, pose in zip(seen.rgb.float() / 255, seen.depth, seen.pose):
        scene, weight, _ = fuse(scene, weight, spare, rgb, depth, pose, LENS)
    return scene


@pytest.mark.slow
def test_what_is_missing_appears_and_what_was_right_stays():
    seen, whole = views(), room()
    half = whole.at(whole.means[:, 0] < 2)
    held, given = seen.at(torch.arange(20) % 4 == 1), seen.at(torch.arange(20) % 4 != 1)
    start, weight, spare = padded(half)
    after = fed(start, weight, spare, given)
    assert _mean_db(after, held) > _mean_db(start, held) + 1.5
    assert _mean_db(fed(*padded(whole), given), held) > 30


def _mean_db(scene, seen) -> float:
    return float(psnr(scene, seen).clamp_max(40).mean())  # what was right already has more than 100


def test_a_colour_is_a_mean_and_what_is_seen_through_goes():
    seen = views().at(torch.arange(4))
    painted = room()
    grey = Gaussians(
        painted.means, painted.quats, painted.scales, painted.opacities, plain_sh(torch.full((1500, 3), 0.5))
    )
    quick, slow = (psnr(fed(*padded(grey, trust), seen), seen).mean() for trust in (0.0, 1e4))
    assert quick > slow + 3
    cloud = Gaussians(seen.pose[:1, :3] + torch.tensor([[0.25, 0.0, 0.0]]), painted.quats[:1], torch.full((1, 3), 0.05),
                      torch.ones(1), plain_sh(torch.ones(1, 3)))  # fmt: skip
    scene, weight, spare = padded(join([painted, cloud]))
    first = seen.at(torch.zeros(4, dtype=torch.int64))
    first = replace(first, depth=torch.full_like(first.depth, 1.2))  # a wall
    assert rasterise(scene, first.pose[:1], LENS, (24, 24)).depth.min() < 0.4
    after = fed(scene, weight, spare, first)
    assert after.opacities[1500] < 0.5 and (after.opacities[:1500] > 0.5).float().mean() > 0.95
