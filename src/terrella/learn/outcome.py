"""train_outcome: teaches an Outcome the rewards, ends and vitals of a recording, on short pieces of its episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..data import ClipCache
from ..worlds.outcome import Logits, Outcome, OutcomeConfig

PIECE = 8  # steps that are learned from at a time
_LEVELS = 33  # values, at most, that a reward or a change is told apart into


@dataclass(frozen=True)
class Happenings:
    """What followed each row of a recording: action as told [N, A]; reward [N]; done [N]; vitals [N, V] at the row;
    change [N, V] by its step; real bool [N]: rows whose step was recorded and may be learned from."""

    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    vitals: np.ndarray
    change: np.ndarray
    real: np.ndarray
    names: tuple[str, ...]

    @staticmethod
    def of(cache: ClipCache, action: np.ndarray, usable: np.ndarray) -> Happenings:
        """`action`: float [N, A] as it is told to networks; `usable`: bool [N], rows that training may see."""
        names = tuple(cache.vitals)
        vitals = np.zeros((cache.length, len(names)), np.float32)
        for column, name in enumerate(names):
            vitals[:, column] = np.asarray(cache.vitals[name], np.float32).reshape(cache.length)
        real = usable & np.roll(usable, -1) & np.asarray(cache.action_valid, bool)
        real[[stop - 1 for _, stop in cache.episodes]] = False  # nothing follows an episode's last row
        change = np.where(real[:, None], np.roll(vitals, -1, 0) - vitals, 0.0)
        told = (cache.reward, cache.done)  # what a recording lacks is none of either
        reward, done = (np.zeros(cache.length, np.float32) if part is None else np.array(part) for part in told)
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
    values = values.clamp(float(among[0]), float(among[-1]))
    above = torch.searchsorted(among, values.contiguous()).clamp(1, len(among) - 1)
    share = (values - among[above - 1]) / (among[above] - among[above - 1])
    rows = torch.arange(len(values))
    shares = torch.zeros(len(values), len(among))
    shares[rows, above - 1], shares[rows, above] = 1 - share, share
    return shares


def train_outcome(
    outcome: Outcome,
    rgb: Callable[[np.ndarray], torch.Tensor],
    happened: Happenings,
    steps: int,
    seed: int,
    report: Callable[[float, float, str], None],
    batch: int = 12,
    learning_rate: float = 2e-3,
) -> dict:
    """Trains in place. `rgb(rows)` gives uint8 [n, 3, H, W]. Half of the pieces hold an event; each piece counts by how
    much likelier than evenly it was drawn, so that what is rare stays as rare as it is. Returns facts of the training."""
    device = outcome.rewards.device
    real = np.lib.stride_tricks.sliding_window_view(happened.real, PIECE).all(1)
    starts = np.flatnonzero(real)
    if not len(starts):
        return {"outcome_steps": 0}
    sums = np.concatenate([[0], np.cumsum(happened.events())])
    eventful = (sums[starts + PIECE] - sums[starts]).astype(float)
    even = np.full(len(starts), 1 / len(starts))
    often = 0.5 * even + 0.5 * (eventful / eventful.sum() if eventful.any() else even)
    heads = [weight for head in (outcome.paid, outcome.ending, *outcome.changed) for weight in head.parameters()]
    known = {id(weight) for weight in heads}
    body = [weight for weight in outcome.parameters() if id(weight) not in known]
    optimiser = torch.optim.AdamW([{"params": body, "pace": 1.0}, {"params": heads, "pace": 8.0}], weight_decay=1e-3)
    outcome.train()
    recent: list[float] = []
    for step in range(steps):
        rng = np.random.default_rng([seed, step, 7])
        now = learning_rate * min(1, (step + 1) / 50) * (0.03 + 0.97 * (0.5 + 0.5 * np.cos(np.pi * step / steps)))
        for group in optimiser.param_groups:
            group["lr"] = now * group["pace"]  # what is rare is heard by the heads alone, and seldom
        picks = rng.choice(len(starts), batch, p=often)
        weight = torch.from_numpy(even[picks] / often[picks]).float().to(device)
        loss = _loss(outcome, rgb, happened, starts[picks], weight, rng)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(outcome.parameters(), 1.0)
        optimiser.step()
        recent.append(float(loss.detach()))
        if step % 20 == 19:
            report((step + 1) / steps, 1.0, f"outcome {np.mean(recent[-20:]):.4f}")
    outcome.eval()
    return {"outcome_steps": steps, "outcome_loss": round(float(np.mean(recent[-100:])), 5)}


def _loss(outcome: Outcome, rgb, happened: Happenings, starts, weight: torch.Tensor, rng) -> torch.Tensor:
    """Mean over the pieces [B, PIECE] that begin at `starts`, weighted [B]."""
    device = outcome.rewards.device
    rows = starts[:, None] + np.arange(PIECE)
    frames = rgb((starts[:, None] + np.arange(PIECE + 1)).ravel()).to(device)
    frames = _spoilt(frames, rng).unflatten(0, (len(starts), PIECE + 1))
    seen = outcome.seen(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1)).unflatten(0, rows.shape)
    at = {
        name: torch.from_numpy(getattr(happened, name)[rows]).float() for name in ("action", "reward", "done", "change")
    }
    vitals = torch.from_numpy(happened.vitals[rows]).float().to(device)
    hidden, total = outcome.begin(len(starts)).to(device), torch.zeros((), device=device)
    for step in range(PIECE):
        told = outcome.judge(seen[:, step], at["action"][:, step].to(device), vitals[:, step], hidden)
        hidden = told.hidden
        change = at["change"][:, step]
        done = outcome.ends(told.known, vitals[:, step] + change.to(device))
        error = surprise(outcome.config, told, done, at["reward"][:, step], at["done"][:, step], change)
        total = total + (weight * error).mean()
    return total / PIECE


def surprise(
    config: OutcomeConfig,
    told: Logits,
    ends: torch.Tensor,
    reward: torch.Tensor,
    done: torch.Tensor,
    change: torch.Tensor,
) -> torch.Tensor:
    """How unlikely what happened was: [B], in nats; ends [B], the logit; reward and done [B], change [B, V] as they were."""
    there = told.reward.device
    total = F.cross_entropy(told.reward, two_hot(reward, torch.tensor(config.rewards)).to(there), reduction="none")
    total = total + F.binary_cross_entropy_with_logits(ends, done.to(there), reduction="none")
    for column, (logits, values) in enumerate(zip(told.changes, config.changes)):
        right = two_hot(change[:, column], torch.tensor(values)).to(there)
        total = total + F.cross_entropy(logits, right, reduction="none")
    return total


def _spoilt(frames: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Half of the batches a little soft and noisy, as dreamt frames are: uint8 to uint8."""
    if rng.random() < 0.5:
        return frames
    soft = F.avg_pool2d(frames.float(), 3, 1, 1, count_include_pad=False)
    mixed = frames.float().lerp(soft, float(rng.random() * 0.6))
    noise = torch.randn(mixed.shape, generator=torch.Generator().manual_seed(int(rng.integers(2**62)))).to(mixed.device)
    return (mixed + 5 * float(rng.random()) * noise).round().clamp(0, 255).to(torch.uint8)


@torch.inference_mode()
def examine_outcome(outcome: Outcome, rgb, happened: Happenings, first: int, stop: int) -> dict[str, np.ndarray]:
    """Follows the recorded frames of rows first..stop: predicted reward, done (probability) and vitals' change, one row
    for each recorded step."""
    found: dict[str, list] = {"reward": [], "done": [], "change": []}
    hidden = outcome.begin(1)
    for row in range(first, stop - 1):
        frames = rgb(np.array([row, row + 1]))
        vitals = torch.from_numpy(happened.vitals[row : row + 1])
        told = outcome(frames[:1], frames[1:], torch.from_numpy(happened.action[row : row + 1]).float(), vitals, hidden)
        hidden = told.hidden
        found["reward"].append(float(told.reward))
        found["done"].append(float(torch.sigmoid(told.done)))
        found["change"].append((told.vitals - vitals)[0].numpy())
    return {name: np.array(values) for name, values in found.items()}
