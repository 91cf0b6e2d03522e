"""train distil: a world that draws a frame in many steps teaches one that draws it in one or two, without blur."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import TrainingError
from ..core.world import World, make_rng
from ..worlds.generator import Generator, generate
from .losses import Critic, flow_losses, frame_losses, half_precision, sharpened
from .post_training import Beside, beside, leave, recipe_of, with_generator
from .samples import Box, Lesson
from .updates import Report, Updates, descend


@dataclass(frozen=True)
class DistilConfig:
    """Settings of a distillation.

    Args:
        flow_steps: Steps in which the student draws a frame.
        steps: Training steps.
        batch: Frames a step.
        learning_rate: Of the student at its height.
        truth_weight: How hard the recorded frames pull (alone, they would blur whatever is not determined).
        teacher_weight: How hard the teacher's distribution pulls.
        critic_weight: How hard a critic of small patches pulls.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees; by itself the one the world was
            trained without.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth against dream.
        seed: Of everything random.
    """

    flow_steps: int = 1
    steps: int = 2000
    batch: int = 16
    learning_rate: float = 3e-4
    truth_weight: float = 0.25
    teacher_weight: float = 1.0
    critic_weight: float = 0.2
    keep_out: Box | None = None
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0


class Matching:
    """Pulls drawn frames towards a teacher's distribution (DMD2: Yin et al. 2024).

    Where a frame of the student's, with noise added, is denoised by the teacher and by a network of the student's own
    frames, the difference says which way frames become likelier in the game and less likely in the dream. Both are
    told what the student was shown, so it is the distribution of this very frame that is matched.
    """

    def __init__(self, teacher: Generator):
        self.teacher = copy.deepcopy(teacher).eval().requires_grad_(False)
        self.mimic = copy.deepcopy(teacher).train().requires_grad_(True)
        self.optimiser = torch.optim.AdamW(self.mimic.parameters(), 4e-4, (0.0, 0.99), weight_decay=0.0)

    def towards_teacher(self, clean: torch.Tensor, lesson: Lesson, rng: torch.Generator) -> torch.Tensor:
        """A loss whose gradient by `clean` [B, 4, H, W] is the difference of the two denoised frames over the mean
        distance from the teacher's."""
        clean = clean[:, :4]
        with torch.no_grad(), half_precision(clean.device):
            noisy, time = _noised(clean.detach(), rng)
            seen = lesson.glimpse, lesson.last, lesson.told
            likely, own = (net(noisy, time, *seen)[:, :4].float() for net in (self.teacher, self.mimic))
            away = (clean.detach() - likely).abs().mean((1, 2, 3), keepdim=True).clamp_min(1e-3)
            pull = (own - likely) / away
        return (clean * pull).mean()

    def learn(self, clean: torch.Tensor, lesson: Lesson, rng: torch.Generator, step: int) -> float:
        """One update of the mimic on drawn frames; its loss."""
        with half_precision(clean.device):
            noisy, time = _noised(clean.detach()[:, :4], rng)
            again = self.mimic(noisy, time, lesson.glimpse, lesson.last, lesson.told)[:, :4].float()
            losses = flow_losses(again, clean.detach()[:, :4], time)
        descend(self.optimiser, losses["rgb"] + 0.5 * losses["depth"], step, self.mimic)
        return float(losses["rgb"].detach())


def trusted(step: int) -> float:
    """How far the critic is heeded: not at all at first, for it knows nothing yet."""
    return min(1.0, step / 200)


def learn_critic(
    critic: Critic, optimiser: torch.optim.Optimizer, clean: torch.Tensor, lesson: Lesson, real: Lesson, step: int
) -> float:
    """One update of the critic on frames drawn from `lesson`, and on true ones with what led to them; its loss."""
    with half_precision(clean.device):
        true, dreamt = critic(real.truth[:, :3], real.glimpse), critic(clean.detach()[:, :3], lesson.glimpse)
        loss = F.relu(1 - true).mean() + F.relu(1 + dreamt).mean()
    descend(optimiser, loss, step, critic)
    return float(loss.detach())


def drawn(generator: Generator, noise: torch.Tensor, lesson: Lesson, steps: int, rng: np.random.Generator):
    """A frame [B, 4, H, W] as the generator has it after some of `steps`, drawn at random; only the last has a gradient
    (Self-Forcing: Huang et al. 2025)."""
    x, exit_at = noise, int(rng.integers(steps))
    seen = lesson.glimpse, lesson.last, lesson.told
    for step in range(exit_at + 1):
        now = step / steps
        with torch.set_grad_enabled(step == exit_at), half_precision(noise.device):
            clean = generator(x, torch.full((len(x),), now, device=x.device), *seen).float()
        x = x + (clean.detach()[:, :4] - x) / (steps - step)
    return clean


