"""Is Breakout's ball still there? Counts pictures with a ball in dreams of a learned world, beside the recording's.

    terrella learn gym:ALE/Breakout-v5 --minutes 30 --out runs/breakout --seed 1
    terrella record world gym:ALE/Breakout-v5 --seed 77 --frames 3000 --out recordings/breakout
    python -m lab.breakouts_ball runs/breakout recordings/breakout

Each dream begins after 4 recorded frames, imagined and observed in turn: one picture alone does not say how fast a ball flies. A
ball is what is bright between the bricks and the paddle. Where the recording shows one, "right" counts the dreams that show one
within 2 pixels, "some" those that show one anywhere.
"""

import sys

import numpy as np
import torch
import torch.nn.functional as F

import terrella
from terrella.core import make_rng
from terrella.data import ClipCache
from terrella.measure.clips import clips_from_cache
from terrella.measure.rollouts import StepMetric, dream, rows_at
from terrella.measure.scorecard import PREDICTED
from terrella.measure.statistics import wilson

SHOWN, STEPS, CLIPS = 4, 64, 48
BRIGHT, FIELD = 70, (slice(30, 56), slice(4, 60))  # of 255; rows and columns of 64


def balls(pictures: torch.Tensor) -> torch.Tensor:
    """Where pictures uint8 [B, 64, 64, 3] show a ball, bool [B, 26, 56]."""
    return (pictures.amax(3) > BRIGHT)[:, FIELD[0], FIELD[1]]


def counted(seen, clips, row: int, step: int) -> dict[str, torch.Tensor]:
    true, drawn = balls(rows_at(clips, "rgb", row)), balls(seen["rgb"])
    near = F.max_pool2d(true.float()[:, None], 5, 1, 2)[:, 0] > 0
    found = [true.flatten(1).any(1), drawn.flatten(1).any(1), (drawn & near).flatten(1).any(1)]
    return {"balls": torch.stack(found, 1)}


def main(folder: str, recording: str) -> None:
    torch.set_num_threads(1)
    cache = ClipCache.open(recording, (64, 64))
    clips = clips_from_cache(cache, range(len(cache.episodes)), SHOWN, STEPS, CLIPS, make_rng(0))
    metric = StepMetric(("rgb",), counted)
    kept = dream(terrella.load(folder), clips, PREDICTED, STEPS, make_rng(1), [metric])["balls"].numpy()
    print(f"{len(clips)} clips of {recording}")
    for step in (1, 4, 8, 16, 32, 64):
        true, drawn, right = kept[:, step - 1].T
        count, some, false = int(true.sum()), int(drawn[true].sum()), int(drawn[~true].sum())
        part = wilson(some, max(1, count))
        found = f"right {right[true].sum()}, some {some} [{part.low:.2f}, {part.high:.2f}]"
        print(f"after {step}: of {count} with a ball {found}; of {np.sum(~true)} without, {false}")


if __name__ == "__main__":
    main(*sys.argv[1:])
