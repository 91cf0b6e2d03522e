"""Losses of generated frames: against recorded frames, and by a critic that tells blur from detail."""

import torch
import torch.nn.functional as F
from torch import nn

from ..core.precision import half_precision
from ..space.keyframes import Glimpse
from .batches import Batch
from .learners import Learner

GLIMPSED = 3 + 3 + 1  # maps of a frame and the glimpse of memory


class PatchCritic(nn.Module):
    """Classifies 16-pixel patches as recorded or generated (hinge loss), by maps [B, inputs, H, W] of a frame and of what is known
    of it."""

    def __init__(self, inputs: int = GLIMPSED):
        super().__init__()
        widths = (inputs, 32, 48, 64)
        self.layers = nn.ModuleList(
            nn.utils.parametrizations.spectral_norm(nn.Conv2d(a, b, 4, 2, 1)) for a, b in zip(widths, widths[1:])
        )
        self.judge = nn.utils.parametrizations.spectral_norm(nn.Conv2d(widths[-1], 1, 3, 1, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        return self.judge(x)


def glimpsed(rgb: torch.Tensor, glimpse: Glimpse) -> torch.Tensor:
    """The maps [B, GLIMPSED, H, W] of frames [B, 3, H, W] and the glimpse of memory."""
    return torch.cat([rgb, glimpse.merged * 2 - 1, glimpse.known[:, None]], 1)


def critic_pull(
    critic: PatchCritic, clean: torch.Tensor, loss: torch.Tensor, glimpse: Glimpse, weight: float
) -> torch.Tensor:
    """A loss with the critic's gradient by generated frames, scaled to `weight` times that of the loss (Esser et al. 2021), and
    strongest where memory knows nothing: there the loss alone would draw a mean of all that is possible."""
    drawn = clean.detach()[:, :3].requires_grad_()
    with half_precision(clean.device):
        realness = critic(glimpsed(drawn, glimpse)).float()
    known = glimpse.known[:, None]
    if clean.shape[1] > 4:  # what moves is not known
        known = known * (1 - clean.detach()[:, 4:].sigmoid())
    invented = 1 - F.adaptive_avg_pool2d(known, realness.shape[-2:])
    (pull,) = torch.autograd.grad(-(realness * (0.2 + 0.8 * invented)).mean(), drawn)
    return scaled_pull(clean, loss, pull, weight)


def scaled_pull(clean: torch.Tensor, loss: torch.Tensor, pull: torch.Tensor, weight: float) -> torch.Tensor:
    """A loss of the colours of generated frames [B, 3 or more, H, W] with the gradient `pull` [B, 3, H, W], scaled to `weight`
    times that of `loss`."""
    (own,) = torch.autograd.grad(loss, clean, retain_graph=True)
    return (clean[:, :3] * (weight * own[:, :3].norm() / pull.norm().clamp_min(1e-12) * pull)).sum()


def frame_losses(
    clean: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor | None = None
) -> dict[str, torch.Tensor]:
    """Mean absolute errors of encoded frames [B, 4, H, W]: colour, depth, and gradients of colour (edges).

    With pixel weights [B, 1, H, W] squared errors of colour are added: the minimum of absolute
    errors alone is a frame in which nothing changes, as most pixels do not.
    """
    losses = {"rgb": _l1(clean[:, :3], truth[:, :3]), "depth": _l1(clean[:, 3:], truth[:, 3:])}
    if weight is not None:
        away = clean[:, :3] - truth[:, :3]
        losses["rgb"] = (weight * (0.2 * away.abs() + 2 * away.square())).mean()
    losses["edges"] = _l1(clean[:, :3].diff(dim=2), truth[:, :3].diff(dim=2))
    losses["edges"] = losses["edges"] + _l1(clean[:, :3].diff(dim=3), truth[:, :3].diff(dim=3))
    return losses


def flow_losses(clean: torch.Tensor, truth: torch.Tensor, time: torch.Tensor) -> dict[str, torch.Tensor]:
    """Squared errors of frames predicted at flow time [B], as flow matching requires (Lipman et al. 2023); late times weigh more,
    for their errors are small and carry the detail."""
    error = (clean - truth).square() / (1 - time).clamp_min(0.1)[:, None, None, None]
    return {"rgb": error[:, :3].mean(), "depth": error[:, 3:].mean()}


def _l1(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a - b).abs().mean()


def truth_losses(clean: torch.Tensor, batch: Batch) -> dict[str, torch.Tensor]:
    """`frame_losses` with the weights of the batch, and the classification of moving pixels, if the world has any."""
    counts = 1.0 if batch.weight is None else batch.weight
    losses = frame_losses(clean[:, :4] * counts, batch.truth[:, :4] * counts)
    if clean.shape[1] > 4:
        losses["things"] = F.binary_cross_entropy_with_logits(clean[:, 4], batch.truth[:, 4])
    return losses


def weighted_total(losses: dict[str, torch.Tensor]) -> torch.Tensor:
    """The weighted sum of the losses of a generator."""
    weights = {"rgb": 1.0, "depth": 0.5, "edges": 0.5, "things": 0.2}
    return torch.stack([weights[name] * loss for name, loss in losses.items()]).sum()


def critic_loss(
    critic: PatchCritic, fake: torch.Tensor, shown: Glimpse, real: torch.Tensor, led: Glimpse
) -> torch.Tensor:
    """Hinge loss on generated frames, given `shown`, and recorded ones, given `led`; frames [B, 3 or more, H, W]."""
    with half_precision(fake.device):
        true, drawn = critic(glimpsed(real[:, :3], led)), critic(glimpsed(fake.detach()[:, :3], shown))
        return F.relu(1 - true).mean() + F.relu(1 + drawn).mean()


def critic_learner(critic: PatchCritic) -> Learner:
    return Learner(torch.optim.Adam(critic.parameters(), 3e-4, (0.0, 0.99)), (critic,))
