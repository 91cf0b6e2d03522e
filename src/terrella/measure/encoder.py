"""The fixed encoder of the scorecard: a small pretrained convnet from frames to features, which `frechet` compares.

It learned to recognise pictures and their distortions (recipes/frame_encoder.py). No world may be trained against it.
"""

import hashlib
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load
from torch import nn

from ..core.errors import TerrellaError

WEIGHTS = Path(__file__).parent / "weights" / "frame_encoder.safetensors"
SHA256 = "0c20b194ada912e5d6a62da12d5c40fa645412243d788308d783e1e634a08712"
MIN_SIDE = 48  # pixels; smaller frames leave the deepest layer nothing to take statistics of
FEATURES = 32
_STAGES = ((3, 32, 5, 2), (32, 32, 3, 1), (32, 64, 3, 2), (64, 96, 3, 2), (96, 128, 3, 1), (128, 128, 3, 2))
_TAPS = (1, 3, 5)  # stages whose means and deviations are read: texture, parts, layout


class FrameEncoder(nn.Module):
    """Frames uint8 [N, H, W, 3], both sides at least MIN_SIDE, to features float32 [N, FEATURES].

    The mean and the standard deviation of three of six convolutions, mapped to directions that vary with distortions and little
    between intact pictures; asinh limits large values. The features of a frame do not depend on its batch.
    """

    def __init__(self):
        super().__init__()
        self.convs = nn.ModuleList(nn.Conv2d(i, o, size, step, size // 2) for i, o, size, step in _STAGES)
        self.last = nn.Linear(2 * sum(_STAGES[tap][1] for tap in _TAPS), FEATURES)
        self.gain = nn.Parameter(torch.ones(FEATURES))

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        seen = self.last(self.pooled(frames.permute(0, 3, 1, 2).float()))
        return self.gain * 3 * torch.asinh(seen / 3)

    def pooled(self, pictures: torch.Tensor) -> torch.Tensor:
        """Means and deviations over the picture: float [N, 3, H, W] in 0..255 -> [N, 512]."""
        x, statistics = pictures / 127.5 - 1, []
        for number, conv in enumerate(self.convs):
            x = F.leaky_relu(conv(x), 0.1)
            if number in _TAPS:
                statistics += [x.mean((2, 3)), (x.var((2, 3), correction=0) + 1e-4).sqrt()]
        return torch.cat(statistics, 1)


@lru_cache(maxsize=1)
def shipped_encoder() -> FrameEncoder:
    """The encoder with the shipped weights, on the CPU; TerrellaError if the file is not the published one."""
    try:
        data = WEIGHTS.read_bytes()
    except OSError as error:
        raise TerrellaError(f"cannot read {WEIGHTS} ({error}); install terrella again.") from error
    return encoder_of(data, SHA256)


def encoder_of(data: bytes, sha256: str) -> FrameEncoder:
    """An encoder from safetensors bytes with this SHA-256; TerrellaError otherwise."""
    digest = hashlib.sha256(data).hexdigest()
    if digest != sha256:
        raise TerrellaError(
            f"the frame encoder's weights are not the published ones (SHA-256 {digest[:12]}..., not {sha256[:12]}...), "
            "so its distances would compare with nobody else's; install terrella again."
        )
    encoder = FrameEncoder()
    try:
        encoder.load_state_dict({name: tensor.float() for name, tensor in load(data).items()}, strict=True)
    except (SafetensorError, RuntimeError) as error:
        raise TerrellaError(f"the frame encoder's weights do not fit this version: {error}.") from error
    return encoder.eval().requires_grad_(False)


def frame_features(frames: torch.Tensor, encoder: nn.Module | None = None, batch: int = 32) -> torch.Tensor:
    """Features of uint8 [..., H, W, 3], both sides MIN_SIDE or more, -> float64 [..., FEATURES]."""
    encoder = encoder or shipped_encoder()
    flat = frames.cpu().reshape(-1, *frames.shape[-3:])
    features = torch.zeros(len(flat), FEATURES, dtype=torch.float64)
    with torch.no_grad():
        for first in range(0, len(flat), batch):
            features[first : first + batch] = encoder(flat[first : first + batch])
    return features.reshape(*frames.shape[:-3], FEATURES)
