"""Fits Gaussians to posed pictures with depth (stereo.py estimates missing depth) by gradient descent, from the surfaces in the
depth images. Adding Gaussians where the error is large and relocating transparent ones follow Kheradmand et al. 2024 (3DGS as
MCMC)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from ..core.errors import ContractError
from .camera import FAR_M, Intrinsics, rotation, unproject
from .raster import Drawing, Gaussians, rasterise
from .raster.gaussians import plain_sh

EVERY = 50  # steps between two rounds of adding and relocating
FADED = 0.02  # Gaussians below this opacity are relocated
SHARE = 0.06  # of all Gaussians, the most that are added or relocated in a round
_RATES = {"means": 1.5e-4, "quats": 1e-3, "scales": 1e-2, "opacities": 3e-2, "sh": 5e-3}  # means: times the mean depth


@dataclass(frozen=True)
class PosedViews:
    """Posed pictures with depth."""

    rgb: torch.Tensor  # uint8 [T, 3, H, W]
    depth: torch.Tensor  # float32 [T, h, w], metres; 0 or FAR_M where unknown
    pose: torch.Tensor  # float32 [T, 7]
    camera: Intrinsics

    def __len__(self) -> int:
        return len(self.rgb)

    @property
    def size(self) -> tuple[int, int]:
        return self.rgb.shape[-2], self.rgb.shape[-1]

    def at(self, rows: torch.Tensor) -> PosedViews:
        return replace(self, rgb=self.rgb[rows], depth=self.depth[rows], pose=self.pose[rows])

    def depths(self, rows: torch.Tensor) -> torch.Tensor:
        """Depth of some views at the size of the pictures: [n, H, W], 0 where unknown."""
        depth = resize_depth(self.depth[rows], self.size)
        return torch.where((depth > 0) & (depth < FAR_M) & depth.isfinite(), depth, 0.0)


def resize_depth(depth: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Depth [n, h, w] resized by nearest neighbour."""
    return F.interpolate(depth[:, None], size, mode="nearest-exact")[:, 0]


@dataclass(frozen=True)
class FitConfig:
    """Settings of the optimisation."""

    gaussians: int = 40_000  # Gaussians, at most.
    steps: int = 2000  # Steps of gradient descent, one picture each.
    degree: int = 0  # Degree of the spherical harmonics of colours, 0 to 3.
    depth_weight: float = 0.05  # Weight of the relative depth error, beside the error of colours in 0..1.
    seed: int = 0  # Seed of the order of the pictures.

    def __post_init__(self):
        if self.gaussians < 100 or self.steps < 1 or self.degree not in range(4):
            raise ContractError("a fit takes 100 Gaussians or more, 1 step or more, and harmonics of degree 0 to 3.")


