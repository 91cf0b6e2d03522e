"""Gaussian splatting on a CPU: scenes of Gaussians, drawn by cameras, with gradients."""

from .gaussians import Gaussians, join
from .rasterise import Drawing, rasterise

__all__ = ["Drawing", "Gaussians", "join", "rasterise"]
