"""Proximal policy optimisation (Schulman et al. 2017): several passes over what a policy has just done in a fast simulator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import nn

from ...act.actor_network import ActorNetwork
from ..imagination import Imagined
from ..trainer import Loss, Now, adamw, warmed
from .actor_critic import Critic, Wanted, lambda_returns, weights_of
from .outcome import two_hot

CLIP = 0.2  # how far the share of an action may move within a batch
PASSES, PARTS = 5, 4  # over a batch, in so many parts
FARTHEST = 0.03  # nats that the policy may have moved from what it was (its KL divergence), after which the passes end
SLOWER, FASTER, SLOWEST = (
    1 / 1.5,
    1.05,
    0.02,
)  # of the learning rate, where it moved too far in the first pass, or not in any


class Pace(nn.Module):
    """The share of the learning rate that is taken: less after a batch whose first pass already moved the policy too far (as in
    Rudin et al. 2021, "Learning to walk in minutes"), more again after one that moved it little."""

    share: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("share", torch.ones(()))

    def change(self, parts: int) -> None:
        """After a batch that ended after so many of its parts."""
        factor = SLOWER if parts < PARTS else FASTER if parts == PASSES * PARTS else 1.0
        self.share.mul_(factor).clamp_(SLOWEST, 1.0)


class Ppo:
    """The policy is moved towards what paid more than the critic expected, but not far. `more` are modules that are saved with the
    run."""

    def __init__(
        self, actor: ActorNetwork, critic: Critic, wanted: Wanted, learning_rate: float, more: Mapping[str, nn.Module]
    ):
        self.actor, self.critic, self.wanted = actor, critic, wanted
        self.pace = Pace()
        self.modules = {"actor": actor, "critic": critic, "pace": self.pace, **more}
        whole = warmed(learning_rate, 10, 0.1)
        rate = lambda now: whole(now) * float(self.pace.share)  # noqa: E731
        self.learners = {"actor": adamw((actor,), rate), "critic": adamw((critic,), rate)}

    def losses(self, batch: Imagined, now: Now) -> Iterator[Loss]:
        seen, drawn, returns, better, weights, before = self._judged(batch)
        count = len(drawn)
        facts = {
            "reward": (batch.reward.flatten() * weights).sum() / weights.sum(),
            "steps": weights.sum() / count,
            "pace": self.pace.share.clone(),
        }
        for done in range(PASSES):
            for at, part in enumerate(torch.from_numpy(now.rng.permutation(count)).to(drawn.device).chunk(PARTS)):
                here = {name: value[part] for name, value in seen.items()}
                share, distribution = weights[part] / weights[part].sum().clamp_min(1.0), self.actor(here)
                moved = distribution.log_prob(drawn[part]) - before[part]
                ratio = moved.clamp(-20, 20).exp()
                far = ((ratio.detach() - 1 - moved.detach()) * share).sum()
                if far > FARTHEST:
                    return self.pace.change(done * PARTS + at)
                worth = torch.minimum(ratio * better[part], ratio.clamp(1 - CLIP, 1 + CLIP) * better[part])
                entropy = distribution.entropy(drawn[part])
                parts = {**facts, "entropy": (entropy.detach() * share).sum(), "moved": far}
                yield Loss("actor", -((worth + self.wanted.entropy * entropy) * share).sum(), parts)
                target = two_hot(returns[part], self.critic.bins)
                surprise = -((target * self.critic(here).log_softmax(1)).sum(1) * share).sum()
                yield Loss("critic", surprise, {"critic": surprise})
        self.pace.change(PASSES * PARTS)

    @torch.no_grad()
    def _judged(self, batch: Imagined) -> tuple:
        """Flat over steps and episodes: what was seen, what was drawn, its returns, how much better than expected in deviations,
        how likely the step happened, and the log-probability of what was drawn."""
        flat = {name: value.flatten(0, 1) for name, value in batch.seen.items()}
        value = self.critic.value(flat).unflatten(0, (len(batch.reward) + 1, -1))
        returns = lambda_returns(batch.reward, batch.goes_on, value, batch.known, self.wanted)
        weights = weights_of(batch.goes_on, batch.known).flatten()
        better, total = (returns - value[:-1]).flatten(), weights.sum().clamp_min(1.0)
        mean = (better * weights).sum() / total
        spread = ((better - mean).square() * weights).sum().div(total).sqrt()
        past = {name: seen[:-1].flatten(0, 1) for name, seen in batch.seen.items()}
        drawn = batch.drawn.flatten(0, 1)
        before = self.actor(past).log_prob(drawn)
        return past, drawn, returns.flatten(), (better - mean) / (spread + 1e-6), weights, before
