"""Speed: milliseconds for one imagined and rendered step of one story, and whether the cost grows with time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..core.world import World, make_rng
from .clips import Clip
from .endurance import recorded_hands
from .roll import fold_context


@dataclass(frozen=True)
class Speed:
    """imagine + render of rgb at batch 1: median and 95th percentile in ms, of the first and the last tenth of the
    steps, and growth = last / first - 1. Depends on the machine: `threads` are those torch was given."""

    arm: str
    steps: int
    threads: int
    median_ms: float
    p95_ms: float
    first_ms: float
    last_ms: float
    growth: float


def speed(world: World, clips: Sequence[Clip], rng: torch.Generator, arm: str = "", steps: int = 1000) -> Speed:
    """Times `steps` steps from the first clip's context under recorded actions, after ten untimed ones."""
    own = make_rng(int(torch.randint(2**31 - 1, (1,), generator=rng).item()))
    state = fold_context(world, clips[:1], own)
    actions = recorded_hands(world, clips, 1, steps + 10, own)
    times = []
    for action in actions:
        began = time.perf_counter()
        state = world.imagine(state, action, own)
        world.render(state, ("rgb",))["rgb"].cpu()
        times.append((time.perf_counter() - began) * 1e3)
    took = torch.tensor(times[10:], dtype=torch.float64)
    tenth = max(1, steps // 10)
    first, last = float(took[:tenth].median()), float(took[-tenth:].median())
    median, late = took.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
    return Speed(arm, steps, torch.get_num_threads(), median, late, first, last, last / first - 1)
