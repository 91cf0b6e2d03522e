"""Outcome: reward, end and the player's vitals of a step; a network reads them off two frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from ..core import chance
from ..core.backend import constant, plus
from ..core.errors import ObservationError
from ..core.spec import DONE, REWARD
from ..core.state import State
from .parts import CHANGES, Channels, Ends, Evidence, Tensors, newest_frame


@dataclass(frozen=True)
class ConstantConfig:
    """Of a constant outcome."""

    usual: float = 0.0  # reward of every step
    ending: float = 0.0  # added to that of the last


@final
class ConstantOutcome:
    """The same reward for every step but the last; the body says where an episode ends."""

    kind = "constant"
    begins: tuple[float, ...] = ()
    vectors: tuple[str, ...] = ()
    draws: Mapping[int, Sequence[int]] = MappingProxyType({})

    def __init__(self, config: ConstantConfig):
        self.config = config

    def to(self, device) -> ConstantOutcome:
        return self

    def channels(self) -> Channels:
        return Channels({"reward": REWARD, "done": DONE})

    def observe(self, prior: State | None, evidence: Evidence, observation: Mapping) -> Tensors:
        return _going(evidence)

    def step(
        self, before: State, after: State, ends: Ends, action: torch.Tensor, chances: Mapping[int, torch.Tensor]
    ) -> Tensors:
        """Reward and end of a step; no frame is read."""
        over = ends()
        usual, last = (
            constant(torch.tensor, over.device, reward)
            for reward in (self.config.usual, self.config.usual + self.config.ending)
        )
        return {"done": before["done"] | over, "reward": torch.where(over, last, usual)}

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        return {}


@dataclass(frozen=True)
class OutcomeConfig:
    """Of the outcome network."""

    actions: int  # numbers of an encoded action
    rewards: tuple[float, ...]  # values of the two-hot code of rewards, ascending
    # Channels of the player's numbers, such as "health"; then those of vectors, each once for each of its numbers.
    vitals: tuple[str, ...] = ()
    changes: tuple[tuple[float, ...], ...] = ()  # of each other vital the changes that a step may bring, ascending
    spans: tuple[float, ...] = ()  # of each vital its usual size
    hidden: int = 64  # width of the GRU
    side: int = 64  # pixels; larger frames are shrunk to it
    begins: tuple[float, ...] = ()  # vitals of a new episode
    sizes: tuple[float, ...] = ()  # of each number of vectors the usual size of its change


class OutcomePrediction(NamedTuple):
    """The outcome of a step."""

    reward: torch.Tensor  # float32 [B], the expectation
    done: torch.Tensor  # [B], a logit
    vitals: torch.Tensor  # [B, V] after the step
    hidden: torch.Tensor  # [B, hidden]


class OutcomeLogits(NamedTuple):
    """What the network reads off two frames."""

    reward: torch.Tensor  # [B, len(rewards)]
    changes: list[torch.Tensor]  # of each vital that is no vector's [B, len(changes)]
    numbers: torch.Tensor  # [B, len(sizes)], changes of vectors over their usual sizes
    hidden: torch.Tensor  # [B, hidden]
    known: torch.Tensor  # [B, inner], what was seen and remembered


@final
class FrameOutcome(nn.Module):
    """A small convolutional network over the frames before and after a step, and a GRU cell that remembers.

    Rewards and changes are classified among the values of the recording (two-hot, as in Dreamer 3). A reward is the
    expectation; the change of a vital is sampled, so that a count of lives stays whole. Changes of vectors are regressed, from
    the action once more. The end depends on the vitals, too.
    """

    kind = "frames"

    rewards: torch.Tensor

    def __init__(self, config: OutcomeConfig):
        super().__init__()
        self.config, self.begins = config, config.begins or (0.0,) * len(config.vitals)
        widths = (24, 32, 48, 64)
        self.look = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in zip(widths, widths[1:]))
        self.sum_up = nn.Linear(widths[-1] * 16, 128)
        self.remember = nn.GRUCell(128 + config.actions + len(config.vitals), config.hidden)
        inner = 128 + config.hidden
        self.paid = nn.Linear(inner, len(config.rewards))
        self.ending = nn.Linear(inner + len(config.vitals) + len(config.changes), 1)
        nn.init.constant_(self.ending.bias, -3.0)  # few steps are the last
        self.changed = nn.ModuleList(nn.Linear(inner, len(levels)) for levels in config.changes)
        self.regressed = nn.Linear(inner + config.actions, len(config.sizes)) if config.sizes else None
        self._widths = Counter(config.vitals)  # of each channel, in the order of its columns
        self.register_buffer("rewards", torch.tensor(config.rewards), persistent=False)

    @property
    def draws(self) -> Mapping[int, Sequence[int]]:
        """See parts.Outcome."""
        return {CHANGES + column: () for column in range(len(self.config.changes))}

    @property
    def vectors(self) -> tuple[str, ...]:
        """See parts.Outcome."""
        return tuple(self._widths)[len(self.config.changes) :]

    def begin(self, batch: int) -> torch.Tensor:
        """The hidden state of a new episode: [batch, hidden]."""
        return self.rewards.new_zeros(batch, self.config.hidden)

    # -- as a part of a world -----------------------------------------------------------------------------------------

    def channels(self) -> Channels:
        vitals = {name: _numbers(width) for name, width in self._widths.items()}
        return Channels({"reward": REWARD, "done": DONE, **vitals}, may_observe=tuple(vitals))

    def observe(self, prior: State | None, evidence: Evidence, observation: Mapping) -> Tensors:
        """An episode that goes on, with the vitals that evidence gives, else those of `prior`, else those of a new episode."""
        batch, device = evidence.batch, evidence.device
        if prior is None:
            begun = {"hidden": self.begin(batch)}
            known = torch.tensor(self.begins, device=device).expand(batch, -1)
        else:
            begun, known = {}, prior["vitals"]
        vitals = evidence.seen.get("vitals", known).clone()
        for name, columns in self._columns():
            if name in observation:
                given, shape = torch.as_tensor(observation[name]).float(), vitals[:, columns].shape
                if given.shape != shape or not torch.isfinite(given).all():
                    raise ObservationError(f"{name} is finite float {list(shape)}; got {tuple(given.shape)}.")
                vitals[:, columns] = given.to(device)
        return {**_going(evidence), **begun, "vitals": vitals}

    def step(
        self, before: State, after: State, ends: Ends, action: torch.Tensor, chances: Mapping[int, torch.Tensor]
    ) -> Tensors:
        """Reward, end and vitals as they are read off the frames before and after the step; where the body ends is ignored."""
        frames = newest_frame(before), newest_frame(after)
        outcome = self(*frames, action, before["vitals"], before["hidden"], chances)
        return {**outcome._asdict(), "done": outcome.done > 0}

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        return {name: state["vitals"][:, at].clone() for name, at in self._columns() if name in channels}

    def _columns(self) -> Iterable[tuple[str, int | slice]]:
        """Of each channel its column among the vitals, of a vector its columns."""
        at = 0
        for name, width in self._widths.items():
            yield name, at if width == 1 else slice(at, at + width)
            at += width

    # -- the network --------------------------------------------------------------------------------------------------

    def seen(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """Features [B, 128] of two frames uint8 [B, 3, H, W]."""
        first, second = _shrunk(torch.cat([before, after]), self.config.side).chunk(2)
        x = F.pixel_unshuffle(torch.cat([second, second - first], 1), 2)
        for layer in self.look:
            x = F.silu(layer(x))
        return F.silu(self.sum_up(F.adaptive_avg_pool2d(x, 4).flatten(1)))

    def judge(
        self, seen: torch.Tensor, action: torch.Tensor, vitals: torch.Tensor, hidden: torch.Tensor
    ) -> OutcomeLogits:
        """From `seen` [B, 128]; action [B, actions]; vitals [B, V] before the step; hidden [B, hidden]."""
        spans = constant(torch.tensor, seen.device, self.config.spans)
        hidden = self.remember(torch.cat([seen, action, vitals / spans], 1), hidden)
        known = torch.cat([seen, hidden], 1)
        numbers = known[:, :0] if self.regressed is None else self.regressed(torch.cat([known, action], 1))
        return OutcomeLogits(self.paid(known), [head(known) for head in self.changed], numbers, hidden, known)

    def ends(self, known: torch.Tensor, vitals: torch.Tensor) -> torch.Tensor:
        """The logit [B] that the episode is over, from OutcomeLogits.known and the vitals [B, V] after the step."""
        spans = constant(torch.tensor, known.device, self.config.spans)
        used_up = 4.0 * (vitals[:, : len(self.changed)] <= 0)  # large, so that it is learned from few ends
        return self.ending(torch.cat([known, vitals / spans, used_up], 1))[:, 0]

    def forward(
        self,
        before: torch.Tensor,
        after: torch.Tensor,
        action: torch.Tensor,
        vitals: torch.Tensor,
        hidden: torch.Tensor,
        chances: Mapping[int, torch.Tensor] | None = None,
    ) -> OutcomePrediction:
        """The outcome of a step; arguments as for `seen` and `judge`. With random numbers of `draws` the changes of vitals are
        sampled; without, they are the likeliest."""
        read = self.judge(self.seen(before, after), action, vitals, hidden)
        reward = (read.reward.float().softmax(1) * self.rewards).sum(1)
        changes = []
        for column, (logits, values) in enumerate(zip(read.changes, self.config.changes)):
            levels, likely = constant(torch.tensor, logits.device, values), logits.float().softmax(1)
            picked = logits.argmax(1) if chances is None else chance.chosen(chances[CHANGES + column], likely)
            changes.append(levels[picked])
        if self.regressed is not None:
            changes += (read.numbers.float() * constant(torch.tensor, vitals.device, self.config.sizes)).unbind(1)
        left = vitals.float() + torch.stack(changes, 1) if changes else vitals
        return OutcomePrediction(reward, self.ends(read.known, left).float(), left, read.hidden.float())


def _numbers(count: int) -> spaces.Box:
    """The space of a channel of `count` numbers."""
    return spaces.Box(-np.inf, np.inf, () if count == 1 else (count,), np.float32)


def _going(evidence: Evidence) -> Tensors:
    """An episode that is not over, without reward yet."""
    reward = torch.zeros(evidence.batch, device=evidence.device)
    return {"reward": reward, "done": torch.zeros_like(reward, dtype=torch.bool)}


def _shrunk(frame: torch.Tensor, side: int) -> torch.Tensor:
    """uint8 [B, 3, H, W] -> [-1, 1] with even sides, the longer at most `side`."""
    height, width = frame.shape[-2:]
    share = min(1.0, side / max(height, width))
    size = [max(8, 2 * round(length * share / 2)) for length in (height, width)]
    picture = plus(-1.0, frame, 1 / 127.5)
    return picture if size == [height, width] else F.interpolate(picture, size, mode="area")
