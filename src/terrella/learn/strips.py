"""Strips: pictures of a held-out stretch of a recording above rollouts of worlds, to look at while they train."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ..core.world import make_rng, without_end
from ..worlds.learned import LearnedWorld
from ..worlds.parts import newest_frame
from .recording import Recording


def draw_strip(worlds: Sequence[LearnedWorld], recording: Recording, path: Path) -> None:
    """64 steps of the first held-out episode, every 8th frame: the truth above a rollout of each world."""
    first, last = recording.cache.episodes[(recording.held_out or (0,))[0]]
    rows = np.arange(max(first, min(first + 40, last - 65)), last)[:65]
    lines = [recording.rgb(rows[::8]), *(_dream(world, recording, rows) for world in worlds)]
    write_lines(lines, path)


def write_lines(lines: Sequence[torch.Tensor], path: Path) -> None:
    """Writes `lines`, uint8 [n, 3, H, W] each, one below the other, as one picture."""
    picture = torch.cat([torch.cat(list(line), 2) for line in lines], 1).permute(1, 2, 0).numpy()
    Image.fromarray(picture).save(path)


@torch.inference_mode()
def _dream(world: LearnedWorld, recording: Recording, rows: np.ndarray) -> torch.Tensor:
    """Every 8th frame of a rollout from the first of `rows`, along the recorded poses or, in a world without poses or with moving
    things, under the recorded actions."""
    rng, config = make_rng(1), world.config
    state = world.observe(recording.evidence(config, rows[:1]), None, rng)
    frames = [newest_frame(state)]
    for row in rows[1:]:
        if config.geometry and not config.moving:  # what moves depends on actions
            state = world.observe({"pose": recording.pose([row])}, state, rng)
        else:
            state = world.imagine(without_end(state), recording.recorded_actions(world.spec, [row - 1]), rng)
        frames.append(newest_frame(state))
    return torch.cat(frames)[::8].cpu()
