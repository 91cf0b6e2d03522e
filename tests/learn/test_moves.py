"""How a recording scrolls: moves by block matching, what lies over them, and the mosaics of clips."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from terrella.core import make_rng
from terrella.core.errors import DatasetError
from terrella.learn.feeds import fitting_rollout
from terrella.learn.moves import STATISTICS, Scrolling, frequent_moves, mosaics, overlay
from terrella.space.mosaic import read_mosaic

SIZE = (32, 40)
NONE = torch.zeros(SIZE, dtype=torch.bool)  # nothing lies over what scrolls
LINE = (torch.arange(SIZE[0]) < 8)[:, None].expand(SIZE)  # a status line does


def scrolling(x: int, y: int, count: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures of noise, and the same x pixels further to the right and y down, with a status line that stands still."""
    wide = torch.randint(0, 256, (count, 3, 64, 96), dtype=torch.uint8, generator=make_rng(x + 31 * y))
    before, after = wide[..., 16:48, 20:60].clone(), wide[..., 16 - y : 48 - y, 20 - x : 60 - x].clone()
    after[..., :8, :] = before[..., :8, :]
    return before, after


def test_the_moves_of_most_blocks_are_found():
    pairs = [scrolling(3, 0), scrolling(3, 0, 8), scrolling(-2, 5)]
    before, after = (torch.cat(part) for part in zip(*pairs))
    found = frequent_moves(before, after, 2)
    assert found.tolist() == [[3, 0], [-2, 5]]
    assert frequent_moves(*(torch.cat([part, part]) for part in scrolling(-18, 4)), 1).tolist() == [[-18, 4]], (
        "far ones too"
    )
    assert not len(frequent_moves(before, before, 2)), "nothing moves where nothing changes"


def test_what_stays_while_the_picture_scrolls_is_found():
    before, after = (torch.cat(part) for part in zip(scrolling(3, 0, 40), scrolling(-3, 0, 40)))
    for picture in (before, after):
        picture[..., 18:22, 18:22] = torch.tensor([200, 30, 90], dtype=torch.uint8)[:, None, None]  # the walker
        picture[..., 3:6, 10:30] = picture[..., :3, 34:] = 60
    found = overlay(before, after, torch.tensor([[0, 0], [3, 0], [-3, 0]]))
    wanted = NONE.clone()
    wanted[:8], wanted[18:22, 18:22] = True, True
    assert (found != wanted).sum() <= 4 and found[:8].all(), "plain pixels of the status line, too, up to its corners"
    assert not overlay(before, before, torch.tensor([[0, 0], [3, 0]])).any(), (
        "where nothing scrolls, nothing lies over it"
    )


def test_what_stays_is_found_though_the_picture_scrolls_by_part_of_a_pixel():
    fine = F.interpolate(torch.rand(1, 3, 12, 40, generator=make_rng(0)), scale_factor=(8, 12), mode="bicubic")
    views = [
        F.avg_pool2d(255 * fine[..., x : x + 400].clamp(0, 1), 4).to(torch.uint8) for x in (43, 40)
    ]  # 3/4 of a pixel
    for view in views:
        view[..., :6, :] = torch.randint(0, 256, (3, 6, 100), dtype=torch.uint8, generator=make_rng(1))
    found = overlay(*(view.repeat(40, 1, 1, 1) for view in views), torch.tensor([[0, 0], [1, 0]]))
    assert found[:6].float().mean() > 0.95 and found[7:].float().mean() < 0.05


def test_a_run_keeps_how_its_pictures_scroll_and_only_its_own(tmp_path):
    found = Scrolling(torch.tensor([[0, 0], [0, -2], [3, 0]]), NONE.clone())
    found.over[:3, 5] = True
    assert Scrolling.read(tmp_path, {}) is None
    found.write(tmp_path, {"size": (64, 64)})
    kept = Scrolling.read(tmp_path, {"size": (64, 64)})
    assert kept is not None and torch.equal(kept.moves, found.moves) and torch.equal(kept.over, found.over)
    assert Scrolling.read(tmp_path, {"size": (32, 32)}) is None, "that of another recipe"
    text = (tmp_path / STATISTICS).read_text()
    for damage in (text[:40], text.replace("-2", "-99"), text.replace("3,", "0, 3,"), text.replace("#", "?"), "[]"):
        (tmp_path / STATISTICS).write_text(damage)
        assert Scrolling.read(tmp_path, {"size": (64, 64)}) is None


def test_a_mosaic_is_made_of_the_real_part_of_a_clip():
    before, after = scrolling(3, 0, 2)
    moves, real = torch.tensor([[0, 0], [3, 0]]), torch.tensor([[True, True], [False, False]])
    made = mosaics(torch.stack([before, after], 1), moves, NONE, real)
    known = read_mosaic(made, SIZE, torch.tensor([[0, 0], [0, 0]]))
    assert torch.equal(known[0, :3, 8:], after[0, :, 8:]) and not known[1].any()
    gone = read_mosaic(made, SIZE, torch.tensor([[-3, 0], [0, 0]]))  # a step back, the left edge is as it was
    assert torch.equal(gone[0, :3, 8:], before[0, :, 8:])
    without = mosaics(torch.stack([before, after], 1), moves, LINE, real)[0]
    known = read_mosaic(without[None], SIZE, torch.zeros(1, 2, dtype=torch.int64))[0, 3] > 0
    assert torch.equal(known, ~LINE), "what lies over it never enters it"


@pytest.mark.parametrize(
    ("lengths", "steps"),
    [
        ([400, 300], 8),
        ([9] * 50, 4),
        ([6] * 50, 2),
        ([9] * 50 + [700], 8),
        ([9] * 200 + [12] * 200, 8),
        ([9] * 200 + [12] * 20, 4),  # a few longer episodes do not decide
    ],
)
def test_clips_are_as_long_as_episodes_allow(lengths, steps):
    assert fitting_rollout(np.array(lengths), 4, 8) == steps


def test_episodes_of_a_few_rows_make_no_clip():
    with pytest.raises(DatasetError, match="the 5 rows that a clip has"):
        fitting_rollout(np.array([3, 4]), 4, 3)
