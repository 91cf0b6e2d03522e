"""Episodes of a policy in a world, judged: what they were paid, whether they reached a goal, how long each decision took."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from ...core.errors import PlanningError
from ...core.policy import Policy, act
from ...core.spec import Spec
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .costs import distance
from .planner import Decision, PlannerMemory
from .routes import NavigatorMemory

_STREAMS = 1 << 40, 2 << 40, 3 << 40  # of the seed: what the world, the policy's actions and its beginning draw
MOST_SKIPPED = 20  # starts that are already solved, for each episode that is asked for


@dataclass(frozen=True)
class SuccessCriterion:
    """When an episode has succeeded: where `channel` is above 0, or else within `within` of the goal (costs.distance).

    goal: channel -> [1, ...]. With neither a goal nor a channel nothing is judged, and an episode has its return alone.
    apart: how far what is seen is from the goal, as costs.distance.
    """

    goal: Observation = field(default_factory=dict)
    within: float = 0.05
    channel: str = ""
    apart: Callable[[Spec, Observation, Observation], torch.Tensor] = distance

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.goal, *([self.channel] if self.channel else []))))

    @property
    def judges(self) -> bool:
        return bool(self.channels)

    def solved(self, world: World, seen: Observation) -> torch.Tensor:
        """bool [B]."""
        if self.channel:
            return (
                seen[self.channel].float().flatten(1).amax(1) > 0
                if seen[self.channel].ndim > 1
                else seen[self.channel] > 0
            )
        return self.away(world, seen) <= self.within

    def away(self, world: World, seen: Observation) -> torch.Tensor:
        """The distance to the goal [B]; NaN without one."""
        if not self.goal:
            return torch.full((len(next(iter(seen.values()))),), torch.nan)
        return self.apart(world.spec, self.goal, seen).cpu()


@dataclass
class PlayedEpisode:
    """One episode. reward: the sum; success: None where nothing is judged; nearest: the least distance to the goal; ended: the
    environment said so; actions: [*action.shape] a step; ms and imagined: of each decision; best_cost: of any plan; seen: what
    was kept, a frame a step from the start on."""

    steps: int = 0
    reward: float = 0.0
    success: bool | None = None
    nearest: float = torch.nan
    ended: bool = False
    actions: list[torch.Tensor] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    imagined: list[int] = field(default_factory=list)
    best_cost: float = torch.inf
    decision: Decision | None = None
    seen: list[dict[str, torch.Tensor]] = field(default_factory=list)


@dataclass(frozen=True)
class PlayResult:
    episodes: list[PlayedEpisode]
    skipped: int  # starts that were already solved


def play(
    world: World,
    policy: Policy,
    episodes: int,
    steps: int,
    seed: int,
    judge: SuccessCriterion | None = None,
    sees: Sequence[str] = (),
    keep: Sequence[str] = (),
    kept: int = 0,
    report: Callable[[float, float], None] | None = None,
) -> PlayResult:
    """`episodes` unsolved starts of `world`, each until it succeeds, ends or has had `steps`.

    The same seed gives the same starts whatever the policy, so that two policies can be compared in pairs. sees: channels that
    the policy is shown. keep: channels that are kept of the first `kept` episodes. Where states are values all episodes are
    played at once, else one after the other. PlanningError where nearly every start is already solved.
    """
    judge = judge or SuccessCriterion()
    spec, starts = world.spec, make_rng(seed)
    found, skipped = list[PlayedEpisode](), 0
    while len(found) < episodes:
        batch = min(episodes - len(found), spec.max_batch or episodes) if spec.forkable else 1
        state = world.start(batch, starts)
        if judge.judges:
            solved = judge.solved(world, world.render(state, judge.channels)).cpu()
            skipped += int(solved.sum())
            if skipped > MOST_SKIPPED * episodes:
                raise PlanningError(
                    f"{skipped} of {skipped + len(found)} starts of {spec.name} are already solved; give a goal that is further "
                    "away, or a smaller --within."
                )
            if solved.all():
                continue
            state = state.at((~solved).nonzero()[:, 0]) if solved.any() else state
        own, left = seed + 1 + len(found) + skipped, max(0, kept - len(found))
        found += play_from(world, state, policy, steps, own, judge, sees, keep, left)
        if report:
            report(len(found), episodes)
    return PlayResult(found, skipped)


def play_from(
    world: World,
    state: State,
    policy: Policy,
    steps: int,
    seed: int,
    judge: SuccessCriterion | None = None,
    sees: Sequence[str] = (),
    keep: Sequence[str] = (),
    kept: int = 0,
) -> list[PlayedEpisode]:
    """The episodes that begin in `state`, as `play` plays them. What the policy draws by chance is the same in any world, as long
    as none of the episodes ends."""
    judge = judge or SuccessCriterion()
    told = [name for name in ("reward", "done") if name in world.spec.channels]
    world.spec.check_channels((*judge.channels, *sees, *keep))
    channels = tuple(dict.fromkeys((*sees, *judge.channels, *told)))
    group = _Group(world, policy, judge, channels, tuple(keep), kept, steps)
    return group.play(state, *(make_rng(seed ^ which) for which in _STREAMS))


@dataclass
class _Group:
    """Episodes that are played at once; those that are over are left out, where the world lets them."""

    world: World
    policy: Policy
    judge: SuccessCriterion
    channels: tuple[str, ...]
    keep: tuple[str, ...]
    kept: int
    steps: int

    @torch.no_grad()
    def play(
        self, state: State, moves: torch.Generator, chance: torch.Generator, begins: torch.Generator
    ) -> list[PlayedEpisode]:
        """moves: of the world alone; chance: of the policy's actions; begins: of its memory."""
        episodes = [PlayedEpisode(success=False if self.judge.judges else None) for _ in range(state.batch)]
        memory, going = self.policy.begin(state.batch, begins), list(range(state.batch))
        seen = self.world.render(state, self.channels)
        for episode, away in zip(episodes, self.judge.away(self.world, seen).tolist() if self.judge.goal else []):
            episode.nearest = away
        for _ in range(self.steps):
            self._note(episodes, going, state)
            began = time.perf_counter()
            action, memory = act(self.policy, seen, memory, state.batch, self.world.spec, chance)
            ms = 1e3 * (time.perf_counter() - began) / len(going)
            for entry, number in enumerate(going):
                _decided(episodes[number], action[entry], ms, memory, entry)
            state = self.world.imagine(state, action, moves)
            seen = self.world.render(state, self.channels)
            over = self._judged(episodes, going, seen)
            if over.any():
                self._note(episodes, [number if gone else -1 for number, gone in zip(going, over.tolist())], state)
                if over.all():
                    return episodes
                rows = (~over).nonzero()[:, 0]
                going = [going[entry] for entry in rows.tolist()]
                state, memory = state.at(rows.to(state.device)), _chosen(memory, rows)
                seen = {name: value[rows.to(value.device)] for name, value in seen.items()}
        self._note(episodes, going, state)
        return episodes

    def _judged(self, episodes: list[PlayedEpisode], going: list[int], seen: Observation) -> torch.Tensor:
        """Writes down what a step brought; bool [B]: which episodes are over."""
        none = torch.zeros(len(going))
        paid = seen["reward"].cpu().tolist() if "reward" in seen else none.tolist()
        ended = seen["done"].cpu() if "done" in seen else none.bool()
        solved = self.judge.solved(self.world, seen).cpu() if self.judge.judges else none.bool()
        away = self.judge.away(self.world, seen).tolist() if self.judge.goal else none.tolist()
        for entry, number in enumerate(going):
            episode = episodes[number]
            episode.steps, episode.reward = episode.steps + 1, episode.reward + paid[entry]
            episode.ended = bool(ended[entry])
            if self.judge.judges:
                episode.success = bool(solved[entry])
            if self.judge.goal:
                episode.nearest = min(episode.nearest, away[entry])
        return ended | solved

    def _note(self, episodes: list[PlayedEpisode], going: list[int], state: State) -> None:
        """Keeps what is seen of the episodes that are to be kept."""
        for entry, number in enumerate(going):
            if 0 <= number < self.kept and self.keep:
                shown = self.world.render(state.at(entry) if state.batch > 1 else state, self.keep)
                episodes[number].seen.append({name: value[0].cpu() for name, value in shown.items()})


def _decided(episode: PlayedEpisode, action: torch.Tensor, ms: float, memory: Any, entry: int) -> None:
    """Writes down an action, and the decision behind it if that is a new one."""
    episode.actions.append(action.cpu())
    thought = memory[entry] if isinstance(memory, list) else None
    thought = thought.thought if isinstance(thought, NavigatorMemory) else thought
    if not isinstance(thought, PlannerMemory) or thought.decision is None:
        episode.ms.append(ms)
    elif thought.decision is not episode.decision:
        episode.decision = thought.decision
        episode.best_cost = min(episode.best_cost, thought.decision.cost)
        episode.ms.append(thought.decision.ms)
        episode.imagined.append(thought.decision.steps)


def _chosen(memory: Any, rows: torch.Tensor) -> Any:
    """The memory of some of the episodes."""
    if isinstance(memory, State):
        return memory.at(rows)
    if isinstance(memory, torch.Tensor):
        return memory[rows]
    return [memory[entry] for entry in rows.tolist()] if isinstance(memory, list) else memory
