"""Rollouts of a world from clips, under recorded actions or along true poses, with metrics of each step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.policy import Idle, Policy, Replay, act
from ..core.state import State
from ..core.world import Observation, World, without_end
from .clips import Clip, evidence
from .scorecard import IDLE, OTHERS, TRUE

Tick = Callable[[float], None]  # steps x clips done since the last call
Results = dict[str, torch.Tensor]


@dataclass(frozen=True)
class StepMetric:
    """Values that are kept of each step of a rollout."""

    channels: tuple[str, ...]  # to render
    # (observation, clips, row of the clips, step from 1) -> name -> [B, ...]
    measure: Callable[[Observation, Sequence[Clip], int, int], Mapping[str, torch.Tensor]]
    ends: bool = False  # all stand still after an end that the world predicts; else the rollout goes on as the clips do


def fold_context(world: World, clips: Sequence[Clip], rng: torch.Generator) -> State:
    """The state after the context frames, imagined and observed in turn. A world that observes nothing just starts."""
    if not world.spec.observes:
        return world.start(len(clips), rng)
    state = world.observe(evidence(clips, world.spec, 0), None, rng)
    for row in range(1, clips[0].context):
        state = world.imagine(state, actions_at(world, clips, row - 1), rng)
        state = world.observe(evidence(clips, world.spec, row), state, rng)
    return state


def actions_at(world: World, clips: Sequence[Clip], row: int) -> torch.Tensor:
    """The recorded action of row `row` of each clip: [B, *spec.action.shape]."""
    actions = torch.from_numpy(np.stack([np.asarray(clip.action[row]) for clip in clips]))
    return actions.reshape(len(clips), *(world.spec.action.shape or ()))


def recorded_policy(
    world: World, clips: Sequence[Clip], motion: str, steps: int, others: Sequence[Clip] | None = None
) -> Policy:
    """The policy after the context: the recorded actions, those of `others`, or none."""
    if motion == IDLE:
        return Idle(world.spec)
    source, first = (others or clips) if motion == OTHERS else clips, clips[0].context - 1
    return Replay(torch.stack([actions_at(world, source, first + step) for step in range(steps)]))


def dream(
    world: World,
    clips: Sequence[Clip],
    motion: str,
    steps: int,
    rng: torch.Generator,
    metrics: Sequence[StepMetric],
    others: Sequence[Clip] | None = None,
    tick: Tick = lambda done: None,
) -> Results:
    """Rolls a batch of clips out for `steps` steps after their context; the values of the metrics, [B, T, ...], T the steps that
    have a value."""
    state = fold_context(world, clips, rng)
    context = clips[0].context
    tick(len(clips) * context)
    policy = None if motion == TRUE else recorded_policy(world, clips, motion, steps, others)
    memory = policy.begin(len(clips), rng) if policy else None
    channels = tuple(dict.fromkeys(name for metric in metrics for name in metric.channels))
    kept: dict[str, list[torch.Tensor]] = {}
    ends = any(metric.ends for metric in metrics)
    seen: Observation = {}
    for step in range(1, steps + 1):
        row = context - 1 + step
        if policy is None:
            state = world.observe({"pose": poses_at(clips, row)}, state, rng)
        else:
            action, memory = act(policy, seen, memory, len(clips), world.spec, rng)
            state = world.imagine(state if ends else without_end(state), action, rng)
        seen = {name: tensor.cpu() for name, tensor in world.render(state, channels).items()}
        for metric in metrics:
            for name, value in metric.measure(seen, clips, row, step).items():
                kept.setdefault(name, []).append(value)
        tick(len(clips))
    return {name: torch.stack(values, 1) for name, values in kept.items()}


def rows_at(clips: Sequence[Clip], channel: str, row: int) -> torch.Tensor:
    """The recorded channel in row `row` of each clip: [B, ...]."""
    return torch.from_numpy(np.stack([np.asarray(clip.channels[channel][row]) for clip in clips]))


def poses_at(clips: Sequence[Clip], row: int) -> torch.Tensor:
    """The recorded pose of row `row` of each clip: float32 [B, 7]; DatasetError where a clip has none."""
    if any(clip.pose is None for clip in clips):
        raise DatasetError("these clips have no poses; record them, or leave true motion out.")
    return rows_at(clips, "pose", row).float()
