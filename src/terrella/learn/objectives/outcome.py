"""Outcome: rewards, terminations and vitals of a recording, learned on short clips of its episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ...data import ClipCache
from ...worlds.outcome import FrameOutcome, OutcomeConfig, OutcomeLogits
from ..feeds import RandomBatches
from ..learners import Learner, warmup_cosine
from ..sized_feed import SizedFeed
from ..train_step import TrainStep
from ..trainer import Loss, Run, Trainer

LENGTH = 8  # steps of a clip
FOLLOWED = 0.5  # the part of the clips that go on with their own vitals, as in play, and learn to correct them
_LEVELS = 33  # values at most into which rewards and changes are discretised


@dataclass(frozen=True)
class Happenings:
    """The outcomes of the steps of a recording: action encoded for networks [N, A]; reward [N]; done [N]; vitals [N, V] before the
    step; change [N, V] of the vitals; real bool [N]: whether the step was recorded and may be trained on; names [V]: the channel of
    each vital; vectors: those of vectors, which come last."""

    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    vitals: np.ndarray
    change: np.ndarray
    real: np.ndarray
    names: tuple[str, ...]
    vectors: tuple[str, ...] = ()

    @staticmethod
    def of(
        cache: ClipCache, action: np.ndarray, usable: np.ndarray, vectors: Mapping[str, np.ndarray] = {}
    ) -> Happenings:
        """`action`: float [N, A] encoded for networks; `usable`: bool [N], rows that training may see; `vectors`: channels
        [N, D] whose numbers are vitals, too, the last."""
        chosen = cache.vitals | dict(vectors)
        columns = {name: np.asarray(array, np.float32).reshape(cache.length, -1) for name, array in chosen.items()}
        names = tuple(name for name, array in columns.items() for _ in range(array.shape[1]))
        vitals = np.concatenate([np.zeros((cache.length, 0), np.float32), *columns.values()], 1)
        real = usable & np.roll(usable, -1) & np.asarray(cache.action_valid, bool)
        real[[stop - 1 for _, stop in cache.episodes]] = False  # nothing follows an episode's last row
        change = np.where(real[:, None], np.roll(vitals, -1, 0) - vitals, 0.0)
        nothing = np.zeros(cache.length, np.float32)
        reward, done = (nothing if part is None else np.array(part) for part in (cache.reward, cache.done))
        return Happenings(
            action, reward.astype(np.float32), done.astype(bool), vitals, change, real, names, tuple(vectors)
        )

    @property
    def is_informative(self) -> bool:
        """Whether there is anything to learn: rewards that differ, terminations, vitals."""
        return bool(self.names) or bool(np.ptp(self.reward[self.real])) or bool(self.done[self.real].any())

    def events(self) -> np.ndarray:
        """bool [N]: steps with a termination, another reward than most, or a change of a vital. Rewards and vitals that vary most
        of the time are no events."""
        unusual = np.column_stack([self.reward != np.median(self.reward[self.real]), self.change != 0])
        rare = unusual[self.real].mean(0) <= 0.5
        return self.real & (self.done | unusual[:, rare].any(1))

    def config(self, cameras: int = 1) -> OutcomeConfig:
        """Of frames in which the pictures of this many cameras lie side by side."""
        before, change = self.vitals[self.real], self.change[self.real]
        single = sum(name not in self.vectors for name in self.names)
        changes = tuple(levels(of) for of in change[:, :single].T)
        sizes = tuple(float(size) or 1.0 for size in np.sqrt(np.square(change[:, single:]).mean(0)))
        largest = np.maximum(np.abs(before), np.abs(before + change)).max(0, initial=0)  # some change at the end alone
        spans = tuple(float(span) or 1.0 for span in largest)
        rewards, side = levels(self.reward[self.real]), OutcomeConfig.side * cameras
        return OutcomeConfig(self.action.shape[1], rewards, self.names, changes, spans, side=side, sizes=sizes)


def levels(values: np.ndarray) -> tuple[float, ...]:
    """The distinct values, ascending, at least two; if there are many, their quantiles, extremes included."""
    distinct = np.unique(values.astype(np.float32))
    if len(distinct) > _LEVELS:
        distinct = np.unique(np.quantile(distinct, np.linspace(0, 1, _LEVELS)).astype(np.float32))
    if len(distinct) < 2:
        distinct = np.append(distinct, distinct[-1:] + 1 if len(distinct) else [0.0, 1.0]).astype(np.float32)
    return tuple(float(value) for value in distinct)


def two_hot(values: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """Two-hot encoding [n, L] of values [n] over the ascending bins `among` [L]; values outside are clipped."""
    values, among = values.clamp(float(among[0]), float(among[-1])), among.to(values.device)
    above = torch.searchsorted(among, values.contiguous()).clamp(1, len(among) - 1)
    share = (values - among[above - 1]) / (among[above] - among[above - 1])
    rows = torch.arange(len(values), device=values.device)
    shares = torch.zeros(len(values), len(among), device=values.device)
    shares[rows, above - 1], shares[rows, above] = 1 - share, share
    return shares


class OutcomeObjective:
    """The likelihood of outcomes in clips, half of which contain an event; importance weights keep the probabilities of rare events
    unbiased. `rgb(rows)` gives uint8 [n, 3, H, W]."""

    def __init__(
        self,
        outcome: FrameOutcome,
        rgb: Callable[[np.ndarray], torch.Tensor],
        happened: Happenings,
        batch: int = 12,
        learning_rate: float = 2e-3,
    ):
        self.outcome, self.rgb, self.happened, self.size = outcome, rgb, happened, batch
        real = np.lib.stride_tricks.sliding_window_view(happened.real, LENGTH).all(1)
        self.starts = np.flatnonzero(real)
        sums = np.concatenate([[0], np.cumsum(happened.events())])
        eventful = (sums[self.starts + LENGTH] - sums[self.starts]).astype(float)
        self.even = np.full(len(self.starts), 1 / max(1, len(self.starts)))
        self.often = 0.5 * self.even + 0.5 * (eventful / eventful.sum() if eventful.any() else self.even)
        heads = [weight for head in (outcome.paid, outcome.ending, *outcome.changed) for weight in head.parameters()]
        known = {id(weight) for weight in heads}
        body = [weight for weight in outcome.parameters() if id(weight) not in known]
        groups = [{"params": body}, {"params": heads, "pace": 8.0}]  # only the heads learn from rare events at first
        optimiser = torch.optim.AdamW(groups, weight_decay=1e-3)
        self.modules = {"outcome": outcome}
        self.learners = {"outcome": Learner(optimiser, (outcome,), warmup_cosine(learning_rate, 50, 0.03))}

    def sample(self, now: TrainStep, size: int) -> tuple[np.ndarray, torch.Tensor]:
        """The first rows of a batch of clips, and their importance weights."""
        picks = now.rng.choice(len(self.starts), size, p=self.often)
        return self.starts[picks], torch.from_numpy(self.even[picks] / self.often[picks]).float()

    def losses(self, batch: tuple[np.ndarray, torch.Tensor], now: TrainStep) -> Iterator[Loss]:
        starts, weight = batch
        outcome, happened, device = self.outcome, self.happened, now.device
        rows = starts[:, None] + np.arange(LENGTH)
        frames = self.rgb((starts[:, None] + np.arange(LENGTH + 1)).ravel()).to(device)
        frames = _degraded(frames, now).unflatten(0, (len(starts), LENGTH + 1))
        seen = outcome.seen(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1)).unflatten(0, rows.shape)
        names = ("action", "reward", "done", "change", "vitals")
        at = {name: torch.from_numpy(getattr(happened, name)[rows]).float().to(device) for name in names}
        hidden, total = outcome.begin(len(starts)).to(device), torch.zeros((), device=device)
        own, follows = at["vitals"][:, 0], now.rand(len(starts), 1) < FOLLOWED
        for step in range(LENGTH):
            recorded = at["vitals"][:, step]
            vitals = torch.where(follows, own, recorded)
            change = recorded + at["change"][:, step] - vitals
            predicted = outcome.judge(seen[:, step], at["action"][:, step], vitals, hidden)
            hidden = predicted.hidden
            own = vitals + self._drawn(predicted, now)  # an end is seen, too, where a vital that tells it was not drawn
            ends = outcome.ends(predicted.known, torch.where(follows, own, vitals + change))
            error = negative_log_likelihood(
                outcome.config, predicted, ends, at["reward"][:, step], at["done"][:, step], change
            )
            total = total + (weight.to(device) * error).mean() / LENGTH
        yield Loss("outcome", total, {"outcome": total})

    def _drawn(self, predicted: OutcomeLogits, now: TrainStep) -> torch.Tensor:
        """Changes [B, V] of the vitals, drawn from what is predicted."""
        drawn = [predicted.hidden.new_zeros(len(predicted.hidden), 0)]
        for logits, values in zip(predicted.changes, self.outcome.config.changes):
            upto = logits.detach().float().softmax(1).cumsum(1)
            pick = (upto < now.rand(len(upto), 1)).sum(1, keepdim=True).clamp_max(len(values) - 1)
            drawn.append(torch.tensor(values, device=upto.device)[pick])
        sizes = predicted.numbers.new_tensor(self.outcome.config.sizes)
        return torch.cat([*drawn, predicted.numbers.detach() * sizes], 1)


def learn_outcome(run: Run, objective: OutcomeObjective, steps: int) -> dict:
    """Trains the objective's FrameOutcome in place; returns facts of the training."""
    if not len(objective.starts):
        return {"outcome_steps": 0}
    feed = SizedFeed(lambda size: RandomBatches(lambda now: objective.sample(now, size)), objective.size)
    trainer = Trainer(run, "outcome", feed, objective, steps)
    trainer.train()
    objective.outcome.eval()
    return {"outcome_steps": trainer.facts["step"]}


