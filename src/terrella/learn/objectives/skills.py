"""What a skill's predictor learns: where instructions are followed, where they are done, and how many steps are left."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ...act.imitation_network import ImitationNetwork
from ...act.skills.predictor import SkillPredictor
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss
from .imitation import window_features


@dataclass(frozen=True)
class SkillMoments:
    """N segments of T moments, and for each a moment on the way and the end of any segment."""

    seen: Mapping[str, torch.Tensor]  # channel -> [M, ...], the moments of all segments
    windows: torch.Tensor  # int64 [N, T]: the row of `seen` of each moment
    other: Mapping[str, torch.Tensor]  # channel -> [N, ...], on the way
    other_ends: Mapping[str, torch.Tensor]  # channel -> [N, ...]
    others: torch.Tensor  # bool [N]: the other segment is of another instruction
    words: torch.Tensor  # int64 [N, WORDS], the instructions of the segments
    left: torch.Tensor  # float32 [N, T], steps until the segment's end; negative after it
    success: torch.Tensor  # bool [N]


class SkillPrediction:
    """Trains the predictor; the policy, whose features it reads, stays as it is."""

    def __init__(self, network: ImitationNetwork, predictor: SkillPredictor, learning_rate: float):
        self.network, self.predictor, self.name = network, predictor, "skills"
        self.modules = {"predictor": predictor}
        self.learners = {self.name: adamw((predictor,), warmup_cosine(learning_rate, 50, 0.05), decay=1e-3)}

    def losses(self, batch: SkillMoments, now: TrainStep) -> Iterator[Loss]:
        inside, count = batch.left >= 0, len(batch.left)
        with torch.no_grad():
            spoken, features, recalled = recalled_moments(self.network, batch)
            other, other_ends = (
                self.network.recall(self.network.features(each, spoken)[:, None], None)[0][:, 0]
                for each in (batch.other, batch.other_ends)
            )
            on_way = (now.rand(count) * (inside.sum(1) - 1)).long()
            here = self.network.recall(features[torch.arange(count), on_way][:, None], None)[0][:, 0]
        outlook = self.predictor(recalled.flatten(0, 1), spoken.repeat_interleave(inside.shape[1], 0))
        begins = self.predictor(torch.cat([here, other]), spoken.repeat(2, 1)).begins
        mine = torch.cat([torch.ones(count), torch.zeros(count)]).to(begins)
        over = ((batch.left == 0) & batch.success[:, None]).float().flatten()
        done = F.binary_cross_entropy_with_logits(outlook.done, over, inside.float().flatten(), reduction="sum")
        not_yet = F.softplus(self.predictor(other_ends, spoken).done) * batch.others
        won = (inside & batch.success[:, None]).flatten()
        error = (outlook.log_steps - batch.left.clamp_min(0).log1p().flatten()).square()
        parts = {
            "begins": F.binary_cross_entropy_with_logits(begins, mine),
            "done": (done + not_yet.sum()) / inside.sum(),
            "log_steps": (error * won).sum() / won.sum().clamp_min(1),
        }
        yield Loss(self.name, torch.stack(list(parts.values())).sum(), parts)


def recalled_moments(network: ImitationNetwork, batch: SkillMoments) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The features of the instructions [N, words], those of all moments [N, T, width], and these with what is remembered."""
    assert network.words is not None
    spoken = network.words(batch.words)
    features = window_features(network, batch.seen, spoken, batch.windows)
    return spoken, features, network.recall(features, None)[0]
