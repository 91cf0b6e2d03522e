"""The reported scorecard of doom-maze: `terrella score` with its two arms side by side, one process and thread each.

python recipes/doom_maze_score.py RECORDING OUT [--clips 50]
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
from terrella.data import ClipCache, split
from terrella.measure import (
    Album,
    ExamConfig,
    Scorecard,
    ScoreConfig,
    bars,
    clips_from_cache,
    examine,
    in_box,
    outside_box,
    speed,
    write_report,
)

ARMS = {"memory": True, "no memory": False}
CONTEXT, HORIZONS = 10, (1, 8, 32, 64)


def exam(arm: str, name: str, data: str, count: int) -> Scorecard:
    """One arm's scorecard, without speeds: those are measured alone."""
    torch.set_num_threads(1)
    world, rng = terrella.load(name, memory=ARMS[arm]), terrella.make_rng(0)
    clips, cache = places(world, data, count, rng)
    scoring = ScoreConfig(horizons=HORIZONS, control_horizons=(8, 32))
    config = ExamConfig(score=scoring, closure_clips=12, stories=4)

    def tell(share: float, words: str) -> None:
        print(f"{arm}: {share:.0%} {words}", file=sys.stderr, flush=True)

    return examine({arm: world}, clips, rng, config, Album.of_cache(cache), tell)


def places(world, data: str, count: int, rng):
    """Clips of recorded places (held-out episodes) and of the places that training never saw."""
    cache = ClipCache.open(data, world.spec.channels["rgb"].shape[:2])
    box = world.spec.card["keep_out"]
    held_out, every = split(len(cache.episodes))[1], range(len(cache.episodes))
    recorded = clips_from_cache(cache, held_out, CONTEXT, max(HORIZONS), count, rng, outside_box(*box))
    return {
        "recorded": recorded,
        "new": clips_from_cache(cache, every, CONTEXT, max(HORIZONS), count, rng, in_box(*box)),
    }, cache


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("out", type=Path)
    parser.add_argument("--world", default="doom-maze")
    parser.add_argument("--clips", type=int, default=50)
    given = parser.parse_args()
    with ProcessPoolExecutor(len(ARMS), get_context("spawn")) as pool:
        futures = [pool.submit(exam, arm, given.world, given.data, given.clips) for arm in ARMS]
        cards = [future.result() for future in futures]
    card = cards[0]
    for other in cards[1:]:
        lists = {
            field.name: getattr(card, field.name) + getattr(other, field.name)
            for field in dataclasses.fields(card)
            if isinstance(getattr(card, field.name), list) and field.name != "places"
        }
        card = dataclasses.replace(card, worlds=card.worlds | other.worlds, **lists)
    rng, speeds = terrella.make_rng(0), []
    for arm, memory in ARMS.items():
        world = terrella.load(given.world, memory=memory)
        speeds.append(speed(world, places(world, given.data, 1, rng)[0]["recorded"], rng, arm, 600))
    card = dataclasses.replace(card, speeds=speeds)
    found = bars(card, "memory")
    print(*write_report(card, found, given.out, "doom-maze: the scorecard"))


if __name__ == "__main__":
    main()
