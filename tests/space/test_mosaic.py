"""Matching and the mosaic: kernels against their slow twins, and what a camera saw over a made-up map."""

from __future__ import annotations

import torch

from terrella.core import make_rng
from terrella.space.matching import edge_shares, edge_shares_slowly, scroll_index
from terrella.space.mosaic import MOST, empty_mosaic, read_mosaic, update_mosaic, update_mosaic_slowly

NONE = torch.zeros(16, 24, dtype=torch.bool)  # nothing lies over the mosaic
MOVES = torch.tensor([[0, 0], [3, 0], [-3, 0], [0, 2], [0, -2], [1, 1]])


def map_(seed: int = 0, size: tuple[int, int] = (60, 90)) -> torch.Tensor:
    return torch.randint(0, 256, (3, *size), dtype=torch.uint8, generator=make_rng(seed))


def view(whole: torch.Tensor, x: int, y: int, size: tuple[int, int] = (16, 24)) -> torch.Tensor:
    return whole[None, :, y : y + size[0], x : x + size[1]]


def test_kernels_are_as_their_slow_twins():
    whole = map_()
    frame = view(whole, 20, 20)
    truth = view(whole, 17, 20).clone()
    truth[..., 4:8, 4:8] = 30
    assert torch.allclose(edge_shares(frame, truth, MOVES), edge_shares_slowly(frame, truth, MOVES))
    mosaic, some = empty_mosaic(1, (16, 24)), torch.rand(16, 24, generator=make_rng(3)) < 0.2
    for move in MOVES[:4]:
        for seen in (frame, truth, truth):
            slow = update_mosaic_slowly(mosaic, seen, move[None], some)
            mosaic = update_mosaic(mosaic, seen, move[None], some)
            assert torch.equal(mosaic, slow)


def test_a_scroll_is_found_and_a_still_picture_stands():
    whole = map_()
    one = view(whole, 30, 20)
    for number, (x, y) in enumerate(MOVES.tolist()):
        assert scroll_index(one, view(whole, 30 - x, 20 - y), MOVES).item() == number
    assert scroll_index(one, torch.full_like(one, 9), MOVES).item() == 0, "nothing explains a plain picture"


def test_what_left_the_picture_is_recalled_where_it_comes_back():
    whole, mosaic, x = map_(), empty_mosaic(1, (16, 24)), 20
    mosaic = update_mosaic(mosaic, view(whole, x, 20), MOVES[:1], NONE)
    for way, steps in ((2, 8), (1, 7)):  # the camera goes 24 pixels to the right, and 21 back
        for _ in range(steps):
            before, x = x, x - int(MOVES[way, 0])
            found = scroll_index(view(whole, before, 20), view(whole, x, 20), MOVES)
            mosaic = update_mosaic(mosaic, view(whole, x, 20), MOVES[found], NONE)
    known = read_mosaic(mosaic, (16, 24), MOVES[1:2])  # one step more, and it is where it was
    assert torch.equal(known[:, :3], view(whole, 20, 20)) and (known[:, 3] > 0).all()
    assert (read_mosaic(mosaic, (16, 24), torch.tensor([[0, 16]]))[:, 3] == 0).all(), "above it nothing was seen"


def test_what_passes_leaves_no_trace():
    whole, mosaic = map_(), empty_mosaic(1, (16, 24))
    still = torch.zeros(1, 2, dtype=torch.int64)
    for step in range(24):
        frame = view(whole, 20, 20).clone()
        if 6 <= step < 16:
            frame[..., 5:9, step : step + 4] = 255
        mosaic = update_mosaic(mosaic, frame, still, NONE)
    known = read_mosaic(mosaic, (16, 24), still)
    assert torch.equal(known[:, :3], view(whole, 20, 20)) and known[:, 3].max() == MOST


def test_what_lies_over_a_mosaic_is_no_part_of_it():
    whole, mosaic, over = map_(), empty_mosaic(1, (16, 24)), NONE.clone()
    over[:3], over[8:11, 10:13] = True, True  # a status line, and the walker in the middle
    for step in range(8):
        frame = view(whole, 20 + 3 * step, 20).clone()
        frame[..., over] = 255
        mosaic = update_mosaic(mosaic, frame, MOVES[2][None] * min(step, 1), over)
    known = read_mosaic(mosaic, (16, 24), MOVES[:1])
    assert torch.equal(known[0, :3, 3:], view(whole, 41, 20)[0, :, 3:]), (
        "the ground under the walker is what was seen before"
    )
    assert not known[0, :, :3].any()
