"""Latent actions: a few actions learned from pictures alone, by asking which of K outcomes explains the next frame.

Each code is a hypothesis of what follows. The code whose outcome is nearest to what followed is trained to come nearer
(hard expectation-maximisation, shared out evenly at first so that every code finds work), and the inverse model learns
to name it from the two frames. Recorded actions are never looked at.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F

from ..trainer import Loss, Now, adamw, warmed
from .latent_model import LatentModel

EVEN_FOR = 0.5  # share of the training in which the codes are shared out evenly
BENDING = 0.003  # of the loss, for each pixel by which a frame bends the motion of a code


class Codes:
    """Batches are clips of two frames, rgb uint8 [B, 2, H, W, 3]."""

    def __init__(self, model: LatentModel, learning_rate: float):
        self.model = model
        self.modules = {"inverse": model.inverse, "forward": model.forward}
        self.learners = {"codes": adamw(tuple(self.modules.values()), warmed(learning_rate, 50, 0.05))}

    def losses(self, batch: np.ndarray, now: Now) -> Iterator[Loss]:
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
        yield Loss("codes", parts["outcome"] + BENDING * parts["bend_px"] + 0.1 * parts["naming"], parts)


def posterior(errors: torch.Tensor, share: float) -> torch.Tensor:
    """How likely each code is [B, K] from the errors of its outcome [B, K], after a `share` of the training: sharper and
    sharper, and at first corrected so that no code is without work (a few rounds of Sinkhorn's balancing)."""
    early = max(0.0, 1 - share / EVEN_FOR)
    likely = (-errors / errors.mean(1, keepdim=True) / (0.005 + 0.1 * early)).softmax(1)
    if early:
        even = 0.1 * len(errors) / errors.shape[1]
        for _ in range(3):
            likely = likely / (likely.sum(0) + even)
            likely = likely / likely.sum(1, keepdim=True)
    return likely


def _drawn(likely: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One code for each row of `likely` [B, K], as likely as it says."""
    upto = likely.cumsum(1)
    return (rng.random((len(likely), 1)) * upto[:, -1:] > upto[:, :-1]).sum(1)
