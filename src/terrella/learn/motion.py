"""Learning to move: the motion model of a VideoWorld, one step at a time from recorded poses and felt walls."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F

from ..space.camera import yaw
from ..space.floorplan import clearance, wall_segments
from ..space.keyframes import Keyframes
from ..worlds.video import Motion, VideoConfig
from .samples import Recording

MOST_STEPS = 24_000  # recorded steps that are looked at


def train_motion(
    motion: Motion, recording: Recording, memory: Keyframes, config: VideoConfig, steps: int, seed: int,
    report: Callable[[int, int, str], None],
) -> dict[str, float]:  # fmt: skip
    """Fits `motion` in place; returns how near the body came to walls, and the median and mean
    error of a step's displacement, all in metres."""
    torch.manual_seed(seed)
    rows, inputs, targets, ended = _steps(recording, memory, config)
    optimiser = torch.optim.Adam(motion.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    rng = np.random.default_rng(seed)
    rare = np.flatnonzero(ended.numpy())
    for step in range(steps):
        pick = torch.from_numpy(rng.integers(0, len(rows), 512))
        turn_loss, move_loss = _losses(motion, inputs, targets, pick)
        if len(rare):
            pick[:64] = torch.from_numpy(rng.choice(rare, 64))
        place, action = inputs["place"][pick], inputs["actions"][pick, -1]
        ending = F.binary_cross_entropy_with_logits(motion.ends(place, action), ended[pick].float())
        optimiser.zero_grad()
        (turn_loss + move_loss + 0.1 * ending).backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0:
            report(step, steps, f"motion: {10 * move_loss.item():.2f} cm off a step")
    if not len(rare):
        list(motion.ending.parameters())[-1].data.fill_(-20.0)  # nothing was seen to end
    with torch.no_grad():
        every = torch.arange(len(rows))
        _, moved = motion(inputs["heading"], inputs["moved"], inputs["actions"], inputs["free"])
        error = (moved - targets["moved"]).norm(dim=-1)[every]
    body = 0.95 * float(inputs["free"].amin(1).quantile(0.02))  # a corner may deceive the felt distance a little
    return {"body_m": body, "motion_error_median_m": float(error.median()), "motion_error_mean_m": float(error.mean())}


def _losses(motion, inputs, targets, pick):
    heading, moved = motion(*(inputs[name][pick] for name in ("heading", "moved", "actions", "free")))
    off = heading - targets["heading"][pick]
    turn = torch.atan2(off.sin(), off.cos()).abs().mean() * 20
    return turn, (moved - targets["moved"][pick]).abs().sum(-1).mean() * 10


def _steps(recording: Recording, memory: Keyframes, config: VideoConfig):
    cache, span = recording.cache, config.history
    pose = torch.from_numpy(np.array(cache.pose))
    place, heading = pose[:, :2], yaw(pose)
    action = torch.from_numpy(np.array(cache.action))
    valid = np.array(cache.action_valid)
    number = np.arange(cache.length)
    usable = recording.usable & np.roll(recording.usable, -1) & valid & (number - recording.start >= 1)
    rows = np.flatnonzero(usable)
    rows = rows[rows + 1 < cache.length]
    if len(rows) > MOST_STEPS:  # enough: the rest of a long recording says the same
        keep = np.random.default_rng(0).choice(rows, MOST_STEPS, replace=False)
        rows = np.union1d(keep, rows[np.array(cache.done)[rows]])
    index = torch.from_numpy(rows)
    back = index[:, None] + torch.arange(-span, 1)
    seen = back >= torch.from_numpy(recording.start[rows])[:, None]
    history = action[back.clamp_min(0)] * seen[..., None]
    walls = wall_segments(memory.depth, memory.pose, config.camera).flatten(0, 1)
    inputs = {
        "heading": heading[index],
        "moved": place[index] - place[index - 1],
        "actions": history,
        "place": place[index + 1],
        "free": clearance(walls, place[index], config.directions),
    }
    targets = {"heading": heading[index + 1], "moved": place[index + 1] - place[index]}
    return rows, inputs, targets, torch.from_numpy(np.array(cache.done)[rows])
