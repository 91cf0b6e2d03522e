"""Similarity of pictures (PSNR, SSIM) and their appearance (gradient energy, colour statistics)."""

import math

import torch
import torch.nn.functional as F

PSNR_CAP_DB = 60.0  # of identical frames, in place of infinity
_FLOOR = 255.0**2 / 10 ** (PSNR_CAP_DB / 10)
CHANGED = 8  # of 255; a pixel has changed if a channel differs by more (less is video noise)
_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


def psnr(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Peak signal-to-noise ratio in dB of uint8 frames [..., H, W, 3] -> float64 [...], peak 255, one figure a frame.

    Capped at PSNR_CAP_DB. A mean over frames is the mean of their dB, not the dB of their mean error.
    """
    return 10 * torch.log10(255.0**2 / squared_error(first, second).mean((-2, -1)).clamp_min(_FLOOR))


def squared_error(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Mean over the channels of each pixel: uint8 [..., H, W, 3] -> float64 [..., H, W]."""
    return (first.double() - second.double()).square().mean(-1)


def pooled(error: torch.Tensor, changed: torch.Tensor) -> torch.Tensor:
    """Sums of squared error [..., H, W] over all pixels, and over those that changed: [..., 2], floored at the cap of `psnr`."""
    sums = torch.stack([error.sum((-2, -1)), (error * changed).sum((-2, -1))], -1)
    counts = torch.stack([torch.ones_like(changed).sum((-2, -1)), changed.sum((-2, -1))], -1)
    return torch.maximum(sums, _FLOOR * counts)


def changes(last: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
    """The pixels of uint8 frames [..., H, W, 3] that differ from `last`: bool [..., H, W]."""
    return ((frames.short() - last.short()).abs() > CHANGED).any(-1)


def ssim(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Structural similarity of the luma of uint8 frames [..., H, W, 3], 11 pixels or more, -> float64 [...].

    Wang et al. 2004: Gaussian window of 11 pixels, sigma 1.5, K1 0.01, K2 0.03, L 255, only where the window fits.
    """
    lead = first.shape[:-3]
    a, b = (luma(frame).reshape(-1, 1, *frame.shape[-3:-1]) for frame in (first, second))
    mean_a, mean_b, square_a, square_b, product = (_smoothed(part, 1.5, 5) for part in (a, b, a * a, b * b, a * b))
    var_a, var_b, cov = square_a - mean_a.square(), square_b - mean_b.square(), product - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    top = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    bottom = (mean_a.square() + mean_b.square() + c1) * (var_a + var_b + c2)
    return (top / bottom).mean((-3, -2, -1)).reshape(lead)


def luma(frames: torch.Tensor) -> torch.Tensor:
    """Brightness of uint8 [..., H, W, 3] -> float64 [..., H, W] in 0..255."""
    return frames.double() @ torch.tensor(_LUMA, dtype=torch.float64, device=frames.device)


def gradient_energy(frames: torch.Tensor) -> torch.Tensor:
    """Sharpness: mean squared difference of neighbouring luma, horizontal plus vertical: uint8 [..., H, W, 3] -> float64 [...]."""
    brightness = luma(frames)
    return brightness.diff(dim=-1).square().mean((-2, -1)) + brightness.diff(dim=-2).square().mean((-2, -1))


def colour_statistics(frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation over the pixels of each channel: uint8 [..., H, W, 3] -> two float64 [..., 3]."""
    pixels = frames.double().flatten(-3, -2)
    return pixels.mean(-2), pixels.std(-2, correction=0)


def blurred(frames: torch.Tensor, sigma: float = 1.0) -> torch.Tensor:
    """uint8 [N, H, W, 3] under a Gaussian blur of `sigma` pixels, edges mirrored; uint8 of the same shape."""
    reach = math.ceil(3 * sigma)
    image = F.pad(frames.permute(0, 3, 1, 2).float(), (reach,) * 4, mode="reflect").flatten(0, 1)[:, None]
    image = _smoothed(image, sigma, reach)
    return image.unflatten(0, (len(frames), 3))[:, :, 0].permute(0, 2, 3, 1).round().to(torch.uint8)


def _smoothed(image: torch.Tensor, sigma: float, reach: int) -> torch.Tensor:
    """Images [N, 1, H, W] under a Gaussian of `sigma` pixels, cut off `reach` pixels away, where it fits."""
    taps = torch.exp(-((torch.arange(-reach, reach + 1, dtype=image.dtype, device=image.device) / sigma) ** 2) / 2)
    taps = taps / taps.sum()
    return F.conv2d(F.conv2d(image, taps.view(1, 1, 1, -1)), taps.view(1, 1, -1, 1))
