"""Fog: whether a world that scrolls keeps to the ground that its recordings saw, and shows fog beyond it."""

from dataclasses import replace

import numpy as np
import torch

from ...core import make_rng
from ...worlds.frame_history import FrameHistory
from ...worlds.learned import LearnedWorld
from ..moves import ground_of
from ..recording import Recording
from .stress import SHOWN, observed, steps_ahead

FOG_PX = 12  # see HistoryConfig
WIDER = 1.5  # times the area of a picture that a ground must have
STEPS, CLIPS = 32, 12  # of the rollouts, and their number
FEWEST_CLIPS = 4


def choose_fog(
    world: LearnedWorld, scene: FrameHistory, recording: Recording, seed: int, clips: int = CLIPS
) -> FrameHistory:
    """The scene of `world` with the recording's ground and fog beyond it, if `clips` rollouts of recorded episodes are nearer to
    the truth with that; else as it is."""
    begins = np.flatnonzero(steps_ahead(recording) >= SHOWN + STEPS)
    if not len(begins) or len(scene.moves) < 2 or clips < FEWEST_CLIPS:
        return scene
    ground = ground_of(recording, scene.moves, scene.over)
    height, width = scene.config.size
    if (ground[3] > 0).sum() < WIDER * height * width:
        return scene
    begins = np.random.default_rng([seed, 12]).choice(begins, clips)
    fog = FrameHistory(replace(scene.config, fog_px=FOG_PX), scene.starts, scene.over, ground)
    errors = [_error(world.replaced(scene=one), recording, begins, seed) for one in (scene, fog)]
    return fog if errors[1] < errors[0] else scene


@torch.inference_mode()
def _error(world: LearnedWorld, recording: Recording, begins: np.ndarray, seed: int) -> float:
    """The mean squared error of the frames of rollouts."""
    chance = make_rng(seed)
    state, errors = observed(world, recording, begins, SHOWN, chance), []
    for step in range(STEPS):
        rows = begins + SHOWN + step
        state = world.imagine(state, recording.recorded_actions(world.spec, rows - 1), chance)
        drawn = world.render(state, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).float()
        errors.append((drawn - recording.rgb(rows).float()).square().mean())
    return float(torch.stack(errors).mean())
