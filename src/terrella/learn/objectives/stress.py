"""Stress: how much of the weight that pixels had in training that change is taken back when frames are drawn."""

from __future__ import annotations

import numpy as np
import torch

from ...core import make_rng
from ...worlds.codec import Codec
from ...worlds.learned import LearnedWorld
from ..recording import Recording
from .uncertainty import ahead

# Powers of the stress. With a small one what moves is drawn where it is unlikely, with a large one small things fade.
POWERS, USUAL = (0.5, 0.7, 1.0, 1.4), 0.7
HARDLY = 1.5  # a stress of less has no effect worth choosing
SHOWN, STEPS, CLIPS = 8, (32, 16, 8, 4), 12  # frames that a dream is shown, steps that it goes on, dreams
FRAMES = CLIPS * (SHOWN + STEPS[0] * len(POWERS))  # that are drawn, at most
ALIKE = 0.115  # of the logarithm of errors, half a decibel: errors closer than that count as equal
CHANGED = 8  # difference of 255 from the step before, above which a pixel has changed


@torch.inference_mode()
def balanced(world: LearnedWorld, codec: Codec, recording: Recording, stress: float, seed: int) -> float:
    """Which of POWERS brings dreams of recorded episodes nearest to them, by the mean logarithm of the pooled squared error after
    1, 2, 4, ... steps; of those that are nearly alike, the one of which as much changes from step to step as in the recording
    (what stops or fades costs hardly any error). Sets the stress of `codec`, by which the world draws, to that power of
    `stress`."""
    codec.stress.fill_(stress**USUAL)
    reach, rng = ahead(recording), np.random.default_rng([seed, 11])
    many = max((reach > SHOWN).sum() / 2, CLIPS)  # of the rows from which a dream may begin
    steps = next((steps for steps in STEPS if (reach >= SHOWN + steps).sum() >= many), 0)
    if not steps or stress < HARDLY:
        return USUAL
    begins = rng.choice(np.flatnonzero(reach >= SHOWN + steps), CLIPS, replace=False)
    chance = make_rng(seed)
    state = world.observe(recording.evidence(world.config, begins), None, chance)
    for row in range(1, SHOWN):
        state = world.imagine(state, recording.played(world.spec, begins + row - 1), chance)
        state = world.observe(recording.evidence(world.config, begins + row), state, chance)
    found, unlike = [], []
    for power in POWERS:
        codec.stress.fill_(stress**power)
        dreamt, chance, errors, counts = state, make_rng(seed), [], torch.ones(2)
        before = last = recording.rgb(begins + SHOWN - 1).float()
        for step in range(steps):
            rows = begins + SHOWN + step
            dreamt = world.imagine(dreamt, recording.played(world.spec, rows - 1), chance)
            drawn = world.render(dreamt, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float()
            truth = recording.rgb(rows).float()
            errors.append((drawn - truth).square().mean())
            counts += torch.stack(
                [((drawn - before).abs() > CHANGED).any(1).sum(), ((truth - last).abs() > CHANGED).any(1).sum()]
            )
            before, last = drawn, truth
        told = [2**doubled - 1 for doubled in range(6) if 2**doubled <= steps]
        found.append(float(torch.stack(errors)[told].clamp_min(1e-3).log().mean()))
        unlike.append(abs(float((counts[0] / counts[1]).log())))
    alike = [at for at, error in enumerate(found) if error <= min(found) + ALIKE]
    best = POWERS[min(alike, key=lambda at: unlike[at])]
    codec.stress.fill_(stress**best)
    return best
