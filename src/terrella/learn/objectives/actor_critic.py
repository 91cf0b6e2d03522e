"""Actor-critic on imagined rollouts: lambda-returns, a two-hot critic, and a policy that follows the advantage or the world's own
gradients (DreamerV3, Hafner et al. 2023).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from ...act.actor_network import ActorConfig, ActorNetwork, ObservationEncoder, mlp, symexp
from ..imagination import Imagined
from ..trainer import Average, Loss, Now, adamw, warmed
from .outcome import two_hot

BINS, REACH = 63, 10.0  # of the critic, even in symlog: up to about 22,000
SLOW = 0.98  # how much of its weights the slow critic keeps in a step
MIDDLE, STEADY = (0.05, 0.95), 0.99  # quantiles between which returns lie, and how steadily they are followed


@dataclass(frozen=True)
class Wanted:
    """What the policy is to be paid for. discount: of a reward a step later; td_lambda: lambda, from 0 (the critic's word after one
    step) to 1 (what came to the end of the dream); entropy: what a nat is worth, in ranges of returns; cautious: where a dream is
    no longer known counts as the worst that the critic expects anywhere in the batch, so that a policy stays where the world knows
    what comes (after MOReL, Kidambi et al. 2020)."""

    discount: float = 0.99
    td_lambda: float = 0.95
    entropy: float = 3e-4
    cautious: bool = False


def lambda_returns(
    reward: torch.Tensor, goes_on: torch.Tensor, value: torch.Tensor, known: torch.Tensor, wanted: Wanted
) -> torch.Tensor:
    """[T, B]: what is paid from each step on, by rewards [T, B] and by values [T + 1, B] of where they led (Sutton & Barto 2018,
    12.1). A dream that is no longer `known` counts as far, and its value from there."""
    if wanted.cautious:
        value = torch.cat([value[:1], torch.where(known, value[1:], value.detach().min())])
    found, after = [], value[-1]
    for step in range(len(reward) - 1, -1, -1):
        td_lambda = wanted.td_lambda * known[step]
        ahead = (1 - td_lambda) * value[step + 1] + td_lambda * after
        after = reward[step] + wanted.discount * goes_on[step] * ahead
        found.append(after)
    return torch.stack(found[::-1])


def weights_of(goes_on: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """[T, B]: how likely a step happened at all, for what came before it [T, B]."""
    reached = (goes_on.detach() * known).cumprod(0)
    return torch.cat([torch.ones_like(reached[:1]), reached[:-1]])


class Critic(nn.Module):
    """What is to come from a state: shares of BINS values that are even in symlog."""

    bins: torch.Tensor

    def __init__(self, config: ActorConfig):
        super().__init__()
        self.eyes = ObservationEncoder(config)
        self.think = mlp(self.eyes.width, config.hidden, config.layers, BINS, gain=0.0)
        self.register_buffer("bins", symexp(torch.linspace(-REACH, REACH, BINS)), persistent=False)

    def forward(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Logits [N, BINS]."""
        return self.think(self.eyes(seen))

    def value(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """[N]; the two halves are summed apart, so that a critic that knows nothing says 0."""
        shares, half = self(seen).softmax(1), BINS // 2
        both = shares[:, half + 1 :] * self.bins[half + 1 :] + shares[:, :half].flip(1) * self.bins[:half].flip(0)
        return both.sum(1)


class Range(nn.Module):
    """How far apart returns lie, 1 at least, followed steadily: returns that differ by more are measured in it."""

    low: torch.Tensor
    high: torch.Tensor
    seen: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("low", "high", "seen"):
            self.register_buffer(name, torch.zeros(()))

    def follow(self, returns: torch.Tensor) -> torch.Tensor:
        low, high = returns.detach().flatten().quantile(torch.tensor(MIDDLE, device=returns.device))
        self.seen += 1
        keep = torch.clamp(1 - 1 / self.seen, max=STEADY)  # a mean at first
        self.low.lerp_(low, 1 - float(keep))
        self.high.lerp_(high, 1 - float(keep))
        return (self.high - self.low).clamp_min(1.0)


class ActorCritic:
    """The policy is moved towards what paid more than the critic expected, or, where the world passes them, along the gradients of
    what was paid. `more` are modules that are saved with the run."""

    def __init__(
        self,
        actor: ActorNetwork,
        critic: Critic,
        wanted: Wanted,
        learning_rate: float,
        gradients: bool,
        more: Mapping[str, nn.Module],
    ):
        self.actor, self.critic, self.wanted, self.gradients = actor, critic, wanted, gradients
        self.slow, self.range = Average(critic, SLOW), Range()
        self.modules = {"actor": actor, "critic": critic, "slow": self.slow, "range": self.range, **more}
        rate = warmed(learning_rate, 100, 0.1)
        self.learners = {
            "actor": adamw((actor,), rate),
            "critic": adamw((critic,), rate, average=self.slow),
        }

    def losses(self, batch: Imagined, now: Now) -> Iterator[Loss]:
        flat = {name: value.flatten(0, 1) for name, value in batch.seen.items()}
        value = self.slow.module.value(flat).unflatten(0, (len(batch.reward) + 1, -1))
        returns = lambda_returns(batch.reward, batch.goes_on, value, batch.known, self.wanted)
        weights, unit = weights_of(batch.goes_on, batch.known), self.range.follow(returns)
        past = {name: seen[:-1].flatten(0, 1).detach() for name, seen in batch.seen.items()}
        distribution, drawn = self.actor(past), batch.drawn.flatten(0, 1)
        entropy = distribution.entropy(drawn.detach()).view_as(weights)
        if self.gradients:
            worth = returns / unit
        else:
            better = ((returns - value[:-1]) / unit).detach()
            worth = better * distribution.log_prob(drawn).view_as(better)
        share = weights.sum().clamp_min(1.0)
        parts = {
            "reward": (batch.reward.detach() * weights).sum() / share,
            "return": (returns.detach() * weights).sum() / share,
            "entropy": (entropy.detach() * weights).sum() / share,
            "steps": weights.sum() / weights.shape[1],
        }
        yield Loss("actor", -(weights * (worth + self.wanted.entropy * entropy)).sum() / share, parts)
        target = two_hot(returns.detach().flatten(), self.critic.bins)
        surprise = -(target * self.critic(past).log_softmax(1)).sum(1).view_as(weights)
        loss = (weights * surprise).sum() / share
        yield Loss("critic", loss, {"critic": loss})
