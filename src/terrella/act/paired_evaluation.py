"""Judging policies in a dream and in reality: from the same starts, beside a matched control, with the dream's error on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from ..core.errors import PlanningError, TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.spec import Spec
from ..core.state import State
from ..core.world import Observation, World, make_rng
from .planning import PlayedEpisode, SuccessCriterion, distance, play_from
from .planning.problem import later

CHUNK = 100  # episodes that are played, and saved, together
OPEN_LOOP_EPISODES, OPEN_LOOP_WITH_PICTURES = (
    16,
    4,
)  # episodes of a policy whose actions are followed in the dream; with pictures to compare
_ATTEMPTS = 64  # starts that are tried for an episode, until one is not solved already
_ACTIONS, _DREAM = 1, 2  # what seeds are spent on
PERSISTENCE = " of the start"  # the error of what holds the first observation
UNCERTAINTY = "uncertainty"


@dataclass(frozen=True)
class EpisodeStarts:
    """Where some episodes begin: the seed of each, what is seen there ([B, ...]), and how many were left out as solved."""

    seeds: list[int]
    seen: Observation
    skipped: int


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


class LoopedActions:
    """Does given actions, a sequence [T, *action.shape] an episode, again and again, whatever it sees."""

    sees = ()

    def __init__(self, sequences: Sequence[torch.Tensor]):
        self.sequences = list(sequences)

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        return torch.stack([torch.arange(batch), torch.zeros(batch, dtype=torch.int64)], 1)  # which, and how many steps

    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        found = [self.sequences[which][step % len(self.sequences[which])] for which, step in memory.tolist()]
        return torch.stack(found), memory + torch.tensor([0, 1])


@dataclass
class PairedEvaluation:
    """A dream, and where there is one the reality that it is held against; `compared`: the channels of both that are.

    Episode n begins alike whoever plays it: with the seed n of `seed`, in the dream with what is seen of reality there. A dream
    that observes nothing (a simulator) begins with the same seeds by itself.
    """

    dream: World
    real: World | None
    judge: SuccessCriterion
    steps: int
    seed: int
    compared: tuple[str, ...] = ()
    _starts: dict[tuple[int, int], EpisodeStarts] = field(default_factory=dict)

    def play(self, load: Callable[[], Policy], spec: Spec, number: int, count: int) -> Chunk:
        """Chunk `number`, of `count` episodes, of the policy that `load` makes anew for dream and reality, so that nothing that it
        learns in one helps it in the other. `spec`: of the channels that it may be shown."""
        starts, real, seed = self.starts(number, count), list[PlayedEpisode](), later(self.seed, number) ^ _ACTIONS
        followed: Mapping[str, torch.Tensor] = {}
        if self.real is not None:
            policy, kept = load(), self._kept if number == 0 else 0
            real = self._played(self.real, self._real_states(starts), policy, seed, spec, self.compared, kept)
            followed = self._followed(starts, real[: min(kept, count)]) if kept else {}
        dream = self._played(self.dream, self._dream_states(starts), load(), seed, spec)
        return Chunk(real, dream, self._control(starts, dream, seed), starts.skipped, followed)

    def starts(self, number: int, count: int) -> EpisodeStarts:
        if (number, count) not in self._starts:
            self._starts[number, count] = self._sought(number, count)
        return self._starts[number, count]

    @torch.no_grad()
    def _sought(self, number: int, count: int) -> EpisodeStarts:
        world = self.dream if self.real is None else self.real
        shown = [*self.dream.spec.observes, *self.dream.spec.may_observe] if self._paired else []
        wanted = tuple(dict.fromkeys((*(name for name in shown if name in world.spec.channels), *self.judge.channels)))
        seeds, views, skipped = [], [], 0
        for episode in range(number * CHUNK, number * CHUNK + count):
            for attempt in range(_ATTEMPTS):
                seed = later(self.seed, episode * _ATTEMPTS + attempt)
                seen = world.render(world.start(1, make_rng(seed)), wanted)
                if not (self.judge.judges and bool(self.judge.solved(world, seen).any())):
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
        """Whether the dream is told where a real episode begins."""
        return self.real is not None and bool(self.dream.spec.observes)

    @property
    def _kept(self) -> int:
        assert self.real is not None
        pictures = any(len(self.real.spec.channels[name].shape or ()) > 1 for name in self.compared)
        kept = (
            (OPEN_LOOP_WITH_PICTURES if pictures else OPEN_LOOP_EPISODES)
            if self.compared and self.dream.spec.forkable
            else 0
        )
        return min(kept, self.dream.spec.max_batch or kept)

    def _real_states(self, starts: EpisodeStarts) -> Iterator[State]:
        assert self.real is not None
        return _started(self.real, starts.seeds)

    def _dream_states(self, starts: EpisodeStarts) -> Iterator[State]:
        if not self._paired:
            yield from _started(self.dream, starts.seeds)
            return
        spec = self.dream.spec
        names = [name for name in (*spec.observes, *spec.may_observe) if name in starts.seen]
        for part in _parts(spec, len(starts.seeds)):
            seen = {name: starts.seen[name][part] for name in names}
            yield self.dream.observe(seen, None, make_rng(starts.seeds[part.start] ^ _DREAM))

    def _played(
        self,
        world: World,
        states: Iterator[State],
        policy: Policy,
        seed: int,
        spec: Spec,
        keep: tuple[str, ...] = (),
        kept: int = 0,
    ) -> list[PlayedEpisode]:
        found: list[PlayedEpisode] = []
        for state in states:
            left = max(0, kept - len(found))
            told = (
                policy,
                self.steps,
                later(seed, len(found)),
                self.judge,
                observed_channels(policy, spec),
                keep,
                left,
            )
            found += play_from(world, state, *told)
        return found

    def _control(self, starts: EpisodeStarts, dream: Sequence[PlayedEpisode], seed: int) -> list[PlayedEpisode]:
        """The matched control: the same policy, starts and dream, but the dream hears the actions of another episode, which answer
        to something else; of a lone one those from its middle on."""
        done = [torch.stack(episode.actions) for episode in dream]
        heard = [*done[1:], done[0]] if len(done) > 1 else [done[0].roll(len(done[0]) // 2, 0)]
        found: list[PlayedEpisode] = []
        for state in self._dream_states(starts):
            echo = LoopedActions(heard[len(found) : len(found) + state.batch])
            found += play_from(self.dream, state, echo, self.steps, later(seed, len(found)), self.judge)
        return found

    @torch.no_grad()
    def _followed(self, starts: EpisodeStarts, episodes: Sequence[PlayedEpisode]) -> dict[str, torch.Tensor]:
        assert self.real is not None
        state, rng = next(self._dream_states(starts)).at(list(range(len(episodes)))), make_rng(self.seed)
        told = [UNCERTAINTY] if UNCERTAINTY in self.dream.spec.channels else []
        length = max(episode.steps for episode in episodes)
        curves: dict[str, list[torch.Tensor]] = {}
        for step in range(length + 1):
            shown = self.dream.render(state, [*self.compared, *told])
            over = torch.tensor([step > episode.steps for episode in episodes])
            found = {name: shown[name].float().cpu() for name in told}
            for name in self.compared:
                truth = torch.stack([episode.seen[min(step, episode.steps)][name] for episode in episodes])
                first = torch.stack([episode.seen[0][name] for episode in episodes])
                found[name] = distance(self.real.spec, {name: truth}, {name: shown[name].cpu()})
                found[name + PERSISTENCE] = distance(self.real.spec, {name: truth}, {name: first})
            for name, values in found.items():
                curves.setdefault(name, []).append(torch.where(over, torch.nan, values))
            if step < length:
                actions = [episode.actions[min(step, episode.steps - 1)] for episode in episodes]
                state = self.dream.imagine(state, torch.stack(actions), rng)
        return {name: torch.stack(values, 1) for name, values in curves.items()}


def _parts(spec: Spec, count: int) -> list[slice]:
    """How many episodes of a world are played together: all, or one after the other."""
    most = (spec.max_batch or count) if spec.forkable else 1
    return [slice(at, min(at + most, count)) for at in range(0, count, most)]


def _started(world: World, seeds: Sequence[int]) -> Iterator[State]:
    for part in _parts(world.spec, len(seeds)):
        yield State.stack([world.start(1, make_rng(seed)) for seed in seeds[part]])


def check_finite(name: str, place: str, episodes: Sequence[PlayedEpisode]) -> None:
    """TerrellaError where a return is no number."""
    broken = [at for at, episode in enumerate(episodes) if not abs(episode.reward) < float("inf")]
    if broken:
        raise TerrellaError(
            f"the return of {name} in {place} is no finite number in {len(broken)} of {len(episodes)} episodes: the rewards there "
            "are broken, and nothing can be judged by them."
        )
