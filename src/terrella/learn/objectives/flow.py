"""Flow: a generator learns to draw recorded frames (flow matching), the last frame dreamt by itself, with a critic of sharpness."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ...worlds.generator import Conditioning, UNet, channels_last
from ..batches import Batch, drawn_now
from ..losses import Critic, critic_learner, critic_loss, flow_losses, frame_losses, sharpened, total
from ..trainer import Average, Loss, Now, adamw, warmed

CRITIC_AHEAD = 200  # steps that the critic learns before it is heeded


class Flow:
    """Where a frame is drawn in one step a critic judges it, from the step `critic_from` on, `critic_weight` times as hard
    as the loss itself. With more steps the whole flow from noise to frame is learned."""

    strides = 1  # losses of a batch that the generator descends

    def __init__(self, generator: UNet, flow_steps: int, learning_rate: float, critic_from: int, critic_weight: float):
        self.generator, self.critic = channels_last(generator), Critic()
        self.one_step, self.critic_from, self.critic_weight = flow_steps == 1, critic_from, critic_weight
        self.smooth = Average(self.generator, 0.999)
        self.modules = {"generator": self.generator, "smooth": self.smooth, "critic": self.critic}
        generating = adamw((self.generator,), warmed(learning_rate, 200, 0.05), average=self.smooth)
        self.learners = {"generator": generating, "critic": critic_learner(self.critic)}

    def dream(self, shown: Conditioning, now: Now) -> torch.Tensor:
        """A frame [B, 4 or 5, H, W] as the generator now draws it."""
        return drawn_now(self.generator, shown, now)

    def losses(self, batch: Batch, now: Now) -> Iterator[Loss]:
        batch = batch.to(now.device)
        truth, shown = batch.truth, batch.shown
        noisy, time = self._noisy(batch, now)
        with now.half():
            clean = batch.judged(self.generator(noisy, time, shown).float())
            drawn, found = clean[:, :4], truth[:, :4]
            parts = frame_losses(drawn, found, batch.weight) if self.one_step else flow_losses(drawn, found, time)
        if clean.shape[1] > 4:
            logits = torch.nn.functional.binary_cross_entropy_with_logits
            parts["things"] = logits(clean[:, 4], truth[:, 4])
        loss = total(parts)
        if self.one_step and now.step >= self.critic_from:
            loss = loss + sharpened(self.critic, clean, loss, shown.glimpse, self.critic_weight)
        yield Loss("generator", loss, parts)
        if self.one_step and now.step >= self.critic_from - CRITIC_AHEAD:
            judged = critic_loss(self.critic, clean, shown.glimpse, truth, shown.glimpse)
            yield Loss("critic", judged, {"critic": judged})

    def _noisy(self, batch: Batch, now: Now) -> tuple[torch.Tensor, torch.Tensor]:
        """True frames somewhere on the way from noise, and where [B]; pure noise where no pixel counts."""
        truth, count = batch.truth, len(batch.truth)
        noise = now.randn(*truth.shape)
        from_noise = 0.75 if self.one_step else 0.0
        time = np.where(now.rng.random(count) < from_noise, 0, now.rng.random(count))
        time = torch.from_numpy(time).float().to(now.device)
        share = time[:, None, None, None]
        noisy = truth * share + noise * (1 - share)
        return (noisy if batch.weight is None else torch.where(batch.weight > 0, noisy, noise)), time
