"""The lifter: two layers of depth from one picture, the colour of the hidden one, and the view, learned from pictures with both."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError
from ...space.lifting.network import LayerCodes, Lifter, LifterConfig
from ..learners import Ema, warmup_cosine
from ..muon import muon
from ..train_step import TrainStep
from ..trainer import Loss

Batch = Mapping[str, torch.Tensor]
SCALES = (1, 2, 4, 8)  # pixels between which depth is compared
LARGEST_M = 40.0  # what is farther is not learned from
COARSE = 0.3  # the part of the training that sees twice as many pictures at half the size


class LayeredPictures:
    """Shards of training pictures (recipes/lifter.py), some of which are kept out of training."""

    def __init__(self, folder: Path, kept_out: int = 0):
        groups: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
        for file in sorted(folder.glob("*.npz"))[kept_out:]:
            with np.load(file) as shard:
                parts = {name: shard[name] for name in shard.files}
            groups.setdefault(parts["depth"].shape[1:], []).append(parts)
        if not groups:
            raise DatasetError(f"{folder} holds no shards of pictures; make some with recipes/lifter.py draw.")
        self.groups = [{name: np.concatenate([one[name] for one in g]) for name in g[0]} for g in groups.values()]

    def batch(self, size: int, now: TrainStep) -> Batch:
        """Pictures of one shape, some mirrored, cut to other aspects, recoloured and blurred."""
        rng, coarse = now.rng, now.share < COARSE
        sizes = np.array(
            [len(g["rgb"]) * (not coarse or g["rgb"].shape[1] == g["rgb"].shape[2]) for g in self.groups], float
        )
        group = self.groups[int(rng.choice(len(sizes), p=sizes / sizes.sum()))]
        rows = rng.integers(len(group["rgb"]), size=size * (1 + coarse))
        batch = {name: torch.from_numpy(part[rows]) for name, part in group.items()}
        batch["rgb"], batch["behind_rgb"] = (
            batch[name].permute(0, 3, 1, 2).float() / 255 for name in ("rgb", "behind_rgb")
        )
        batch["depth"], batch["behind"] = batch["depth"].float(), batch["behind"].float()
        if rng.random() < 0.5:
            batch = {
                name: part.flip(-1) if name != "lens" else part * torch.tensor([1, 1, -1, 1])
                for name, part in batch.items()
            }
        if batch["depth"].shape[1] == batch["depth"].shape[2] and rng.random() < 0.4:
            batch = _cut(batch, 32 if coarse else 16 * int(rng.integers(1, 3)), rng.random() < 0.6)
        if coarse:
            small = {name: part[..., ::2, ::2] if name != "lens" else part for name, part in batch.items()}
            batch = small | {"rgb": F.avg_pool2d(batch["rgb"], 2)}
        return batch | _recoloured(batch, rng)


def _cut(batch: Batch, less: int, rows: bool) -> dict[str, torch.Tensor]:
    """Pictures without their outer rows or columns; the longer side stays."""
    cut = {}
    for name, part in batch.items():
        off = (less if name in ("rgb", "depth") else less // 2) // 2
        length = part.shape[-2 if rows else -1] if name != "lens" else 0
        cut[name] = part if name == "lens" else part.narrow(-2 if rows else -1, off, length - 2 * off).contiguous()
    return cut


def _recoloured(batch: Batch, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Both layers with other exposure, contrast and white balance; the picture also blurred and noisy."""
    count, rgb = len(batch["rgb"]), batch["rgb"]

    def some(spread: float, channels: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(0, spread, (count, channels, 1, 1))).float().exp()

    gain, curve = some(0.15, 1) * some(0.08, 3), some(0.15, 1)
    both = [(part.clamp_min(1e-3) ** curve * gain).clamp(0, 1) for part in (rgb, batch["behind_rgb"])]
    soft = F.avg_pool2d(F.pad(both[0], (1, 1, 1, 1), mode="replicate"), 3, 1)
    blur = torch.from_numpy(rng.random((count, 1, 1, 1)) ** 3).float()
    noise = torch.from_numpy(rng.standard_normal(rgb.shape, np.float32) * (0.04 * rng.random((count, 1, 1, 1)) ** 2))
    return {"rgb": (both[0].lerp(soft, blur) + noise.float()).clamp(0, 1), "behind_rgb": both[1]}


