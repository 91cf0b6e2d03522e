"""CountBased: a count-based exploration policy for any world."""

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

from ..core.spec import BUTTONS, Spec, neutral_action
from ..core.world import Observation

_GRIDS = ((24, 12), (12, 24), (6, 48))  # side of a downscaled picture, and the grey levels that are merged
_MAX_ARMS = 128  # single actions
_HOLDS = ((1, 1), (2, 4), (5, 12), (13, 40))  # ranges of steps for which an action is held
_EVENT, _NONE = (
    struct.Struct("<IIIHB?"),
    255,
)  # of the log: three cells, arm, index of the hold, first step of an episode
_DISCOUNT, _LEARNING_RATE = 0.95, 0.3
_MOVE_KINDS = {"seek": 0.65, "hold": 0.2, "mash": 0.1, "rest": 0.05}
_STILL = 1.0  # grey levels; a smaller change of the most changed hundredth of a downscaled picture is none


class NoveltyModel:
    """Statistics of a world over all episodes: visits of each cell of each grid, the action values there, how often each action
    changes the observation, and the novelty for each length of holding an action."""

    def __init__(self, arms: int):
        self.arms, self.mean_novelty = arms, 1.0  # running mean of the novelty of a step
        self.visits: list[dict[int, int]] = [{} for _ in _GRIDS]
        self.values: list[dict[int, np.ndarray]] = [{} for _ in _GRIDS]  # cell -> [2, arms]: tries, and Q-values
        self.effect, self.holds = np.ones(arms), np.ones(len(_HOLDS))

    def add_step(self, cells: list[int], before: list[int] | None, arm: int, hold: int) -> None:
        """The cells seen after `arm` was done in cells `before` (None: an episode begins). hold: the index of the hold that was
        tried, or _NONE."""
        novelty = 0.0
        for seen, cell in zip(self.visits, cells):
            seen[cell] = seen.get(cell, 0) + 1
            novelty += 1 / math.sqrt(seen[cell]) / len(cells)
        self.mean_novelty += 0.005 * (novelty - self.mean_novelty)
        if before is not None:
            self.effect[arm] += 0.05 * ((cells != before) - self.effect[arm])
            self._learn(before, arm, novelty, cells)
            if hold != _NONE:
                self.holds[hold] += 0.02 * (novelty / self.mean_novelty - self.holds[hold])

    def end_episode(self, cells: list[int] | None, arm: int) -> None:
        """The last action of an episode leads to no novelty."""
        if cells is not None:
            self._learn(cells, arm, 0.0, None)

    def score(self, cells: list[int]) -> np.ndarray:
        """[arms]: the upper confidence bound of the novelty that each action leads to."""
        scores = np.zeros(self.arms)
        for values, cell in zip(self.values, cells):
            if cell in values:
                tries, q_value = values[cell]
                scores += q_value * (1 - _DISCOUNT) + self.mean_novelty * (0.1 + self.effect) / np.sqrt(1 + tries)
            else:
                scores += self.mean_novelty * (1.1 + self.effect)
        return scores / len(cells)

    def _learn(self, cells: list[int], arm: int, novelty: float, after: list[int] | None) -> None:
        """One step of Q-learning on each grid, with the novelty as reward."""
        initial = self.mean_novelty / (1 - _DISCOUNT)
        for at, (values, cell) in enumerate(zip(self.values, cells)):
            if cell not in values:
                values[cell] = np.stack([np.zeros(self.arms), initial * (0.5 + 0.5 * self.effect)])
            ahead = 0.0
            if after is not None:
                ahead = float(values[after[at]][1].max()) if after[at] in values else initial
            values[cell][1, arm] += _LEARNING_RATE * (novelty + _DISCOUNT * ahead - values[cell][1, arm])
            values[cell][0, arm] += 1


@dataclass
class _Play:
    """The memory of one episode: the last observation and action, and the current move."""

    cells: list[int] | None = None
    small: np.ndarray | None = None  # the downscaled picture
    arm: int = 0
    kind: str = "rest"  # of _MOVE_KINDS
    hold: int = 0  # index into _HOLDS
    left: int = 0  # steps of the move
    mash: int = 0  # steps left of the current action, of several quick ones
    still: int = 0  # steps without a change of the picture
    action: torch.Tensor | None = None

    @property
    def tried(self) -> int:
        """The index of the hold that is tried, or _NONE."""
        return self.hold if self.kind == "seek" else _NONE


