"""Learning to move: the motion model of a VideoWorld from recorded poses, then the body that slides along walls."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from ..space.camera import yaw
from ..space.floorplan import floor_plan, slide
from ..space.keyframes import Keyframes
from ..worlds.generator import VideoConfig
from ..worlds.motion import Motion
from .samples import Recording
from .updates import Report

_WINDOWS, _LENGTH = 512, 24  # walks, and steps of each, on which the body is fitted


def train_motion(
    motion: Motion, recording: Recording, memory: Keyframes, config: VideoConfig, steps: int, seed: int, report: Report
) -> dict[str, float]:
    """Fits `motion` in place; returns the body that fits best (`body_m`, `short`), and how far off it is after 24 steps
    (mean, metres)."""
    torch.manual_seed(seed)
    rows, inputs, targets, ended = _steps(recording, config)
    places = inputs["place"]
    motion.middle.copy_((places.amin(0) + places.amax(0)) / 2)
    motion.span.copy_((places.amax(0) - places.amin(0)).max().clamp_min(1e-3))
    optimiser = torch.optim.Adam(motion.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2, total_steps=steps)
    rng = np.random.default_rng(seed)
    rare = np.flatnonzero(ended.numpy())
    for step in range(steps):
        pick = torch.from_numpy(rng.integers(0, len(rows), 512))
        turn_loss, move_loss = _losses(motion, inputs, targets, pick)
        if len(rare):
            pick[:64] = torch.from_numpy(rng.choice(rare, 64))
        logit = motion.ends(inputs["place"][pick], inputs["actions"][pick, -1])
        ending = F.binary_cross_entropy_with_logits(logit, ended[pick].float())
        optimiser.zero_grad()
        (turn_loss + move_loss + 0.1 * ending).backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0:
            report(step, steps, f"motion: {10 * move_loss.item():.2f} cm off a step")
    if not len(rare):  # nothing was seen to end
        last = list(motion.ending.parameters())[-2:]
        last[0].data.zero_()
        last[1].data.fill_(-20.0)
    return _fit_body(motion, recording, memory, config, rng)


def _losses(motion, inputs, targets, pick):
    """Of absolute errors: steps against a wall are fewer than free ones, so that the fit is that of the free ones."""
    heading, wish = motion(*(inputs[name][pick] for name in ("heading", "speed", "actions")))
    off = heading - targets["heading"][pick]
    turn = torch.atan2(off.sin(), off.cos()).abs().mean() * 20
    return turn, (wish - targets["moved"][pick]).abs().sum(-1).mean() * 10


def _steps(recording: Recording, config: VideoConfig):
    cache = recording.cache
    pose = torch.from_numpy(np.array(cache.pose))
    place, heading = pose[:, :2], yaw(pose)
    number = np.arange(cache.length)
    usable = recording.usable & np.roll(recording.usable, -1) & np.array(cache.action_valid)
    usable &= (number - recording.start >= 1) & (number + 1 < cache.length)
    rows = np.flatnonzero(usable)
    index = torch.from_numpy(rows)
    inputs = {
        "heading": heading[index],
        "speed": place[index] - place[index - 1],
        "actions": _actions(recording, rows, config.history),
        "place": place[index + 1],
    }
    targets = {"heading": heading[index + 1], "moved": place[index + 1] - place[index]}
    return (
        rows,
        inputs,
        targets,
        torch.from_numpy(np.zeros(len(rows), bool) if cache.done is None else np.array(cache.done)[rows]),
    )


def _actions(recording: Recording, rows: np.ndarray, history: int) -> torch.Tensor:
    """Actions [n, history + 1, A] up to each of `rows`; none before an episode's first."""
    back = rows[:, None] + np.arange(-history, 1)
    action = (
        np.asarray(recording.cache.action)[np.maximum(back, 0)] * (back >= recording.start[rows][:, None])[..., None]
    )
    return torch.from_numpy(action.astype(np.float32))


@torch.no_grad()
def _fit_body(motion: Motion, recording: Recording, memory: Keyframes, config: VideoConfig, rng) -> dict[str, float]:
    """The body whose walks end nearest to the recorded ones: coarse widths first, then finer ones around the best."""
    usable = np.append(0, np.cumsum(recording.usable & np.array(recording.cache.action_valid)))
    first = np.arange(2, recording.cache.length - _LENGTH)
    whole = usable[first + _LENGTH + 1] - usable[first - 1] == _LENGTH + 2
    first = first[whole & (recording.start[first - 1] == recording.start[first + _LENGTH])]
    if not len(first):
        return {"body_m": 0.0, "short": 0.0}  # no walk is long enough to tell: nothing will stop it
    first = rng.choice(first, min(_WINDOWS, len(first)), replace=False)
    walls = floor_plan(memory.walls, memory.pose)
    errors = {}

    def off(half: float, short: float) -> float:
        if (half, short) not in errors:
            errors[half, short] = _walked_off(motion, recording, config, first, walls, half, short)
        return errors[half, short]

    best, short = min((off(half, 0.0), half) for half in np.linspace(0.0, 1.0, 21).tolist())[1], 0.0
    for reach in (0.04, 0.01, 0.003, 0.001):  # each on what the other was found to be
        near = [half for side in (-1, -0.5, 0, 0.5, 1) if (half := best + reach * side) >= 0]
        best = min((off(half, short), half) for half in near)[1]
        error, short = min((off(best, share), share) for share in (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8))
    return {"body_m": best, "short": short, "motion_error_m": error}


def _walked_off(motion, recording: Recording, config, first: np.ndarray, walls, half: float, short: float) -> float:
    """Mean distance in metres from the recorded places after `_LENGTH` steps from the rows `first`."""
    pose = recording.pose(first)
    place, heading = pose[:, :2], yaw(pose)
    speed = place - recording.pose(first - 1)[:, :2]
    for step in range(_LENGTH):
        heading, wish = motion(heading, speed, _actions(recording, first + step, config.history))
        moved, speed = slide(walls, place, wish, half, short)
        place = place + moved
    return float((place - recording.pose(first + _LENGTH)[:, :2]).norm(dim=-1).mean())
