"""Actor-critic on imagined rollouts (DreamerV3, Hafner et al. 2023): lambda-returns, a two-hot critic, and a policy gradient by
advantages or through the world."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from ...act.actor_network import ActorConfig, ActorNetwork, ObservationEncoder, mlp, symexp
from ..imagination import ImaginedRollouts
from ..learners import Ema, adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from .outcome import two_hot

BINS, REACH = 63, 10.0  # of the critic, evenly spaced in symlog: up to about 22,000
SLOW_DECAY = 0.98  # of the target critic's average
QUANTILES, RANGE_DECAY = (0.05, 0.95), 0.99  # between which the range of returns lies, and the decay of its average


@dataclass(frozen=True)
class ReturnConfig:
    """How returns are computed."""

    discount: float = 0.99  # Discount factor, gamma.
    # Lambda, from 0 (one-step bootstrapping) to 1 (the return of the whole rollout).
    td_lambda: float = 0.95
    entropy: float = 3e-4  # Coefficient of the entropy bonus, in ranges of returns per nat.
    # Bootstrap from the lowest value in the batch wherever a rollout is no longer trusted, so that the policy stays where the
    # world is accurate (after MOReL, Kidambi et al. 2020).
    cautious: bool = False


def lambda_returns(
    reward: torch.Tensor, continues: torch.Tensor, value: torch.Tensor, trusted: torch.Tensor, config: ReturnConfig
) -> torch.Tensor:
    """Lambda-returns [T, B] (Sutton & Barto 2018, 12.1) of rewards [T, B], probabilities that the episode continues [T, B] and
    values [T + 1, B]. After a step that is not `trusted` [T, B] the return bootstraps from the value."""
    if config.cautious:
        value = torch.cat([value[:1], torch.where(trusted, value[1:], value.detach().min())])
    returns, after = [], value[-1]
    for step in range(len(reward) - 1, -1, -1):
        td_lambda = config.td_lambda * trusted[step]
        following = (1 - td_lambda) * value[step + 1] + td_lambda * after
        after = reward[step] + config.discount * continues[step] * following
        returns.append(after)
    return torch.stack(returns[::-1])


def step_weights(continues: torch.Tensor, trusted: torch.Tensor) -> torch.Tensor:
    """[T, B]: the probability that a rollout reaches each step, and is trusted up to it."""
    reached = (continues.detach() * trusted).cumprod(0)
    return torch.cat([torch.ones_like(reached[:1]), reached[:-1]])


class Critic(nn.Module):
    """The value of a state as a distribution over BINS values, evenly spaced in symlog."""

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
        """Expected values [N]; the two halves are summed apart, so that an untrained critic gives exactly 0."""
        shares, half = self(seen).softmax(1), BINS // 2
        both = shares[:, half + 1 :] * self.bins[half + 1 :] + shares[:, :half].flip(1) * self.bins[:half].flip(0)
        return both.sum(1)


class Range(nn.Module):
    """A moving average of the range of returns, at least 1, by which advantages are divided."""

    low: torch.Tensor
    high: torch.Tensor
    seen: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("low", "high", "seen"):
            self.register_buffer(name, torch.zeros(()))

    def update(self, returns: torch.Tensor) -> torch.Tensor:
        low, high = returns.detach().flatten().quantile(torch.tensor(QUANTILES, device=returns.device))
        self.seen += 1
        keep = torch.clamp(1 - 1 / self.seen, max=RANGE_DECAY)  # a plain mean at first
        self.low.lerp_(low, 1 - float(keep))
        self.high.lerp_(high, 1 - float(keep))
        return (self.high - self.low).clamp_min(1.0)


class ActorCritic:
    """REINFORCE with the critic as baseline or, with `gradients`, gradients of the returns through the world. `more` are modules
    that are saved with the run."""

    def __init__(
        self,
        actor: ActorNetwork,
        critic: Critic,
        returns: ReturnConfig,
        learning_rate: float,
        gradients: bool,
        more: Mapping[str, nn.Module],
    ):
        self.actor, self.critic, self.returns, self.gradients = actor, critic, returns, gradients
        self.slow, self.range = Ema(critic, SLOW_DECAY), Range()
        self.modules = {"actor": actor, "critic": critic, "slow": self.slow, "range": self.range, **more}
        rate = warmup_cosine(learning_rate, 100, 0.1)
        self.learners = {"actor": adamw((actor,), rate), "critic": adamw((critic,), rate, average=self.slow)}

    def losses(self, batch: ImaginedRollouts, now: TrainStep) -> Iterator[Loss]:
        flat = {name: value.flatten(0, 1) for name, value in batch.observations.items()}
        value = self.slow.module.value(flat).unflatten(0, (len(batch.reward) + 1, -1))
        returns = lambda_returns(batch.reward, batch.continues, value, batch.trusted, self.returns)
        weights, scale = step_weights(batch.continues, batch.trusted), self.range.update(returns)
        past = {name: seen[:-1].flatten(0, 1).detach() for name, seen in batch.observations.items()}
        distribution, actions = self.actor(past), batch.actions.flatten(0, 1)
        entropy = distribution.entropy(actions.detach()).view_as(weights)
        if self.gradients:
            objective = returns / scale
        else:
            advantage = ((returns - value[:-1]) / scale).detach()
            objective = advantage * distribution.log_prob(actions).view_as(advantage)
        total = weights.sum().clamp_min(1.0)
        parts = {
            "reward": (batch.reward.detach() * weights).sum() / total,
            "return": (returns.detach() * weights).sum() / total,
            "entropy": (entropy.detach() * weights).sum() / total,
            "steps": weights.sum() / weights.shape[1],
        }
        yield Loss("actor", -(weights * (objective + self.returns.entropy * entropy)).sum() / total, parts)
        target = two_hot(returns.detach().flatten(), self.critic.bins)
        cross_entropy = -(target * self.critic(past).log_softmax(1)).sum(1).view_as(weights)
        loss = (weights * cross_entropy).sum() / total
        yield Loss("critic", loss, {"critic": loss})
