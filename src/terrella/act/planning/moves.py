"""Sequences of actions as numbers that a search can draw, mix and narrow, for axes and for choices alike.

A plan is coded as float [H, D]: of axes their values between -1 (least) and 1 (most); of choices the number of each choice. What
a search believes of good plans is a tensor [B, H, D, K]: mean and deviation of an axis (K = 2), or the probabilities of K choices.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from gymnasium import spaces

from ...core import chance
from ...core.errors import PlanningError
from ...core.spec import Spec, dtype_of, shape_of, torch_dtype_of

_FLOOR = 0.02  # least deviation, and least share of probability that is spread over all choices
_MOST_MOVES = 256  # of which a tree tries each


class ContinuousMoves:
    """Actions of a Box. Axes without a limit reach from -1 to 1."""

    def __init__(self, spec: Spec):
        low, high = (np.asarray(limit, np.float64).reshape(-1) for limit in spec.action_limits)
        wild = ~(np.isfinite(low) & np.isfinite(high))
        low, high = np.where(wild, np.clip(low, -1, None), low), np.where(wild, np.clip(high, None, 1), high)
        self.shape, self.dtype, self.size = shape_of(spec.action), torch_dtype_of(spec.action), len(low)
        self._middle, self._half = (torch.from_numpy(part).float() for part in ((low + high) / 2, (high - low) / 2))
        self._low, self._high = torch.from_numpy(low).float(), torch.from_numpy(high).float()

    def first(self, batch: int, horizon: int, spread: float) -> torch.Tensor:
        return torch.tensor([0.0, spread]).expand(batch, horizon, self.size, 2)

    def uniform(self, noise: torch.Tensor) -> torch.Tensor:
        """Codes spread evenly, of standard normal noise [B, N, H, D]."""
        return torch.special.ndtr(noise) * 2 - 1

    def draw(self, belief: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return (belief[:, None, ..., 0] + belief[:, None, ..., 1] * noise).clamp(-1, 1)

    def fitted(self, codes: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """The belief that codes [B, N, H, D] with weights [B, N], which sum to 1, speak for."""
        share = weights[..., None, None]
        mean = (codes * share).sum(1)
        deviation = ((codes - mean[:, None]).square() * share).sum(1).sqrt()
        return torch.stack([mean, deviation.clamp_min(_FLOOR)], -1)

    def reopened(self, belief: torch.Tensor, spread: float) -> torch.Tensor:
        """A belief of before, as doubtful as a first one."""
        return torch.stack([belief[..., 0], torch.full_like(belief[..., 0], spread)], -1)

    def best_of(self, belief: torch.Tensor) -> torch.Tensor:
        """The middle of a belief, as codes [B, H, D]."""
        return belief[..., 0].clamp(-1, 1)

    def actions(self, codes: torch.Tensor) -> torch.Tensor:
        """[..., D] -> [..., *action.shape]; gradients pass."""
        values = (self._middle + self._half * codes).clamp(self._low, self._high)
        return values.to(self.dtype).reshape(*codes.shape[:-1], *self.shape)

    def codes(self, actions: torch.Tensor) -> torch.Tensor:
        values = actions.float().reshape(*actions.shape[: actions.ndim - len(self.shape)], self.size)
        return ((values - self._middle) / self._half.clamp_min(1e-9)).clamp(-1, 1)

    def all(self) -> torch.Tensor:
        raise PlanningError("a tree search tries each choice in turn, and axes have no end of them: use icem or mppi.")


class DiscreteMoves:
    """Actions of one choice or several, and buttons."""

    def __init__(self, spec: Spec):
        low, high = (np.asarray(limit).reshape(-1).astype(np.int64) for limit in spec.action_limits)
        self.shape, self.dtype, self.size = shape_of(spec.action), torch_dtype_of(spec.action), len(low)
        self._low, self._counts = torch.from_numpy(low), torch.from_numpy(high - low + 1)
        there = torch.arange(int(self._counts.max())) < self._counts[:, None]
        self._even = there.float() / self._counts[:, None]

    def first(self, batch: int, horizon: int, spread: float) -> torch.Tensor:
        return self._even.expand(batch, horizon, *self._even.shape)

    def uniform(self, noise: torch.Tensor) -> torch.Tensor:
        return self.draw(self.first(len(noise), noise.shape[2], 1.0), noise)

    def draw(self, belief: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The choice at whose place in the summed probabilities the noise stands: noise that changes slowly, slow choices."""
        sums = belief.cumsum(-1)[:, None]
        point = torch.special.ndtr(noise)[..., None] * sums[..., -1:]
        return torch.minimum((sums <= point).sum(-1), self._counts - 1).float()

    def fitted(self, codes: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        ones = torch.nn.functional.one_hot(codes.long(), self._even.shape[1]).float()
        shares = (ones * weights[..., None, None, None]).sum(1)
        return (1 - _FLOOR) * shares + _FLOOR * self._even

    def reopened(self, belief: torch.Tensor, spread: float) -> torch.Tensor:
        return (belief + self._even) / 2

    def best_of(self, belief: torch.Tensor) -> torch.Tensor:
        return belief.argmax(-1).float()

    def actions(self, codes: torch.Tensor) -> torch.Tensor:
        return (codes.long() + self._low).to(self.dtype).reshape(*codes.shape[:-1], *self.shape)

    def codes(self, actions: torch.Tensor) -> torch.Tensor:
        values = actions.long().reshape(*actions.shape[: actions.ndim - len(self.shape)], self.size)
        return torch.minimum((values - self._low).clamp_min(0), self._counts - 1).float()

    def all(self) -> torch.Tensor:
        """Every combination: [M, D]. PlanningError where there are too many."""
        total = math.prod(self._counts.tolist())
        if total > _MOST_MOVES:
            raise PlanningError(
                f"a tree search tries each action in turn, and there are {total:,} of them; use icem or cem."
            )
        every = [torch.arange(int(count)) for count in self._counts]
        return torch.cartesian_prod(*every).reshape(total, self.size).float()


Moves = ContinuousMoves | DiscreteMoves


def moves_of(spec: Spec) -> Moves:
    """How the actions of a world are coded. ActionError for spaces that no world has."""
    if dtype_of(spec.action).kind == "f" and isinstance(spec.action, spaces.Box):
        return ContinuousMoves(spec)
    return DiscreteMoves(spec)


def coloured(seeds: torch.Tensor, candidates: int, horizon: int, size: int, colour: float, stream: int) -> torch.Tensor:
    """Standard normal noise [B, N, H, D] whose power falls with frequency as f^-colour along H (Timmer & Koenig 1995, as in iCEM,
    Pinneri et al. 2020); 0 is white. An episode's noise is that of its seed."""
    white = chance.normal(seeds, (candidates, size, horizon), stream)
    if colour and horizon > 1:
        gains = torch.fft.fftfreq(horizon).abs().clamp_min(1 / horizon) ** (-colour / 2)
        gains = gains / gains.square().mean().sqrt()
        white = torch.fft.irfft(torch.fft.rfft(white) * gains[: horizon // 2 + 1], n=horizon)
    return white.transpose(2, 3)


def shifted(belief: torch.Tensor, steps: int, rest: torch.Tensor) -> torch.Tensor:
    """A belief or codes [H, ...] `steps` later: what is gone is left out, and `rest` [H, ...] fills the end."""
    return torch.cat([belief[steps:], rest[len(rest) - min(steps, len(rest)) :]])
