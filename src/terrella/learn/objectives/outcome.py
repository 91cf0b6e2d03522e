"""Outcome: the rewards, ends and vitals of a recording, learned on short pieces of its episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ...data import ClipCache
from ...worlds.outcome import FrameOutcome, OutcomeConfig, OutcomeLogits
from ..feeds import Drawn
from ..trainer import Learner, Loss, Now, Run, Trainer, warmed

PIECE = 8  # steps that are learned from at a time
_LEVELS = 33  # values, at most, that a reward or a change is told apart into


@dataclass(frozen=True)
class Happenings:
    """What followed each row of a recording: action as networks are given it [N, A]; reward [N]; done [N]; vitals [N, V] at
    the row; change [N, V] by its step; real bool [N]: rows whose step was recorded and may be learned from."""

    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    vitals: np.ndarray
    change: np.ndarray
    real: np.ndarray
    names: tuple[str, ...]

    @staticmethod
    def of(cache: ClipCache, action: np.ndarray, usable: np.ndarray) -> Happenings:
        """`action`: float [N, A] as networks are given it; `usable`: bool [N], rows that training may see."""
        names = tuple(cache.vitals)
        vitals = np.zeros((cache.length, len(names)), np.float32)
        for column, name in enumerate(names):
            vitals[:, column] = np.asarray(cache.vitals[name], np.float32).reshape(cache.length)
        real = usable & np.roll(usable, -1) & np.asarray(cache.action_valid, bool)
        real[[stop - 1 for _, stop in cache.episodes]] = False  # nothing follows an episode's last row
        change = np.where(real[:, None], np.roll(vitals, -1, 0) - vitals, 0.0)
        found = (cache.reward, cache.done)  # what a recording lacks is none of either
        reward, done = (np.zeros(cache.length, np.float32) if part is None else np.array(part) for part in found)
        return Happenings(action, reward.astype(np.float32), done.astype(bool), vitals, change, real, names)

    @property
    def tells_something(self) -> bool:
        """Whether there is anything to learn: a reward that differs, an end, a vital."""
        return bool(self.names) or bool(np.ptp(self.reward[self.real])) or bool(self.done[self.real].any())

    def events(self) -> np.ndarray:
        """bool [N]: steps after which something is otherwise than it mostly is."""
        usual = np.median(self.reward[self.real])
        return self.real & ((self.reward != usual) | self.done | (self.change != 0).any(1))

    def config(self) -> OutcomeConfig:
        changes = tuple(levels(self.change[self.real, column]) for column in range(len(self.names)))
        spans = tuple(
            float(max(np.abs(self.vitals[self.real, column]).max(), 1e-6)) for column in range(len(self.names))
        )
        return OutcomeConfig(self.action.shape[1], levels(self.reward[self.real]), self.names, changes, spans)


def levels(values: np.ndarray) -> tuple[float, ...]:
    """The distinct values, ascending, two or more; of many, those that part them evenly, with the rarest kept: the ends."""
    found = np.unique(values.astype(np.float32))
    if len(found) > _LEVELS:
        found = np.unique(np.quantile(found, np.linspace(0, 1, _LEVELS)).astype(np.float32))
    if len(found) < 2:
        found = np.append(found, found[-1:] + 1 if len(found) else [0.0, 1.0]).astype(np.float32)
    return tuple(float(value) for value in found)


def two_hot(values: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """values [n] as shares of the two nearest of `among` [L], ascending: [n, L]; what lies outside is the nearest end."""
    values, among = values.clamp(float(among[0]), float(among[-1])), among.to(values.device)
    above = torch.searchsorted(among, values.contiguous()).clamp(1, len(among) - 1)
    share = (values - among[above - 1]) / (among[above] - among[above - 1])
    rows = torch.arange(len(values), device=values.device)
    shares = torch.zeros(len(values), len(among), device=values.device)
    shares[rows, above - 1], shares[rows, above] = 1 - share, share
    return shares


class Pieces:
    """Half of the pieces hold an event; each counts by how much likelier than evenly it was drawn, so that what is rare stays
    as rare as it is. `rgb(rows)` gives uint8 [n, 3, H, W]."""

    def __init__(
        self,
        outcome: FrameOutcome,
        rgb: Callable[[np.ndarray], torch.Tensor],
        happened: Happenings,
        batch: int = 12,
        learning_rate: float = 2e-3,
    ):
        self.outcome, self.rgb, self.happened, self.size = outcome, rgb, happened, batch
        real = np.lib.stride_tricks.sliding_window_view(happened.real, PIECE).all(1)
        self.starts = np.flatnonzero(real)
        sums = np.concatenate([[0], np.cumsum(happened.events())])
        eventful = (sums[self.starts + PIECE] - sums[self.starts]).astype(float)
        self.even = np.full(len(self.starts), 1 / max(1, len(self.starts)))
        self.often = 0.5 * self.even + 0.5 * (eventful / eventful.sum() if eventful.any() else self.even)
        heads = [weight for head in (outcome.paid, outcome.ending, *outcome.changed) for weight in head.parameters()]
        known = {id(weight) for weight in heads}
        body = [weight for weight in outcome.parameters() if id(weight) not in known]
        groups = [{"params": body}, {"params": heads, "pace": 8.0}]  # what is rare is heard by the heads alone
        optimiser = torch.optim.AdamW(groups, weight_decay=1e-3)
        self.modules = {"outcome": outcome}
        self.learners = {"outcome": Learner(optimiser, (outcome,), warmed(learning_rate, 50, 0.03))}

    def picked(self, now: Now) -> tuple[np.ndarray, torch.Tensor]:
        """The first rows of a batch of pieces, and how much each counts."""
        picks = now.rng.choice(len(self.starts), self.size, p=self.often)
        return self.starts[picks], torch.from_numpy(self.even[picks] / self.often[picks]).float()

    def losses(self, batch: tuple[np.ndarray, torch.Tensor], now: Now) -> Iterator[Loss]:
        starts, weight = batch
        outcome, happened, device = self.outcome, self.happened, now.device
        rows = starts[:, None] + np.arange(PIECE)
        frames = self.rgb((starts[:, None] + np.arange(PIECE + 1)).ravel()).to(device)
        frames = _spoilt(frames, now).unflatten(0, (len(starts), PIECE + 1))
        seen = outcome.seen(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1)).unflatten(0, rows.shape)
        names = ("action", "reward", "done", "change", "vitals")
        at = {name: torch.from_numpy(getattr(happened, name)[rows]).float().to(device) for name in names}
        hidden, total = outcome.begin(len(starts)).to(device), torch.zeros((), device=device)
        for step in range(PIECE):
            vitals, change = at["vitals"][:, step], at["change"][:, step]
            predicted = outcome.judge(seen[:, step], at["action"][:, step], vitals, hidden)
            hidden = predicted.hidden
            ends = outcome.ends(predicted.known, vitals + change)
            error = surprise(outcome.config, predicted, ends, at["reward"][:, step], at["done"][:, step], change)
            total = total + (weight.to(device) * error).mean() / PIECE
        yield Loss("outcome", total, {"outcome": total})


def learn_outcome(run: Run, objective: Pieces, steps: int) -> dict:
    """Trains the objective's FrameOutcome in place; returns facts of the training."""
    if not len(objective.starts):
        return {"outcome_steps": 0}
    trainer = Trainer(run, "outcome", Drawn(objective.picked), objective, steps)
    trainer.train()
    objective.outcome.eval()
    return {"outcome_steps": trainer.facts["step"]}


