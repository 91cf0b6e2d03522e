"""Episodes of a policy in a world: their return, whether they succeeded, and how long each decision took."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch

from ...core.errors import PlanningError
from ...core.policy import Policy, act, observed_channels
from ...core.spec import Spec
from ...core.state import State
from ...core.world import Observation, World, make_rng
from .costs import distance
from .planner import Decision, PlannerMemory
from .routes import NavigatorMemory

_STREAMS = 1 << 40, 2 << 40, 3 << 40  # of the seed: the world, the policy's actions, the policy's memory
MAX_SKIPPED = 20  # starts that already succeed, for each episode asked for


@dataclass(frozen=True)
class SuccessCriterion:
    """When an episode succeeds: where `channel` is above 0 and it is within a distance of the goal, as far as there are such. With
    neither, episodes have a return alone."""

    goal: Observation = field(default_factory=dict)  # channel -> [1, ...]
    within: float = 0.05  # distance to the goal
    channel: str = ""
    distance_to_goal: Callable[[Spec, Observation, Observation], torch.Tensor] = distance  # (spec, goal, seen) -> [B]

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.goal, *([self.channel] if self.channel else []))))

    @property
    def defined(self) -> bool:
        return bool(self.channels)

    def succeeded(self, world: World, seen: Observation) -> torch.Tensor:
        """bool [B]."""
        if not self.channel:
            return self.distance(world, seen) <= self.within
        values = seen[self.channel]
        above = values.float().flatten(1).amax(1) > 0 if values.ndim > 1 else values > 0
        return above.cpu() & (self.distance(world, seen) <= self.within) if self.goal else above

    def distance(self, world: World, seen: Observation) -> torch.Tensor:
        """The distance to the goal [B]; NaN without one."""
        if not self.goal:
            return torch.full((len(next(iter(seen.values()))),), torch.nan)
        return self.distance_to_goal(world.spec, self.goal, seen).cpu()


@dataclass
class PlayedEpisode:
    """One episode of a policy."""

    steps: int = 0
    reward: float = 0.0  # the return
    success: bool | None = None  # None without a criterion
    nearest: float = torch.nan  # the least distance to the goal
    ended: bool = False  # by the environment
    actions: list[torch.Tensor] = field(default_factory=list)  # [*action.shape] each step
    ms: list[float] = field(default_factory=list)  # of each decision
    imagined: list[int] = field(default_factory=list)  # steps imagined for each decision
    trusted: list[int] = field(default_factory=list)  # moves of each decision's plans that are within `trust`
    best_cost: float = torch.inf  # of all plans
    decision: Decision | None = None  # the last
    seen: list[dict[str, torch.Tensor]] = field(default_factory=list)  # kept channels at the start and after each step


@dataclass(frozen=True)
class PlayResult:
    episodes: list[PlayedEpisode]
    skipped: int  # starts that already succeed


@dataclass(frozen=True)
class PlaySettings:
    """How episodes are played, and what is kept of them."""

    steps: int  # of an episode, at most
    criterion: SuccessCriterion = field(default_factory=SuccessCriterion)
    sees: Sequence[str] | None = None  # channels that the policy is shown; None: those that it names (core.policy)
    keep: Sequence[str] = ()  # channels to keep in PlayedEpisode.seen
    keep_episodes: int = 0  # of how many episodes, from the first on


class PlayInterrupted(KeyboardInterrupt):
    """Ctrl-C while episodes are played. done: the batches that were over. begun: the episodes of the batch that was not, over or
    not: of some the end, of others the steps so far."""

    def __init__(self, done: PlayResult, begun: Sequence[PlayedEpisode] = ()):
        super().__init__()
        self.done, self.begun = done, [episode for episode in begun if episode.steps]


def play(
    world: World,
    policy: Policy,
    episodes: int,
    settings: PlaySettings,
    seed: int = 0,
    progress: Callable[[float, float], None] | None = None,
) -> PlayResult:
    """Plays `episodes` episodes, each until it succeeds, ends or is `steps` long. Starts that already succeed are skipped.

    The same seed gives the same starts whatever the policy, so that two policies can be compared in pairs. If states are values,
    all episodes are played at once, else one after the other. progress(done, episodes) is called after each step.
    PlanningError if nearly every start already succeeds; PlayInterrupted on Ctrl-C.
    """
    criterion, spec, starts = settings.criterion, world.spec, make_rng(seed)
    played, skipped = list[PlayedEpisode](), 0
    try:
        while len(played) < episodes:
            batch = min(episodes - len(played), spec.max_batch or episodes) if spec.forkable else 1
            state = world.start(batch, starts)
            if criterion.defined:
                succeeded = criterion.succeeded(world, world.render(state, criterion.channels)).cpu()
                skipped += int(succeeded.sum())
                if skipped > MAX_SKIPPED * episodes:
                    raise PlanningError(
                        f"{skipped} of {skipped + len(played)} starts of {spec.name} are already solved; give a goal that is "
                        "further away, or a smaller --within."
                    )
                if succeeded.all():
                    continue
                state = state.at((~succeeded).nonzero()[:, 0]) if succeeded.any() else state
            kept = replace(settings, keep_episodes=max(0, settings.keep_episodes - len(played)))
            report = None if progress is None else partial(_within, progress, len(played), state.batch, episodes)
            played += play_from(world, state, policy, kept, seed + 1 + len(played) + skipped, report)
            if progress:
                progress(len(played), episodes)
    except PlayInterrupted as stop:
        raise PlayInterrupted(PlayResult(played, skipped), stop.begun) from None
    except KeyboardInterrupt:
        raise PlayInterrupted(PlayResult(played, skipped)) from None
    return PlayResult(played, skipped)


def _within(progress: Callable[[float, float], None], before: int, batch: int, episodes: int, share: float) -> None:
    progress(before + batch * share, episodes)


def play_from(
    world: World,
    state: State,
    policy: Policy,
    settings: PlaySettings,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> list[PlayedEpisode]:
    """The episodes that begin in `state`. The policy's random draws are the same in any world, as long as no episode ends.
    progress(share of the steps) is called after each step."""
    sees = observed_channels(policy, world.spec) if settings.sees is None else settings.sees
    outcome = [name for name in ("reward", "done") if name in world.spec.channels]
    world.spec.check_channels((*settings.criterion.channels, *sees, *settings.keep))
    channels = tuple(dict.fromkeys((*sees, *settings.criterion.channels, *outcome)))
    streams = (make_rng(seed ^ stream) for stream in _STREAMS)
    return _Batch(world, policy, settings, channels, progress).play(state, *streams)


@dataclass
class _Batch:
    """Episodes that are played at once; each leaves the batch when it is over."""

    world: World
    policy: Policy
    settings: PlaySettings
    channels: tuple[str, ...]  # rendered after each step
    progress: Callable[[float], None] | None = None

    @torch.no_grad()
    def play(
        self, state: State, world_rng: torch.Generator, action_rng: torch.Generator, memory_rng: torch.Generator
    ) -> list[PlayedEpisode]:
        criterion = self.settings.criterion
        episodes = [PlayedEpisode(success=False if criterion.defined else None) for _ in range(state.batch)]
        memory, going = self.policy.begin(state.batch, memory_rng), list(range(state.batch))
        seen = self.world.render(state, self.channels)
        for episode, away in zip(episodes, criterion.distance(self.world, seen).tolist() if criterion.goal else []):
            episode.nearest = away
        try:
            for step in range(self.settings.steps):
                if self.progress:
                    self.progress(step / self.settings.steps)
                self._keep(episodes, going, state)
                began = time.perf_counter()
                action, memory = act(self.policy, seen, memory, state.batch, self.world.spec, action_rng)
                ms = 1e3 * (time.perf_counter() - began) / len(going)
                for entry, number in enumerate(going):
                    _add_action(episodes[number], action[entry], ms, memory, entry)
                state = self.world.imagine(state, action, world_rng)
                seen = self.world.render(state, self.channels)
                over = self._add_outcome(episodes, going, seen)
                if over.any():
                    self._keep(episodes, [number if ends else -1 for number, ends in zip(going, over.tolist())], state)
                    if over.all():
                        return episodes
                    rows = (~over).nonzero()[:, 0]
                    going = [going[entry] for entry in rows.tolist()]
                    state, memory = state.at(rows.to(state.device)), _memory_at(memory, rows)
                    seen = {name: value[rows.to(value.device)] for name, value in seen.items()}
        except KeyboardInterrupt:
            raise PlayInterrupted(PlayResult([], 0), episodes) from None
        self._keep(episodes, going, state)
        return episodes

    def _add_outcome(self, episodes: list[PlayedEpisode], going: list[int], seen: Observation) -> torch.Tensor:
        """Adds a step's reward and end; bool [B]: the episodes that are over."""
        criterion, zeros = self.settings.criterion, torch.zeros(len(going))
        reward = seen["reward"].cpu().tolist() if "reward" in seen else zeros.tolist()
        ended = seen["done"].cpu() if "done" in seen else zeros.bool()
        succeeded = criterion.succeeded(self.world, seen).cpu() if criterion.defined else zeros.bool()
        away = criterion.distance(self.world, seen).tolist() if criterion.goal else zeros.tolist()
        for entry, number in enumerate(going):
            episode = episodes[number]
            episode.steps, episode.reward = episode.steps + 1, episode.reward + reward[entry]
            episode.ended = bool(ended[entry])
            if criterion.defined:
                episode.success = bool(succeeded[entry])
            if criterion.goal:
                episode.nearest = min(episode.nearest, away[entry])
        return ended | succeeded

    def _keep(self, episodes: list[PlayedEpisode], going: list[int], state: State) -> None:
        """Keeps the channels `keep` of the first episodes; -1 in `going` for none."""
        for entry, number in enumerate(going):
            if 0 <= number < self.settings.keep_episodes and self.settings.keep:
                shown = self.world.render(state.at(entry) if state.batch > 1 else state, tuple(self.settings.keep))
                episodes[number].seen.append({name: value[0].cpu() for name, value in shown.items()})


def _add_action(episode: PlayedEpisode, action: torch.Tensor, ms: float, memory: Any, entry: int) -> None:
    """Adds an action, and the decision behind it if it is a new one."""
    episode.actions.append(action.cpu())
    planned = memory[entry] if isinstance(memory, list) else None
    planned = planned.planner if isinstance(planned, NavigatorMemory) else planned
    if not isinstance(planned, PlannerMemory) or planned.decision is None:
        episode.ms.append(ms)
    elif planned.decision is not episode.decision:
        episode.decision = planned.decision
        episode.best_cost = min(episode.best_cost, planned.decision.cost)
        episode.ms.append(planned.decision.ms)
        episode.imagined.append(planned.decision.steps)
        episode.trusted.append(planned.decision.trusted_moves)


def _memory_at(memory: Any, rows: torch.Tensor) -> Any:
    """The memory of the episodes `rows`."""
    if isinstance(memory, State):
        return memory.at(rows)
    if isinstance(memory, torch.Tensor):
        return memory[rows]
    return [memory[entry] for entry in rows.tolist()] if isinstance(memory, list) else memory
