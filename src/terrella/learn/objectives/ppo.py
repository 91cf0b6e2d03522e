"""Proximal policy optimisation (Schulman et al. 2017): several epochs over the rollouts of a policy in a fast simulator."""

from collections.abc import Iterator, Mapping

import torch
from torch import nn

from ...act.actor_network import ActorNetwork
from ..imagination import ImaginedRollouts
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from .actor_critic import Critic, ReturnConfig, lambda_returns, step_weights
from .outcome import two_hot

CLIP = 0.2  # range of the probability ratio
EPOCHS, MINIBATCHES = 5, 4
TARGET_KL = 0.03  # nats: the epochs end once the policy has moved further from the one that acted
DECREASE, INCREASE, LOWEST = 1 / 1.5, 1.05, 0.02  # of the learning rate, see AdaptiveRate


def clipped_surrogate(ratio: torch.Tensor, advantage: torch.Tensor) -> torch.Tensor:
    return torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)


class AdaptiveRate(nn.Module):
    """The factor of the learning rate: it falls after a batch whose first epoch reached the target KL, and rises again after one
    that never did (as in Rudin et al. 2021, "Learning to walk in minutes")."""

    share: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("share", torch.ones(()))

    def update(self, minibatches: int) -> None:
        """After a batch from which `minibatches` gradient steps were taken."""
        factor = DECREASE if minibatches < MINIBATCHES else INCREASE if minibatches == EPOCHS * MINIBATCHES else 1.0
        self.share.mul_(factor).clamp_(LOWEST, 1.0)


class Ppo:
    """The clipped surrogate objective with an entropy bonus, and a two-hot critic. `more` are modules saved with the run."""

    def __init__(
        self,
        actor: ActorNetwork,
        critic: Critic,
        returns: ReturnConfig,
        learning_rate: float,
        more: Mapping[str, nn.Module],
    ):
        self.actor, self.critic, self.returns = actor, critic, returns
        self.adaptive = AdaptiveRate()
        self.modules = {"actor": actor, "critic": critic, "pace": self.adaptive, **more}
        schedule = warmup_cosine(learning_rate, 10, 0.1)
        rate = lambda now: schedule(now) * float(self.adaptive.share)  # noqa: E731
        self.learners = {"actor": adamw((actor,), rate), "critic": adamw((critic,), rate)}

    def losses(self, batch: ImaginedRollouts, now: TrainStep) -> Iterator[Loss]:
        observations, actions, returns, advantages, weights, old_logprob = self._advantages(batch)
        count = len(actions)
        facts = {
            "reward": (batch.reward.flatten() * weights).sum() / weights.sum(),
            "steps": weights.sum() / count,
            "rate": self.adaptive.share.clone(),
        }
        for epoch in range(EPOCHS):
            order = torch.from_numpy(now.rng.permutation(count)).to(actions.device)
            for at, rows in enumerate(order.chunk(MINIBATCHES)):
                seen = {name: value[rows] for name, value in observations.items()}
                weight, distribution = weights[rows] / weights[rows].sum().clamp_min(1.0), self.actor(seen)
                log_ratio = distribution.log_prob(actions[rows]) - old_logprob[rows]
                ratio = log_ratio.clamp(-20, 20).exp()
                approx_kl = ((ratio.detach() - 1 - log_ratio.detach()) * weight).sum()
                if approx_kl > TARGET_KL:
                    return self.adaptive.update(epoch * MINIBATCHES + at)
                surrogate = clipped_surrogate(ratio, advantages[rows])
                entropy = distribution.entropy(actions[rows])
                parts = {**facts, "entropy": (entropy.detach() * weight).sum(), "approx_kl": approx_kl}
                yield Loss("actor", -((surrogate + self.returns.entropy * entropy) * weight).sum(), parts)
                target = two_hot(returns[rows], self.critic.bins)
                value_loss = -((target * self.critic(seen).log_softmax(1)).sum(1) * weight).sum()
                yield Loss("critic", value_loss, {"critic": value_loss})
        self.adaptive.update(EPOCHS * MINIBATCHES)

    @torch.no_grad()
    def _advantages(self, batch: ImaginedRollouts) -> tuple:
        """Flat over steps and episodes: observations, actions, returns, normalised advantages, step weights and log-probabilities
        of the actions under the policy that drew them."""
        flat = {name: value.flatten(0, 1) for name, value in batch.observations.items()}
        value = self.critic.value(flat).unflatten(0, (len(batch.reward) + 1, -1))
        returns = lambda_returns(batch.reward, batch.continues, value, batch.trusted, self.returns)
        weights = step_weights(batch.continues, batch.trusted).flatten()
        advantages, total = (returns - value[:-1]).flatten(), weights.sum().clamp_min(1.0)
        mean = (advantages * weights).sum() / total
        deviation = ((advantages - mean).square() * weights).sum().div(total).sqrt()
        past = {name: seen[:-1].flatten(0, 1) for name, seen in batch.observations.items()}
        actions = batch.actions.flatten(0, 1)
        old_logprob = self.actor(past).log_prob(actions)
        return past, actions, returns.flatten(), (advantages - mean) / (deviation + 1e-6), weights, old_logprob
