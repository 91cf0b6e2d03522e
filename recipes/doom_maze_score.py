"""The reported scorecard of doom-maze, on a recording that training saw nothing of; goes on where it was stopped;
and its targets, which of them are met, and which surely (their whole interval is on that side), in targets.json.

python recipes/doom_maze_score.py RECORDING OUT [--clips 50]

Arms: "memory"; "no memory": without the recordings' keyframes; "no network": memory alone, its colours averaged, nothing
sharpened and nothing invented.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

import terrella
from terrella.data import ClipCache
from terrella.measure import (
    CLIPS,
    LONG,
    Album,
    Exam,
    ExamConfig,
    Row,
    Scorecard,
    clips_from_cache,
    examine,
    in_box,
    out_of_sight,
    verdict,
    write_report,
)
from terrella.worlds.generator import encode_depth

CONTEXT, HORIZONS = 10, (1, 8, 32, 64)
DRIFT, DRIFT_CLIPS = 256, 24


@dataclass(frozen=True)
class Bar:
    """A target and its figure: low <= figure <= high. `sure`: its whole interval lies on the same side."""

    name: str
    row: Row | None
    low: float = -math.inf
    high: float = math.inf

    @property
    def status(self) -> str:
        if self.row is None or not math.isfinite(self.row.figure.value):
            return "not measured"
        if self.row.void:
            return "void"
        return "met" if self.low <= self.row.figure.value <= self.high else "missed"

    @property
    def sure(self) -> bool:
        if self.row is None or self.status not in ("met", "missed"):
            return False
        inside = self.low <= self.row.figure.low and self.row.figure.high <= self.high
        outside = self.row.figure.high < self.low or self.row.figure.low > self.high
        return inside if self.status == "met" else outside

    @property
    def target(self) -> str:
        unit = f" {self.row.unit}" if self.row and self.row.unit else ""
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"{self.low:g} to {self.high:g}{unit}"
        return f"\u2265 {self.low:g}{unit}" if math.isfinite(self.low) else f"\u2264 {self.high:g}{unit}"


def worst_of(rows: list[Row]) -> Row | None:
    """Of ratios that should be 1, the one farthest from it; what could not be measured is never the worst."""
    known = [row for row in rows if math.isfinite(row.figure.value)]
    return max(known, key=lambda row: abs(row.figure.value - 1), default=None)


class Average(torch.nn.Module):
    """In the place of the generator: what memory knows, averaged, and the last frame where it knows nothing."""

    def __init__(self, config):
        super().__init__()
        self.config = config
        self.where = torch.nn.Parameter(torch.zeros(()))  # a world asks its generator which device it is on

    def forward(self, noisy, time, conditioning):
        glimpse, last = conditioning.glimpse, conditioning.last
        rgb = torch.where(last[:, 3:] > 0, last[:, :3], glimpse.merged)
        return torch.cat([rgb * 2 - 1, encode_depth(glimpse.depth)[:, None]], 1)


def places(world, cache, count: int, seed: int, steps: int) -> dict:
    """Clips of `steps` steps of the places that training saw, and of those that it never did."""
    box, every, rng = world.spec.card["keep_out"], range(len(cache.episodes)), terrella.make_rng(seed)
    asked = (cache, every, CONTEXT, steps, count, rng)
    return {
        "recorded": clips_from_cache(*asked, out_of_sight(*box)),
        "new": clips_from_cache(*asked, in_box(*box)),
    }


def bars(card: Scorecard) -> Iterator[Bar]:
    """The targets of this world, for the first arm."""

    def row(probe: str, what: str, place: str, motion: str, horizon: int | None = None) -> Row | None:
        found = [
            one
            for one in card.find(probe, what, place=place, motion=motion, arm=next(iter(card.worlds)))
            if horizon in (None, one.horizon)
        ]
        return worst_of(found) if horizon is None else next(iter(found), None)

    for motion in ("predicted", "true"):
        for place, horizon, least in (("recorded", 8, 26.0), ("new", 8, 23.0), ("new", 32, 20.0)):
            found = row("pixels", "PSNR", place, motion, horizon)
            yield Bar(f"PSNR after {horizon} steps, {place} places, {motion} motion", found, least)
        found = row("pixels", "PSNR lost from 8 to 64 steps", "recorded", motion, 64)
        yield Bar(f"PSNR lost from 8 to 64 steps, {motion} motion", found, high=1.0)
        for place in ("recorded", "new"):
            found = row("pixels", "sharpness", place, motion)
            yield Bar(f"sharpness, worst horizon, {place} places, {motion} motion", found, 0.7, 1.3)
    for place in ("recorded", "new"):
        what = "PSNR: true actions over other actions"
        yield Bar(f"obeys the actions, {place} places, 8 steps", row("control", what, place, "predicted", 8), 3.0)
        yield Bar(f"obeys the actions, {place} places, 32 steps", row("control", what, place, "predicted", 32), 0.0)
        what = "distance over the way gone, mean"
        yield Bar(f"position, {place} places", row("pose", what, place, "predicted", 64), high=5.0)
        for way, least in (("yaw 0-90-0", 25.0), ("yaw 0-180-0", 27.0), ("walk of 100 steps", 25.0)):
            yield Bar(f"back from {way}, {place} places", row("memory", way, place, "true"), least)
    for what in ("sharpness", "mean of green", "spread of green"):
        yield Bar(f"{what} over 1,000 steps, worst stretch", row("endurance", what, "recorded", "predicted"), 0.7, 1.3)
    for what, within in (("sharpness", 0.1), ("mean of red", 0.03), ("mean of green", 0.03), ("mean of blue", 0.03)):
        still = row("stillness", what, "recorded", "no action")
        yield Bar(f"{what}, standing still for 1,000 steps", still, 1 - within, 1 + within)


def said(share: float, words: str, left_s: float) -> None:
    print(f"{share:.0%} {words}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("out", type=Path)
    parser.add_argument("--world", default="doom-maze")
    parser.add_argument("--clips", type=int, default=50)
    given = parser.parse_args()
    world = terrella.load(given.world)
    bare = terrella.load(given.world, memory=False)
    arms = {"memory": world, "no memory": bare, "no network": world.replaced(generator=Average(world.generator.config))}
    cache = ClipCache.open(given.data, world.spec.channels["rgb"].shape[:2])
    sets = {
        CLIPS: places(world, cache, given.clips, 0, max(HORIZONS)),
        LONG: places(world, cache, DRIFT_CLIPS, 1, DRIFT),
    }
    closing = {"last frame only": bare.with_memory_budget(0)}
    exam = Exam(arms, sets, ExamConfig(horizons=HORIZONS), album=Album.of_cache(cache), closing=closing)
    card = examine(exam, given.out / "parts", f"{given.world} {cache.path}", said)
    print(*verdict(card), sep="\n")
    print(*write_report(card, given.out, "doom-maze: the scorecard"))
    targets = []
    for bar in bars(card):
        figure = str(bar.row.figure) if bar.row else ""
        print(f"{bar.status + ('' if bar.sure else '?'):>14}  {bar.name}, {bar.target}: {figure}")
        targets.append(
            {"name": bar.name, "target": bar.target, "figure": figure, "status": bar.status, "sure": bar.sure}
        )
    (given.out / "targets.json").write_text(json.dumps(targets, indent=1) + "\n")
    shutil.rmtree(given.out / "parts")


if __name__ == "__main__":
    main()