class Fit:
    """A fit in progress: call `step()` until `done` equals config.steps. `state()` and `restore` resume it exactly."""

    def __init__(self, views: PosedViews, config: FitConfig):
        self.views, self.config, self.done = views, config, 0
        self.mean_depth_m = float(views.depths(torch.arange(0, len(views), max(len(views) // 20, 1))).mean())
        if not self.mean_depth_m > 0:
            raise ContractError("these pictures have no depth: record with depth, or give them an estimator's.")
        begun = from_depth(views, config.gaussians * 2 // 3, config.seed)
        extra = begun.sh.new_zeros(len(begun), (config.degree + 1) ** 2 - 1, 3)
        self.leaves = {
            "means": begun.means, "quats": begun.quats, "scales": begun.scales.log(),
            "opacities": begun.opacities.logit(), "sh": torch.cat([begun.sh, extra], 1),
        }  # fmt: skip
        self.first = {name: torch.zeros_like(leaf) for name, leaf in self.leaves.items()}
        self.second = {name: torch.zeros_like(leaf) for name, leaf in self.leaves.items()}

    @property
    def gaussians(self) -> Gaussians:
        return _scene(self.leaves)

    def step(self) -> float:
        """One step on one picture; returns the mean absolute error of its colours."""
        rng = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.done // len(self.views))
        row = torch.randperm(len(self.views), generator=rng)[self.done % len(self.views)][None]
        leaves = {name: leaf.detach().requires_grad_() for name, leaf in self.leaves.items()}
        seen = rasterise(_scene(leaves), self.views.pose[row], self.views.camera, self.views.size)
        loss, error = self._loss(seen, row)
        grads = torch.autograd.grad(loss, list(leaves.values()))
        with torch.no_grad():
            self._descend(dict(zip(leaves, grads)))
            self.done += 1
            if self.done % EVERY == 0 and self.done < 0.8 * self.config.steps:
                self._improve()
        return error

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that the rest of the fit depends on, as tensors."""
        groups = {"leaf": self.leaves, "first": self.first, "second": self.second}
        tensors = {f"{group}.{name}": part.clone() for group, parts in groups.items() for name, part in parts.items()}
        return {**tensors, "done": torch.tensor([self.done])}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Goes on from the result of `state`."""
        for group, parts in (("leaf", self.leaves), ("first", self.first), ("second", self.second)):
            parts.update({name: state[f"{group}.{name}"].clone() for name in parts})
        self.done = int(state["done"])

    def _loss(self, seen: Drawing, row: torch.Tensor) -> tuple[torch.Tensor, float]:
        off = seen.rgb - self.views.rgb[row].float() / 255
        depth = self.views.depths(row)
        known = depth > 0
        apart = ((seen.depth - depth).abs() / depth.clamp_min(0.3))[known]
        colour = off.abs().mean() + 2 * off.square().mean()
        loss = colour + (self.config.depth_weight * apart.clamp_max(1).mean() if known.any() else 0.0)
        return loss, float(off.detach().abs().mean())

    def _descend(self, grads: dict[str, torch.Tensor]) -> None:
        """Adam (Kingma and Ba 2015), with a learning rate for each parameter; that of the means decays to a hundredth."""
        step, share = self.done + 1, self.done / self.config.steps
        for name, grad in grads.items():
            rate = _RATES[name] * (self.mean_depth_m if name == "means" else 1.0)
            rate *= 0.01**share if name == "means" else 0.1**share
            first, second = (
                self.first[name].lerp_(grad, 0.1),
                self.second[name].mul_(0.999).addcmul_(grad, grad, value=0.001),
            )
            scale = (second / (1 - 0.999**step)).sqrt_().add_(1e-15)
            self.leaves[name] = self.leaves[name].addcdiv(first, scale, value=-rate / (1 - 0.9**step))

    def _improve(self) -> None:
        """Adds Gaussians where the error of some pictures is largest: first in place of transparent ones, then as new ones."""
        rng = torch.Generator().manual_seed(self.config.seed * 7919 + self.done)
        faded = (self.leaves["opacities"].sigmoid() < FADED).nonzero()[:, 0]
        room = self.config.gaussians - len(self.leaves["means"])
        count = min(int(SHARE * self.config.gaussians), len(faded) + room)
        if not count:
            return
        rows = torch.randperm(len(self.views), generator=rng)[:6]
        new = self._where_wrong(rows, count, rng)
        spare = faded[: len(new["means"])]
        for name, part in new.items():
            for held in (self.first[name], self.second[name]):
                held[spare] = 0
            self.leaves[name] = self.leaves[name].index_copy(0, spare, part[: len(spare)])
            blank = torch.zeros_like(part[len(spare) :])
            self.leaves[name] = torch.cat([self.leaves[name], part[len(spare) :]])
            self.first[name], self.second[name] = (torch.cat([m[name], blank]) for m in (self.first, self.second))

    def _where_wrong(self, rows: torch.Tensor, count: int, rng: torch.Generator) -> dict[str, torch.Tensor]:
        """At most `count` Gaussians of the size of a pixel, sampled by the squared error of pictures `rows`, at the recorded depth
        or else the rendered one."""
        seen = rasterise(self.gaussians, self.views.pose[rows], self.views.camera, self.views.size)
        truth, depth = self.views.rgb[rows].float() / 255, self.views.depths(rows)
        drawn = torch.where(seen.alpha > 0.5, seen.depth / seen.alpha.clamp_min(0.5), 0.0)
        depth = torch.where(depth > 0, depth, drawn)
        wrong = (seen.rgb - truth).square().mean(1) * (depth > 0)
        if not wrong.any():
            return {name: leaf[:0] for name, leaf in self.leaves.items()}
        picked = torch.multinomial(wrong.flatten().double(), min(count, int((wrong > 0).sum())), generator=rng)
        new = _of_pixels(truth, depth, self.views.pose[rows], self.views.camera, picked, 0.5)
        extra = new.sh.new_zeros(len(new), self.leaves["sh"].shape[1] - 1, 3)
        return {
            "means": new.means, "quats": new.quats, "scales": new.scales.log(),
            "opacities": new.opacities.logit(), "sh": torch.cat([new.sh, extra], 1),
        }  # fmt: skip


def _scene(leaves: dict[str, torch.Tensor]) -> Gaussians:
    return Gaussians(
        leaves["means"], leaves["quats"], leaves["scales"].exp(), leaves["opacities"].sigmoid(), leaves["sh"]
    )


def from_depth(views: PosedViews, count: int, seed: int = 0) -> Gaussians:
    """At most `count` Gaussians on the surfaces in the depth images, one per voxel; voxels of near surfaces are smaller."""
    rng = torch.Generator().manual_seed(seed)
    parts = []
    for row in torch.arange(0, len(views), max(len(views) // 200, 1)):
        truth, depth = views.rgb[row : row + 1].float() / 255, views.depths(row[None])
        known = (depth.flatten() > 0).nonzero()[:, 0]
        some = known[torch.randperm(len(known), generator=rng)[: max(6 * count // len(views), 2000)]]
        parts.append(_of_pixels(truth, depth, views.pose[row : row + 1], views.camera, some, 0.7))
    points = Gaussians(*(torch.cat([getattr(one, name) for one in parts]) for name in vars(parts[0])))
    side = points.scales.amin(1).clamp_min(1e-3)
    wide = 1.0
    while True:  # grow the voxels until few enough are left
        level = (side * wide).log2().ceil()
        cube = torch.cat([(points.means / 2 ** level[:, None]).floor(), level[:, None]], 1).long()
        _, place, many = torch.unique(cube, dim=0, return_inverse=True, return_counts=True)
        if len(many) <= count:
            break
        wide *= max((len(many) / count) ** 0.4, 1.05)

    def mean(part: torch.Tensor) -> torch.Tensor:
        sums = part.new_zeros(len(many), *part.shape[1:]).index_add_(0, place, part)
        return sums / many.view(-1, *[1] * (part.ndim - 1))

    scales = torch.zeros(len(many)).index_add_(0, place, 2**level) / many * 0.45
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(many), 1)
    return Gaussians(
        mean(points.means), quats, scales[:, None].repeat(1, 3), torch.full((len(many),), 0.7), mean(points.sh)
    )


def _of_pixels(
    rgb: torch.Tensor, depth: torch.Tensor, pose: torch.Tensor, camera: Intrinsics, picked: torch.Tensor, opacity: float
) -> Gaussians:
    """A Gaussian for each of the pixels `picked` (indices into the flattened [n, H, W]), as wide as the pixel at its depth."""
    points = unproject(depth, pose, camera).reshape(-1, 3)[picked]
    far, width = depth.flatten()[picked], depth.shape[-1]
    colours = rgb.permute(0, 2, 3, 1).reshape(-1, 3)[picked]
    scales = (0.6 * far / (camera[0] * width)).clamp_min(1e-3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(picked), 1)
    return Gaussians(
        points, quats, scales[:, None].repeat(1, 3), torch.full((len(picked),), opacity), plain_sh(colours)
    )


def psnr(gaussians: Gaussians, views: PosedViews) -> torch.Tensor:
    """PSNR of the rendered views, in dB: [T]."""
    scores = []
    with torch.no_grad():
        for row in torch.arange(len(views)):
            seen = rasterise(gaussians, views.pose[row][None], views.camera, views.size).rgb
            scores.append(decibels((seen.clamp(0, 1) * 255).round() - views.rgb[row].float()))
    return torch.stack(scores) if scores else torch.zeros(0)


def decibels(off: torch.Tensor) -> torch.Tensor:
    """PSNR of differences of intensities in 0..255."""
    return 10 * (255**2 / off.square().mean().clamp_min(1e-6)).log10()


def nearest_views(kept: PosedViews, others: PosedViews) -> torch.Tensor:
    """For each view of `others`, the view of `kept` with the most similar pose: rows [T]. A metre counts as 0.5 rad."""
    apart = torch.cdist(others.pose[:, :3], kept.pose[:, :3])
    ahead, other = rotation(others.pose)[..., 0], rotation(kept.pose)[..., 0]
    return (apart + 2 * (ahead @ other.T).clamp(-1, 1).acos()).argmin(1)
