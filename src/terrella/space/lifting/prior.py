"""Depth of posed pictures where stereo gives none: the lifter's, fitted to what stereo gives."""

from dataclasses import replace

import torch

from ..camera import FAR_M
from ..fitting import PosedViews, resize_depth
from .layers import layers_of
from .network import Lifter

FEWEST_KNOWN = 0.03  # share of a picture whose depth is known, below which nothing is fitted
TILT = 0.05  # resists a tilt, as a share of the weight
APART, TRUSTED = (
    0.15,
    0.25,
)  # a difference of logarithms that is an outlier; the largest median one of a fit that is used


def with_prior(views: PosedViews, lifter: Lifter) -> PosedViews:
    """The views with depth also where it is unknown, of those to which the lifter's can be fitted."""
    height, width = views.size
    focal = views.camera[0] * width / max(height, width)
    depths = []
    for rgb, depth in zip(views.rgb, views.depth):
        layers = layers_of(rgb.permute(1, 2, 0).numpy(), lifter, focal)
        more = fitted_depth(resize_depth(layers.depth[None], (depth.shape[0], depth.shape[1]))[0], depth)
        known = (depth > 0) & (depth < FAR_M)
        depths.append(depth if more is None else torch.where(known, depth, more))
    return replace(views, depth=torch.stack(depths))


def fitted_depth(lifted: torch.Tensor, depth: torch.Tensor) -> torch.Tensor | None:
    """Lifted depth [h, w] times the factor, and with the tilt of its logarithm, by which it fits the known parts of `depth` [h, w];
    None where too little is known, or they do not fit."""
    known = (depth > 0) & (depth < FAR_M)
    if float(known.float().mean()) < FEWEST_KNOWN:
        return None
    row, column = torch.meshgrid(*(torch.linspace(-1, 1, side) for side in depth.shape), indexing="ij")
    basis = torch.stack([torch.ones_like(row), row, column], -1)
    off, some = (depth.clamp_min(1e-3) / lifted).log()[known], basis[known]
    weight, theta = torch.ones(len(off)), torch.zeros(3)
    theta[0] = off.median()
    for _ in range(6):
        weight = (-((off - some @ theta) / APART).square()).exp() + 1e-3
        ridge = TILT * float(weight.sum()) * torch.diag(torch.tensor([1e-6, 1.0, 1.0]))
        theta = torch.linalg.solve((some * weight[:, None]).T @ some + ridge, (some * weight[:, None]).T @ off)
    if float((off - some @ theta).abs().median()) > TRUSTED:
        return None
    return lifted * (basis @ theta).exp()
