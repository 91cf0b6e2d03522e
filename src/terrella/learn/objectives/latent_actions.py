"""Latent actions: a few actions learned from pictures alone. Which of K predictions explains the next frame best?

Each code is a hypothesis of what follows. The code whose prediction is nearest to the next frame is trained to come nearer (hard
expectation-maximisation, balanced at first so that every code is used), and the inverse model learns to classify the code from
the two frames. Recorded actions are not used.
"""

from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F

from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from .latent_model import LatentModel

BALANCED_FOR = 0.5  # the part of the training in which the use of codes is balanced
BEND_WEIGHT = 0.003  # of a pixel by which a frame changes the flow of a code


class LatentActionsObjective:
    """Batches are clips of two frames, rgb uint8 [B, 2, H, W, 3]."""

    def __init__(self, model: LatentModel, learning_rate: float):
        self.model = model
        self.modules = {"inverse": model.inverse, "forward": model.forward}
        self.learners = {"codes": adamw(tuple(self.modules.values()), warmup_cosine(learning_rate, 50, 0.05))}

    def losses(self, batch: np.ndarray, now: TrainStep) -> Iterator[Loss]:
        model = self.model
        frames = torch.from_numpy(batch).to(now.device).permute(1, 0, 4, 2, 3).float() / 255
        before, after = frames[0].contiguous(), frames[1].contiguous()
        features = model.forward.features(before)
        with torch.no_grad():
            likely = posterior(model.forward.errors(features, before, after), now.share)
            code = torch.from_numpy(_drawn(likely.cpu().double().numpy(), now.rng)).to(now.device)
        drawn, _, bend = model.forward.outcome(features, before, F.one_hot(code, model.codes).float())
        parts = {"outcome": (drawn - after).abs().mean(), "bend_px": bend.abs().mean()}
        parts["naming"] = -(likely * model.inverse(before, after).log_softmax(1)).sum(1).mean()
        yield Loss("codes", parts["outcome"] + BEND_WEIGHT * parts["bend_px"] + 0.1 * parts["naming"], parts)


def posterior(errors: torch.Tensor, share: float) -> torch.Tensor:
    """Probabilities of codes [B, K] from the errors of their predictions [B, K], after a `share` of the training: ever sharper, and
    at first balanced so that every code is used (a few Sinkhorn iterations)."""
    early = max(0.0, 1 - share / BALANCED_FOR)
    likely = (-errors / errors.mean(1, keepdim=True) / (0.005 + 0.1 * early)).softmax(1)
    if early:
        even = 0.1 * len(errors) / errors.shape[1]
        for _ in range(3):
            likely = likely / (likely.sum(0) + even)
            likely = likely / likely.sum(1, keepdim=True)
    return likely


def _drawn(likely: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One code for each row of probabilities [B, K]."""
    upto = likely.cumsum(1)
    return (rng.random((len(likely), 1)) * upto[:, -1:] > upto[:, :-1]).sum(1)
