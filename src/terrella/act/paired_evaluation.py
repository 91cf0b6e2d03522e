"""Paired evaluation of policies in a world and in the real environment: the same starts, a matched control, open-loop errors."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from ..core.errors import PlanningError, TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.spec import Spec
from ..core.state import State
from ..core.world import Observation, World, make_rng, without_end
from .planning import PlayedEpisode, PlaySettings, SuccessCriterion, distance, play_from
from .planning.problem import later

CHUNK = 100  # episodes that are played and saved together
OPEN_LOOP_EPISODES, OPEN_LOOP_WITH_PICTURES = 16, 4  # real episodes replayed in the dream; if pictures are compared
_ATTEMPTS = 64  # starts drawn for an episode, until one has not succeeded already
_ACTIONS, _DREAM = 1, 2  # streams of a seed
PERSISTENCE = " of the start"  # suffix of a channel: the error of holding the first observation
UNCERTAINTY = "uncertainty"


@dataclass(frozen=True)
class EpisodeStarts:
    """The starts of some episodes."""

    seeds: list[int]
    seen: Observation  # channel -> [B, ...], the first observation
    skipped: int  # starts left out because they succeed already


@dataclass(frozen=True)
class Chunk:
    """Some episodes of a policy: real (none without an environment), dreamt from the same starts, and those of the control.

    open_loop_errors: channel -> [F, T + 1], the distance of the dream to F real episodes under the real actions, NaN after an
    episode's end; channel + PERSISTENCE: that of the first observation, held; UNCERTAINTY: the error that the dream expects.
    """

    real: list[PlayedEpisode]
    dream: list[PlayedEpisode]
    control: list[PlayedEpisode]
    skipped: int
    open_loop_errors: Mapping[str, torch.Tensor]
    replay: list[PlayedEpisode] = field(default_factory=list)  # the dream, given the actions of the real episodes


class LoopedActions:
    """Repeats given actions in a loop, a sequence [T, *action.shape] for each episode."""

    sees = ()

    def __init__(self, sequences: Sequence[torch.Tensor]):
        self.sequences = list(sequences)

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        # index of the sequence, step
        return torch.stack([torch.arange(batch), torch.zeros(batch, dtype=torch.int64)], 1)

    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        actions = [self.sequences[which][step % len(self.sequences[which])] for which, step in memory.tolist()]
        return torch.stack(actions), memory + torch.tensor([0, 1])


@dataclass
class PairedEvaluation:
    """Plays policies in a world (the dream) and in the real environment, if there is one.

    Episode n starts alike for all policies, from the n-th seed of `seed`; the dream observes the real start. A dream that
    observes nothing (a simulator) starts from the same seeds.
    """

    dream: World
    real: World | None
    criterion: SuccessCriterion
    steps: int  # of an episode, at most
    seed: int
    compared: tuple[str, ...] = ()  # channels of both whose open-loop error is measured
    replays: bool = False  # whether the actions of real episodes are replayed in the dream
    _starts: dict[tuple[int, int], EpisodeStarts] = field(default_factory=dict)

    def play(self, load: Callable[[], Policy], spec: Spec, number: int, count: int) -> Chunk:
        """Chunk `number`, of `count` episodes. load: makes the policy anew for dream and reality, so that what it learns in one
        does not help it in the other. spec: of the channels that it may be shown."""
        starts, real, seed = self.starts(number, count), list[PlayedEpisode](), later(self.seed, number) ^ _ACTIONS
        errors: Mapping[str, torch.Tensor] = {}
        if self.real is not None:
            policy, kept = load(), self._open_loop_count if number == 0 else 0
            real = self._play(self.real, self._real_states(starts), policy, seed, spec, kept)
            errors = self._open_loop_errors(starts, real[: min(kept, count)]) if kept else {}
        dream = self._play(self.dream, self._dream_states(starts), load(), seed, spec)
        control, replay = self._control(starts, dream, seed), self._replay(starts, real, seed) if self.replays else []
        return Chunk(real, dream, control, starts.skipped, errors, replay)

    def starts(self, number: int, count: int) -> EpisodeStarts:
        if (number, count) not in self._starts:
            self._starts[number, count] = self._draw_starts(number, count)
        return self._starts[number, count]

    @torch.no_grad()
    def _draw_starts(self, number: int, count: int) -> EpisodeStarts:
        world = self.dream if self.real is None else self.real
        shown = [*self.dream.spec.observes, *self.dream.spec.may_observe] if self._paired else []
        wanted = tuple(
            dict.fromkeys((*(name for name in shown if name in world.spec.channels), *self.criterion.channels))
        )
        seeds, views, skipped = [], [], 0
        for episode in range(number * CHUNK, number * CHUNK + count):
            for attempt in range(_ATTEMPTS):
                seed = later(self.seed, episode * _ATTEMPTS + attempt)
                seen = world.render(world.start(1, make_rng(seed)), wanted)
                if not (self.criterion.defined and bool(self.criterion.succeeded(world, seen).any())):
                    break
                skipped += 1
            else:
                raise PlanningError(
                    f"{_ATTEMPTS} starts of {world.spec.name} in a row are already solved; give a goal that is further away, or a "
                    "smaller --within."
                )
            seeds.append(seed)
            views.append(seen)
        return EpisodeStarts(seeds, {name: torch.cat([seen[name] for seen in views]) for name in wanted}, skipped)

    @property
    def _paired(self) -> bool:
        """Whether the dream observes the start of a real episode."""
        return self.real is not None and bool(self.dream.spec.observes)

    @property
    def _open_loop_count(self) -> int:
        assert self.real is not None
        pictures = any(len(self.real.spec.channels[name].shape or ()) > 1 for name in self.compared)
        followed = self.compared and self.dream.spec.forkable
        kept = 0 if not followed else OPEN_LOOP_WITH_PICTURES if pictures else OPEN_LOOP_EPISODES
        return min(kept, self.dream.spec.max_batch or kept)

    def _real_states(self, starts: EpisodeStarts) -> Iterator[State]:
        assert self.real is not None
        return _start(self.real, starts.seeds)

    def _dream_states(self, starts: EpisodeStarts) -> Iterator[State]:
        if not self._paired:
            yield from _start(self.dream, starts.seeds)
            return
        spec = self.dream.spec
        names = [name for name in (*spec.observes, *spec.may_observe) if name in starts.seen]
        for part in _parts(spec, len(starts.seeds)):
            seen = {name: starts.seen[name][part] for name in names}
            yield self.dream.observe(seen, None, make_rng(starts.seeds[part.start] ^ _DREAM))

    def _play(
        self, world: World, states: Iterator[State], policy: Policy, seed: int, spec: Spec, kept: int = 0
    ) -> list[PlayedEpisode]:
        """kept: of how many episodes the compared channels are kept."""
        episodes: list[PlayedEpisode] = []
        sees, keep = observed_channels(policy, spec), self.compared if kept else ()
        for state in states:
            settings = PlaySettings(self.steps, self.criterion, sees, keep, max(0, kept - len(episodes)))
            episodes += play_from(world, state, policy, settings, later(seed, len(episodes)))
        return episodes

    def _control(self, starts: EpisodeStarts, dream: Sequence[PlayedEpisode], seed: int) -> list[PlayedEpisode]:
        """The matched control: the same policy, starts and dream, but the dream is given the actions of another episode, which
        do not respond to it; a lone episode gets its own from the middle on."""
        done = [torch.stack(episode.actions) for episode in dream]
        shuffled = [*done[1:], done[0]] if len(done) > 1 else [done[0].roll(len(done[0]) // 2, 0)]
        return self._dream_of(starts, shuffled, seed)

    def _replay(self, starts: EpisodeStarts, real: Sequence[PlayedEpisode], seed: int) -> list[PlayedEpisode]:
        """The dream under the actions of the real episodes; what succeeds only after a real episode ended has not succeeded."""
        episodes = self._dream_of(starts, [torch.stack(episode.actions) for episode in real], seed)
        for mine, true in zip(episodes, real):
            mine.success = mine.success and mine.steps <= true.steps
        return episodes

    def _dream_of(self, starts: EpisodeStarts, actions: Sequence[torch.Tensor], seed: int) -> list[PlayedEpisode]:
        """The dream under given actions, a sequence for each episode."""
        episodes: list[PlayedEpisode] = []
        settings = PlaySettings(self.steps, self.criterion)
        for state in self._dream_states(starts):
            policy = LoopedActions(actions[len(episodes) : len(episodes) + state.batch])
            episodes += play_from(self.dream, state, policy, settings, later(seed, len(episodes)))
        return episodes

    @torch.no_grad()
    def _open_loop_errors(self, starts: EpisodeStarts, episodes: Sequence[PlayedEpisode]) -> dict[str, torch.Tensor]:
        """The errors of Chunk: the dream starts with the episodes and is given their actions alone."""
        assert self.real is not None
        state, rng = next(self._dream_states(starts)).at(list(range(len(episodes)))), make_rng(self.seed)
        expected = [UNCERTAINTY] if UNCERTAINTY in self.dream.spec.channels else []
        length = max(episode.steps for episode in episodes)
        curves: dict[str, list[torch.Tensor]] = {}
        for step in range(length + 1):
            shown = self.dream.render(state, [*self.compared, *expected])
            over = torch.tensor([step > episode.steps for episode in episodes])
            errors = {name: shown[name].float().cpu() for name in expected}
            for name in self.compared:
                truth = torch.stack([episode.seen[min(step, episode.steps)][name] for episode in episodes])
                first = torch.stack([episode.seen[0][name] for episode in episodes])
                errors[name] = distance(self.real.spec, {name: truth}, {name: shown[name].cpu()})
                errors[name + PERSISTENCE] = distance(self.real.spec, {name: truth}, {name: first})
            for name, values in errors.items():
                curves.setdefault(name, []).append(torch.where(over, torch.nan, values))
            if step < length:
                actions = [episode.actions[min(step, episode.steps - 1)] for episode in episodes]
                state = self.dream.imagine(without_end(state), torch.stack(actions), rng)
        return {name: torch.stack(values, 1) for name, values in curves.items()}


def _parts(spec: Spec, count: int) -> list[slice]:
    """The episodes that are played together: as many as the world takes, or one after the other."""
    most = (spec.max_batch or count) if spec.forkable else 1
    return [slice(at, min(at + most, count)) for at in range(0, count, most)]


def _start(world: World, seeds: Sequence[int]) -> Iterator[State]:
    for part in _parts(world.spec, len(seeds)):
        yield State.stack([world.start(1, make_rng(seed)) for seed in seeds[part]])


def check_finite(name: str, place: str, episodes: Sequence[PlayedEpisode]) -> None:
    """TerrellaError if a return is not finite."""
    broken = [at for at, episode in enumerate(episodes) if not abs(episode.reward) < float("inf")]
    if broken:
        raise TerrellaError(
            f"the return of {name} in {place} is not finite in {len(broken)} of {len(episodes)} episodes: the rewards there are "
            "broken, and policies cannot be compared by them."
        )