def surprise(
    config: OutcomeConfig,
    predicted: OutcomeLogits,
    ends: torch.Tensor,
    reward: torch.Tensor,
    done: torch.Tensor,
    change: torch.Tensor,
) -> torch.Tensor:
    """How unlikely what happened was: [B], in nats; ends [B], the logit; reward and done [B], change [B, V] as they were."""
    total = F.cross_entropy(predicted.reward, two_hot(reward, torch.tensor(config.rewards)), reduction="none")
    total = total + F.binary_cross_entropy_with_logits(ends, done, reduction="none")
    for column, (logits, values) in enumerate(zip(predicted.changes, config.changes)):
        right = two_hot(change[:, column], torch.tensor(values))
        total = total + F.cross_entropy(logits, right, reduction="none")
    return total


def _spoilt(frames: torch.Tensor, now: Now) -> torch.Tensor:
    """Half of the batches a little soft and noisy, as dreamt frames are: uint8 to uint8."""
    if now.rng.random() < 0.5:
        return frames
    soft = F.avg_pool2d(frames.float(), 3, 1, 1, count_include_pad=False)
    mixed = frames.float().lerp(soft, float(now.rng.random() * 0.6))
    noise = now.randn(*mixed.shape)
    return (mixed + 5 * float(now.rng.random()) * noise).round().clamp(0, 255).to(torch.uint8)
