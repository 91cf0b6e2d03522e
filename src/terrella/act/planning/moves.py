"""Plans coded as numbers that a search can sample, mix and narrow, for continuous and for discrete actions alike.

A plan is coded as float [H, D]: continuous actions from -1 to 1 between their limits, discrete ones as the number of each choice.
`belief` [B, H, D, K] is a search's distribution: mean and standard deviation (K = 2), or the probabilities of K choices.
"""

import math

import numpy as np
import torch
from gymnasium import spaces

from ...core import chance
from ...core.errors import PlanningError
from ...core.spec import Spec, dtype_of, shape_of, torch_dtype_of

_FLOOR = 0.02  # least standard deviation, and the share of probability spread evenly over all choices
_MAX_BRANCHES = 256  # of a tree search, at each depth


class ContinuousMoves:
    """Actions of a Box. An axis without a limit reaches from -1 to 1."""

    def __init__(self, spec: Spec):
        low, high = (np.asarray(limit, np.float64).reshape(-1) for limit in spec.action_limits)
        free = ~(np.isfinite(low) & np.isfinite(high))
        low, high = np.where(free, np.clip(low, -1, None), low), np.where(free, np.clip(high, None, 1), high)
        self.shape, self.dtype, self.size = shape_of(spec.action), torch_dtype_of(spec.action), len(low)
        self._middle, self._half = (torch.from_numpy(part).float() for part in ((low + high) / 2, (high - low) / 2))
        self._low, self._high = torch.from_numpy(low).float(), torch.from_numpy(high).float()

    def initial(self, batch: int, horizon: int, spread: float) -> torch.Tensor:
        return torch.tensor([0.0, spread]).expand(batch, horizon, self.size, 2)

    def uniform(self, noise: torch.Tensor) -> torch.Tensor:
        """Uniform codes, from standard normal noise [B, N, H, D]."""
        return torch.special.ndtr(noise) * 2 - 1

    def sample(self, belief: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return (belief[:, None, ..., 0] + belief[:, None, ..., 1] * noise).clamp(-1, 1)

    def fit(self, codes: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """The belief fitted to codes [B, N, H, D] with weights [B, N] that sum to 1."""
        share = weights[..., None, None]
        mean = (codes * share).sum(1)
        deviation = ((codes - mean[:, None]).square() * share).sum(1).sqrt()
        return torch.stack([mean, deviation.clamp_min(_FLOOR)], -1)

    def widen(self, belief: torch.Tensor, spread: float) -> torch.Tensor:
        """The belief of the decision before, with the spread of an initial one."""
        return torch.stack([belief[..., 0], torch.full_like(belief[..., 0], spread)], -1)

    def mode(self, belief: torch.Tensor) -> torch.Tensor:
        """The most likely codes [B, H, D] of a belief."""
        return belief[..., 0].clamp(-1, 1)

    def actions(self, codes: torch.Tensor) -> torch.Tensor:
        """[..., D] -> [..., *action.shape]; gradients pass."""
        values = (self._middle + self._half * codes).clamp(self._low, self._high)
        return values.to(self.dtype).reshape(*codes.shape[:-1], *self.shape)

    def codes(self, actions: torch.Tensor) -> torch.Tensor:
        values = actions.float().reshape(*actions.shape[: actions.ndim - len(self.shape)], self.size)
        return ((values - self._middle) / self._half.clamp_min(1e-9)).clamp(-1, 1)

    def all(self) -> torch.Tensor:
        raise PlanningError(
            "a tree search tries each choice in turn, and continuous actions have none: use icem or mppi."
        )


class DiscreteMoves:
    """Actions of one choice or several, or buttons."""

    def __init__(self, spec: Spec):
        low, high = (np.asarray(limit).reshape(-1).astype(np.int64) for limit in spec.action_limits)
        self.shape, self.dtype, self.size = shape_of(spec.action), torch_dtype_of(spec.action), len(low)
        self._low, self._counts = torch.from_numpy(low), torch.from_numpy(high - low + 1)
        valid = torch.arange(int(self._counts.max())) < self._counts[:, None]
        self._even = valid.float() / self._counts[:, None]

    def initial(self, batch: int, horizon: int, spread: float) -> torch.Tensor:
        return self._even.expand(batch, horizon, *self._even.shape)

    def uniform(self, noise: torch.Tensor) -> torch.Tensor:
        return self.sample(self.initial(len(noise), noise.shape[2], 1.0), noise)

    def sample(self, belief: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Choices by inverse transform sampling: noise that changes slowly gives choices that change slowly."""
        sums = belief.cumsum(-1)[:, None]
        point = torch.special.ndtr(noise)[..., None] * sums[..., -1:]
        return torch.minimum((sums <= point).sum(-1), self._counts - 1).float()

    def fit(self, codes: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        ones = torch.nn.functional.one_hot(codes.long(), self._even.shape[1]).float()
        shares = (ones * weights[..., None, None, None]).sum(1)
        return (1 - _FLOOR) * shares + _FLOOR * self._even

    def widen(self, belief: torch.Tensor, spread: float) -> torch.Tensor:
        return (belief + self._even) / 2

    def mode(self, belief: torch.Tensor) -> torch.Tensor:
        return belief.argmax(-1).float()

    def actions(self, codes: torch.Tensor) -> torch.Tensor:
        return (codes.long() + self._low).to(self.dtype).reshape(*codes.shape[:-1], *self.shape)

    def codes(self, actions: torch.Tensor) -> torch.Tensor:
        values = actions.long().reshape(*actions.shape[: actions.ndim - len(self.shape)], self.size)
        return torch.minimum((values - self._low).clamp_min(0), self._counts - 1).float()

    def all(self) -> torch.Tensor:
        """Every combination: [M, D]. PlanningError if there are too many."""
        total = math.prod(self._counts.tolist())
        if total > _MAX_BRANCHES:
            raise PlanningError(
                f"a tree search tries each action in turn, and there are {total:,} of them; use icem or cem."
            )
        choices = [torch.arange(int(count)) for count in self._counts]
        return torch.cartesian_prod(*choices).reshape(total, self.size).float()


Moves = ContinuousMoves | DiscreteMoves


def moves_of(spec: Spec) -> Moves:
    """The coding of a world's actions."""
    if dtype_of(spec.action).kind == "f" and isinstance(spec.action, spaces.Box):
        return ContinuousMoves(spec)
    return DiscreteMoves(spec)


def coloured(seeds: torch.Tensor, candidates: int, horizon: int, size: int, colour: float, stream: int) -> torch.Tensor:
    """Standard normal noise [B, N, H, D] whose power falls with frequency as f^-colour along H (Timmer & Koenig 1995, as in iCEM,
    Pinneri et al. 2020); 0 is white. Each episode's noise comes from its own seed."""
    white = chance.normal(seeds, (candidates, size, horizon), stream)
    if colour and horizon > 1:
        gains = torch.fft.fftfreq(horizon).abs().clamp_min(1 / horizon) ** (-colour / 2)
        gains = gains / gains.square().mean().sqrt()
        white = torch.fft.irfft(torch.fft.rfft(white) * gains[: horizon // 2 + 1], n=horizon)
    return white.transpose(2, 3)


def shifted(belief: torch.Tensor, steps: int, rest: torch.Tensor) -> torch.Tensor:
    """A belief or codes [H, ...] shifted by `steps`: the first are dropped, and the end is filled from `rest` [H, ...]."""
    return torch.cat([belief[steps:], rest[len(rest) - min(steps, len(rest)) :]])
