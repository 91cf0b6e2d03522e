"""Cards: painted into frames where they stand, and cut out of frames as they were painted."""

from __future__ import annotations

import torch

from terrella.core import make_rng
from terrella.space.billboards import PICTURE, cut_out, paint_billboards, paint_billboards_slowly
from terrella.space.camera import planar_pose

CAMERA, SIZE = (0.5, 0.8, 0.5, 0.5), (48, 64)
BOX = torch.tensor([0.4, 0.4, 0.0, 1.6])  # 0.8 m wide, 1.6 m tall, on its feet


def camera_at(x: float = 0.0, heading: float = 0.0) -> torch.Tensor:
    one = torch.ones(1)
    return planar_pose(x * one, 0 * one, one, heading * one)


def picture(*colour: float) -> torch.Tensor:
    whole = torch.ones(4, *PICTURE)
    whole[:3] = torch.tensor(colour)[:, None, None]
    return whole


def paint(places, pictures, pose=None, wall_m: float = 9.0, there=None):
    """Cards before a grey wall."""
    places = torch.tensor(places)[None]
    boxes = BOX.expand(1, places.shape[1], 4)
    there = torch.ones(places.shape[:2]).bool() if there is None else there
    behind = torch.full((1, 3, *SIZE), 0.4), torch.full((1, *SIZE), wall_m)
    return paint_billboards(
        *behind, (places, torch.stack(pictures)[None], boxes), there, camera_at() if pose is None else pose, CAMERA
    )


def test_a_card_stands_where_it_is_and_as_large_as_it_is():
    """At 4 m, 0.8 m are 0.1 of the width and 1.6 m are 0.32 of the height; its feet, a metre below the camera, are 0.2 below
    the middle."""
    rgb, depth, instances = paint([[4.0, 0.0, 0.0]], [picture(1, 0, 0)])
    rows, columns = instances[0].any(1).nonzero()[:, 0], instances[0].any(0).nonzero()[:, 0]
    assert abs(len(columns) - 6.4) < 1.7 and abs(len(rows) - 15.4) < 1.7
    assert abs((rows.max() + 1) / 48 - 0.7) < 0.03 and abs(columns.float().mean() - 31.5) < 0.6
    inside = instances[0] == 1
    assert torch.allclose(rgb[0, :, 30, 31], torch.tensor([1.0, 0, 0]), atol=1e-3)
    assert (depth[0][30, 31] == 4) and (depth[0][~inside] == 9).all() and (rgb[0][:, ~inside] == 0.4).all()


def test_what_is_nearer_hides_what_is_farther():
    near, far = [3.0, 0.0, 0.0], [6.0, 0.0, 0.0]
    for places, front in (([near, far], 1), ([far, near], 2)):
        rgb, depth, instances = paint(places, [picture(1, 0, 0), picture(0, 1, 0)])
        assert instances[0, 30, 31] == front and depth[0, 30, 31] == 3 and rgb[0, front - 1, 30, 31] > 0.99
    rgb, _, instances = paint([far], [picture(1, 0, 0)], wall_m=4.0)
    assert not instances.any() and (rgb == 0.4).all()


def test_behind_the_camera_and_absent_there_is_nothing():
    for pose, there in ((camera_at(heading=3.14159), None), (None, torch.zeros(1, 1).bool())):
        rgb, depth, instances = paint([[4.0, 0.0, 0.0]], [picture(1, 0, 0)], pose, there=there)
        assert not instances.any() and (rgb == 0.4).all() and (depth == 9).all()


def test_what_was_painted_is_cut_out_again():
    half = picture(1, 0, 0)
    half[1, : PICTURE[0] // 2] = 1  # yellow above, red below
    places = [[4.0, 0.7, 0.0], [7.0, -2.0, 0.5]]
    rgb, depth, instances = paint(places, [half, picture(0, 0, 1)])
    cut = cut_out((rgb * 255).to(torch.uint8), instances, depth, torch.tensor(places)[None], camera_at(), CAMERA)
    assert cut.view.tolist() == [0, 0] and cut.row.tolist() == [0, 1] and cut.whole.all()
    pixel_m = torch.tensor(places)[:, 0] / CAMERA[0] / SIZE[1]
    assert ((cut.box - BOX).abs().amax(1) < 1.3 * pixel_m).all()
    upper, lower = cut.picture[0, :, 9, 16], cut.picture[0, :, 40, 16]
    assert upper[1] > 0.9 and lower[1] < 0.1 and upper[0] > 0.9 and upper[3] > 0.9
    assert cut.picture[1, 2].mean() > 0.85


def test_what_is_not_seen_whole_says_so():
    cases = {"edge": [3.0, 3.0, 0.0], "whole": [4.0, 0.0, 0.0], "hidden": [6.0, 1.1, 0.0]}
    for name, place in cases.items():
        places = [place, [2.0, 0.0, 0.0]] if name == "hidden" else [place]
        rgb, depth, instances = paint(places, [picture(1, 0, 0), picture(0, 1, 0)][: len(places)])
        cut = cut_out((rgb * 255).to(torch.uint8), instances, depth, torch.tensor(places)[None], camera_at(), CAMERA)
        assert cut.row[0] == 0 and bool(cut.whole[0]) == (name == "whole"), name


def test_frames_without_cards_give_none():
    frames = torch.zeros(2, 3, *SIZE, dtype=torch.uint8)
    none, far = torch.zeros(2, *SIZE, dtype=torch.uint8), torch.full((2, *SIZE), 5.0)
    cut = cut_out(frames, none, far, torch.zeros(2, 4, 3), camera_at().expand(2, 7), CAMERA)
    assert len(cut.view) == 0 and cut.picture.shape == (0, 4, *PICTURE)


def test_the_kernel_paints_as_the_slow_way_does():
    """Billboards with holes in them, before, in and behind a rough wall, some of them cut off by the picture's edge."""
    rng = make_rng(0)
    for _ in range(10):
        places = torch.rand(2, 5, 3, generator=rng) * torch.tensor([6.0, 5.0, 0.4]) + torch.tensor([0.5, -2.5, -0.2])
        pictures, boxes = torch.rand(2, 5, 4, *PICTURE, generator=rng), 0.2 + torch.rand(2, 5, 4, generator=rng)
        rgb, depth = torch.rand(2, 3, *SIZE, generator=rng), 2 + 4 * torch.rand(2, *SIZE, generator=rng)
        there = torch.rand(2, 5, generator=rng) < 0.8
        given = rgb, depth, (places, pictures, boxes), there, camera_at().expand(2, 7), CAMERA
        quick, slow = paint_billboards(*given), paint_billboards_slowly(*given)
        assert torch.allclose(quick[0], slow[0], atol=1e-3) and torch.allclose(quick[1], slow[1])
        assert torch.equal(quick[2], slow[2]) and (slow[2] > 0).any()
