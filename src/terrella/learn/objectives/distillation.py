"""Distillation: a world that draws a frame in many steps teaches one that draws it in one or two, without blur."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import torch

from ...worlds.generator import Conditioning, Generator, generate
from ..batches import Batch
from ..losses import Critic, critic_learner, critic_loss, flow_losses, sharpened, total, truth_losses
from ..trainer import Average, Learner, Loss, Now, half_precision


class Matching:
    """Pulls drawn frames towards a teacher's distribution (DMD2: Yin et al. 2024).

    Where a frame of the student's, with noise added, is denoised by the teacher and by a network of the student's own
    frames, the difference says which way frames become likelier in the game and less likely in the dream. Both are
    shown what the student was shown, so it is the distribution of this very frame that is matched.
    """

    def __init__(self, teacher: Generator):
        self.teacher = copy.deepcopy(teacher).eval().requires_grad_(False)
        self.mimic = copy.deepcopy(teacher).train().requires_grad_(True)
        optimiser = torch.optim.AdamW(self.mimic.parameters(), 4e-4, (0.0, 0.99), weight_decay=0.0)
        self.learner = Learner(optimiser, (self.mimic,))

    def towards_teacher(self, clean: torch.Tensor, shown: Conditioning, rng: torch.Generator) -> torch.Tensor:
        """A loss whose gradient by `clean` [B, 4, H, W] is the difference of the two denoised frames over the mean
        distance from the teacher's."""
        clean = clean[:, :4]
        with torch.no_grad(), half_precision(clean.device):
            noisy, time = _noised(clean.detach(), rng)
            likely, own = (net(noisy, time, shown)[:, :4].float() for net in (self.teacher, self.mimic))
            away = (clean.detach() - likely).abs().mean((1, 2, 3), keepdim=True).clamp_min(1e-3)
            pull = (own - likely) / away
        return (clean * pull).mean()

    def loss(self, clean: torch.Tensor, shown: Conditioning, rng: torch.Generator) -> Loss:
        """Of the mimic, on drawn frames."""
        with half_precision(clean.device):
            noisy, time = _noised(clean.detach()[:, :4], rng)
            again = self.mimic(noisy, time, shown)[:, :4].float()
            losses = flow_losses(again, clean.detach()[:, :4], time)
        return Loss("mimic", losses["rgb"] + 0.5 * losses["depth"], {"mimic": losses["rgb"]})


def drawn(generator: Generator, noise: torch.Tensor, shown: Conditioning, steps: int, rng: np.random.Generator):
    """A frame [B, 4, H, W] as the generator has it after some of `steps`, drawn at random; only the last has a gradient
    (Self-Forcing: Huang et al. 2025)."""
    x, exit_at = noise, int(rng.integers(steps))
    for step in range(exit_at + 1):
        now = step / steps
        with torch.set_grad_enabled(step == exit_at), half_precision(noise.device):
            clean = generator(x, torch.full((len(x),), now, device=x.device), shown).float()
        x = x + (clean.detach()[:, :4] - x) / (steps - step)
    return clean


class Distillation:
    """`student` draws in `flow_steps`; the weights say how hard the recorded frames, the teacher's distribution and a critic
    of small patches pull."""

    def __init__(
        self, teacher: Generator, flow_steps: int, learning_rate: float, truth: float, matching: float, critic: float
    ):
        self.flow_steps, self.weights = flow_steps, (truth, matching, critic)
        self.student = copy.deepcopy(teacher).train().requires_grad_(True)
        self.smooth, self.matching, self.critic = Average(self.student, 0.995), Matching(teacher), Critic()
        self.modules = {
            "student": self.student,
            "smooth": self.smooth,
            "mimic": self.matching.mimic,
            "critic": self.critic,
        }
        optimiser = torch.optim.AdamW(self.student.parameters(), learning_rate, (0.0, 0.99), weight_decay=1e-4)

        def rate(now: Now) -> float:
            return learning_rate * min(1, (now.step + 1) / 50, (1 - now.share) / 0.3)

        self.learners = {
            "student": Learner(optimiser, (self.student,), rate, self.smooth),
            "mimic": self.matching.learner,
            "critic": critic_learner(self.critic),
        }

    @torch.no_grad()
    def dream(self, shown: Conditioning, now: Now) -> torch.Tensor:
        """A frame as the student now draws it."""
        batch, _, height, width = shown.last.shape
        noise = now.randn(batch, 4, height, width)
        with now.half():
            return generate(self.student, noise, shown.to(now.device), self.flow_steps).float().cpu()

    def losses(self, batch: Batch, now: Now) -> Iterator[Loss]:
        batch = batch.to(now.device)
        truth, matching, critic = self.weights
        noise = now.randn(len(batch.truth), 4, *batch.truth.shape[2:])
        clean = batch.judged(drawn(self.student, noise, batch.shown, self.flow_steps, now.rng))
        parts = truth_losses(clean, batch)
        pull = self.matching.towards_teacher(clean, batch.shown, now.noise)
        loss = truth * total(parts) + matching * pull
        loss = loss + sharpened(self.critic, clean, loss, batch.shown.glimpse, critic * trusted(now.step))
        yield Loss("student", loss, {**parts, "teacher": pull})
        yield self.matching.loss(clean, batch.shown, now.noise)
        judged = critic_loss(self.critic, clean, batch.shown.glimpse, batch.truth, batch.shown.glimpse)
        yield Loss("critic", judged, {"critic": judged})


def trusted(step: int) -> float:
    """How far a critic is heeded: not at all at first, for it knows nothing yet."""
    return min(1.0, step / 200)


def _noised(clean: torch.Tensor, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames with noise added at random flow times, 0.02 to 0.98."""
    time = 0.02 + 0.96 * torch.rand(len(clean), generator=rng)
    noise = torch.randn(clean.shape, generator=rng)
    share = time.to(clean.device)[:, None, None, None]
    return clean * share + noise.to(clean.device) * (1 - share), time.to(clean.device)
