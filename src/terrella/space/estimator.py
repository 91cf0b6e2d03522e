"""Estimator: depth from one picture, motion between two, and the distance from the training pictures; trained by
learn/objectives/estimator.py."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from ..core.errors import CheckpointError
from .align import align
from .camera import Intrinsics

Network = TypeVar("Network", bound=nn.Module)
_USUAL = 0.99  # share of training pictures with strangeness below 1


@dataclass(frozen=True)
class EstimatorConfig:
    """size: height and width of its input, multiples of 16; near_m and far_m: the range of depth; channels: of its maps at 1/2,
    1/4, 1/8 and 1/16 of the size; camera: intrinsics of the training pictures (camera.py)."""

    size: tuple[int, int] = (48, 64)
    near_m: float = 0.1
    far_m: float = 60.0
    channels: tuple[int, int, int, int] = (20, 32, 52, 76)
    camera: Intrinsics = (0.5, 0.8, 0.5, 0.5)


class Estimator(nn.Module):
    """A small U-Net from a normalised picture to logarithmic depth; motion by direct alignment of two pictures with that depth."""

    kind = "network"
    prior: torch.Tensor  # logit of the mean code of the recordings' depth, at each pixel
    pace: torch.Tensor  # of a step of the recordings: metres forward, metres to the left, radians
    usual: torch.Tensor  # mean of the looks of the training pictures [D]
    spread: torch.Tensor  # matrix that whitens their looks [D, D]
    reach: torch.Tensor  # quantile _USUAL of the norm of their whitened looks

    def __init__(self, config: EstimatorConfig):
        super().__init__()
        self.config = config
        widths = config.channels
        self.enter = nn.Conv2d(12 + 2, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.before = nn.ModuleList(_Block(width) for width in widths)
        self.whole = nn.Linear(widths[-1], widths[-1])
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.after = nn.ModuleList(_Block(width) for width in widths[:-1])
        self.output = nn.Conv2d(widths[0], 4, 3, padding=1)
        looks = widths[0] + widths[1] + 12
        self.register_buffer("prior", torch.zeros(config.size))
        self.register_buffer("pace", torch.ones(3))
        self.register_buffer("usual", torch.zeros(looks))
        self.register_buffer("spread", torch.zeros(looks, looks))
        self.register_buffer("reach", torch.ones(()))

    def depth(self, rgb: torch.Tensor) -> torch.Tensor:
        """Pictures, uint8 [B, 3, H, W] of any size -> metres along the optical axis [B, H, W], near_m to far_m."""
        seen = self._metres(self.depth_code(normalise(self._seen(rgb))))
        near = F.interpolate(1 / seen[:, None], rgb.shape[-2:], mode="bilinear", align_corners=False)[:, 0]
        return (1 / near).clamp(self.config.near_m, self.config.far_m)

    def motion(self, before: torch.Tensor, after: torch.Tensor, depth: torch.Tensor | None = None) -> torch.Tensor:
        """The motion between consecutive pictures, uint8 [B, 3, H, W] each: [B, 3] metres forward and to the left in the frame of
        the first, radians to the left. `depth` [B, h, w]: of the first in metres, if known."""
        metres = self.depth(before) if depth is None else depth.float()
        size = (2 * self.config.size[0], 2 * self.config.size[1])  # motion is finer than depth
        first, second = self._seen(before, size), self._seen(after, size)
        near = F.interpolate(metres[:, None], size, mode="nearest-exact")[:, 0]
        return align(first, second, near, self.config.camera, self.pace)

    def strangeness(self, rgb: torch.Tensor) -> torch.Tensor:
        """Mahalanobis distance of the looks from those of the training pictures: [B], below 1 for the share _USUAL of them."""
        return ((self.looks(rgb) - self.usual) @ self.spread).norm(dim=1) / self.reach

    # -- inside, and for training: pictures are float [B, 3, *size] in 0..1, or the same `normalise` --------------

    def depth_code(self, plain: torch.Tensor) -> torch.Tensor:
        """A normalised picture -> depth as a share of the way from near to far, logarithmic: [B, h, w] in 0..1."""
        kept, x = self._encode(plain)
        x = x + self.whole(x.mean((2, 3)))[:, :, None, None]
        for level in reversed(range(len(self.after))):
            x = kept[level] + F.interpolate(self.up[level](x), kept[level].shape[-2:], mode="nearest")
            x = self.after[level](x)
        return (self.prior + F.pixel_shuffle(self.output(F.silu(x)), 2)[:, 0]).sigmoid()

    def looks(self, rgb: torch.Tensor) -> torch.Tensor:
        """Features [B, D] of pictures uint8 [B, 3, H, W]: variance in the two finest maps; mean and contrast of each colour;
        logarithm of the differences along each axis."""
        picture = self._seen(rgb)
        kept, _ = self._encode(normalise(picture))
        steps = [picture.diff(dim=axis).abs().mean((2, 3)).clamp_min(1e-3).log() for axis in (2, 3)]
        light = [part.flatten(1) for part in _light(picture)]
        return torch.cat([kept[0].std((2, 3)), kept[1].std((2, 3)), *light, *steps], 1)

    def learn_usual(self, looks: torch.Tensor) -> None:
        """Sets the usual looks from looks [N, D] of the training pictures."""
        values = looks.double()
        mean = values.mean(0)
        covariance = torch.cov(values.T) + 1e-6 * torch.eye(values.shape[1]) + 0.01 * torch.diag(values.var(0))
        scales, axes = torch.linalg.eigh(covariance)
        spread = axes / scales.sqrt()
        self.usual.copy_(mean)
        self.spread.copy_(spread)
        self.reach.copy_(((values - mean) @ spread).norm(dim=1).quantile(_USUAL))

    def code(self, depth: torch.Tensor) -> torch.Tensor:
        """Metres to the code of `depth_code`."""
        near, far = self.config.near_m, self.config.far_m
        limits = torch.tensor([near, far], device=depth.device).log()
        return (depth.clamp(near, far).log() - limits[0]) / (limits[1] - limits[0])

    def _metres(self, code: torch.Tensor) -> torch.Tensor:
        near, far = self.config.near_m, self.config.far_m
        return (near * (far / near) ** code).clamp(near, far)

    def _encode(self, plain: torch.Tensor) -> tuple[list[torch.Tensor], torch.Tensor]:
        """The maps of a normalised picture, but for the smallest, and that."""
        kept, x = [], self.enter(torch.cat([F.pixel_unshuffle(plain, 2), self._where(len(plain))], 1))
        for level, block in enumerate(self.before):
            x = block(x)
            if level < len(self.down):
                kept.append(x)
                x = self.down[level](x)
        return kept, x

    def _seen(self, rgb: torch.Tensor, size: tuple[int, int] | None = None) -> torch.Tensor:
        height, width = size or self.config.size
        picture = rgb.float() / 255
        if tuple(rgb.shape[-2:]) == (height, width):
            return picture
        return F.interpolate(picture, (height, width), mode="bilinear", antialias=True, align_corners=False)

    def _where(self, batch: int) -> torch.Tensor:
        height, width = (length // 2 for length in self.config.size)
        device = self.pace.device
        row = torch.linspace(-1, 1, height, device=device)[:, None].expand(height, width)
        column = torch.linspace(-1, 1, width, device=device).expand(height, width)
        return torch.stack([row, column]).expand(batch, -1, -1, -1)


class _Block(nn.Module):
    """Two 3x3 convolutions of normalised maps, with a residual path."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.even = nn.ModuleList(nn.GroupNorm(4, channels) for _ in range(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x + self.first(F.silu(self.even[0](x)))
        return x + self.second(F.silu(self.even[1](x)))


