"""Gaussians: a scene as coloured ellipsoids in space (Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch

from ...core.errors import ContractError

Y0 = 0.28209479177387814  # the harmonic of degree 0


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, float32, world frame (z up, metres).

    means [N, 3]; quats [N, 4] w, x, y, z of any length; scales [N, 3] standard deviations in metres; opacities [N] in 0..1; sh [N,
    K, 3] spherical harmonics, K = 1, 4, 9 or 16 (degree 0 to 3): a colour is 0.5 + their sum in the direction from the camera, at
    least 0."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self):
        n, many = len(self.means), self.sh.shape[1] if self.sh.ndim == 3 else 0
        want = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, many, 3)}
        shapes = {name: tuple(getattr(self, name).shape) for name in want}
        if shapes != want or many not in (1, 4, 9, 16):
            raise ContractError(f"{n} Gaussians have parts of the shapes {want}, sh of 1, 4, 9 or 16; got {shapes}.")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def colours(self) -> torch.Tensor:
        """[N, 3] in 0..1, without the part that depends on the direction."""
        return (0.5 + Y0 * self.sh[:, 0]).clamp(0, 1)

    def at(self, index: torch.Tensor) -> Gaussians:
        """The Gaussians at `index`, numbers or a mask."""
        return self.each(lambda part: part[index])

    def each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Gaussians:
        """`change` applied to every part."""
        return replace(self, **{field.name: change(getattr(self, field.name)) for field in fields(self)})


def join(parts: Sequence[Gaussians]) -> Gaussians:
    """Several scenes in one, with the highest degree among them."""
    many = max(part.sh.shape[1] for part in parts)
    whole = [
        replace(part, sh=torch.cat([part.sh, part.sh.new_zeros(len(part), many - part.sh.shape[1], 3)], 1))
        for part in parts
    ]
    return Gaussians(*(torch.cat([getattr(part, field.name) for part in whole]) for field in fields(Gaussians)))


def plain_sh(colours: torch.Tensor) -> torch.Tensor:
    """Colours [N, 3] in 0..1 as harmonics of degree 0: [N, 1, 3]."""
    return ((colours - 0.5) / Y0)[:, None]
