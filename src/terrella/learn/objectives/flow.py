"""Flow matching: a generator learns to draw recorded frames after its own predictions, with a critic of sharpness."""

from collections.abc import Iterator

import numpy as np
import torch

from ...worlds.generator import Conditioning, UNet, channels_last
from ..batches import Batch, generate_now
from ..learners import Ema, adamw, warmup_cosine
from ..losses import PatchCritic, critic_learner, critic_loss, critic_pull, flow_losses, frame_losses, weighted_total
from ..train_step import TrainStep
from ..trainer import Loss

CRITIC_AHEAD = 200  # steps that the critic trains before the generator uses it


class Flow:
    """With one flow step, regression with a critic from the step `critic_from` on, its gradient `critic_weight` times that of the
    loss. With more flow steps, the whole flow from noise to frame is learned."""

    losses_per_batch = 1  # gradient steps of the generator per batch

    def __init__(self, generator: UNet, flow_steps: int, learning_rate: float, critic_from: int, critic_weight: float):
        self.generator, self.critic = channels_last(generator), PatchCritic()
        self.one_step, self.critic_from, self.critic_weight = flow_steps == 1, critic_from, critic_weight
        self.smooth = Ema(self.generator, 0.999)
        self.modules = {"generator": self.generator, "smooth": self.smooth, "critic": self.critic}
        generating = adamw((self.generator,), warmup_cosine(learning_rate, 200, 0.05), average=self.smooth)
        self.learners = {"generator": generating, "critic": critic_learner(self.critic)}

    def dream(self, shown: Conditioning, now: TrainStep) -> torch.Tensor:
        """Frames [B, 4 or 5, H, W] as the generator now draws them."""
        return generate_now(self.generator, shown, now)

    def losses(self, batch: Batch, now: TrainStep) -> Iterator[Loss]:
        batch = batch.to(now.device)
        truth, shown = batch.truth, batch.shown
        noisy, time = self._noisy(batch, now)
        with now.half():
            clean = batch.judged(self.generator(noisy, time, shown).float())
            drawn, target = clean[:, :4], truth[:, :4]
            parts = frame_losses(drawn, target, batch.weight) if self.one_step else flow_losses(drawn, target, time)
        if clean.shape[1] > 4:
            logits = torch.nn.functional.binary_cross_entropy_with_logits
            parts["things"] = logits(clean[:, 4], truth[:, 4])
        loss = weighted_total(parts)
        if self.one_step and now.step >= self.critic_from:
            loss = loss + critic_pull(self.critic, clean, loss, shown.glimpse, self.critic_weight)
        yield Loss("generator", loss, parts)
        if self.one_step and now.step >= self.critic_from - CRITIC_AHEAD:
            hinge = critic_loss(self.critic, clean, shown.glimpse, truth, shown.glimpse)
            yield Loss("critic", hinge, {"critic": hinge})

    def _noisy(self, batch: Batch, now: TrainStep) -> tuple[torch.Tensor, torch.Tensor]:
        """True frames mixed with noise, and their flow times [B]; pure noise where a pixel has no weight."""
        truth, count = batch.truth, len(batch.truth)
        noise = now.randn(*truth.shape)
        from_noise = 0.75 if self.one_step else 0.0
        time = np.where(now.rng.random(count) < from_noise, 0, now.rng.random(count))
        time = torch.from_numpy(time).float().to(now.device)
        share = time[:, None, None, None]
        noisy = truth * share + noise * (1 - share)
        return (noisy if batch.weight is None else torch.where(batch.weight > 0, noisy, noise)), time