def normalise(picture: torch.Tensor) -> torch.Tensor:
    """A picture [B, 3, H, W] less its mean and over its contrast: exposure and white balance say nothing of space."""
    mean, scale = _light(picture)
    return (picture - mean) / scale


def _light(picture: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and contrast of each colour: two [B, 3, 1, 1]."""
    return picture.mean((2, 3), keepdim=True), picture.std((2, 3), keepdim=True) + 0.02


def half_weights(network: nn.Module) -> dict[str, torch.Tensor]:
    """The tensors of a network for a file: what was learned by descent in half precision, the statistics as they are."""
    learned = dict(network.named_parameters())
    return {name: value.half() if name in learned else value for name, value in network.state_dict().items()}


def load_weights(network: Network, weights: Mapping[str, torch.Tensor]) -> Network:
    """`network` with weights of a file."""
    network.load_state_dict(
        {name: part.float() if part.dtype == torch.half else part for name, part in weights.items()}
    )
    return network.eval().requires_grad_(False)


def save_estimator(estimator: Estimator, path: str | Path) -> None:
    """Writes one safetensors file."""
    about = {"kind": "estimator", "config": asdict(estimator.config)}
    weights = {name: value.cpu().contiguous() for name, value in half_weights(estimator).items()}
    save_file(weights, str(path), metadata={"terrella": json.dumps(about)})


def load_estimator(path: str | Path) -> Estimator:
    """Reads what `save_estimator` wrote; CheckpointError where the file is missing or foreign."""
    try:
        with safe_open(str(path), framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("terrella", "{}"))
        if about.get("kind") not in ("estimator", "eye"):  # as it was called at first
            raise CheckpointError(f"{path} holds no estimator; make one with `terrella train estimator`.")
        settings: dict[str, Any] = about["config"]
        settings = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
        return load_weights(Estimator(EstimatorConfig(**settings)), load_file(str(path)))
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        first = str(error).splitlines()[0]
        raise CheckpointError(f"{path} is no estimator that can be read ({first}); train it again.") from error
