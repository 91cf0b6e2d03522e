"""Direct alignment finds the motion between two views of a room that is known exactly."""

from __future__ import annotations

import pytest
import torch

from terrella.space.align import align

from .rooms import CAMERA, painted, pose_at, room_depth

PACE = torch.tensor([0.2, 0.1, 0.08])


def seen(place) -> tuple[torch.Tensor, torch.Tensor]:
    pose = pose_at(*place)
    depth = room_depth(pose, (96, 128))
    return painted(pose, depth).float(), depth


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.25, 0, 0), (-0.2, 0.1, 0), (0, 0, 0.06), (0.2, -0.05, -0.06)])
@pytest.mark.parametrize("heading", [0.3, 2.0])
def test_the_motion_between_two_views_is_found(motion, heading):
    forward, left, turn = motion
    c, s = torch.cos(torch.tensor(heading)), torch.sin(torch.tensor(heading))
    x, y = -0.5, 0.4
    before, depth = seen((x, y, heading))
    after, _ = seen((x + float(forward * c - left * s), y + float(forward * s + left * c), heading + turn))
    found = align(before, after, depth, CAMERA, PACE)
    assert torch.allclose(found[0], torch.tensor(motion), atol=0.02), found


def test_other_light_changes_little():
    before, depth = seen((0.0, 0.0, 0.5))
    after, _ = seen((0.15, 0.08, 0.53))
    bright, dim = align(before, after, depth, CAMERA, PACE), align(before, 0.6 * after + 20, depth, CAMERA, PACE)
    assert torch.allclose(bright, dim, atol=0.01)


def test_views_are_aligned_each_for_itself():
    before, depth = seen((0.0, 0.0, 0.5))
    after, _ = seen((0.15, 0.08, 0.53))
    both = align(torch.cat([before, after]), torch.cat([after, before]), torch.cat([depth, depth]), CAMERA, PACE)
    assert torch.allclose(both[:1], align(before, after, depth, CAMERA, PACE), atol=1e-4)


def test_where_nothing_can_be_seen_nothing_moves():
    blank, depth = torch.full((1, 3, 96, 128), 90.0), torch.full((1, 96, 128), 2.0)
    found = align(blank, blank, depth, CAMERA, PACE)
    assert torch.isfinite(found).all() and float(found.abs().max()) < 0.01
    noise = 255 * torch.rand(1, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    assert torch.isfinite(align(noise, noise.flip(-1), depth, CAMERA, PACE)).all()
