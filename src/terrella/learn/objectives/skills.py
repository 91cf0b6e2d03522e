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


@dataclass(frozen=True)
class SkillMoments:
    """N segments of T moments, and for each a moment and the end of any segment."""

    features: torch.Tensor  # [N, T, width], what the policy sees at them
    began: torch.Tensor  # [N, width], the same where the segments began
    here: torch.Tensor  # [N, width], the same at a moment at which the instruction can be followed
    other: Mapping[str, torch.Tensor]  # channel -> [N, ...], at such a moment of any segment
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
            assert self.network.words is not None
            moments, spoken = recalled_moments(self.network, batch), self.network.words(batch.words)
            begun = [batch.here]
            begun += [self.network.features(each, spoken) for each in (batch.other, batch.other_ends)]
            here, other, other_ends = (
                (
                    self.network.recall(each[:, None], None)[0][:, 0],
                    spoken,
                    self.network.foreseen(each[:, None], spoken),
                )
                for each in begun
            )
        outlook = self.predictor(*moments)
        begins = torch.cat([self.predictor(*each).begins for each in (here, other)])
        mine = torch.cat([torch.ones(count), torch.zeros(count)]).to(begins)
        over = ((batch.left == 0) & batch.success[:, None]).float().flatten()
        done = F.binary_cross_entropy_with_logits(outlook.done, over, inside.float().flatten(), reduction="sum")
        not_yet = F.softplus(self.predictor(*other_ends).done) * batch.others
        won = (inside & batch.success[:, None]).flatten()
        error = (outlook.log_steps - batch.left.clamp_min(0).log1p().flatten()).square()
        parts = {
            "begins": F.binary_cross_entropy_with_logits(begins, mine),
            "done": (done + not_yet.sum()) / inside.sum(),
            "log_steps": (error * won).sum() / won.sum().clamp_min(1),
        }
        yield Loss(self.name, torch.stack(list(parts.values())).sum(), parts)


def recalled_moments(
    network: ImitationNetwork, batch: SkillMoments
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """What a predictor is given of all moments: their features [N * T, width] with what is remembered, the features of their
    instructions, and the waypoints that were expected where these began."""
    assert network.words is not None
    spoken, length = network.words(batch.words), batch.features.shape[1]
    waypoints = network.foreseen(batch.began[:, None], spoken)
    return (
        network.recall(batch.features, None)[0].flatten(0, 1),
        spoken.repeat_interleave(length, 0),
        None if waypoints is None else waypoints.repeat_interleave(length, 0),
    )
