"""Which actions turn the camera, or scroll the picture: found by trying them, or in what was recorded, never by their names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from gymnasium import spaces

from ..core.spec import Spec
from ..core.world import World
from ..space.camera import yaw
from ..space.matching import scrolled
from .clips import Clip
from .rollouts import fold_context

TRIED, TURNS_RAD = 4, math.radians(0.2)  # steps that an action is tried for; what turns less in a step does not turn
REACH, SCROLLS = 8, 0.5  # pixels that a picture may go in a step, either way; what goes less does not scroll


def turning_actions(
    world: World, clips: Sequence[Clip], rng: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, str, float] | None:
    """Two actions that turn the camera one way and the other, their name, and radians a step; None where nothing does.

    Each button, choice or end of an axis is tried by itself in the world where it shows its pose; else their part in the
    recorded turning is read off by least squares. Nobody needs to name a key TURN_LEFT.
    """
    candidates = _candidates(world.spec)
    if not candidates:
        return None
    if "pose" in world.spec.channels and world.spec.forkable:
        rates = _tried(world, clips[:1], [action for _, action in candidates], rng)
    elif clips[0].pose is not None:
        rates = _read_off(world.spec, clips, [action for _, action in candidates])
    else:
        return None
    left, right = int(rates.argmax()), int(rates.argmin())
    speed = min(float(rates[left]), -float(rates[right]))
    if speed < TURNS_RAD:
        return None
    return candidates[left][1], candidates[right][1], f"{candidates[left][0]} and {candidates[right][0]}", speed


def scrolling_actions(
    world: World, clips: Sequence[Clip], rng: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, str, float] | None:
    """Two actions that scroll the picture one way and back, their name, and pixels a step; None where no two do. Each is tried in
    this world, which shows `rgb`, from each of the clips; the steps that scroll furthest count, for some are blocked."""
    candidates = _candidates(world.spec)
    span = range(-REACH, REACH + 1)
    moves = torch.tensor(sorted(((x, y) for x in span for y in span), key=lambda move: abs(move[0]) + abs(move[1])))
    first, went = fold_context(world, clips, rng), []
    for _, action in candidates:
        state, frames = first, []
        for step in range(TRIED + 1):
            state = state if step == 0 else world.imagine(state, action.expand(len(clips), *action.shape), rng)
            frames.append(world.render(state, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).contiguous())
        steps = torch.stack([moves[scrolled(*pair, moves)] for pair in zip(frames, frames[1:])]).float().sum(0) / TRIED
        went.append(steps[steps.abs().sum(1).argmax()])
    best = None
    for a, b in combinations(range(len(went)), 2):
        speed = min(float(went[a].norm()), float(went[b].norm()))
        if speed >= SCROLLS and (went[a] + went[b]).norm() <= 0.5 * speed and (best is None or speed > best[3]):
            best = candidates[a][1], candidates[b][1], f"{candidates[a][0]} and {candidates[b][0]}", speed
    return best


def _candidates(spec: Spec) -> list[tuple[str, torch.Tensor]]:
    """Every button, choice, or end of an axis by itself, the others at rest."""
    low, high = (np.asarray(limit) for limit in spec.action_limits)
    if isinstance(spec.action, spaces.Discrete):
        first = int(spec.action.start)
        names = spec.action_names or tuple(map(str, range(int(spec.action.n))))
        return [(name, torch.tensor(first + number)) for number, name in enumerate(names)]
    rest = np.clip(np.zeros_like(low), low, high)
    found, names = [], spec.action_names
    for place in range(low.size):
        name = names[place] if place < len(names) else f"action {place}"
        ends = (low.flat[place], high.flat[place]) if low.dtype.kind == "f" else (high.flat[place],)
        for end in ends:
            if np.isfinite(end) and end != rest.flat[place]:
                action = rest.copy()
                action.flat[place] = end
                signed = f"{'-' if end < 0 else '+'}{name}" if len(ends) > 1 else name
                found.append((signed, torch.from_numpy(action)))
    return found


def _tried(world: World, clips: Sequence[Clip], actions: Sequence[torch.Tensor], rng: torch.Generator) -> torch.Tensor:
    """Radians a step that each action turns the camera to the left, in this world."""
    first = fold_context(world, clips, rng)
    turned = []
    for action in actions:
        state = first
        for _ in range(TRIED):
            state = world.imagine(state, action.expand(1, *action.shape), rng)
        seen = [world.render(each, ("pose",))["pose"].float().cpu() for each in (first, state)]
        turned.append(_angle(yaw(seen[1]) - yaw(seen[0]))[0] / TRIED)
    return torch.stack(turned)


def _read_off(spec: Spec, clips: Sequence[Clip], actions: Sequence[torch.Tensor]) -> torch.Tensor:
    """The same, of the recordings: the yaw of each step as a sum of what each button, choice or axis adds."""

    def features(rows: np.ndarray) -> torch.Tensor:
        flat = torch.from_numpy(np.array(rows, np.float64)).reshape(len(rows), -1)
        if isinstance(spec.action, spaces.Discrete):
            flat = torch.nn.functional.one_hot(flat[:, 0].long() - int(spec.action.start), int(spec.action.n)).double()
        return flat

    posed = [(clip, yaw(torch.from_numpy(np.array(clip.pose)))) for clip in clips if clip.pose is not None]
    change = torch.cat([_angle(heading.diff()) for _, heading in posed]).double()
    played = features(np.concatenate([np.asarray(clip.action[:-1]) for clip, _ in posed]))
    still = torch.eye(played.shape[1], dtype=torch.float64) * 1e-3  # what was never played adds nothing
    parts = torch.linalg.lstsq(
        torch.cat([played, still]), torch.cat([change, torch.zeros(len(still)).double()])
    ).solution
    return features(np.stack([action.numpy() for action in actions])) @ parts


def _angle(turn: torch.Tensor) -> torch.Tensor:
    return torch.remainder(turn + torch.pi, 2 * torch.pi) - torch.pi
