"""Bars judge rightly, the page stands alone, and pictures come out as asked."""

from __future__ import annotations

import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from panorama import Panorama, some_clips
from PIL import Image

from terrella.core import make_rng
from terrella.core.errors import TerrellaError
from terrella.measure import ExamConfig, ScoreConfig, bars, examine, strip, write_report
from terrella.measure.plot import Line, line_chart
from terrella.measure.strip import jpeg


@pytest.fixture(scope="module")
def card():
    arms = {name: Panorama(flaw) for name, flaw in (("memory", ""), ("no <memory>", "fading"), ("still", "static"))}
    places = {"recorded": some_clips(5, 128), "new": some_clips(4, 128, seed=4)}
    config = ExamConfig(ScoreConfig(batch=8, strips=1), closure_step_deg=15, long_steps=200, stories=2)
    shares = []
    found = examine(arms, places, make_rng(0), config, progress=lambda share, words: shares.append(share))
    assert shares == sorted(shares) and shares[-1] == 1
    return found


def test_every_bar_of_the_perfect_world_is_met(card):
    found = bars(card, "memory")
    assert {bar.status for bar in found} == {"met"}
    assert {bar.place for bar in found} == {"recorded", "new"}
    eight = next(bar for bar in found if bar.name == "PSNR" and bar.horizon == 8)
    assert eight.seconds == pytest.approx(8 / 35) and eight.sure


def test_flawed_worlds_miss_their_bars(card):
    fading = {
        bar.name: bar for bar in bars(card, "no <memory>") if bar.place == "recorded" and bar.motion == "predicted"
    }
    assert fading["sharpness against the game's, worst horizon"].status == "missed"
    assert fading["sharpness against the game's, worst horizon"].horizon == 128
    assert fading["PSNR lost from 8 to 64 steps"].status == "missed"
    still = bars(card, "still")
    assert {bar.status for bar in still if bar.name.startswith("closure")} == {"void"}
    assert {bar.status for bar in still if bar.name.startswith("obeys")} == {"missed"}


def test_what_the_card_lacks_is_not_measured(card):
    assert {bar.status for bar in bars(card, "no such arm")} == {"not measured"}


def test_longer_horizons_are_told_as_the_same_seconds_at_frame_skip_four(card):
    side = [bar for bar in bars(card, "memory") if bar.side]
    assert {bar.horizon for bar in side} == {32, 128}
    assert {bar.note for bar in side} == {"as long as 8 steps at frame-skip 4", "as long as 32 steps at frame-skip 4"}


def test_the_report_stands_alone(card, tmp_path):
    paths = write_report(card, bars(card, "memory"), tmp_path / "new" / "folder", "A <world>")
    html = paths[1].read_text(encoding="utf-8")
    assert paths[0].read_text(encoding="utf-8").endswith("}\n")
    assert "A &lt;world&gt;" in html and "no &lt;memory&gt;" in html and "no <memory>" not in html
    assert not re.search(r"(src|href)=(?!\"data:)|url\(|@import|https?://", html)
    assert "nan" not in re.sub(r"base64,[^\"]*", "", html).lower()
    for heading in ("Bars", "Likeness over time", "Sharpness over time", "Position", "A long dream", "Speed"):
        assert f"<h2>{heading}</h2>" in html
    for svg in re.findall(r"<svg .*?</svg>", html):
        ElementTree.fromstring(re.sub(r"class=key", 'class="key"', svg))


def test_a_report_that_cannot_be_written_is_one_sentence(card, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrellaError, match="cannot write the report"):
        write_report(card, [], tmp_path / "file" / "inside", "x")


def test_a_strip_shows_its_frames_where_they_belong():
    frames = np.zeros((3, 10, 20, 3), np.uint8)
    frames[1] = (250, 10, 10)
    picture = strip({"truth": frames, "dream": frames}, ["0", "8", "32"])
    red = np.asarray(picture)[..., 0] > 200
    assert red.sum() == 2 * 10 * 20
    assert Image.open(io.BytesIO(jpeg(picture))).size == picture.size
    with pytest.raises(ValueError, match="one frame for each column"):
        strip({"truth": frames}, ["0"])


def test_a_chart_puts_larger_values_higher_and_survives_gaps():
    line = Line("a", [1, 2, 4], [1.0, float("nan"), 3.0], [1.0] * 3, [3.0] * 3, "#fff")
    svg = ElementTree.fromstring(line_chart([line], [(1, "1"), (4, "4")], "steps", "dB", log_x=True))
    path = next(part for part in svg.iter("path") if part.get("class") == "line").get("d")
    (x0, y0), (x1, y1) = (map(float, pair.split()) for pair in path.removeprefix("M").split("L"))
    assert x1 > x0 and y1 < y0