class LiftingObjective:
    """L1 of logarithmic depths and of their differences, of the hidden colours and of the view; cross-entropy of where something is
    hidden; the expected error by a Laplace likelihood."""

    def __init__(self, config: LifterConfig, learning_rate: float):
        self.lifter = Lifter(config)
        average = Ema(self.lifter, 0.998)
        heads = (self.lifter.pixels, self.lifter.view, self.lifter.enter)
        self.modules = {"lifter": self.lifter, "average": average}
        self.learners = {"lifter": muon((self.lifter,), warmup_cosine(learning_rate, 100, 0.02), heads, average)}

    def losses(self, batch: Batch, now: TrainStep) -> Iterator[Loss]:
        with now.half():
            codes = self.lifter(batch["rgb"].contiguous(memory_format=torch.channels_last))
        parts = errors(codes, batch)
        weights = {"near": 1.0, "edges": 0.5, "spread": 0.05, "step": 0.5, "hides": 0.2, "hidden_rgb": 1.0}
        weights |= {"focal": 0.5, "tilt": 1.0, "height": 0.2}
        yield Loss("lifter", sum((weights[name] * part for name, part in parts.items()), torch.zeros(())), parts)


def errors(codes: LayerCodes, batch: Batch) -> dict[str, torch.Tensor]:
    """The mean error of each part."""
    depth, behind, lens = batch["depth"], batch["behind"], batch["lens"]
    valid = (depth > 0) & (depth < LARGEST_M)
    focal = lens[:, 0].log()[:, None, None]
    off = (codes.near - (depth.clamp_min(0.05).log() - focal)) * valid
    first = depth[:, ::2, ::2]
    hides = (behind > 0) & (behind < LARGEST_M) & (first > 0)
    step = (behind.clamp_min(0.05) / first.clamp_min(0.05)).log().clamp(0.01, 4)
    known = (behind >= 0).float()
    tall = lens[:, 3].isfinite() & (lens[:, 3] > 0.05)
    height = torch.where(tall, lens[:, 3], 1.0).log()
    seen = codes.lens
    return {
        "near": _mean(off.abs(), valid),
        "edges": torch.stack([_slopes(off, valid, scale) for scale in SCALES]).mean(),
        "spread": _mean(off.detach().abs() * (-codes.spread).exp() + codes.spread, valid),
        "step": _mean((codes.step - step).abs(), hides),
        "hides": _mean(F.binary_cross_entropy_with_logits(codes.hides, hides.float(), reduction="none"), known),
        "hidden_rgb": _mean((codes.rgb - batch["behind_rgb"]).abs().mean(1), hides),
        "focal": (seen[:, 0] - lens[:, 0].log()).abs().mean(),
        "tilt": (seen[:, 1:3] - lens[:, 1:3]).abs().sum(1).mean(),
        "height": _mean((seen[:, 3] - height).abs(), tall),
    }


def _mean(values: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    return (values * valid).sum() / valid.sum().clamp_min(1)


def _slopes(off: torch.Tensor, valid: torch.Tensor, scale: int) -> torch.Tensor:
    """The mean difference of errors [B, H, W] between pixels `scale` apart."""
    total = torch.zeros(())
    for axis in (1, 2):
        length = off.shape[axis] - scale
        both = valid.narrow(axis, 0, length) & valid.narrow(axis, scale, length)
        total = total + _mean((off.narrow(axis, scale, length) - off.narrow(axis, 0, length)).abs(), both)
    return total / 2
