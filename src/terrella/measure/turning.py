"""The actions that turn the camera or scroll the picture, from trials or recordings, not from their names."""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from gymnasium import spaces

from ..core.spec import Spec
from ..core.world import World, without_end
from ..space.camera import yaw
from ..space.matching import scroll_index
from .clips import Clip
from .rollouts import fold_context

TRIAL_STEPS, MIN_TURN_RAD = 4, math.radians(0.2)  # steps of a trial; least turn per step
REACH, MIN_SCROLL = 8, 0.5  # largest and least scroll per step, in pixels


def turning_actions(
    world: World, clips: Sequence[Clip], rng: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, str, float] | None:
    """Two actions that turn the camera left and right, their names, and radians per step; None if none do.

    Each button, choice or limit of an axis is tried by itself if the world has a pose; else their shares of the recorded turning
    are fitted by least squares.
    """
    candidates = _candidates(world.spec)
    if not candidates:
        return None
    if "pose" in world.spec.channels and world.spec.forkable:
        rates = _turn_rates_by_trial(world, clips[:1], [action for _, action in candidates], rng)
    elif clips[0].pose is not None:
        rates = _turn_rates_by_regression(world.spec, clips, [action for _, action in candidates])
    else:
        return None
    left, right = int(rates.argmax()), int(rates.argmin())
    speed = min(float(rates[left]), -float(rates[right]))
    if speed < MIN_TURN_RAD:
        return None
    return candidates[left][1], candidates[right][1], f"{candidates[left][0]} and {candidates[right][0]}", speed


def scrolling_actions(
    world: World, clips: Sequence[Clip], rng: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, str, float] | None:
    """Two actions that scroll the picture one way and back, their names, and pixels per step; None if no two do. Each is tried
    from each of the clips; the largest scroll counts, since some are blocked."""
    candidates = _candidates(world.spec)
    span = range(-REACH, REACH + 1)
    moves = torch.tensor(sorted(((x, y) for x in span for y in span), key=lambda move: abs(move[0]) + abs(move[1])))
    first, went = fold_context(world, clips, rng), []
    for _, action in candidates:
        state, frames = first, []
        for step in range(TRIAL_STEPS + 1):
            if step:
                state = world.imagine(without_end(state), action.expand(len(clips), *action.shape), rng)
            frames.append(world.render(state, ("rgb",))["rgb"].cpu().permute(0, 3, 1, 2).contiguous())
        scrolls = [moves[scroll_index(*pair, moves)] for pair in zip(frames, frames[1:])]
        steps = torch.stack(scrolls).float().sum(0) / TRIAL_STEPS
        went.append(steps[steps.abs().sum(1).argmax()])
    best = None
    for a, b in combinations(range(len(went)), 2):
        speed = min(float(went[a].norm()), float(went[b].norm()))
        if speed >= MIN_SCROLL and (went[a] + went[b]).norm() <= 0.5 * speed and (best is None or speed > best[3]):
            best = candidates[a][1], candidates[b][1], f"{candidates[a][0]} and {candidates[b][0]}", speed
    return best


def _candidates(spec: Spec) -> list[tuple[str, torch.Tensor]]:
    """Every button, choice, or limit of an axis by itself, the others neutral."""
    low, high = (np.asarray(limit) for limit in spec.action_limits)
    if isinstance(spec.action, spaces.Discrete):
        first = int(spec.action.start)
        names = spec.action_names or tuple(map(str, range(int(spec.action.n))))
        return [(name, torch.tensor(first + number)) for number, name in enumerate(names)]
    rest = np.clip(np.zeros_like(low), low, high)
    candidates, names = [], spec.action_names
    for place in range(low.size):
        name = names[place] if place < len(names) else f"action {place}"
        ends = (low.flat[place], high.flat[place]) if low.dtype.kind == "f" else (high.flat[place],)
        for end in ends:
            if np.isfinite(end) and end != rest.flat[place]:
                action = rest.copy()
                action.flat[place] = end
                signed = f"{'-' if end < 0 else '+'}{name}" if len(ends) > 1 else name
                candidates.append((signed, torch.from_numpy(action)))
    return candidates


def _turn_rates_by_trial(
    world: World, clips: Sequence[Clip], actions: Sequence[torch.Tensor], rng: torch.Generator
) -> torch.Tensor:
    """Radians per step by which each action turns the camera to the left, by trials in the world."""
    first = fold_context(world, clips, rng)
    turned = []
    for action in actions:
        state = first
        for _ in range(TRIAL_STEPS):
            state = world.imagine(without_end(state), action.expand(1, *action.shape), rng)
        seen = [world.render(each, ("pose",))["pose"].float().cpu() for each in (first, state)]
        turned.append(_angle(yaw(seen[1]) - yaw(seen[0]))[0] / TRIAL_STEPS)
    return torch.stack(turned)


def _turn_rates_by_regression(spec: Spec, clips: Sequence[Clip], actions: Sequence[torch.Tensor]) -> torch.Tensor:
    """The same from recordings: the yaw of each step regressed on the buttons, choices or axes."""

    def features(rows: np.ndarray) -> torch.Tensor:
        flat = torch.from_numpy(np.array(rows, np.float64)).reshape(len(rows), -1)
        if isinstance(spec.action, spaces.Discrete):
            flat = torch.nn.functional.one_hot(flat[:, 0].long() - int(spec.action.start), int(spec.action.n)).double()
        return flat

    posed = [(clip, yaw(torch.from_numpy(np.array(clip.pose)))) for clip in clips if clip.pose is not None]
    change = torch.cat([_angle(heading.diff()) for _, heading in posed]).double()
    played = features(np.concatenate([np.asarray(clip.action[:-1]) for clip, _ in posed]))
    still = torch.eye(played.shape[1], dtype=torch.float64) * 1e-3  # actions never played get 0
    target = torch.cat([change, torch.zeros(len(still)).double()])
    shares = torch.linalg.lstsq(torch.cat([played, still]), target).solution
    return features(np.stack([action.numpy() for action in actions])) @ shares


def _angle(turn: torch.Tensor) -> torch.Tensor:
    return torch.remainder(turn + torch.pi, 2 * torch.pi) - torch.pi
