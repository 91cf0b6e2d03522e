"""Stress: training weighs pixels that change more than others; how much of that bias is corrected when frames are drawn."""

import numpy as np
import torch

from ...core import make_rng
from ...core.state import State
from ...worlds.codec import Codec
from ...worlds.learned import LearnedWorld
from ..recording import Recording

# Powers of the weight by which the logits are corrected. With a small one objects are drawn where they are unlikely, with a large
# one small objects fade.
POWERS, USUAL = (0.5, 0.7, 1.0, 1.4), 0.7
NEGLIGIBLE = 1.5  # a weight below which the power hardly matters
SHOWN, STEPS, CLIPS = 8, (32, 16, 8, 4), 12  # observed frames, steps of a rollout, and rollouts
FRAMES = CLIPS * (SHOWN + STEPS[0] * len(POWERS))  # drawn at most
TOLERANCE = 0.115  # of the logarithm of errors, half a decibel: closer errors count as equal
CHANGED = 8  # difference of 255 from the step before above which a pixel has changed


def steps_ahead(recording: Recording) -> np.ndarray:
    """For each row [N], the number of steps that can be rolled out from it: consecutive usable rows of its episode."""
    fine = recording.usable & np.asarray(recording.cache.action_valid)
    if recording.cache.done is not None:
        fine &= ~np.asarray(recording.cache.done)
    last = np.append(recording.start[1:] != recording.start[:-1], True)
    ends = np.flatnonzero(~fine | last)
    rows = np.arange(len(fine))
    end = ends[np.searchsorted(ends, rows)]
    return np.where(fine, end - rows + fine[end], 0)


def observed(
    world: LearnedWorld, recording: Recording, begins: np.ndarray, shown: int, chance: torch.Generator
) -> State:
    """The state of `world` that has observed `shown` rows from each of `begins` on, under the recorded actions."""
    state = world.observe(recording.evidence(world.config, begins), None, chance)
    for row in range(1, shown):
        state = world.imagine(state, recording.recorded_actions(world.spec, begins + row - 1), chance)
        state = world.observe(recording.evidence(world.config, begins + row), state, chance)
    return state


@torch.inference_mode()
def choose_stress(
    world: LearnedWorld, codec: Codec, recording: Recording, stress: float, seed: int, frames: int = FRAMES
) -> float:
    """The power of POWERS with which rollouts of recorded episodes have the lowest error, by the mean logarithm of the pooled
    squared error after 1, 2, 4, ... steps; among nearly equal ones, the power with which as many pixels change in a step as in the
    recording (motion that stops or fades costs hardly any error). At most `frames` are drawn. Sets the `stress` of `codec` to that
    power of `stress`."""
    codec.stress.fill_(stress**USUAL)
    length, rng = steps_ahead(recording), np.random.default_rng([seed, 11])
    many = max((length > SHOWN).sum() / 2, CLIPS)  # of the rows from which a rollout may begin
    fits = [steps for steps in STEPS if CLIPS * (SHOWN + steps * len(POWERS)) <= frames]
    steps = next((steps for steps in fits if (length >= SHOWN + steps).sum() >= many), 0)
    if not steps or stress < NEGLIGIBLE:
        return USUAL
    begins = rng.choice(np.flatnonzero(length >= SHOWN + steps), CLIPS, replace=False)
    state = observed(world, recording, begins, SHOWN, make_rng(seed))
    errors_of, change_off = [], []
    for power in POWERS:
        codec.stress.fill_(stress**power)
        dreamt, chance, errors, counts = state, make_rng(seed), [], torch.ones(2)
        before = last = recording.rgb(begins + SHOWN - 1).float()
        for step in range(steps):
            rows = begins + SHOWN + step
            dreamt = world.imagine(dreamt, recording.recorded_actions(world.spec, rows - 1), chance)
            drawn = world.render(dreamt, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float()
            truth = recording.rgb(rows).float()
            errors.append((drawn - truth).square().mean())
            counts += torch.stack(
                [((drawn - before).abs() > CHANGED).any(1).sum(), ((truth - last).abs() > CHANGED).any(1).sum()]
            )
            before, last = drawn, truth
        doubled = [2**n - 1 for n in range(6) if 2**n <= steps]
        errors_of.append(float(torch.stack(errors)[doubled].clamp_min(1e-3).log().mean()))
        change_off.append(abs(float((counts[0] / counts[1]).log())))
    best_ones = [at for at, error in enumerate(errors_of) if error <= min(errors_of) + TOLERANCE]
    best = POWERS[min(best_ones, key=lambda at: change_off[at])]
    codec.stress.fill_(stress**best)
    return best
