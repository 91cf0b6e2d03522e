"""The compiled ways of the memory give what their slow, obvious twins give."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from terrella.core import make_rng
from terrella.space import floorplan
from terrella.space.billboards import PICTURE, paint_billboards
from terrella.space.camera import FAR_M, planar_pose, rotation
from terrella.space.floorplan import NOWHERE, columns_left, slide, slide_slowly, straight_runs, straight_runs_slowly
from terrella.space.kernels_numba.recall import pick as pick_kernel
from terrella.space.keyframes import ANYWAY, Keyframes, pick_slowly
from terrella.space.patches import cast_inverse, patches
from terrella.space.reproject import (
    carry_things,
    carry_things_slowly,
    carry_unknown,
    carry_unknown_slowly,
    fill_holes,
    fill_holes_slowly,
)
from terrella.space.views import arrays, each_view, over_views

from .rooms import cast, cast_slowly

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
    """Many small and large patches all around the camera, most of them out of the picture."""
    rng = make_rng(1)
    centre = torch.randn(400, 3, generator=rng) * 3
    sides = torch.randn(400, 6, generator=rng) * torch.rand(400, 1, generator=rng) * 2
    patch = torch.cat([centre, sides], 1)[None]
    for pose in poses(4, rng):
        quick, slow, boxes = (way(patch, pose[None], camera, (24, 32)) for way in (cast, cast_slowly, cast_inverse))
        boxes = boxes.reciprocal().clamp_max(FAR_M)
        assert (slow < FAR_M).float().mean() > 0.3
        close = torch.isclose(quick, slow, rtol=1e-3, atol=1e-3)
        assert float(close.float().mean()) > 0.995, "but for pixels on the very edge of a patch"
        assert float(torch.isclose(boxes, quick, rtol=1e-4).float().mean()) > 0.995, "small ones and large ones"


def pick(votes: torch.Tensor, count: int) -> torch.Tensor:
    picks = torch.full((len(votes), count), -1)
    each_view(lambda votes, picks: pick_kernel(votes, ANYWAY, picks), arrays(votes, picks))
    return picks


def test_the_picks_are_those_of_the_slow_twin():
    rng = make_rng(2)
    for keys, points, count in ((30, 40, 6), (5, 7, 9), (1, 3, 2), (0, 3, 2)):
        seen = torch.rand(4, keys, points, generator=rng) < 0.3
        votes = torch.where(seen, torch.rand(4, keys, points, generator=rng), 0.0)
        assert torch.equal(pick(votes, count), pick_slowly(votes, count))
    assert pick(torch.zeros(1, 4, 5), 3).tolist() == pick_slowly(torch.zeros(1, 4, 5), 3).tolist() == [[-1, -1, -1]]
    alike = torch.ones(1, 3, 5)
    assert pick(alike, 3).tolist() == pick_slowly(alike, 3).tolist() == [[0, -1, -1]], (
        "the first of equals, then no gain"
    )


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


@pytest.mark.parametrize("beyond_m", [0.0, 100.0, 250.0])
def test_things_are_carried_as_the_slow_twin_does(beyond_m):
    """Also where a part of the picture is beyond all that is known."""
    rng = make_rng(7)
    rgb = torch.randint(0, 256, (3, 3, 24, 32), generator=rng, dtype=torch.uint8)
    depth, things = 2 + torch.rand(3, 24, 32, generator=rng) * 0.1, (torch.rand(3, 24, 32, generator=rng) < 0.3).float()
    depth[:, :, 20:] += beyond_m
    given = (
        rgb,
        depth,
        things,
        torch.rand(3, 24, 32, generator=rng) < 0.1,
        poses(3, rng, 0.2),
        poses(3, rng, 0.2),
        CAMERA,
    )
    quick, slow = carry_things(*given), carry_things_slowly(*given)
    assert (slow[:, 3] > 0).float().mean() > 0.3
    assert float(torch.isclose(quick, slow, atol=1e-3).float().mean()) > 0.98, "but for points on the rim of a pixel"


def walls_and_walks(rng: torch.Generator, batch: int = 64):
    shared, own = torch.rand(30, 4, generator=rng) * 6 - 3, torch.rand(batch, 5, 4, generator=rng) * 6 - 3
    own[:, 3:] = NOWHERE
    return shared, torch.rand(batch, 2, generator=rng) * 4 - 2, torch.randn(batch, 2, generator=rng) * 0.3, own


def test_bodies_slide_as_the_slow_twin_does():
    shared, places, wish, own = walls_and_walks(make_rng(8))
    for quick, slow in zip(
        slide(shared, places, wish, 0.2, 0.03, own), slide_slowly(shared, places, wish, 0.2, 0.03, own)
    ):
        torch.testing.assert_close(quick, slow, atol=1e-5, rtol=1e-5)
    alone = torch.cat(
        [slide(torch.cat([shared, own[n]]), places[n, None], wish[n, None], 0.2, 0.03)[0] for n in range(64)]
    )
    assert torch.equal(slide(shared, places, wish, 0.2, 0.03, own)[0], alone)


def test_straight_runs_are_those_of_the_slow_twin():
    rng = make_rng(9)
    left = columns_left(64, 0.5, 0.5)
    slope, level = (torch.rand(20, 4, 1, generator=rng, dtype=torch.float64) - part for part in (0.5, -0.3))
    inverse = (slope * left.view(4, 16) + level).flatten(1).clamp(1e-3, 20)
    inverse[5] = torch.rand(64, generator=rng, dtype=torch.float64)
    runs = straight_runs(inverse, 0.5, 0.5)
    torch.testing.assert_close(runs, straight_runs_slowly(inverse, 0.5, 0.5))
    assert (runs[..., 1] > 0).sum() > 40
    none = inverse[:0]
    assert straight_runs_slowly(none, 0.5, 0.5).shape == straight_runs(none, 0.5, 0.5).shape == (0, 16, 4)


def test_what_is_kept_for_reading_walls_is_small():
    assert floorplan._lines(320, 0.5, 0.5).nbytes < 4e6, "it grows with the square of the width"


def test_views_are_shared_out_whole_and_errors_come_back():
    for batch in (0, 1, 2, 7, 64):
        seen = torch.zeros(batch)
        over_views(batch, lambda first, last, seen=seen: seen[first:last].add_(1))
        assert seen.tolist() == [1] * batch
    with pytest.raises(ZeroDivisionError):
        over_views(5, lambda first, last: 1 // (last - 5))


def test_everything_runs_on_another_device():
    rng = make_rng(11)
    shared, places, wish, own = (part.to("meta") for part in walls_and_walks(rng))
    assert slide(shared, places, wish, 0.2, 0.03, own)[0].device.type == "meta"
    depth = torch.ones(2, 24, 32, device="meta")
    pose, rgb = poses(2, rng).to("meta"), torch.zeros(2, 3, 24, 32, dtype=torch.uint8, device="meta")
    assert carry_unknown(rgb, depth, pose, depth, depth, pose, CAMERA).shape == (2, 4, 24, 32)
    assert carry_things(rgb, depth, depth, depth > 0, pose, pose, CAMERA).shape == (2, 6, 24, 32)
    boards = (
        torch.ones(2, 3, 3, device="meta"),
        torch.ones(2, 3, 4, *PICTURE, device="meta"),
        torch.ones(2, 3, 4, device="meta"),
    )
    there = torch.ones(2, 3, dtype=torch.bool, device="meta")
    assert paint_billboards(rgb.float(), depth, boards, there, pose, CAMERA)[2].device.type == "meta"
