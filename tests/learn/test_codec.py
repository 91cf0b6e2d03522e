"""What a codec learns of a recording: moves by block matching, a palette, and the mosaics of clips."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from terrella.core import make_rng
from terrella.core.errors import DatasetError
from terrella.learn import feeds
from terrella.learn.moves import STATISTICS, CodecStatistics, frequent_moves, mosaics, overlay, palette
from terrella.learn.objectives.codec import RECORDED, ClipMaker, CodecClips, CodecObjective, Spans
from terrella.learn.trainer import TrainStep
from terrella.space.mosaic import read_mosaic
from terrella.worlds.codec import Codec, CodecConfig
from terrella.worlds.controls import Controls

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


def test_a_palette_holds_the_colours_of_a_picture():
    colours = torch.tensor([[0, 0, 0], [250, 10, 10], [10, 250, 10]], dtype=torch.uint8)
    picture = colours[torch.randint(0, 3, (2, 16, 16), generator=make_rng(0))].permute(0, 3, 1, 2)
    found = palette(picture, 8, np.random.default_rng(0))
    assert all((found.int() - colour.int()).abs().amax(1).min() <= 4 for colour in colours)


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


def test_a_run_keeps_its_moves_and_palette_and_only_its_own(tmp_path):
    found = CodecStatistics(
        torch.tensor([[0, -2], [3, 0]]), torch.tensor([[0, 9, 255]], dtype=torch.uint8), 2.5, NONE.clone()
    )
    found.over[:3, 5] = True
    assert CodecStatistics.read(tmp_path, {}) is None
    found.write(tmp_path, {"size": (64, 64)})
    kept = CodecStatistics.read(tmp_path, {"size": (64, 64)})
    assert kept is not None and kept.stress == 2.5 and kept.palette.dtype == torch.uint8
    assert torch.equal(kept.moves, found.moves) and torch.equal(kept.palette, found.palette)
    assert torch.equal(kept.over, found.over)
    assert CodecStatistics.read(tmp_path, {"size": (32, 32)}) is None, "that of another recipe"
    text = (tmp_path / STATISTICS).read_text()
    for damage in (
        text[:40],
        text.replace("255", "256"),
        text.replace("-2", "-99"),
        text.replace("2.5", "0.0"),
        text.replace("#", "?"),
        "[]",
    ):
        (tmp_path / STATISTICS).write_text(damage)
        assert CodecStatistics.read(tmp_path, {"size": (64, 64)}) is None


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
    ("lengths", "spans"),
    [
        ([400, 300], (24, 4, 6)),
        ([23] * 30, (12, 4, 6)),
        ([9] * 50, (0, 4, 3)),
        ([9] * 50 + [700], (24, 4, 6)),
        ([9] * 200 + [12] * 200, (0, 4, 6)),
        ([9] * 200 + [12] * 20, (0, 4, 3)),  # a few longer episodes do not decide
    ],
)
def test_clips_are_as_long_as_episodes_allow(lengths, spans):
    assert Spans.fitting(np.array(lengths), 4) == Spans(*spans)


def test_episodes_of_a_few_rows_make_no_clip():
    with pytest.raises(DatasetError, match="the 5 rows that a clip has"):
        Spans.fitting(np.array([3, 4]), 4)


def test_of_few_clips_some_are_taken_twice():
    rgb = np.zeros((3, 7, 8, 8, 3), np.uint8)
    rgb[:, :, 0, 0, 0] = np.arange(3)[:, None]
    now = TrainStep(0, 0.0, torch.device("cpu"), np.random.default_rng(0), torch.Generator())
    found = {"rgb": rgb, "action": np.zeros((3, 7, 2), np.float32)}
    still, none = torch.zeros(1, 2, dtype=torch.int64), torch.zeros(8, 8, dtype=torch.bool)
    made = ClipMaker(Controls.buttons(2), still, none, Spans(0, 4, 3), 5)(found, now)
    assert made.frames.shape == (5, 7, 3, 8, 8) and made.actions.shape[:2] == (5, 7)
    assert set(made.frames[:, 0, 0, 0, 0].tolist()) <= {0, 1, 2}


def test_clips_are_made_on_the_cpu_wherever_the_codec_learns(monkeypatch):
    objective = CodecObjective(Codec(CodecConfig(SIZE, 4, 36 + 4 * 2, 1, 4, (8, 8))), 1e-3, Spans(0, 4, 3), 2.0, NONE)
    found = {"rgb": np.zeros((3, 7, *SIZE, 3), np.uint8), "action": np.zeros((3, 7, 2), np.float32)}
    monkeypatch.setattr(feeds, "clips_of", lambda *given, **options: SimpleNamespace(forever=lambda: iter([found])))
    recording = SimpleNamespace(controls=Controls.buttons(2))
    feed = feeds.codec_feed(recording, None, objective, 2, 0)  # type: ignore[arg-type]
    objective.generator.to("meta")  # stands for a GPU
    made = feed.batch(TrainStep(0, 0.0, torch.device("meta"), np.random.default_rng(0), make_rng(0)))
    assert made.mosaic.device.type == made.frames.device.type == "cpu"


@pytest.mark.parametrize(
    ("batch", "step", "dreamt"), [(5, RECORDED, [2, 2, 0]), (1, RECORDED, [0, 0, 0]), (5, 0, [0, 0, 0])]
)
def test_half_of_a_batch_is_dreamt_once_recorded_frames_are_known(monkeypatch, batch, step, dreamt):
    codec = Codec(CodecConfig(SIZE, 4, 36 + 4 * 2, 1, 4, (8, 8)))
    objective, seen = CodecObjective(codec, 1e-3, Spans(0, 4, 3), 2.0, LINE), []
    truth = torch.randint(0, 256, (batch, 7, 3, *SIZE), dtype=torch.uint8, generator=make_rng(0))

    def loss(shown, mosaic, move, context, target, before, count, now):
        seen.append(count)
        assert torch.equal(target, truth[:, 3 + len(seen)])
        known = read_mosaic(mosaic, SIZE, torch.zeros(batch, 2, dtype=torch.int64))[:, 3] > 0
        assert torch.equal(known, ~LINE.expand(batch, -1, -1)) and not move.any()
        drawn = torch.full_like(target[:count], len(seen))
        if len(seen) > 1:
            assert (shown[: dreamt[0], 0] == len(seen) - 1).all() and torch.equal(
                shown[dreamt[0] :, 0], before[dreamt[0] :]
            )
        return None, drawn

    monkeypatch.setattr(objective, "_loss", loss)
    mosaic = mosaics(truth[:, :3], codec.moves, LINE, torch.ones(batch, 3, dtype=torch.bool))
    now = TrainStep(step, 0.0, torch.device("cpu"), np.random.default_rng(0), make_rng(0))
    list(objective.losses(CodecClips(truth, torch.zeros(batch, 7, 2), mosaic), now))
    assert seen == dreamt
