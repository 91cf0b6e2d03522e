"""The reported scorecard of doom-maze, on a recording that training saw nothing of; one process and thread an arm.

python recipes/doom_maze_score.py RECORDING OUT [--clips 50]

Arms: "memory"; "no memory": without the recordings' keyframes; "no network": memory alone, its colours averaged, nothing
sharpened and nothing invented.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch

import terrella
from terrella.data import ClipCache
from terrella.measure import (
    Album,
    ExamConfig,
    Scorecard,
    ScoreConfig,
    bars,
    clips_from_cache,
    examine,
    in_box,
    out_of_sight,
    speed,
    write_report,
)
from terrella.space.keyframes import merge
from terrella.worlds.generator import encode_depth

ARMS = ("memory", "no memory", "no network")
CONTEXT, HORIZONS = 10, (1, 8, 32, 64)
DRIFT, DRIFT_CLIPS = 256, 24


def exam(arm: str, name: str, data: str, count: int) -> Scorecard:
    """One arm's scorecard, without speeds: those are measured alone."""
    torch.set_num_threads(1)
    world, rng = load(arm, name), terrella.make_rng(0)
    clips, cache = places(world, data, count, rng)
    long, _ = places(world, data, DRIFT_CLIPS, terrella.make_rng(1), DRIFT)
    scoring = ScoreConfig(horizons=HORIZONS, control_horizons=(8, 32))
    config = ExamConfig(score=scoring, closure_clips=24, closure_step_deg=6.0)
    closing = {"last frame only": world.with_memory_of(0)} if arm == "no memory" else None

    def tell(share: float, words: str) -> None:
        print(f"{arm}: {share:.0%} {words}", file=sys.stderr, flush=True)

    return examine({arm: world}, clips, rng, config, Album.of_cache(cache), tell, long, closing)


class Average(torch.nn.Module):
    """In the place of the generator: what memory knows, averaged, and the last frame where it knows nothing."""

    kind = "average"

    def __init__(self, config):
        super().__init__()
        self.config = config

    def forward(self, noisy, time, conditioning):
        glimpse, last = conditioning.glimpse, conditioning.last
        rgb = torch.where(last[:, 3:] > 0, last[:, :3], merge(glimpse))
        return torch.cat([rgb * 2 - 1, encode_depth(glimpse.depth)[:, None]], 1)


def load(arm: str, name: str):
    world = terrella.load(name, memory=arm != "no memory")
    if arm != "no network":
        return world
    return world.replaced(generator=Average(world.generator.config), uncertainty=None, estimator=None)


def places(world, data: str, count: int, rng, steps: int = max(HORIZONS)):
    """Clips of `steps` steps of the places that training saw, and of those that it never did."""
    cache = ClipCache.open(data, world.spec.channels["rgb"].shape[:2])
    box, every = world.spec.card["keep_out"], range(len(cache.episodes))
    asked = (cache, every, CONTEXT, steps, count, rng)
    return {
        "recorded": clips_from_cache(*asked, out_of_sight(*box)),
        "new": clips_from_cache(*asked, in_box(*box)),
    }, cache


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("out", type=Path)
    parser.add_argument("--world", default="doom-maze")
    parser.add_argument("--clips", type=int, default=50)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers, get_context("spawn")) as pool:
        futures = [pool.submit(exam, arm, given.world, given.data, given.clips) for arm in ARMS]
        cards = [future.result() for future in futures]
    card = cards[0]
    for other in cards[1:]:
        lists = {
            field.name: getattr(card, field.name) + getattr(other, field.name)
            for field in dataclasses.fields(card)
            if isinstance(getattr(card, field.name), list) and field.name not in ("places", "looks")
        }
        card = dataclasses.replace(card, worlds=card.worlds | other.worlds, **lists)
    rng, speeds = terrella.make_rng(0), []
    for arm in ARMS:
        world = load(arm, given.world)
        speeds.append(speed(world, places(world, given.data, 1, rng)[0]["recorded"], rng, arm, 600))
    card = dataclasses.replace(card, speeds=speeds)
    found = bars(card, "memory")
    print(*write_report(card, found, given.out, "doom-maze: the scorecard"))


if __name__ == "__main__":
    main()