def negative_log_likelihood(
    config: OutcomeConfig,
    predicted: OutcomeLogits,
    ends: torch.Tensor,
    reward: torch.Tensor,
    done: torch.Tensor,
    change: torch.Tensor,
) -> torch.Tensor:
    """[B], in nats (of vectors the mean of Huber's loss), of recorded reward [B], done [B] and change [B, V]. ends [B]: a logit."""
    total = F.cross_entropy(predicted.reward, two_hot(reward, torch.tensor(config.rewards)), reduction="none")
    total = total + F.binary_cross_entropy_with_logits(ends, done, reduction="none")
    for column, (logits, values) in enumerate(zip(predicted.changes, config.changes)):
        right = two_hot(change[:, column], torch.tensor(values))
        total = total + F.cross_entropy(logits, right, reduction="none")
    if config.sizes:
        numbers = change[:, len(config.changes) :] / change.new_tensor(config.sizes)
        total = total + F.huber_loss(predicted.numbers, numbers, reduction="none").mean(1)
    return total


def _degraded(frames: torch.Tensor, now: TrainStep) -> torch.Tensor:
    """Half of the batches blurred and noisy, as generated frames are: uint8 to uint8."""
    if now.rng.random() < 0.5:
        return frames
    soft = F.avg_pool2d(frames.float(), 3, 1, 1, count_include_pad=False)
    mixed = frames.float().lerp(soft, float(now.rng.random() * 0.6))
    noise = now.randn(*mixed.shape)
    return (mixed + 5 * float(now.rng.random()) * noise).round().clamp(0, 255).to(torch.uint8)
