"""Distillation: a world that draws a frame in many steps teaches one that draws it in one or two, without blur."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from collections.abc import Generator as Generating

import numpy as np
import torch

from ...worlds.generator import Conditioning, UNet
from ..batches import Batch, drawn_now
from ..losses import Critic, critic_learner, critic_loss, flow_losses, sharpened, total, truth_losses
from ..trainer import Average, Learner, Loss, Now, adamw, half_precision


class Matching:
    """Pulls drawn frames towards a teacher's distribution (DMD2: Yin et al. 2024).

    Where a frame of the student's, with noise added, is denoised by the teacher and by a network of the student's own
    frames, the difference says which way frames become likelier in the game and less likely in the dream. Both are
    shown what the student was shown, so it is the distribution of this very frame that is matched.
    """

    def __init__(self, teacher: UNet):
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


def drawn(generator: UNet, noise: torch.Tensor, shown: Conditioning, steps: int, rng: np.random.Generator):
    """A frame [B, 4, H, W] as the generator has it after some of `steps`, drawn at random; only the last has a gradient
    (Self-Forcing: Huang et al. 2025)."""
    x, exit_at = noise, int(rng.integers(steps))
    for step in range(exit_at + 1):
        now = step / steps
        with torch.set_grad_enabled(step == exit_at), half_precision(noise.device):
            clean = generator(x, torch.full((len(x),), now, device=x.device), shown).float()
        x = x + (clean.detach()[:, :4] - x) / (steps - step)
    return clean


class Student:
    """A copy of a generator, called `name` in its run, that draws a frame in `flow_steps`. `weights` say how hard the recorded
    frames, the distribution of a `teacher`, where there is one, and a critic of small patches pull."""

    def __init__(
        self,
        name: str,
        generator: UNet,
        flow_steps: int,
        rate: Callable[[Now], float],
        momentum: float,
        weights: tuple[float, float, float],
        teacher: UNet | None,
    ):
        self.name, self.flow_steps, self.weights = name, flow_steps, weights
        self.generator = copy.deepcopy(generator).train().requires_grad_(True)
        self.smooth, self.critic = Average(self.generator, 0.995), Critic()
        self.matching = None if teacher is None else Matching(teacher)
        self.modules = {name: self.generator, "smooth": self.smooth, "critic": self.critic}
        generating = adamw((self.generator,), rate, betas=(momentum, 0.99), average=self.smooth)
        self.learners = {name: generating, "critic": critic_learner(self.critic)}
        if self.matching is not None:
            self.modules["mimic"] = self.matching.mimic
            self.learners["mimic"] = self.matching.learner

    def dream(self, shown: Conditioning, now: Now) -> torch.Tensor:
        """A frame as it is now drawn."""
        return drawn_now(self.generator, shown, now, self.flow_steps)

    def descent(
        self, asked: Batch, real: Callable[[], Batch], heeded: int, now: Now
    ) -> Generating[Loss, None, torch.Tensor]:
        """The losses of one batch, whose frames as they were drawn are returned; `real` gives what the critic is shown as
        true, and it has judged `heeded` batches before."""
        truth, matching, critic = self.weights
        noise = now.randn(len(asked.truth), 4, *asked.truth.shape[2:])
        fresh = drawn(self.generator, noise, asked.shown, self.flow_steps, now.rng)
        clean = asked.judged(fresh)
        parts = truth_losses(clean, asked)
        loss = truth * total(parts)
        if self.matching is not None:
            parts["teacher"] = self.matching.towards_teacher(clean, asked.shown, now.noise)
            loss = loss + matching * parts["teacher"]
        if critic:
            loss = loss + sharpened(self.critic, clean, loss, asked.shown.glimpse, critic * trusted(heeded))
        yield Loss(self.name, loss, parts)
        if self.matching is not None:
            yield self.matching.loss(clean, asked.shown, now.noise)
        found = real()
        judged = critic_loss(self.critic, clean, asked.shown.glimpse, found.truth, found.shown.glimpse)
        yield Loss("critic", judged, {"critic": judged})
        return fresh

    def losses(self, batch: Batch, now: Now) -> Iterator[Loss]:
        """Those of a distillation: the critic sees the same recorded frames."""
        batch = batch.to(now.device)
        yield from self.descent(batch, lambda: batch, now.step, now)


def trusted(step: int) -> float:
    """How far a critic is heeded: not at all at first, for it knows nothing yet."""
    return min(1.0, step / 200)


def _noised(clean: torch.Tensor, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames with noise added at random flow times, 0.02 to 0.98."""
    time = 0.02 + 0.96 * torch.rand(len(clean), generator=rng)
    noise = torch.randn(clean.shape, generator=rng)
    share = time.to(clean.device)[:, None, None, None]
    return clean * share + noise.to(clean.device) * (1 - share), time.to(clean.device)
