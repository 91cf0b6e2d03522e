"""Hindsight goals: every state that an episode reached is a goal that its actions reached (HER, Andrychowicz et al. 2017; GCSL,
Ghosh et al. 2019)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ...act.distributions import SquashedGaussian
from ...act.goal_network import GoalNetwork
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss

QUANTILE = 0.2  # of the steps to a goal, which estimates a short way to it


@dataclass(frozen=True)
class Hindsight:
    """N samples: latents [N, D], goals [N, D] reached steps [N] later, and actions [N, A] encoded for networks."""

    latent: torch.Tensor
    goal: torch.Tensor
    steps: torch.Tensor
    action: torch.Tensor


class Trajectories:
    """Latents [R, D] and encoded actions [R, A] of a recording. ends [R]: the last row of each row's episode; rows: those with a
    valid action, which are sampled, with goals up to `farthest` steps later."""

    def __init__(self, latents: torch.Tensor, actions: torch.Tensor, ends: np.ndarray, rows: np.ndarray, farthest: int):
        self.latents, self.actions, self.ends, self.farthest = latents, actions, ends, farthest
        self.rows = rows[ends[rows] > rows]

    def sample(self, count: int, rng: np.random.Generator, steps: int | None = None) -> Hindsight:
        """`count` samples with goals `steps` steps later, or uniformly up to the end of the episode, half of them log-uniformly."""
        rows = self.rows if steps is None else self.rows[self.ends[self.rows] - self.rows >= steps]
        picked = rng.choice(rows, count)
        most = np.minimum(self.ends[picked] - picked, self.farthest)
        even, share = rng.random(count) < 0.5, rng.random(count)
        ahead = np.where(even, 1 + np.floor(share * most), np.floor((most + 1) ** share)).astype(np.int64).clip(1, most)
        ahead = ahead if steps is None else np.full(count, steps)
        start, end = torch.from_numpy(picked), torch.from_numpy(picked + ahead)
        after = torch.from_numpy(ahead).float().to(self.latents.device)
        return Hindsight(self.latents[start], self.latents[end], after, self.actions[start])


class GoalReaching:
    """The action that led to the goal, and a low quantile of the steps that it took (Koenker & Bassett 1978)."""

    def __init__(self, network: GoalNetwork, learning_rate: float):
        self.network = network
        self.modules = {"network": network}
        self.learners = {"goals": adamw((network,), warmup_cosine(learning_rate, 100, 0.02))}

    def losses(self, batch: Hindsight, now: TrainStep) -> Iterator[Loss]:
        distribution = self.network(batch.latent, batch.goal, batch.steps)
        action = action_error(distribution, batch.action, self.network.config.actor.counts)
        scale = math.log(self.network.config.farthest)
        short = batch.steps.log() / scale - self.network.share(batch.latent, batch.goal)
        steps = torch.maximum(QUANTILE * short, (QUANTILE - 1) * short).mean()
        yield Loss("goals", action + steps, {"action": action, "steps": steps})


def action_error(distribution, action: torch.Tensor, counts: tuple[int, ...]) -> torch.Tensor:
    """The loss of actions [N, A], encoded for networks: squared error of the mode for axes, negative log-likelihood for the
    rest."""
    if isinstance(distribution, SquashedGaussian):
        return (torch.tanh(distribution.mode()) - action).square().mean()
    if action.shape[1] != len(counts):  # one-hot
        action = torch.stack([part.argmax(1) for part in action.split(list(counts), 1)], 1).float()
    return -distribution.log_prob(action).mean()
