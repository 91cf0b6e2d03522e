"""The ground: pictures are found on it, also where they hang over its edge, and grounds of several episodes become one."""

from __future__ import annotations

import pytest
import torch

from terrella.core import make_rng
from terrella.space.ground import ALIKE, cropped, joined, locate, window


def ground(height: int = 40, width: int = 60, seed: int = 0) -> torch.Tensor:
    made = torch.randint(0, 256, (4, height, width), dtype=torch.uint8, generator=make_rng(seed))
    made[3] = 1
    return made


def part(whole: torch.Tensor, x: int, y: int, height: int = 16, width: int = 24) -> torch.Tensor:
    return whole[None, :, y : y + height, x : x + width].clone()


@pytest.mark.parametrize("x, y", [(0, 0), (13, 7), (36, 24)])
def test_a_picture_is_found_though_a_third_of_it_differs(x, y):
    whole = ground()
    picture = part(whole, x, y)[:, :3]
    picture[..., :5, :] = 255 - picture[..., :5, :]
    place, share = locate(picture, torch.ones(1, 16, 24, dtype=torch.bool), whole)
    assert place.tolist() == [[x, y]] and ALIKE < float(share) < 0.8


def test_a_picture_is_found_over_the_edge_and_one_of_another_place_is_not():
    whole = ground()
    pictures = torch.stack([part(ground(seed=1), 9, 9)[0, :3], part(whole, 0, 3)[0, :3].roll(6, -1)])
    place, share = locate(pictures, torch.ones(2, 16, 24, dtype=torch.bool), whole)
    assert float(share[0]) < ALIKE and place[1].tolist() == [-6, 3] and float(share[1]) == 1
    nothing = torch.zeros(1, 16, 24, dtype=torch.bool)
    assert float(locate(pictures[:1], nothing, whole)[1]) == 0
    assert float(locate(pictures[:1], ~nothing, torch.zeros(4, 1, 1, dtype=torch.uint8))[1]) == 0


def test_a_window_beyond_the_ground_is_empty():
    whole = ground(20, 31)
    seen = window(whole, torch.tensor([[-3, 5], [10**6, -(10**6)]]), (16, 25))
    assert torch.equal(seen[0, :, :15, 3:], whole[:, 5:, :22]) and not seen[0, :, :, :3].any() and not seen[1].any()


def test_grounds_of_several_episodes_are_joined_where_they_overlap():
    whole = ground()
    pieces = [part(whole, 0, 0, 40, 36)[0], part(whole, 14, 0, 40, 46)[0], ground(30, 30, seed=3)]
    pieces = [torch.nn.functional.pad(piece, (5, 7, 3, 2)) for piece in pieces]
    assert torch.equal(joined(pieces), whole)
    assert cropped(torch.zeros(4, 9, 9, dtype=torch.uint8)).shape == (4, 1, 1)
