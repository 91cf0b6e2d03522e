"""The lifter: a U-Net from one picture to two layers of depth, the colour of the hidden one, the lens and the camera's tilt and
height; trained by learn/objectives/lifting.py on pictures of pictures.py."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from ...core.errors import CheckpointError

SHORTEST, MULTIPLE = 32, 16
WEIGHTS = Path(__file__).parent / "weights" / "lifter.safetensors"


@dataclass(frozen=True)
class LifterConfig:
    """longest: pixels of the longer side of its input; channels: of its maps at 1/2, 1/4, 1/8 and 1/16 of the size."""

    longest: int = 128
    channels: tuple[int, int, int, int] = (24, 64, 128, 192)


class LayerCodes(NamedTuple):
    """What the lifter gives for pictures [B, 3, H, W]; h, w are half of that.

    near [B, H, W]: logarithm of depth over the focal length, which sizes of things alone determine; spread [B, H, W]: logarithm of
    its expected error; step [B, h, w]: by how much the hidden layer's logarithm of depth is larger; hides [B, h, w]: logit that
    one sees it from near the camera; rgb [B, 3, h, w] in 0..1: its colour; lens [B, 4]: logarithm of the focal length in longer
    sides of the picture, pitch and roll in radians, logarithm of the height above the floor in metres.
    """

    near: torch.Tensor
    spread: torch.Tensor
    step: torch.Tensor
    hides: torch.Tensor
    rgb: torch.Tensor
    lens: torch.Tensor


class Lifter(nn.Module):
    """Sides of its input are multiples of MULTIPLE. measured: its mean relative error of depth on pictures that training never saw,
    by their kind (benchmarks/lift.py --store)."""

    def __init__(self, config: LifterConfig | None = None, measured: Mapping[str, float] | None = None):
        super().__init__()
        self.config, self.measured = config or LifterConfig(), dict(measured or {})
        widths = self.config.channels
        self.enter = nn.Conv2d(4 * 5, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.before = nn.ModuleList(_Residual(width) for width in widths)
        self.whole = nn.Linear(widths[-1], widths[-1])
        self.deep = nn.Sequential(_Residual(widths[-1]), _Residual(widths[-1]))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.after = nn.ModuleList(_Residual(width) for width in widths[:-1])
        self.pixels = nn.Conv2d(widths[0], 8 + 5, 3, padding=1)
        self.view = nn.Sequential(nn.Linear(2 * widths[-1], 128), nn.SiLU(), nn.Linear(128, 4))

    def forward(self, rgb: torch.Tensor) -> LayerCodes:
        """Pictures float32 [B, 3, H, W] in 0..1."""
        x, kept = torch.cat([2 * rgb - 1, _where(rgb)], 1), []
        x = self.enter(F.pixel_unshuffle(x, 2))
        for level, block in enumerate(self.before):
            x = block(x)
            if level < len(self.down):
                kept.append(x)
                x = self.down[level](x)
        x = self.deep(x + self.whole(x.mean((2, 3)))[:, :, None, None])
        lens = self.view(torch.cat([x.mean((2, 3)), x.amax((2, 3))], 1)).float()
        for level in reversed(range(len(kept))):
            x = kept[level] + F.interpolate(self.up[level](x), scale_factor=2.0, mode="bilinear")
            x = self.after[level](x)
        out = self.pixels(F.silu(x)).float()
        near, spread = F.pixel_shuffle(out[:, :8], 2).unbind(1)
        usual = lens.new_tensor([-0.3, 0.0, 0.0, 0.35])
        step = F.softplus(out[:, 8] - 1)
        return LayerCodes(near + 1.5, spread - 2, step, out[:, 9] - 2, out[:, 10:].sigmoid(), lens + usual)


class _Residual(nn.Module):
    """Two 3x3 convolutions of normalised maps, beside a path that leaves them as they are."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.even = nn.GroupNorm(8, channels)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.second(F.silu(self.first(F.silu(self.even(x)))))


def _where(rgb: torch.Tensor) -> torch.Tensor:
    """Coordinates [B, 2, H, W] of pixels from the middle, 1 at the ends of the longer side."""
    height, width = rgb.shape[-2:]
    long = max(height, width)
    row = (torch.arange(height, device=rgb.device) + 0.5 - height / 2) * (2 / long)
    column = (torch.arange(width, device=rgb.device) + 0.5 - width / 2) * (2 / long)
    both = torch.stack([row[:, None].expand(height, width), column.expand(height, width)])
    return both.to(rgb.dtype).expand(len(rgb), -1, -1, -1)


def save_lifter(lifter: Lifter, path: Path) -> None:
    """Writes one safetensors file in half precision."""
    about = {"kind": "lifter", "config": asdict(lifter.config), "measured": lifter.measured}
    weights = {name: value.detach().cpu().half().contiguous() for name, value in lifter.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(weights, str(path), metadata={"terrella": json.dumps(about)})


def load_lifter(path: Path = WEIGHTS) -> Lifter:
    """Reads what `save_lifter` wrote; CheckpointError where the file is missing or foreign."""
    try:
        with safe_open(str(path), framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("terrella", "{}"))
        if about.get("kind") != "lifter":
            raise CheckpointError(f"{path} holds no lifter; recipes/lifter.py makes one.")
        config = LifterConfig(about["config"]["longest"], tuple(about["config"]["channels"]))
        measured = {str(kind): float(error) for kind, error in about.get("measured", {}).items()}
        lifter = Lifter(config, measured)
        lifter.load_state_dict({name: value.float() for name, value in load_file(str(path)).items()})
        return lifter.eval().requires_grad_(False)
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise CheckpointError(f"{path} is no lifter that can be read ({str(error).splitlines()[0]}).") from error
