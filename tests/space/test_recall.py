"""Recall: new frames are kept, the oldest goes, and the one most like a draft comes back."""

from __future__ import annotations

import torch

from terrella.core import make_rng
from terrella.space.recall import KEPT, keep, most_alike, nothing_kept

SIZE = (12, 20)


def pictures(count: int) -> torch.Tensor:
    return (
        torch.randint(0, 256, (count, 3, 3, 5), dtype=torch.uint8, generator=make_rng(0))
        .repeat_interleave(4, 2)
        .repeat_interleave(4, 3)
    )


def test_a_frame_is_kept_once_and_the_oldest_goes():
    frames, keys = nothing_kept(2, SIZE)
    shown = pictures(KEPT + 3)
    for picture in shown:
        for _ in range(2):
            frames, keys = keep(frames, keys, picture.expand(2, -1, -1, -1))
    assert torch.equal(frames[0], shown.flip(0)[:KEPT]) and torch.equal(frames[1], frames[0])


def test_what_is_most_like_a_blurred_draft_comes_back_in_each_episode():
    frames, keys = nothing_kept(2, SIZE)
    shown = pictures(9)
    for picture in shown:
        frames, keys = keep(frames, keys, torch.stack([picture, picture.flip(2)]))
    draft = torch.stack([shown[3], shown[6].flip(2)]).float()
    draft = 0.6 * draft + 0.4 * draft.mean((2, 3), keepdim=True)
    known = most_alike(frames, keys, draft / 127.5 - 1)
    assert torch.equal(known[:, :3], torch.stack([shown[3], shown[6].flip(2)])) and (known[:, 3] == 255).all()


def test_where_nothing_is_kept_nothing_is_known():
    frames, keys = nothing_kept(2, SIZE)
    frames, keys = keep(frames, keys, pictures(2))
    keys[0] = nothing_kept(1, SIZE)[1]
    known = most_alike(frames, keys, torch.zeros(2, 3, *SIZE))
    assert not known[0].any() and (known[1, 3] == 255).all()
