"""Group-relative policy optimisation (GRPO, Shao et al. 2024): PPO's clipped surrogate with advantages within groups of rollouts
from the same start, for policies by imitation (flows as in Flow-GRPO, Liu et al. 2025) and for actors."""

import math
from collections.abc import Iterator

import torch

from ...act.actor_network import ActorNetwork
from ...act.choices import Choices
from ...act.imitation_network import AXES, FLOW_STEPS, ImitationNetwork
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from ..verified_rollouts import GroupedRollouts
from .imitation import chunk_errors
from .ppo import EPOCHS, MINIBATCHES, TARGET_KL, AdaptiveRate, clipped_surrogate

MOST = 4096  # decisions of a batch that are learned from, drawn by chance
_TINY = 1e-6


def group_advantages(reward: torch.Tensor) -> torch.Tensor:
    """[groups, size]: rewards less their group's mean, in its deviations; 0 where a group's rewards are all the same."""
    spread = reward.std(1, correction=0, keepdim=True)
    return torch.where(spread > _TINY, (reward - reward.mean(1, keepdim=True)) / spread.clamp_min(_TINY), 0.0)


def log_prob(network: ImitationNetwork | ActorNetwork, choices: Choices, std: float) -> torch.Tensor:
    """The log-probability [N] of choices: of an actor its actions; of an imitating policy the choices or buttons that it takes
    before it decides anew, or the steps of a flow with noise of deviation `std`."""
    inputs, drawn = choices.inputs, choices.drawn
    if isinstance(network, ActorNetwork):
        return network(inputs).log_prob(drawn)
    out = network(inputs["history"], inputs["acted"], *(inputs.get(key) for key in ("words", "outcome", "waypoints")))
    if network.config.actor.mode != AXES:
        return -chunk_errors(network, out, drawn)[:, : network.config.execute].sum(1)
    times = torch.arange(FLOW_STEPS, device=out.device).repeat(len(out)) / FLOW_STEPS
    before = drawn[:, :-1].flatten(0, 1)
    mean = before + network.flow(before, times, out.repeat_interleave(FLOW_STEPS, 0)) / FLOW_STEPS
    z = (drawn[:, 1:] - mean.view_as(drawn[:, 1:])) * (math.sqrt(FLOW_STEPS) / std)
    return -z.square().sum((1, 2)) / 2  # the constant does not depend on the network


class GroupRelative:
    """std: of the noise with which a flow was drawn."""

    def __init__(self, network: ImitationNetwork | ActorNetwork, learning_rate: float, std: float):
        self.network, self.std, self.adaptive = network, std, AdaptiveRate()
        self.modules = {"network": network, "pace": self.adaptive}
        schedule = warmup_cosine(learning_rate, 5, 0.1)
        self.learners = {"policy": adamw((network,), lambda now: schedule(now) * float(self.adaptive.share))}

    def losses(self, batch: GroupedRollouts, now: TrainStep) -> Iterator[Loss]:
        steps, reward = len(batch.weight), batch.reward
        advantage, weights = group_advantages(reward).flatten().repeat(steps), batch.weight.flatten()
        differ = (reward.std(1, correction=0) > _TINY).float().mean()
        facts = {"reward": reward.mean().to(now.device), "groups that differ": differ.to(now.device)}
        used = ((weights > 0) & (advantage != 0)).nonzero()[:, 0]
        if not len(used):
            return
        used = used[torch.from_numpy(now.rng.permutation(len(used))[:MOST])]
        choices, advantage = batch.choices.at(used), advantage[used].to(batch.choices.drawn.device)
        with torch.no_grad():
            old = log_prob(self.network, choices, self.std)
        for epoch in range(EPOCHS):
            order = torch.from_numpy(now.rng.permutation(len(used)))
            for at, rows in enumerate(order.chunk(MINIBATCHES)):
                log_ratio = log_prob(self.network, choices.at(rows), self.std) - old[rows]
                ratio = log_ratio.clamp(-20, 20).exp()
                approx_kl = (ratio.detach() - 1 - log_ratio.detach()).mean()
                if approx_kl > TARGET_KL:
                    return self.adaptive.update(epoch * MINIBATCHES + at)
                loss = -clipped_surrogate(ratio, advantage[rows]).mean()
                yield Loss("policy", loss, {**facts, "approx_kl": approx_kl})
        self.adaptive.update(EPOCHS * MINIBATCHES)
