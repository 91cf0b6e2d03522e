"""Scroll: by which displacement most of a flat world's picture goes on."""

import torch
import torch.nn.functional as F
from torch import nn

from ..core.backend import derived, plus
from ..space.matching import edge_shares
from .generator import Conditioning


class Scroll(nn.Module):
    """Predicts by which of `moves` + 1 moves most of the picture scrolls next, from the last `slots` frames and a context of
    `context` numbers."""

    def __init__(self, size: tuple[int, int], slots: int, context: int, moves: int):
        super().__init__()
        height, width = size
        self.glance = nn.Sequential(
            nn.AvgPool2d(2), nn.Conv2d(3, 24, 4, stride=4), nn.SiLU(), nn.Conv2d(24, 48, 2, stride=2), nn.SiLU(), nn.Flatten(),
            nn.Linear(48 * (height // 16) * (width // 16), 64), nn.SiLU(),
        )  # fmt: skip
        self.known = nn.Linear(64 + context + (slots - 1) * (moves + 1), 128)
        self.votes = nn.Linear(128, moves + 1)
        nn.init.zeros_(self.votes.weight)
        self.votes.bias = nn.Parameter(torch.tensor([4.0] + [0.0] * moves))  # untrained, nothing scrolls

    def frame_features(self, frame: torch.Tensor) -> torch.Tensor:
        """Features [B, 64] of the newest frame uint8 [B, 3, H, W]."""
        return self.glance(plus(-1.0, frame, 1 / 127.5))

    def forward(self, seen: torch.Tensor, context: torch.Tensor, went: torch.Tensor) -> torch.Tensor:
        """Logits [B, moves + 1]. seen: of `frame_features`; went [B, slots - 1, moves + 1]: how well each move explained each
        frame by the one before, 0..1."""
        went = went / went.amax(2, keepdim=True).clamp_min(0.01)
        return self.votes(F.silu(self.known(torch.cat([seen, context, went.pow(4).flatten(1)], 1))))


def predicted_scroll(scroll: Scroll, conditioning: Conditioning, moves: torch.Tensor) -> torch.Tensor:
    """By which of the `moves` int64 [K, 2] most of the picture goes on: int64 [B]."""
    frames = plus(0.5, conditioning.glimpse.rgb, 255).to(torch.uint8)  # the newest first
    went = edge_shares(frames[:, 1:], frames[:, :-1], moves)
    logits = scroll(scroll.frame_features(frames[:, 0]), conditioning.context, went)
    return least_off(logits, moves)


def least_off(logits: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
    """The move int64 [B], of `moves` [K, 2] with logits [B, K], with the least expected error in pixels: where several are likely
    one in the middle, since a picture that is off stays off."""
    return (logits.softmax(1) @ derived(_apart, moves)).argmin(1)


def _apart(moves: torch.Tensor) -> torch.Tensor:
    """float32 [K, K]: pixels between moves int64 [K, 2]."""
    return torch.cdist(*[moves.float()] * 2, p=1)