class CountBased:
    """A policy for any world that shows pictures or numbers, without prior knowledge of it.

    Downscaled pictures (Go-Explore, Ecoffet et al. 2019) of three sizes are counted, and Q-learning with reward 1/sqrt(count)
    (Bellemare et al. 2016) learns where each action leads. In between, it holds random actions, mixes them quickly, and rests.
    Statistics carry over from episode to episode; `log`, a file of 17 bytes a step, restores them.
    """

    def __init__(self, spec: Spec, log: Path | None = None):
        self.spec, self.arms = spec, _arms(spec)
        self.novelty, self.log = NoveltyModel(len(self.arms)), log
        self.channel = next((name for name in ("rgb", "observation", *spec.channels) if name in spec.channels), "")
        self._open: list[_Play] = []

    def recall(self, steps: int) -> None:
        """Restores the statistics from the first `steps` of the log, and cuts the log there."""
        if self.log is None or not self.log.is_file():
            return
        events = self.log.read_bytes()[: steps * _EVENT.size]
        self.log.write_bytes(events)
        last, arm, hold = None, 0, _NONE
        for *cells, did, tried, first in _EVENT.iter_unpack(events):
            if first:
                self.novelty.end_episode(last, arm)
            self.novelty.add_step(cells, None if first else last, arm, hold)
            last, arm, hold = cells, did, tried
        self._open = [_Play(last, arm=arm)]

    def begin(self, batch: int, rng: torch.Generator) -> list[_Play]:
        """The memory of `batch` episodes. Those before count as over."""
        for play in self._open:
            self.novelty.end_episode(play.cells, play.arm)
        self._open = [_Play() for _ in range(batch)]
        return list(self._open)

    def act(self, observation: Observation, memory: list, rng: torch.Generator) -> tuple[torch.Tensor, list]:
        seen = observation.get(self.channel)
        chosen = []
        for entry, play in enumerate(memory):
            first = play.cells is None
            self._look(play, np.zeros((1, 1, 1)) if seen is None else seen[entry].cpu().numpy())
            if play.left <= 0 or (play.still > 1 and play.kind != "rest" and random_unit(rng) < 0.7):
                self._move(play, rng)
            elif play.kind == "mash" and play.mash <= 0:
                self._take(play, self._any(rng), rng)
                play.mash = random_int(rng, 1, 3)
            play.left, play.mash = play.left - 1, play.mash - 1
            chosen.append(play.action)
            if self.log is not None:
                with self.log.open("ab", buffering=0) as file:
                    file.write(_EVENT.pack(*play.cells, play.arm, play.tried, first))
        return torch.stack(chosen), memory

    def _look(self, play: _Play, seen: np.ndarray) -> None:
        small = self._small(seen)
        cells = _cells(small)
        self.novelty.add_step(cells, play.cells, play.arm, play.tried)
        if play.small is not None:
            change = np.abs(small - play.small).ravel()
            play.still = play.still + 1 if float(np.sort(change)[-max(1, change.size // 100) :].mean()) < _STILL else 0
        play.cells, play.small = cells, small

    def _move(self, play: _Play, rng: torch.Generator) -> None:
        """Starts a new move."""
        assert play.cells is not None
        kinds, odds = list(_MOVE_KINDS), torch.tensor(list(_MOVE_KINDS.values()))
        play.kind, play.still = kinds[int(torch.multinomial(odds, 1, generator=rng))], 0
        likely = self.novelty.holds.clip(0.05) ** 4 / np.sqrt([sum(ends) for ends in _HOLDS])
        play.hold = int(torch.multinomial(torch.from_numpy(likely / likely.sum() + 0.05), 1, generator=rng))
        play.left = random_int(rng, *_HOLDS[play.hold])
        if play.kind == "seek":
            score = self.novelty.score(play.cells)
            likely = np.exp((score - score.max()) / (0.05 * max(self.novelty.mean_novelty, 1e-9)))
            arm = int(torch.multinomial(torch.from_numpy(likely), 1, generator=rng))
        else:
            arm = 0 if play.kind == "rest" else self._any(rng)
            play.left = min(play.left, 12) if play.kind == "rest" else round(40 ** random_unit(rng))
            play.left, play.mash = (random_int(rng, 5, 20), 1) if play.kind == "mash" else (play.left, 0)
        self._take(play, arm, rng)

    def _any(self, rng: torch.Generator) -> int:
        """A random action, more likely one that changes the observation."""
        return int(torch.multinomial(torch.from_numpy(0.25 + self.novelty.effect), 1, generator=rng))

    def _take(self, play: _Play, arm: int, rng: torch.Generator) -> None:
        play.arm, play.action = arm, self.arms[arm]
        if isinstance(self.spec.action, spaces.Box) and arm and self.spec.action.dtype.kind == "f":
            rest, part = self.arms[0], random_unit(rng)
            if part < 0.5:  # continuous actions between their limits too
                play.action = rest + (play.action - rest) * (2 * part)

    def _small(self, seen: np.ndarray) -> np.ndarray:
        """[n, n, C] in 0..255: the picture averaged over areas, or numbers on an arcsinh scale."""
        if seen.ndim == 3 and seen.dtype == np.uint8:
            stride = max(1, max(seen.shape[:2]) // 96)
            picture = torch.from_numpy(np.ascontiguousarray(seen[::stride, ::stride])).permute(2, 0, 1).float()
            return torch.nn.functional.adaptive_avg_pool2d(picture, _GRIDS[0][0]).permute(1, 2, 0).numpy()
        flat = np.nan_to_num(seen.astype(np.float64).ravel()[:4096])
        return (128 + 30 * np.arcsinh(10 * flat)).clip(0, 255)[None, None]


def _cells(small: np.ndarray) -> list[int]:
    """A hash of the downscaled picture for each grid."""
    hashes, side = [], _GRIDS[0][0]
    for cells, step in _GRIDS:
        pooled = small
        if small.shape[0] == side and cells != side:
            part = side // cells
            pooled = small.reshape(cells, part, cells, part, -1).mean((1, 3))
        hashes.append(zlib.crc32((pooled / step).round().astype(np.uint8).tobytes()))
    return hashes


def _arms(spec: Spec) -> torch.Tensor:
    """[arms, *action.shape]: the candidate actions, the neutral one first: all choices (evenly spaced if there are very many),
    every button, the limits of every axis, and random combinations."""
    rest, (low, high) = neutral_action(spec), spec.action_limits
    if rest.ndim == 0 and rest.dtype.kind != "f":
        low, high = int(low), int(high)
        values = np.unique(np.linspace(low, high, min(high - low + 1, _MAX_ARMS)).round()).astype(rest.dtype)
        return torch.from_numpy(np.array([rest, *values[values != rest]]))
    if rest.dtype.kind == "f":
        ends = [np.clip(low, -1e3, 1e3), np.clip(high, -1e3, 1e3)]
    else:
        ends = [low + np.minimum(k, high - low) for k in range(5)]
    arms = {rest.tobytes(): rest}
    for at, end in [(at, end) for at in range(rest.size) for end in ends][:_MAX_ARMS]:
        one = rest.copy()
        one.flat[at] = end.flat[at]
        arms[one.tobytes()] = one
    singles, rng = list(arms.values()), torch.Generator().manual_seed(0)
    for _ in range(max(12, min(len(singles), 32))):
        if spec.action_mode == BUTTONS:
            both = np.maximum(*(singles[random_int(rng, 0, len(singles) - 1)] for _ in range(2)))
        else:
            both = spec.sample_action(1, rng)[0].numpy()
        arms[both.tobytes()] = both
    return torch.from_numpy(np.stack(list(arms.values())))


def random_unit(rng: torch.Generator) -> float:
    return float(torch.rand(1, generator=rng))


def random_int(rng: torch.Generator, least: int, most: int) -> int:
    return int(torch.randint(least, most + 1, (1,), generator=rng))
