"""DemonstrationRows: moments of a recording for imitation, with the observations before them and the actions from them on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from ..act.embodiment import EMBODIMENT
from ..act.imitation_network import ImitationConfig
from ..act.sentences import WordEncoder
from ..act.teacher import EXPERT
from ..core.errors import DatasetError
from ..data.training.cache import array_for
from .objectives.imitation import Demonstrations
from .recording import Recording

BEGINNINGS = 0.375  # part of a batch at which an instruction begins
CONFIDENCE = "observation.action_confidence"  # of actions that a model named (train inverse)


@dataclass(frozen=True)
class DemonstrationRows:
    """The rows of a recording whose actions are imitated."""

    recording: Recording
    config: ImitationConfig
    device: torch.device
    rows: np.ndarray  # that are sampled
    valid: np.ndarray  # bool [R]: rows with an action
    stop: np.ndarray  # [R]: the end of each row's episode
    actions: torch.Tensor  # float32 [R, A], encoded, that are imitated
    words: torch.Tensor | None  # int64 [R, WORDS], the instruction of each row
    outcome: torch.Tensor | None  # float32 [R], the standardised return of each row's episode
    weight: torch.Tensor | None = None  # float32 [R], of each row's action in the loss; None: 1
    taken: torch.Tensor | None = None  # float32 [R, A], encoded, that were taken; None: those that are imitated
    ahead: int = 0  # observations after the moment that are seen, too, as the last of the history
    body: int | None = None  # which of the policy's bodies acted; None for a policy of one body

    @staticmethod
    def of(recording: Recording, config: ImitationConfig, device: torch.device) -> DemonstrationRows:
        cache = recording.cache
        stop, outcome = np.zeros(cache.length, np.int64), None
        for first, last in cache.episodes:
            stop[first:last] = last
        if config.outcome is not None:
            returns = recording.episode_returns()
            assert returns is not None
            each = (returns - returns.mean()) / returns.std()
            outcome = torch.from_numpy(np.repeat(each, np.diff(cache.ranges, axis=1)[:, 0])).float()
        words = None
        if config.vocabulary:
            texts = WordEncoder(config.vocabulary).read(cache.tasks)
            words = texts[torch.from_numpy(np.array(cache.arrays["task"]))]
        if cache.action is None:  # clips: every row but an episode's last has an action that nobody recorded
            actions, valid = torch.zeros(cache.length, config.action_width), np.arange(cache.length) < stop - 1
        else:
            actions = _padded(recording.action(np.arange(cache.length)), config.action_width)
            valid = np.array(cache.action_valid, bool).reshape(-1)
        rows, sure = np.flatnonzero(recording.usable & valid), cache.arrays.get(CONFIDENCE)
        if not len(rows):
            raise DatasetError(f"{recording.name} holds no actions to imitate; record demonstrations.")
        weight = None if sure is None else torch.from_numpy(np.array(sure, np.float32).reshape(-1))
        bodies = [one.name for one in config.bodies]
        body = bodies.index(recording.embodiment) if bodies else None
        return DemonstrationRows(
            recording, config, device, rows, valid, stop, actions, words, outcome, weight, body=body
        )

    @property
    def advised(self) -> DemonstrationRows:
        """The same with the actions of a recorded teacher in the place of those that were taken, which may be noisy, or those of a
        policy that errs (DAgger, Ross et al. 2011). Episodes without a teacher keep theirs; itself where the recording has no
        channel `expert` of actions."""
        cache, controls = self.recording.cache, self.recording.controls
        array = array_for(EXPERT, cache.arrays, cache.keys)
        if array is None or controls is None:
            return self
        expert = torch.from_numpy(np.array(cache.arrays[array], np.float32)).flatten(1)
        if expert.shape[1] != len(controls.low):
            return self
        actions = _padded(controls.encode(expert), self.config.action_width)
        for number in cache.absent.get(array, ()):  # where it is padding
            alone = slice(*cache.episodes[number])
            actions[alone] = self.actions[alone]
        return replace(self, actions=actions, taken=self.actions)

    @property
    def held_out(self) -> DemonstrationRows:
        """The same of the held-out episodes; of all where none is held out."""
        rows = self.of_episodes(np.array(self.recording.held_out, np.int64))
        return rows if len(rows.rows) else self

    def of_episodes(self, numbers: np.ndarray) -> DemonstrationRows:
        """The same with only the rows of these episodes."""
        cache = self.recording.cache
        inside = np.zeros(cache.length, bool)
        for number in numbers:
            inside[slice(*cache.episodes[number])] = True
        return replace(self, rows=np.flatnonzero(inside & self.valid))

    def sample(self, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` moments, drawn uniformly; with waypoints a part of them at the beginning of instructions."""
        rows = rng.choice(self.rows, count)
        if self.config.waypoint and len(first := self.rows[self._begins(self.rows)]):
            rows[: int(BEGINNINGS * count)] = rng.choice(first, int(BEGINNINGS * count))
        return self.at(rows)

    def beginnings(self, rows: np.ndarray) -> Demonstrations:
        """The moments at which the instructions of `rows` began."""
        return self.at(self._instructed(rows)[0])

    def _begins(self, rows: np.ndarray) -> np.ndarray:
        """bool [N]: whether an instruction begins at these rows."""
        return self._instructed(rows)[0] == rows

    def at(self, rows: np.ndarray) -> Demonstrations:
        """The moments `rows`. Before an episode's first row the history repeats it, with actions of zero. For a policy that
        remembers: windows that hold them, within one instruction and whole where that is short."""
        if self.config.remember:
            return self._windows(rows)
        config, start = self.config, self.recording.start[rows]
        back = rows[:, None] + self.ahead - np.arange(config.history - 1, -1, -1)
        shown = back.clip(start[:, None], self.stop[rows][:, None] - 1).ravel()
        return self._moments(rows, back, shown, rows)

    def _windows(self, rows: np.ndarray) -> Demonstrations:
        start, stop = self._instructed(rows)
        first = np.maximum(start, rows - self.config.remember + 1)
        steps = first[:, None] + np.arange(min(self.config.remember, int((stop - first).max())))
        inside, longest = steps < stop[:, None], steps.shape[1]
        moments = np.minimum(steps, stop[:, None] - 1).ravel()
        shown, places = np.unique(moments, return_inverse=True)
        batch = self._moments(moments, moments[:, None], shown, rows)
        weight = batch.weight * torch.from_numpy(inside.reshape(-1, 1)).to(self.device)
        requested = torch.from_numpy(np.arange(len(rows)) * longest + rows - first)
        windows = torch.from_numpy(places.reshape(steps.shape)).to(self.device)
        return replace(batch, weight=weight, windows=windows, requested=requested)

    def _instructed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(first row [N], row after the last [N]) of the same instruction in the same episode."""
        start, stop = self.recording.start[rows], self.stop[rows]
        if self.words is None:
            return start, stop
        changes = np.flatnonzero(np.diff(np.array(self.recording.cache.arrays["task"]).reshape(-1))) + 1
        changes = np.concatenate([[0], changes, [self.recording.cache.length]])
        after = np.searchsorted(changes, rows, side="right")
        return np.maximum(start, changes[after - 1]), np.minimum(stop, changes[after])

    def observations(self, rows: np.ndarray, numbers_only: bool = False) -> dict[str, torch.Tensor]:
        """What the policy sees at `rows`: channel -> [N, ...]."""
        cache, seen = self.recording.cache, {}
        for name, shape in self.config.actor.sees:
            if numbers_only and len(shape) > 1:
                continue
            array = array_for(name, cache.arrays, cache.keys)
            assert array is not None
            seen[name] = torch.from_numpy(np.asarray(cache.arrays[array][rows])).to(self.device)
        if self.body is not None and not numbers_only:
            seen[EMBODIMENT] = torch.eye(len(self.config.bodies))[[self.body]].expand(len(rows), -1).to(self.device)
        return seen

    def _moments(self, rows: np.ndarray, back: np.ndarray, shown: np.ndarray, spoken: np.ndarray) -> Demonstrations:
        """The actions from `rows` [N] on and before the observations `back` [N, H], the observations `shown` and the
        instructions of the rows `spoken`."""
        config, start, seen = self.config, self.recording.start[rows], self.observations(shown)
        before = torch.from_numpy((back - 1).clip(start[:, None], self.stop[rows][:, None] - 1))
        taken = self.actions if self.taken is None else self.taken
        acted = torch.where(torch.from_numpy(back - 1 >= start[:, None])[..., None], taken[before], 0.0)
        began, until = self._instructed(rows)
        ahead = rows[:, None] + np.arange(config.chunk)
        valid = torch.from_numpy(ahead < until[:, None])  # what follows is of another instruction
        ahead = np.minimum(ahead, self.stop[rows][:, None] - 1)
        valid &= torch.from_numpy(self.valid[ahead])
        weight = valid.float() if self.weight is None else valid * self.weight[torch.from_numpy(ahead)]
        chunk = self.actions[torch.from_numpy(ahead)]
        last = np.minimum(until, self.stop[rows] - 1)
        later = (np.minimum(began + config.waypoint, last), last)[: config.waypoints]
        waypoints = tuple(self.observations(at, numbers_only=True) for at in later)
        begins = torch.from_numpy(self._begins(rows)).float().to(self.device) if config.waypoint else None
        words, outcome = (
            None if each is None else each[torch.from_numpy(of)].to(self.device)
            for each, of in ((self.words, spoken), (self.outcome, rows))
        )  # fmt: skip
        return Demonstrations(
            seen, acted.to(self.device), chunk.to(self.device), weight.to(self.device), words, outcome,
            waypoints=waypoints, begins=begins,
        )  # fmt: skip


@dataclass(frozen=True)
class JointDemonstrations:
    """The rows of several recordings, of one body or several, each as likely as another."""

    parts: tuple[DemonstrationRows, ...]

    def sample(self, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` moments. Those of one recording are drawn as by itself."""
        if len(self.parts) == 1:
            return self.parts[0].sample(count, rng)
        rows = np.array([len(part.rows) for part in self.parts], np.float64)
        counts = rng.multinomial(count, rows / rows.sum())
        return Demonstrations.joined([part.sample(int(n), rng) for part, n in zip(self.parts, counts) if n])


def _padded(actions: torch.Tensor, width: int) -> torch.Tensor:
    """Encoded actions [N, A] of a body with fewer numbers than others: [N, width], the rest 0."""
    return F.pad(actions, (0, width - actions.shape[1]))
