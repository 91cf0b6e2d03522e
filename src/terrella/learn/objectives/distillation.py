"""Distillation: a world that draws a frame in many flow steps teaches one that draws it in one or two, without blur."""

import copy
from collections.abc import Callable, Iterator
from collections.abc import Generator as Generating

import numpy as np
import torch

from ...core.precision import half_precision
from ...worlds.generator import Conditioning, UNet
from ..batches import Batch, generate_now
from ..learners import Ema, Learner, adamw
from ..losses import PatchCritic, critic_learner, critic_loss, critic_pull, flow_losses, truth_losses, weighted_total
from ..train_step import TrainStep
from ..trainer import Loss


class Matching:
    """Distribution matching (DMD2, Yin et al. 2024): moves generated frames towards a teacher's distribution.

    Generated frames with noise are denoised by the teacher and by a mimic, a network of the student's own distribution. The
    difference is the direction in which frames become likelier for the teacher and less likely for the student. Both networks get
    the student's conditioning, so that it is the conditional distribution that is matched.
    """

    def __init__(self, teacher: UNet):
        self.teacher = copy.deepcopy(teacher).eval().requires_grad_(False)
        self.mimic = copy.deepcopy(teacher).train().requires_grad_(True)
        optimiser = torch.optim.AdamW(self.mimic.parameters(), 4e-4, (0.0, 0.99), weight_decay=0.0)
        self.learner = Learner(optimiser, (self.mimic,))

    def towards_teacher(self, clean: torch.Tensor, shown: Conditioning, rng: torch.Generator) -> torch.Tensor:
        """A loss whose gradient by `clean` [B, 4, H, W] is the difference of the two denoised frames over the mean distance from
        the teacher's."""
        clean = clean[:, :4]
        with torch.no_grad(), half_precision(clean.device):
            noisy, time = _noised(clean.detach(), rng)
            likely, own = (net(noisy, time, shown)[:, :4].float() for net in (self.teacher, self.mimic))
            away = (clean.detach() - likely).abs().mean((1, 2, 3), keepdim=True).clamp_min(1e-3)
            pull = (own - likely) / away
        return (clean * pull).mean()

    def loss(self, clean: torch.Tensor, shown: Conditioning, rng: torch.Generator) -> Loss:
        """The mimic's loss on generated frames."""
        with half_precision(clean.device):
            noisy, time = _noised(clean.detach()[:, :4], rng)
            again = self.mimic(noisy, time, shown)[:, :4].float()
            losses = flow_losses(again, clean.detach()[:, :4], time)
        return Loss("mimic", losses["rgb"] + 0.5 * losses["depth"], {"mimic": losses["rgb"]})


def draw_with_random_exit(
    generator: UNet, noise: torch.Tensor, shown: Conditioning, steps: int, rng: np.random.Generator
):
    """The generator's estimate of the frame [B, 4, H, W] after a random number of its `steps`; only the last has a gradient
    (Self-Forcing, Huang et al. 2025)."""
    x, exit_at = noise, int(rng.integers(steps))
    for step in range(exit_at + 1):
        now = step / steps
        with torch.set_grad_enabled(step == exit_at), half_precision(noise.device):
            clean = generator(x, torch.full((len(x),), now, device=x.device), shown).float()
        x = x + (clean.detach()[:, :4] - x) / (steps - step)
    return clean


class Student:
    """A copy of a generator, called `name` in its run, that draws a frame in `flow_steps`. weights: of the recorded frames, of the
    distribution of a `teacher`, if there is one, and of a patch critic."""

    def __init__(
        self,
        name: str,
        generator: UNet,
        flow_steps: int,
        rate: Callable[[TrainStep], float],
        momentum: float,
        weights: tuple[float, float, float],
        teacher: UNet | None,
    ):
        self.name, self.flow_steps, self.weights = name, flow_steps, weights
        self.generator = copy.deepcopy(generator).train().requires_grad_(True)
        self.smooth, self.critic = Ema(self.generator, 0.995), PatchCritic()
        self.matching = None if teacher is None else Matching(teacher)
        self.modules = {name: self.generator, "smooth": self.smooth, "critic": self.critic}
        generating = adamw((self.generator,), rate, betas=(momentum, 0.99), average=self.smooth)
        self.learners = {name: generating, "critic": critic_learner(self.critic)}
        if self.matching is not None:
            self.modules["mimic"] = self.matching.mimic
            self.learners["mimic"] = self.matching.learner

    def dream(self, shown: Conditioning, now: TrainStep) -> torch.Tensor:
        """Frames as the student now draws them."""
        return generate_now(self.generator, shown, now, self.flow_steps)

    def update(
        self, batch: Batch, real: Callable[[], Batch], updates: int, now: TrainStep
    ) -> Generating[Loss, None, torch.Tensor]:
        """The losses of one batch; returns its frames as they were drawn. `real` gives recorded frames for the critic, which has
        been updated `updates` times before."""
        truth_weight, matching_weight, critic_weight = self.weights
        noise = now.randn(len(batch.truth), 4, *batch.truth.shape[2:])
        drawn = draw_with_random_exit(self.generator, noise, batch.shown, self.flow_steps, now.rng)
        clean = batch.judged(drawn)
        parts = truth_losses(clean, batch)
        loss = truth_weight * weighted_total(parts)
        if self.matching is not None:
            parts["teacher"] = self.matching.towards_teacher(clean, batch.shown, now.noise)
            loss = loss + matching_weight * parts["teacher"]
        if critic_weight:
            pull = critic_weight * critic_ramp(updates)
            loss = loss + critic_pull(self.critic, clean, loss, batch.shown.glimpse, pull)
        yield Loss(self.name, loss, parts)
        if self.matching is not None:
            yield self.matching.loss(clean, batch.shown, now.noise)
        recorded = real()
        hinge = critic_loss(self.critic, clean, batch.shown.glimpse, recorded.truth, recorded.shown.glimpse)
        yield Loss("critic", hinge, {"critic": hinge})
        return drawn

    def losses(self, batch: Batch, now: TrainStep) -> Iterator[Loss]:
        """The losses of a distillation; the critic sees the same recorded frames."""
        batch = batch.to(now.device)
        yield from self.update(batch, lambda: batch, now.step, now)


def critic_ramp(updates: int) -> float:
    """The factor of the critic's weight: it rises from 0 as the critic is trained."""
    return min(1.0, updates / 200)


def _noised(clean: torch.Tensor, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames with noise added at random flow times, 0.02 to 0.98."""
    time = 0.02 + 0.96 * torch.rand(len(clean), generator=rng)
    noise = torch.randn(clean.shape, generator=rng)
    share = time.to(clean.device)[:, None, None, None]
    return clean * share + noise.to(clean.device) * (1 - share), time.to(clean.device)
