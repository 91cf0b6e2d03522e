"""What frames are held against while a generator learns: the truth, and a critic that knows blur from detail; in half
precision where that is native."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from ..space.keyframes import Glimpse, merge


class Critic(nn.Module):
    """Judges 16-pixel patches: real or dreamt, given what memory knew (hinge loss)."""

    def __init__(self):
        super().__init__()
        widths = (3 + 3 + 1, 32, 48, 64)
        self.layers = nn.ModuleList(
            nn.utils.parametrizations.spectral_norm(nn.Conv2d(a, b, 4, 2, 1)) for a, b in zip(widths, widths[1:])
        )
        self.judge = nn.utils.parametrizations.spectral_norm(nn.Conv2d(widths[-1], 1, 3, 1, 1))

    def forward(self, rgb: torch.Tensor, glimpse) -> torch.Tensor:
        x = torch.cat([rgb, merge(glimpse) * 2 - 1, glimpse.known[:, None]], 1)
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        return self.judge(x)


def sharpened(critic: Critic, clean: torch.Tensor, loss: torch.Tensor, glimpse: Glimpse, weight: float) -> torch.Tensor:
    """The critic's pull on dreamt frames, `weight` times as strong as the loss's own (Esser et al. 2021), and strongest
    where memory knows nothing: there the loss alone would draw a mean of all that could be."""
    dreamt = clean.detach()[:, :3].requires_grad_()
    with half_precision(clean.device):
        praise = critic(dreamt, glimpse).float()
    known = glimpse.known[:, None]
    if clean.shape[1] > 4:  # what moves is not known
        known = known * (1 - clean.detach()[:, 4:].sigmoid())
    invented = 1 - F.adaptive_avg_pool2d(known, praise.shape[-2:])
    (pull,) = torch.autograd.grad(-(praise * (0.2 + 0.8 * invented)).mean(), dreamt)
    (own,) = torch.autograd.grad(loss, clean, retain_graph=True)
    return (clean[:, :3] * (weight * own[:, :3].norm() / pull.norm().clamp_min(1e-12) * pull)).sum()


def frame_losses(
    clean: torch.Tensor, truth: torch.Tensor, weight: torch.Tensor | None = None
) -> dict[str, torch.Tensor]:
    """Mean absolute errors of frames [B, 4, H, W] in the generator's code: colour, depth, and colour's steps (edges).

    Where pixels count by `weight` [B, 1, H, W] (lessons.changing), colour's squared errors are added: absolute ones alone
    are least where nothing ever changes, for most pixels do not.
    """
    losses = {"rgb": _l1(clean[:, :3], truth[:, :3]), "depth": _l1(clean[:, 3:], truth[:, 3:])}
    if weight is not None:
        away = clean[:, :3] - truth[:, :3]
        losses["rgb"] = (weight * (0.2 * away.abs() + 2 * away.square())).mean()
    losses["edges"] = _l1(clean[:, :3].diff(dim=2), truth[:, :3].diff(dim=2))
    losses["edges"] = losses["edges"] + _l1(clean[:, :3].diff(dim=3), truth[:, :3].diff(dim=3))
    return losses


def flow_losses(clean: torch.Tensor, truth: torch.Tensor, time: torch.Tensor) -> dict[str, torch.Tensor]:
    """Squared errors, which alone make the flow end in the true distribution (Lipman et al. 2023), of frames predicted at
    flow time [B]; late ones count for more, for they are small and are the detail."""
    error = (clean - truth).square() / (1 - time).clamp_min(0.1)[:, None, None, None]
    return {"rgb": error[:, :3].mean(), "depth": error[:, 3:].mean()}


def _l1(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a - b).abs().mean()


def half_precision(device: torch.device):
    """bfloat16 where the device computes it natively."""
    native = device.type == "cuda" or torch.backends.cpu.get_cpu_capability() == "AVX512" and _cpu_has_bf16()
    return torch.autocast(device.type, torch.bfloat16, enabled=native)


def _cpu_has_bf16() -> bool:
    """In hardware: where oneDNN only emulates it, it is 2.7 times slower than float32."""
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
