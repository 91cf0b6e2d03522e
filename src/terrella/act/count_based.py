"""CountBased: a player of any world, which learns what its actions do and goes where it has seldom been."""

from __future__ import annotations

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

_GRIDS = ((24, 12), (12, 24), (6, 48))  # cells of a small picture a side, and the grey levels that count as one
_ARMS = 128  # single actions that are tried, at most
_HOLDS = ((1, 1), (2, 4), (5, 12), (13, 40))
_EVENT, _NONE = struct.Struct("<IIIHB?"), 255  # of the log: three cells, arm, what hold is tried, does an episode begin
_DISCOUNT, _RATE = 0.95, 0.3
_KINDS = {"seek": 0.65, "hold": 0.2, "mash": 0.1, "rest": 0.05}
_STILL = 1.0  # grey levels by which the most changed hundredth of a small picture changes where something happened


class NoveltyModel:
    """What was found out of a world over all episodes: how often each cell of each grid was seen, what each action was
    worth there, how often each changed what is seen at all, and which lengths of holding it brought news."""

    def __init__(self, arms: int):
        self.arms, self.usual = arms, 1.0  # news in a step, lately
        self.visits: list[dict[int, int]] = [{} for _ in _GRIDS]
        self.known: list[dict[int, np.ndarray]] = [{} for _ in _GRIDS]  # cell -> [2, arms]: times tried, and worth
        self.does, self.holds = np.ones(arms), np.ones(len(_HOLDS))

    def see(self, cells: list[int], before: list[int] | None, arm: int, hold: int) -> None:
        """What is seen after `arm` was done where `before` was seen (None: an episode begins); `hold`: which length of holding
        was being tried, or _NONE."""
        news = 0.0
        for seen, cell in zip(self.visits, cells):
            seen[cell] = seen.get(cell, 0) + 1
            news += 1 / math.sqrt(seen[cell]) / len(cells)
        self.usual += 0.005 * (news - self.usual)
        if before is not None:
            self.does[arm] += 0.05 * ((cells != before) - self.does[arm])
            self._learn(before, arm, news, cells)
            if hold != _NONE:
                self.holds[hold] += 0.02 * (news / self.usual - self.holds[hold])

    def end(self, cells: list[int] | None, arm: int) -> None:
        """An episode is over: what was done last leads to no news."""
        if cells is not None:
            self._learn(cells, arm, 0.0, None)

    def score(self, cells: list[int]) -> np.ndarray:
        """[arms]: what each action promises here: the news that it led to, more where it was seldom tried."""
        found = np.zeros(self.arms)
        for known, cell in zip(self.known, cells):
            if cell in known:
                tried, worth = known[cell]
                found += worth * (1 - _DISCOUNT) + self.usual * (0.1 + self.does) / np.sqrt(1 + tried)
            else:
                found += self.usual * (1.1 + self.does)
        return found / len(cells)

    def _learn(self, cells: list[int], arm: int, news: float, after: list[int] | None) -> None:
        """One step of Q-learning on each grid, with the news as reward."""
        usual = self.usual / (1 - _DISCOUNT)
        for at, (known, cell) in enumerate(zip(self.known, cells)):
            if cell not in known:
                known[cell] = np.stack([np.zeros(self.arms), usual * (0.5 + 0.5 * self.does)])
            ahead = 0.0
            if after is not None:
                ahead = float(known[after[at]][1].max()) if after[at] in known else usual
            known[cell][1, arm] += _RATE * (news + _DISCOUNT * ahead - known[cell][1, arm])
            known[cell][0, arm] += 1


@dataclass
class _Play:
    """Where one episode stands: what was last seen and done, and the move that is under way. still: steps for which the
    picture has stood; mash: those for which one of many quick actions is still held."""

    cells: list[int] | None = None
    small: np.ndarray | None = None
    arm: int = 0
    kind: str = "rest"
    hold: int = 0
    left: int = 0
    mash: int = 0
    still: int = 0
    action: torch.Tensor | None = None

    @property
    def tried(self) -> int:
        """The length of holding that is being tried, or _NONE."""
        return self.hold if self.kind == "seek" else _NONE


