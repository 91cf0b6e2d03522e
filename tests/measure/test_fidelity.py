"""Figures of likeness and look against hand-worked cases and slow twins."""

from __future__ import annotations

import math

import numpy as np
import torch

from terrella.core import make_rng
from terrella.measure.fidelity import PSNR_CAP_DB, colour_statistics, gradient_energy, luma, psnr, ssim


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(256, shape, generator=make_rng(seed)).to(torch.uint8)


def test_psnr_of_a_known_error():
    dark = torch.zeros(2, 8, 8, 3, dtype=torch.uint8)
    light = dark.clone()
    light[0] = 5
    light[1] = 255
    assert torch.allclose(psnr(dark, light), torch.tensor([20 * math.log10(255 / 5), 0.0], dtype=torch.float64))


def test_psnr_is_symmetric_and_capped():
    a, b = noise(3, 16, 16, 3), noise(3, 16, 16, 3, seed=1)
    assert torch.equal(psnr(a, b), psnr(b, a))
    assert torch.equal(psnr(a, a), torch.full((3,), PSNR_CAP_DB, dtype=torch.float64))
    nearly = a.clone()
    nearly[:, 0, 0, 0] ^= 1
    assert (psnr(a, nearly) < PSNR_CAP_DB + 1e-9).all()


def test_ssim_agrees_with_its_slow_twin():
    a = noise(13, 15, 3)
    b = (a.float() * 0.7 + 40 + noise(13, 15, 3, seed=1).float() * 0.1).to(torch.uint8)
    assert math.isclose(float(ssim(a, b)), slow_ssim(a, b), rel_tol=1e-9)


def test_ssim_of_the_same_frame_is_one_and_falls_with_noise():
    a = noise(2, 20, 20, 3)
    assert torch.allclose(ssim(a, a), torch.ones(2, dtype=torch.float64))
    assert (ssim(a, 255 - a) < 0).all()


def test_gradient_energy_of_a_ramp_and_of_a_blur():
    ramp = (torch.arange(10)[None, :, None] * 3 + torch.arange(8)[:, None, None] * 2).expand(8, 10, 3).to(torch.uint8)
    assert math.isclose(float(gradient_energy(ramp)), 3**2 + 2**2)
    rough = noise(24, 24, 3)
    smooth = torch.nn.functional.avg_pool2d(rough.permute(2, 0, 1).float(), 3, 1, 1).permute(1, 2, 0).to(torch.uint8)
    assert gradient_energy(smooth) < 0.3 * gradient_energy(rough)
    assert gradient_energy(torch.full((8, 8, 3), 90, dtype=torch.uint8)) == 0


def test_colour_statistics_of_stripes():
    frame = torch.zeros(4, 6, 3, dtype=torch.uint8)
    frame[:, ::2, 0], frame[..., 2] = 100, 7
    mean, deviation = colour_statistics(frame)
    assert mean.tolist() == [50, 0, 7] and deviation.tolist() == [50, 0, 0]


def slow_ssim(a: torch.Tensor, b: torch.Tensor) -> float:
    """Window by window, in plain loops."""
    x, y = luma(a).numpy(), luma(b).numpy()
    taps = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    c1, c2, found = (0.01 * 255) ** 2, (0.03 * 255) ** 2, []
    for row in range(x.shape[0] - 10):
        for column in range(x.shape[1] - 10):
            p, q = x[row : row + 11, column : column + 11], y[row : row + 11, column : column + 11]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
            both = (window * (p - mp) * (q - mq)).sum()
            found.append((2 * mp * mq + c1) * (2 * both + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return float(np.mean(found))
