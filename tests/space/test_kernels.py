"""The compiled ways of the memory give what their slow, obvious twins give."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from terrella.core import make_rng
from terrella.space.camera import planar_pose, rotation
from terrella.space.keyframes import Keyframes, pick, pick_slowly
from terrella.space.patches import FAR_M, cast, cast_slowly, patches
from terrella.space.reproject import carry_unknown, carry_unknown_slowly, fill_holes, fill_holes_slowly

CAMERA = (0.5, 0.667, 0.5, 0.5)


def poses(count: int, rng: torch.Generator, spread: float = 1.0) -> torch.Tensor:
    x, y, turn = (torch.rand(count, generator=rng) * 2 * spread - spread for _ in range(3))
    return planar_pose(x, y, torch.zeros(count), turn)


def test_a_rotation_turns_a_vector_as_its_quaternion_does():
    rng = make_rng(0)
    pose = torch.randn(50, 7, generator=rng, dtype=torch.float64)
    vector = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    unit = F.normalize(pose[:, 3:], dim=-1)
    real, imaginary = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(imaginary, vector)
    turned = vector + 2 * (real * across + torch.linalg.cross(imaginary, across))
    torch.testing.assert_close((rotation(pose) @ vector[..., None])[..., 0], turned)
    torch.testing.assert_close(rotation(pose[0]), rotation(pose)[0])
    assert torch.equal(rotation(torch.zeros(7)), torch.eye(3)), "no quaternion turns nothing"
    pose.requires_grad_()
    assert torch.autograd.gradcheck(rotation, (pose[:2],))


@pytest.mark.parametrize("camera", [CAMERA, (0.8, 0.8, 0.3, 0.6)])
def test_patches_at_the_rim_are_not_lost(camera):
    """Many small and large patches all around the eye, most of them out of the picture."""
    rng = make_rng(1)
    centre = torch.randn(400, 3, generator=rng) * 3
    sides = torch.randn(400, 6, generator=rng) * torch.rand(400, 1, generator=rng) * 2
    patch = torch.cat([centre, sides], 1)[None]
    for pose in poses(4, rng):
        quick, slow = (way(patch, pose[None], camera, (24, 32)) for way in (cast, cast_slowly))
        assert (slow < FAR_M).float().mean() > 0.3
        close = torch.isclose(quick, slow, rtol=1e-3, atol=1e-3)
        assert float(close.float().mean()) > 0.995, "but for pixels on the very edge of a patch"


def test_the_picks_are_those_of_the_slow_twin():
    rng = make_rng(2)
    for keys, points, count in ((30, 40, 6), (5, 7, 9), (1, 3, 2), (0, 3, 2)):
        seen = torch.rand(keys, points, generator=rng) < 0.3
        votes = torch.where(seen, torch.rand(keys, points, generator=rng), 0.0)
        assert pick(votes, count) == pick_slowly(votes, count)
    assert pick(torch.zeros(4, 5), 3) == pick_slowly(torch.zeros(4, 5), 3) == []
    alike = torch.ones(3, 5)
    assert pick(alike, 3) == pick_slowly(alike, 3) == [0], "the first of equals, and then nothing is gained"


def test_the_last_frame_is_carried_where_memory_knows_nothing():
    rng = make_rng(3)
    rgb = torch.randint(0, 256, (3, 3, 24, 32), generator=rng, dtype=torch.uint8)
    depth, seen = (2 + torch.rand(3, *size, generator=rng) * 0.3 for size in ((24, 32), (48, 64)))
    known = (torch.rand(3, 48, 64, generator=rng) < 0.5).float()
    given = rgb, depth, poses(3, rng, 0.3), known, seen, poses(3, rng, 0.3), CAMERA
    quick, slow = carry_unknown(*given), carry_unknown_slowly(*given)
    assert (slow[:, 3] > 0).float().mean() > 0.1
    assert float(torch.isclose(quick, slow, atol=1e-4).float().mean()) > 0.999, "but for depths between two pixels"
    assert not quick[(known > 0)[:, None].expand_as(quick)].any()


def test_a_gradient_goes_through_what_is_carried():
    rng = make_rng(4)
    rgb = torch.randint(0, 256, (1, 3, 8, 8), generator=rng, dtype=torch.uint8)
    depth = torch.full((1, 8, 8), 2.0)
    pose, seen = planar_pose(*torch.zeros(4, 1)), torch.full((1, 8, 8), 2.0, requires_grad=True)
    carry_unknown(rgb, depth, pose, torch.zeros(1, 8, 8), seen, pose, CAMERA).sum().backward()
    assert seen.grad is not None


def test_holes_are_filled_as_from_the_whole_pyramid(monkeypatch):
    """Stopping where no hole is left changes nothing."""
    rng = make_rng(5)
    depth = 1 + 5 * torch.rand(2, 24, 40, generator=rng)
    depth[0, 5:7, 9:12], depth[1, 3:21, 2:35] = FAR_M, FAR_M
    found = fill_holes_slowly(depth, 5)
    assert (found < FAR_M).all()
    monkeypatch.setattr(torch.Tensor, "all", lambda self, *rest: False)
    assert torch.equal(fill_holes_slowly(depth, 5), found)


@pytest.mark.parametrize("size", [(96, 128), (17, 23), (1, 1)])
def test_holes_are_filled_as_the_slow_way_does(size):
    rng = make_rng(1)
    depth = 1 + 8 * torch.rand(5, *size, generator=rng)
    depth[1:][torch.rand(4, *size, generator=rng) < 0.3] = FAR_M
    depth[2, size[0] // 3 :, size[1] // 4 :] = FAR_M
    depth[3] = FAR_M
    depth[4] = torch.where(torch.rand(size, generator=rng) < 0.2, 50.0, 2.0)  # leaks
    assert torch.allclose(fill_holes(depth), fill_holes_slowly(depth, 5), rtol=1e-5)


def test_keyframes_are_taken_by_a_list_as_by_a_mask():
    rng = make_rng(6)
    rgb = torch.randint(0, 256, (5, 3, 16, 16), generator=rng, dtype=torch.uint8)
    keys = Keyframes.of(rgb, 1 + torch.rand(5, 16, 16, generator=rng), poses(5, rng), CAMERA)
    one, other = keys.at([3, 1]), keys.at(torch.tensor([3, 1]))
    assert all(torch.equal(a, b) for a, b in zip(vars(one).values(), vars(other).values()))
    assert len(keys.at([])) == 0 and np.prod(keys.at([]).rgb.shape[1:]) == 3 * 16 * 16
    assert patches(keys.depth, keys.pose, CAMERA, 8).shape == keys.coarse.shape
