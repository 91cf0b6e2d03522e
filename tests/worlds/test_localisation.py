"""Arrival: a picture of a remembered room begins there and takes its depth from memory; another begins far away."""

from __future__ import annotations

import math

import torch
from tests.space.rooms import CAMERA, SIZE, painted, pose_at, room_depth

from terrella.core import make_rng
from terrella.space.estimator import Estimator, EstimatorConfig
from terrella.space.keyframes import Keyframes
from terrella.space.recognise import thumbnails
from terrella.worlds.localisation import AWAY_M, localise


def test_two_pictures_arrive_each_in_its_own_place():
    places = [(x, y, h * math.pi / 4) for x in (-2.0, 1.0) for y in (-1.5, 2.0) for h in range(8)]
    pose = torch.cat([pose_at(*place) for place in places])
    depth = room_depth(pose)
    memory = Keyframes.of(painted(pose, depth), depth, pose, CAMERA)
    torch.manual_seed(0)
    estimator = Estimator(EstimatorConfig((16, 32))).eval().requires_grad_(False)
    here = pose_at(1.2, 2.1, 2.2)
    known = painted(here, room_depth(here))
    noise = torch.randint(0, 256, known.shape, generator=make_rng(0), dtype=torch.uint8)
    small = thumbnails(memory.rgb)
    seen = localise(torch.cat([known, noise]), estimator, memory, small, memory.at(slice(0, 4)), CAMERA, 6)
    assert seen.recognised.tolist() == [True, False] and seen.pose.shape == (2, 7) and seen.depth.shape == (2, *SIZE)
    assert float((seen.pose[0, :2] - here[0, :2]).norm()) < 0.25
    truth = room_depth(here)[0]
    assert float(((seen.depth[0] - truth).abs() / truth).mean()) < 0.1
    assert torch.allclose(seen.depth[1], estimator.depth(noise)[0], rtol=1e-4)
    assert float(seen.pose[1, 0]) > float(pose[:, 0].max()) + AWAY_M - 10
    none = memory.at(slice(0, 0))
    lost = localise(known, estimator, none, thumbnails(none.rgb), memory.at(slice(0, 4)), CAMERA, 6)
    assert lost.recognised.tolist() == [False]
