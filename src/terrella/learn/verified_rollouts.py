"""Groups of imagined rollouts from the same starts, rewarded by a rule that is computed in the world's state, not learned.

A group's rollouts differ in what the policy drew alone, so that the reward above the group's mean is an advantage without a critic
(GRPO, Shao et al. 2024).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from ..act.choices import Choices, ExploringPolicy
from ..act.planning import SuccessCriterion, distance
from ..core.errors import DatasetError, TrainingError
from ..core.spec import kind_of
from ..core.state import State
from ..core.world import Observation, World, make_rng
from .latent_validation import observation_at
from .recording import Recording
from .train_step import TrainStep

SHOWN_BLIND = ("text", "instruction")  # kinds of channels that the blind arm sees: its task, not the world


@dataclass(frozen=True)
class GroupedRollouts:
    """D decisions of each of B = groups * size rollouts, the rollouts of a group in a row."""

    choices: Choices  # of D * B decisions, one step's after the other's
    weight: torch.Tensor  # float32 [D, B]: 1 until a rollout is over, then 0
    reward: torch.Tensor  # float32 [groups, size]


class GroupStarts(Protocol):
    """Where groups begin, and what their rollouts are compared with."""

    def begin(self, groups: int, now: TrainStep) -> tuple[State, Observation]:
        """States [groups], and recorded channels [groups, T + 1, ...] from there on, NaN after an episode's end; {} for none."""
        ...


@dataclass(frozen=True)
class WorldStarts:
    """The world's own starts."""

    world: World

    def begin(self, groups: int, now: TrainStep) -> tuple[State, Observation]:
        return self.world.start(groups, now.seeding), {}


class ReferenceStarts:
    """The starts of a recording's episodes, with what the episodes show of `channels` (vectors) for `steps` steps. DatasetError for
    a recording that lacks what the world observes."""

    def __init__(self, world: World, recording: Recording, channels: tuple[str, ...], steps: int):
        lacks = [
            name for name in (*world.spec.observes, *channels) if name not in recording.cache.keys and name != "rgb"
        ]
        if lacks:
            raise DatasetError(
                f"{recording.name} does not hold {lacks[0]}, which {world.spec.name} observes: a reference is for a learned "
                "world of the same channels."
            )
        first = np.intersect1d(recording.start, np.flatnonzero(recording.usable))
        ends = dict(recording.cache.episodes)
        rows = np.minimum(first[:, None] + np.arange(steps + 1), [[ends[int(at)] - 1] for at in first])
        over = torch.from_numpy(rows < first[:, None] + np.arange(steps + 1))
        self.states = world.observe(observation_at(world, recording, first), None, make_rng(0))
        self.paths = {}
        for name in channels:
            array = recording.cache.arrays[recording.cache.keys.get(name, name)]
            path = torch.from_numpy(np.asarray(array[rows.ravel()], np.float32)).reshape(*rows.shape, -1)
            self.paths[name] = path.masked_fill(over[..., None], torch.nan)

    def begin(self, groups: int, now: TrainStep) -> tuple[State, Observation]:
        rows = torch.from_numpy(now.rng.integers(self.states.batch, size=groups))
        return self.states.at(rows.to(self.states.device)), {name: path[rows] for name, path in self.paths.items()}


class VerifiedRollouts:
    """A feed of `groups` groups of `size` rollouts of `steps` steps. The reward is 1 where the criterion is met within the steps,
    else 0; in a world with references minus the mean distance to them; without a criterion the world's own return.

    blind: the policy sees the first observation of one start at every step instead of the world's.
    """

    least = 1

    def __init__(
        self,
        world: World,
        policy: ExploringPolicy,
        starts: GroupStarts,
        criterion: SuccessCriterion,
        steps: int,
        shape: tuple[int, int],
        blind: bool = False,
    ):
        self.world, self.policy, self.starts, self.criterion, self.steps = world, policy, starts, criterion, steps
        self.groups, self.of_group = shape
        spec, most = world.spec, world.spec.max_batch
        if not spec.forkable or (most is not None and most < self.groups * self.of_group):
            raise TrainingError(
                f"{spec.name} cannot imagine {self.groups} x {self.of_group} episodes from the same starts; give fewer (--groups, "
                "--group-size), or learn a world of it first."
            )
        self.mask = dict(world.render(world.start(1, make_rng(0)), policy.sees)) if blind else {}
        self.mask = {name: value for name, value in self.mask.items() if kind_of(name) not in SHOWN_BLIND}

    @property
    def size(self) -> int:
        """Groups of a batch."""
        return self.groups

    def resize(self, size: int) -> None:
        self.groups = size

    @torch.no_grad()
    def batch(self, now: TrainStep) -> GroupedRollouts:
        world, criterion, count = self.world, self.criterion, self.groups * self.of_group
        state, paths = self.starts.begin(self.groups, now)
        state = state.fork(self.of_group)
        paths = {name: path.repeat_interleave(self.of_group, 0) for name, path in paths.items()}
        outcome = [name for name in ("done", "reward") if name in world.spec.channels]
        channels = tuple(dict.fromkeys((*self.policy.sees, *criterion.channels, *outcome, *paths)))
        memory, choices, weights = self.policy.begin(count, now.seeding), list[Choices](), list[torch.Tensor]()
        seen = world.render(state, channels)
        going, success, total = torch.ones(count), torch.zeros(count), torch.zeros(count)
        away = [self._apart(paths, seen, 0)] if paths else []
        for step in range(self.steps):
            shown = {name: self._shown(name, seen[name]) for name in self.policy.sees}
            action, memory, chosen = self.policy.explore(shown, memory, now.seeding)
            if chosen is not None:
                choices.append(chosen)
                weights.append(going.clone())
            state = world.imagine(state, action.to(state.device), now.seeding)
            seen = world.render(state, channels)
            if "reward" in seen:
                total += going * seen["reward"].cpu().float()
            over = seen["done"].cpu().float() if "done" in seen else torch.zeros(count)
            if criterion.defined:
                reached = criterion.succeeded(world, seen).cpu().float() * going
                success, over = success + reached, torch.maximum(over, reached)
            if paths:
                away.append(torch.where(going > 0, self._apart(paths, seen, step + 1), torch.nan))
            going = going * (1 - over)
        reward = -torch.stack(away).nanmean(0) if paths else success if criterion.defined else total
        return GroupedRollouts(Choices.join(choices), torch.stack(weights), reward.view(self.groups, self.of_group))

    def state(self) -> dict:
        return {}

    def resume(self, state: Mapping) -> None:
        pass

    def _shown(self, name: str, value: torch.Tensor) -> torch.Tensor:
        return self.mask[name].expand_as(value) if name in self.mask else value

    def _apart(self, paths: Observation, seen: Observation, step: int) -> torch.Tensor:
        """The distance [B] to the references after a step; NaN where they have ended."""
        wanted = {name: path[:, step] for name, path in paths.items()}
        known = torch.stack([value.isfinite().any(1) for value in wanted.values()]).all(0)
        flat = {name: seen[name].cpu().reshape(len(known), -1) for name in wanted}
        return torch.where(known, distance(self.world.spec, wanted, flat), torch.nan)
