"""What a codec learns: moves by block matching, a palette, which source explains a pixel; and a scroll that an action makes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from terrella.core import make_rng
from terrella.learn.moves import explained, explained_slowly, frequent_moves, palette, scrolled
from terrella.worlds.codec import Codec, CodecConfig

SIZE = (32, 40)


def scrolling(x: int, y: int, count: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures of noise, and the same x pixels further to the right and y down, with a status line that stands still."""
    wide = torch.randint(0, 256, (count, 3, 64, 80), dtype=torch.uint8, generator=make_rng(x + 31 * y))
    before, after = wide[..., 16:48, 20:60].clone(), wide[..., 16 - y : 48 - y, 20 - x : 60 - x].clone()
    after[..., :8, :] = before[..., :8, :]
    return before, after


def codec(moves: torch.Tensor) -> Codec:
    made = Codec(CodecConfig(SIZE, 2, 4, len(moves), 4, channels=(8, 8)))
    made.moves[1:] = moves
    return made


def test_the_moves_of_most_blocks_are_found():
    pairs = [scrolling(3, 0), scrolling(3, 0, 8), scrolling(-2, 5)]
    before, after = (torch.cat(part) for part in zip(*pairs))
    found = frequent_moves(before, after, 2)
    assert found.tolist() == [[3, 0], [-2, 5]]
    assert not len(frequent_moves(before, before, 2)), "nothing moves where nothing changes"


def test_a_palette_holds_the_colours_of_a_picture():
    colours = torch.tensor([[0, 0, 0], [250, 10, 10], [10, 250, 10]], dtype=torch.uint8)
    picture = colours[torch.randint(0, 3, (2, 16, 16), generator=make_rng(0))].permute(0, 3, 1, 2)
    found = palette(picture, 8, np.random.default_rng(0))
    assert all((found.int() - colour.int()).abs().amax(1).min() <= 4 for colour in colours)


@pytest.mark.parametrize("seed", range(3))
def test_the_kernel_explains_as_its_slow_twin(seed):
    before, after = scrolling(3, 0, 2)
    before[0, :, 9:20] = after[0, :, 9:20]
    made = codec(torch.tensor([[3, 0], [0, -1]]))
    noise = torch.randint(0, 9, after.shape, generator=make_rng(seed))
    frames, truth = torch.stack([before, after.flip(0)], 1), (after.int() + noise).clamp(0, 255).to(torch.uint8)
    fast, slow = explained(made, frames, truth), explained_slowly(made, frames, truth)
    assert torch.allclose(fast[0], slow[0], atol=1e-4) and torch.equal(fast[1], slow[1])


def test_the_scroll_is_what_most_texture_does():
    before, after = scrolling(3, 0, 2)
    made = codec(torch.tensor([[3, 0], [0, -1]]))
    truth = torch.stack([after[0], before[1]])
    share, stays = explained(made, torch.stack([before, before], 1), truth)
    assert scrolled(made, share, truth).tolist() == [1, 0]
    assert not stays[1].any() and stays[0, 8:].float().mean() > 20 and not stays[0, :8].any()
