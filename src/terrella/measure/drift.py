"""Drift: how a dream's likeness to the truth falls with every step, and up to which step it can be used."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from ..core.world import World, make_rng
from .clips import Clip, check_clips
from .fidelity import gradient_energy
from .roll import PREDICTED, TRUE, dream_all, frames_at, stand_still, true_motion_works
from .statistics import Band, Figure, last_step_above, mean_band, ratio_band

COPY_LAST = "copy last"
FALL_DB = 10 * math.log10(2)  # twice the error: a dream is usable until its PSNR has fallen by that


@dataclass(frozen=True)
class Drift:
    """One arm's fall over the steps 1..steps of long clips; motion "" for copy-last, which stands still.

    psnr, dB, and sharpness (gradient energy of dreams over the game's) at each step. usable: the last step, 0 to `steps`,
    up to which the squared error stays within twice that of its own first step, that is PSNR, the mean over clips, within
    3.01 dB of its first (a mean of squared errors instead would follow whichever clip looks at the roughest wall).
    usable_shared: the same against copy-last's first step, one yardstick for every arm, for a dream that is bad from the
    start does not get much worse.
    """

    place: str
    arm: str
    motion: str
    steps: int
    seconds: float
    psnr: Band
    sharpness: Band
    usable: Figure
    usable_shared: Figure


def drift(
    arms: Mapping[str, World],
    clips_by_place: Mapping[str, Sequence[Clip]],
    rng: torch.Generator,
    steps: int = 256,
    batch: int = 8,
    progress: Callable[[float, str], None] | None = None,
) -> list[Drift]:
    """The curves of copy-last and of every arm, with predicted motion and, where the world can, true motion.

    Each arm sees the same clips and the same random numbers. The same generator seed gives the same curves.
    """
    tell = progress or (lambda share, words: None)
    found: list[Drift] = []
    for number, (place, clips) in enumerate(clips_by_place.items()):
        check_clips(place, clips, steps)
        seed = int(torch.randint(2**31 - 1, (1,), generator=rng).item())
        still, truth = stand_still(clips, steps)
        shown = gradient_energy(frames_at(clips, clips[0].context - 1))
        rolled = {(COPY_LAST, ""): (still, shown[:, None].expand_as(truth))}
        for turn, (arm, world) in enumerate(arms.items()):
            tell((number + turn / len(arms)) / len(clips_by_place), f"{steps} steps of drift in {place} places, {arm}")
            motions = (PREDICTED, TRUE) if true_motion_works(world, clips[0], make_rng(seed)) else (PREDICTED,)
            for motion in motions:
                dreamt = dream_all(world, clips, motion, (steps,), batch, seed)
                rolled[arm, motion] = dreamt.psnr, dreamt.energy
        seconds = steps * next(iter(arms.values())).spec.dt_s
        for (arm, motion), (psnr, energy) in rolled.items():
            bands = mean_band(psnr, rng), ratio_band(energy, truth, rng)
            usable = [last_step_above(psnr, first[:, 0] - FALL_DB, rng) for first in (psnr, still)]
            found.append(Drift(place, arm, motion, steps, seconds, *bands, *usable))
    tell(1.0, "drift measured")
    return found