def distil(teacher: World, data: str | Path, out: str | Path, config: DistilConfig, report: Report) -> dict:
    """Trains, or goes on with, the student in the folder `out`; its world lies in `out`/world. Returns the run's facts."""
    pair = beside(teacher, data, config.keep_out, report)
    world = pair.world
    if world.config.steps == 1:
        raise TrainingError(
            f"{world.spec.name} draws a frame in one step already; a teacher comes from `terrella train video --flow-steps 8`."
        )
    if not 1 <= config.flow_steps < world.config.steps:
        raise TrainingError(
            f"--flow-steps is 1 to {world.config.steps - 1}: {world.spec.name} takes {world.config.steps}."
        )
    if config.steps < 1 or config.batch < 1:
        raise TrainingError("--steps and --batch are 1 or more.")
    torch.manual_seed(config.seed)
    student = copy.deepcopy(world.generator).train().requires_grad_(True)
    smooth = copy.deepcopy(student).eval().requires_grad_(False)
    matching, critic = Matching(world.generator), Critic().to(pair.device)
    optimiser = torch.optim.AdamW(student.parameters(), config.learning_rate, (0.0, 0.99), weight_decay=1e-4)
    critic_optimiser = torch.optim.Adam(critic.parameters(), 3e-4, (0.0, 0.99))
    modules = {"student": student, "smooth": smooth, "mimic": matching.mimic, "critic": critic}
    optimisers = {
        "optimiser": optimiser,
        "mimic_optimiser": matching.optimiser,
        "critic_optimiser": critic_optimiser,
    }
    updates = Updates(out, recipe_of(config, world, pair.dataset), modules, optimisers)

    def update(step: int) -> dict[str, float]:
        rng = np.random.default_rng([config.seed, step])
        noise_rng = make_rng(int(rng.integers(2**62)))
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * min(1, (step + 1) / 50, (config.steps - step) / (0.3 * config.steps))

        def dream(shown: Lesson) -> torch.Tensor:
            noise, shown = noise_for(pair, config.batch, noise_rng), shown.to(pair.device)
            with torch.no_grad(), half_precision(pair.device):
                return generate(student, noise, shown.glimpse, shown.last, shown.told, config.flow_steps).float().cpu()

        lesson = pair.lesson(config.batch, rng, dream).to(pair.device)
        clean = lesson.judged(drawn(student, noise_for(pair, config.batch, noise_rng), lesson, config.flow_steps, rng))
        losses = truth_losses(clean, lesson)
        teacher = matching.towards_teacher(clean, lesson, noise_rng)
        loss = config.truth_weight * sum_of(losses) + config.teacher_weight * teacher
        loss = loss + sharpened(critic, clean, loss, lesson.glimpse, config.critic_weight * trusted(step))
        descend(optimiser, loss, step, student)
        follow(smooth, student, step)
        told = {name: float(value.detach()) for name, value in losses.items()}
        told["teacher"] = float(teacher.detach())
        told["mimic"] = matching.learn(clean, lesson, noise_rng, step)
        told["critic"] = learn_critic(critic, critic_optimiser, clean, lesson, lesson, step)
        return told

    def draw() -> None:
        facts = {
            "distilled": f"{world.config.steps} to {config.flow_steps} steps a frame, {updates.facts['step']} updates"
        }
        leave(pair, with_generator(world, smooth, config.flow_steps, facts), world, updates)

    updates.run(config.steps, update, draw, config.save_every_s, config.strip_every_s, report)
    draw()
    return {"world": str(updates.out / "world"), **updates.outcome}


def truth_losses(clean: torch.Tensor, lesson: Lesson) -> dict[str, torch.Tensor]:
    """See `frame_losses`; pixels count as the lesson says. Where things move, where they are counts too."""
    counts = 1.0 if lesson.weight is None else lesson.weight
    losses = frame_losses(clean[:, :4] * counts, lesson.truth[:, :4] * counts)
    if clean.shape[1] > 4:
        losses["things"] = F.binary_cross_entropy_with_logits(clean[:, 4], lesson.truth[:, 4])
    return losses


def sum_of(losses: dict[str, torch.Tensor]) -> torch.Tensor:
    """As `train video` weighs them."""
    return losses["rgb"] + 0.5 * losses["depth"] + 0.5 * losses["edges"] + 0.2 * losses.get("things", 0.0)


def noise_for(pair: Beside, batch: int, rng: torch.Generator) -> torch.Tensor:
    """What `batch` frames are drawn from: [B, 4, H, W]."""
    return torch.randn(batch, 4, *pair.world.config.size, generator=rng).to(pair.device)


def follow(smooth: nn.Module, raw: nn.Module, step: int) -> None:
    """The moving average of weights that play will use."""
    with torch.no_grad():
        for mean, weight in zip(smooth.parameters(), raw.parameters()):
            mean.lerp_(weight, 1 - min(0.995, (step + 1) / (step + 20)))


def _noised(clean: torch.Tensor, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames with noise added at random flow times, 0.02 to 0.98."""
    time = 0.02 + 0.96 * torch.rand(len(clean), generator=rng)
    noise = torch.randn(clean.shape, generator=rng)
    share = time.to(clean.device)[:, None, None, None]
    return clean * share + noise.to(clean.device) * (1 - share), time.to(clean.device)
