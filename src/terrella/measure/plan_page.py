"""The results of `terrella plan` to look at: a film of reality beside the dream with their divergence, and a page of figures."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from ..core.files import replacing
from ..data.storage.mp4 import Mp4Writer, finish_video
from .page_parts import COLOURS, QUIET, document, figure_text, section, table_of
from .plot import Line, line_chart
from .statistics import Figure
from .strip import jpeg, strip

_HIGH, _CHART, _LINE = 224, 84, 18  # heights in pixels: of a panel at least, of the divergence, of a line of text
_MIN_SCALE = 0.01  # of the axis of a divergence
_DARK, _WORDS, _CURVE = (14, 16, 20), (168, 176, 190), (111, 211, 193)


def film(
    path: Path, rows: Mapping[str, np.ndarray], divergence: Sequence[float], what: str, fps: float, hold: int = 8
) -> None:
    """Writes an MP4: pictures uint8 [T, H, W, 3] side by side under their labels, and below them the divergence [T] so far. The
    last picture is held for `hold` more frames."""
    panels = [np.asarray(frames, np.uint8) for frames in rows.values()]
    height, width = panels[0].shape[1:3]
    times = max(1, -(-_HIGH // height))
    size = (height * times, width * times)
    wide = (size[1] * len(panels) + 1) // 2 * 2
    tall = (size[0] + _LINE + _CHART + 1) // 2 * 2
    growing = path.with_suffix(".growing.mp4")
    writer = Mp4Writer(growing, (tall, wide), fps)
    count = len(panels[0])
    for number in range(count + hold):
        at = min(number, count - 1)
        canvas = Image.new("RGB", (wide, tall), _DARK)
        draw = ImageDraw.Draw(canvas)
        for place, (label, frames) in enumerate(zip(rows, panels)):
            shown = Image.fromarray(frames[at]).resize((size[1], size[0]), Image.Resampling.NEAREST)
            canvas.paste(shown, (place * size[1], _LINE))
            draw.text((place * size[1] + 6, 3), label, fill=_WORDS)
        _draw_divergence(draw, divergence, at, what, (4, size[0] + _LINE, wide - 4, tall - 4))
        writer.add(np.asarray(canvas))
    writer.close()
    with replacing(path) as staged:
        finish_video(growing, staged)
    growing.unlink()


def _draw_divergence(
    draw: ImageDraw.ImageDraw, values: Sequence[float], at: int, what: str, box: tuple[int, int, int, int]
) -> None:
    left, top, right, bottom = box
    draw.text((left + 2, top + 3), f"step {at}: {what} {values[at]:.3g}", fill=_WORDS)
    most, top = max(max(values), _MIN_SCALE), top + _LINE
    step = (right - left) / max(1, len(values) - 1)
    points = [(left + step * k, bottom - (bottom - top) * value / most) for k, value in enumerate(values[: at + 1])]
    draw.line([(left, bottom), (right, bottom)], fill=(60, 66, 78))
    if len(points) > 1:
        draw.line(points, fill=_CURVE, width=2)


def film_strip(rows: Mapping[str, np.ndarray], columns: int = 8) -> Image.Image:
    """Some pictures of the film, evenly spaced, one row for each label."""
    count = len(next(iter(rows.values())))
    picks = sorted(set(np.linspace(0, count - 1, min(columns, count)).round().astype(int).tolist()))
    return strip({label: np.asarray(frames)[picks] for label, frames in rows.items()}, [f"step {at}" for at in picks])


def compute_chart(points: Sequence[tuple[float, Figure]], floor: Figure, what: str) -> str:
    """An <svg>: a figure with its interval against the steps imagined per decision (log scale); dashed: random actions."""
    x = [steps for steps, _ in points]
    figures = [figure for _, figure in points]
    lines = [
        Line("planner", x, *_curve(figures), COLOURS[0]),
        Line("random", x, *_curve([floor] * len(x)), QUIET, "5 4"),
    ]
    return line_chart(lines, [(step, f"{step:,.0f}") for step in x], "imagined steps per decision", what, log_x=True)


def _curve(figures: Sequence[Figure]) -> tuple[list[float], list[float], list[float]]:
    return [one.value for one in figures], [one.low for one in figures], [one.high for one in figures]


def plan_page(
    title: str,
    lead: Sequence[str],
    arms: Mapping[str, Mapping[str, Figure]],
    chart: str = "",
    picture: Image.Image | None = None,
    film_name: str = "",
    facts: Mapping[str, object] | None = None,
) -> str:
    """HTML: the verdict, a table with a row for each arm, success against compute, dream beside reality, and the settings."""
    heads = list(dict.fromkeys(name for row in arms.values() for name in row))
    cells = {arm: [figure_text(row[name]) if name in row else "" for name in heads] for arm, row in arms.items()}
    rows = [[escape(arm), *figures] for arm, figures in cells.items()]
    words = "".join(f"<p>{escape(line)}</p>" for line in lead[1:])
    video = f'<video controls loop muted playsinline width="100%" src="{escape(film_name)}"></video>'
    shown = video if film_name else ""
    if picture is not None:
        data = base64.b64encode(jpeg(picture)).decode()
        shown += f'<div class=scroll><img alt="reality and dream" src="data:image/jpeg;base64,{data}"></div>'
    settings = table_of(["setting", ""], [[escape(str(k)), escape(str(v))] for k, v in (facts or {}).items()])
    parts = [
        f"<section><h2>{escape(lead[0])}</h2>{words}{table_of(['', *map(escape, heads)], rows)}</section>",
        section("Does more search help?", "The same starts with more and more plans per decision.", chart),
        section("Dream beside reality", "The dream starts from the first observation and is given the actions.", shown),
        section("Settings", "", settings if facts else ""),
    ]
    return document(title, parts)