class CountBased:
    """A policy for any world that shows pictures or numbers, and knows nothing of it beforehand.

    It sorts what it sees into cells of three sizes (Go-Explore's small pictures, Ecoffet et al. 2019), counts them, and learns
    by Q-learning with 1/sqrt(count) as reward (Bellemare et al. 2016) where each action leads. Between such seeking it
    holds actions at random, mixes them quickly, and rests; whatever it holds is let go when the picture stands still.
    How long it holds an action it learns too. Its findings go on from episode to episode; they follow from what it saw and did
    alone, which `log`, a file, keeps in 17 bytes a step.
    """

    def __init__(self, spec: Spec, log: Path | None = None):
        self.spec, self.arms = spec, _arms(spec)
        self.findings, self.log = NoveltyModel(len(self.arms)), log
        self.channel = next((name for name in ("rgb", "observation", *spec.channels) if name in spec.channels), "")
        self._open: list[_Play] = []

    def recall(self, steps: int) -> None:
        """Finds again what it had found after the first `steps` of the log; the others, whose episode was not kept, it forgets."""
        if self.log is None or not self.log.is_file():
            return
        said = self.log.read_bytes()[: steps * _EVENT.size]
        self.log.write_bytes(said)
        last, arm, hold = None, 0, _NONE
        for *cells, did, tried, first in _EVENT.iter_unpack(said):
            if first:
                self.findings.end(last, arm)
            self.findings.see(cells, None if first else last, arm, hold)
            last, arm, hold = cells, did, tried
        self._open = [_Play(last, arm=arm)]

    def begin(self, batch: int, rng: torch.Generator) -> list[_Play]:
        """The memory of `batch` episodes. Those before count as over: what led to their end leads to no news."""
        for play in self._open:
            self.findings.end(play.cells, play.arm)
        self._open = [_Play() for _ in range(batch)]
        return list(self._open)

    def act(self, observation: Observation, memory: list, rng: torch.Generator) -> tuple[torch.Tensor, list]:
        seen = observation[self.channel] if self.channel in observation else None
        chosen = []
        for entry, play in enumerate(memory):
            first = play.cells is None
            self._look(play, np.zeros((1, 1, 1)) if seen is None else seen[entry].cpu().numpy())
            if play.left <= 0 or (play.still > 1 and play.kind != "rest" and _unit(rng) < 0.7):
                self._move(play, rng)
            elif play.kind == "mash" and play.mash <= 0:
                self._take(play, self._any(rng), rng)
                play.mash = _whole(rng, 1, 3)
            play.left, play.mash = play.left - 1, play.mash - 1
            chosen.append(play.action)
            if self.log is not None:
                with self.log.open("ab", buffering=0) as file:
                    file.write(_EVENT.pack(*play.cells, play.arm, play.tried, first))
        return torch.stack(chosen), memory

    def _look(self, play: _Play, seen: np.ndarray) -> None:
        small = self._small(seen)
        cells = _cells(small)
        self.findings.see(cells, play.cells, play.arm, play.tried)
        if play.small is not None:
            change = np.abs(small - play.small).ravel()
            play.still = play.still + 1 if float(np.sort(change)[-max(1, change.size // 100) :].mean()) < _STILL else 0
        play.cells, play.small = cells, small

    def _move(self, play: _Play, rng: torch.Generator) -> None:
        """Begins something new."""
        assert play.cells is not None
        kinds, odds = list(_KINDS), torch.tensor(list(_KINDS.values()))
        play.kind, play.still = kinds[int(torch.multinomial(odds, 1, generator=rng))], 0
        likely = self.findings.holds.clip(0.05) ** 4 / np.sqrt([sum(ends) for ends in _HOLDS])
        play.hold = int(torch.multinomial(torch.from_numpy(likely / likely.sum() + 0.05), 1, generator=rng))
        play.left = _whole(rng, *_HOLDS[play.hold])
        if play.kind == "seek":
            score = self.findings.score(play.cells)
            likely = np.exp((score - score.max()) / (0.05 * max(self.findings.usual, 1e-9)))
            arm = int(torch.multinomial(torch.from_numpy(likely), 1, generator=rng))
        else:
            arm = 0 if play.kind == "rest" else self._any(rng)
            play.left = min(play.left, 12) if play.kind == "rest" else round(40 ** _unit(rng))
            play.left, play.mash = (_whole(rng, 5, 20), 1) if play.kind == "mash" else (play.left, 0)
        self._take(play, arm, rng)

    def _any(self, rng: torch.Generator) -> int:
        """Any action, rather one that changes something."""
        return int(torch.multinomial(torch.from_numpy(0.25 + self.findings.does), 1, generator=rng))

    def _take(self, play: _Play, arm: int, rng: torch.Generator) -> None:
        play.arm, play.action = arm, self.arms[arm]
        if isinstance(self.spec.action, spaces.Box) and arm and self.spec.action.dtype.kind == "f":
            rest, part = self.arms[0], _unit(rng)
            if part < 0.5:  # axes are to be learned between their ends too
                play.action = rest + (play.action - rest) * (2 * part)

    def _small(self, seen: np.ndarray) -> np.ndarray:
        """[n, n, C] of 0 to 255: the picture's means over areas, or numbers, on a scale that is fine near 0."""
        if seen.ndim == 3 and seen.dtype == np.uint8:
            stride = max(1, max(seen.shape[:2]) // 96)
            picture = torch.from_numpy(np.ascontiguousarray(seen[::stride, ::stride])).permute(2, 0, 1).float()
            return torch.nn.functional.adaptive_avg_pool2d(picture, _GRIDS[0][0]).permute(1, 2, 0).numpy()
        flat = np.nan_to_num(seen.astype(np.float64).ravel()[:4096])
        return (128 + 30 * np.arcsinh(10 * flat)).clip(0, 255)[None, None]


def _cells(small: np.ndarray) -> list[int]:
    """One number per grid for what is seen: alike where the small pictures are."""
    found, side = [], _GRIDS[0][0]
    for cells, step in _GRIDS:
        pooled = small
        if small.shape[0] == side and cells != side:
            part = side // cells
            pooled = small.reshape(cells, part, cells, part, -1).mean((1, 3))
        found.append(zlib.crc32((pooled / step).round().astype(np.uint8).tobytes()))
    return found


def _arms(spec: Spec) -> torch.Tensor:
    """[arms, *action.shape]: the actions that are tried, the first of them rest: all choices (of very many some), every button,
    the ends of every axis, and combinations drawn at random."""
    rest, (low, high) = neutral_action(spec), spec.action_limits
    if rest.ndim == 0 and rest.dtype.kind != "f":
        values = np.unique(np.linspace(int(low), int(high), min(int(high) - int(low) + 1, _ARMS)).round()).astype(
            rest.dtype
        )
        return torch.from_numpy(np.array([rest, *values[values != rest]]))
    axes = rest.dtype.kind == "f"
    ends = (
        [np.clip(low, -1e3, 1e3), np.clip(high, -1e3, 1e3)]
        if axes
        else [low + np.minimum(k, high - low) for k in range(5)]
    )
    found = {rest.tobytes(): rest}
    for at, end in [(at, end) for at in range(rest.size) for end in ends][:_ARMS]:
        one = rest.copy()
        one.flat[at] = end.flat[at]
        found[one.tobytes()] = one
    singles, rng = list(found.values()), torch.Generator().manual_seed(0)
    for _ in range(max(12, min(len(singles), 32))):
        if spec.action_mode == BUTTONS:
            both = np.maximum(*(singles[_whole(rng, 0, len(singles) - 1)] for _ in range(2)))
        else:
            both = spec.sample_action(1, rng)[0].numpy()
        found[both.tobytes()] = both
    return torch.from_numpy(np.stack(list(found.values())))


def _unit(rng: torch.Generator) -> float:
    return float(torch.rand(1, generator=rng))


def _whole(rng: torch.Generator, least: int, most: int) -> int:
    return int(torch.randint(least, most + 1, (1,), generator=rng))
