"""The page stands alone, and pictures come out as asked."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from panorama import Panorama, card_of, some_clips
from PIL import Image

from terrella.core.errors import TerrellaError
from terrella.measure import LONG, ExamConfig, strip, write_report
from terrella.measure.plot import Line, line_chart
from terrella.measure.scorecard import Curve
from terrella.measure.statistics import Band
from terrella.measure.strip import jpeg
from terrella.measure.verdict import good_for


@pytest.fixture(scope="module")
def card():
    arms = {name: Panorama(flaw) for name, flaw in (("memory", ""), ("no <memory>", "fading"), ("still", "static"))}
    places = {"recorded": some_clips(5, 32), "new": some_clips(4, 32, seed=4)}
    config = ExamConfig(
        (1, 8, 32), batch=8, strips=1, drop=(8, 32), closure_deg=(90.0,), closure_step_deg=15, closure_clips=4,
        closure_walk=0, long_steps=100, still_steps=100, long_rollouts=2, speed_steps=20,
    )  # fmt: skip
    return card_of(arms, places, config, sets={LONG: {"recorded": some_clips(3, 110)}})


def test_the_report_stands_alone(card, tmp_path):
    paths = write_report(card, tmp_path / "new" / "folder", "A <world>")
    html = paths[1].read_text(encoding="utf-8")
    assert paths[0].read_text(encoding="utf-8").endswith("}\n")
    assert "A &lt;world&gt;" in html and "no &lt;memory&gt;" in html and "no <memory>" not in html
    assert not re.search(r"(src|href)=(?!\"data:)|url\(|@import|https?://", html)
    assert "nan" not in re.sub(r"base64,[^\"]*", "", html).lower()
    assert html.index("better than copying the last frame") < html.index("<h2>Likeness")
    for heading in (
        "Likeness over time",
        "Does it follow actions?",
        "Position",
        "Does it remember?",
        "A long rollout",
        "Does it fade without actions?",
        "What does it cost?",
    ):
        assert f"<h2>{heading}</h2>" in html
    for svg in re.findall(r"<svg .*?</svg>", html):
        ElementTree.fromstring(re.sub(r"class=key", 'class="key"', svg))


def test_a_film_of_truth_over_dream_comes_first_and_figures_are_folded(card, tmp_path):
    html = write_report(card, tmp_path, "A world")[1].read_text(encoding="utf-8")
    data = re.search(r'src="data:image/webp;base64,([^"]+)"', html)
    assert data and html.index("Good for") < html.index("<table") and data.start() < html.index("Good for")
    film = Image.open(io.BytesIO(base64.b64decode(data[1])))
    height, width = card.films[0].truth.shape[1:3]
    assert film.size == (width, 2 * height + 4) and film.n_frames > 8 and film.info["loop"] == 0
    assert html.index("<details class=more>") < html.index("<table"), "technical rows are under More"
    assert html.count("data-head=") > 20, "on a phone each figure is named"
    assert "films" not in json.loads((tmp_path / "scorecard.json").read_text())


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        ([(1, 2)] * 10, "Good for at least 1.0 seconds"),
        ([(1, 2)] * 4 + [(-1, 1)] * 2 + [(-2, -1)] * 4, "Good for about 0.4 seconds"),
        ([(1, 2)] * 2 + [(-2, -1)] * 2 + [(1, 2)] * 6, "Good for about 0.2 seconds"),
        ([(-1, 1)] * 10, "Not yet better than repeating the last picture"),
    ],
)
def test_it_is_good_for_as_long_as_it_is_better_without_a_break(card, gains, words):
    low, high = (np.array([gain[end] for gain in gains], float) for end in (0, 1))
    arm = next(iter(card.worlds))
    band = Band((low + high) / 2, low, high, 5)
    curve = Curve(
        "pixels", "rgb", "pooled PSNR: gain over copy-last", "dB", "recorded", arm, "predicted", range(1, 11), band
    )
    assert good_for(replace(card, dt_s=0.1, curves=[curve])) == words
    assert good_for(replace(card, curves=[])) == ""


def test_a_report_that_cannot_be_written_is_one_sentence(card, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrellaError, match="cannot write to"):
        write_report(card, tmp_path / "file" / "inside", "x")


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
