"""An atlas of textures for training pictures: every material of layouts, and patterns drawn by chance."""

import numpy as np
from PIL import Image

from ..layout.looks import MATERIALS
from ..layout.textures import texture_colours

SIDE = 128  # texels
MATERIAL_M = 2.0  # what the texture of a material covers
VARIANTS = 3  # of each material
RANDOM = 140  # patterns drawn by chance


def atlas_of(seed: int) -> np.ndarray:
    """Textures float32 [T, SIDE, SIDE, 3] in linear light: first VARIANTS of each of MATERIALS, in white, then RANDOM patterns."""
    rng = np.random.default_rng(seed)
    at = (np.arange(SIDE) + 0.5) * MATERIAL_M / SIDE
    u, v = (part.ravel() for part in np.meshgrid(at, at))
    textures = []
    for name in MATERIALS:
        for _ in range(VARIANTS):
            size, seed = (MATERIAL_M, MATERIAL_M), int(rng.integers(1 << 20))
            seen = texture_colours(name, (0.75, 0.75, 0.75), (u, v), size, MATERIAL_M / SIDE, seed)
            textures.append((seen / 0.75).reshape(SIDE, SIDE, 3))
    textures += [_pattern(rng) for _ in range(RANDOM)]
    return (np.clip(np.stack(textures), 0, 1.6) ** 2.2).astype(np.float32)


def material_texture(name: str, rng: np.random.Generator) -> int:
    """The number of a texture of a material."""
    return VARIANTS * list(MATERIALS).index(name) + int(rng.integers(VARIANTS))


def random_texture(rng: np.random.Generator) -> int:
    """The number of any texture."""
    return int(rng.integers(VARIANTS * len(MATERIALS) + RANDOM))


def _resized(values: np.ndarray, smooth: bool) -> np.ndarray:
    """Values [h, w] stretched to SIDE x SIDE."""
    way = Image.Resampling.BICUBIC if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(values.astype(np.float32)).resize((SIDE, SIDE), way))


def _noise(rng: np.random.Generator) -> np.ndarray:
    """Noise of several sizes, perhaps stretched along one axis: about 0..1."""
    stretch, total, share = rng.choice([1, 1, 4, 10]), np.zeros((SIDE, SIDE), np.float32), 1.0
    first = int(rng.integers(2, 9))
    for octave in range(5):
        wide = min(first * 2**octave, SIDE)
        total += share * _resized(rng.random((max(wide // stretch, 2), wide)), True)
        share *= rng.uniform(0.4, 0.8)
    low, high = np.quantile(total, [0.02, 0.98])
    total = np.clip((total - low) / (high - low + 1e-6), 0, 1)
    return total.T if rng.random() < 0.5 else total


def _pattern(rng: np.random.Generator) -> np.ndarray:
    """A pattern [SIDE, SIDE, 3] in sRGB."""
    kind = rng.integers(7)
    one, other = _colour(rng), _colour(rng)
    x, y = np.meshgrid(np.arange(SIDE) / SIDE, np.arange(SIDE) / SIDE)
    if kind == 0:
        mix = _noise(rng)
    elif kind == 1:  # stripes, straight or bent
        mix = 0.5 + 0.5 * np.sin(
            2 * np.pi * (rng.integers(1, 12) * x + rng.integers(0, 6) * y + 0.4 * rng.random() * _noise(rng))
        )
        mix = mix if rng.random() < 0.5 else (mix > 0.5) * 1.0
    elif kind == 2:  # checks, tiles with seams
        n, m = rng.integers(2, 12, 2)
        mix = ((np.floor(x * n) + np.floor(y * m)) % 2) * rng.random()
        seam = (x * n % 1 < 0.06) | (y * m % 1 < 0.06)
        mix = np.where(seam, 1.0, mix)
    elif kind == 3:  # spots
        n = int(rng.integers(3, 12))
        mix = (np.hypot(x * n % 1 - 0.5, y * n % 1 - 0.5) < rng.uniform(0.15, 0.45)) * 1.0
    elif kind == 4:  # coarse pixels, as games have them
        wide = int(rng.choice([16, 32, 64]))
        mix = _resized(np.round(rng.random((wide, wide)) * 4) / 4, False) * 0.5 + 0.5 * np.round(_noise(rng) * 5) / 5
    elif kind == 5:
        return _poster(rng)
    else:  # cells
        points = rng.random((int(rng.integers(8, 60)), 3)).astype(np.float32)
        near = np.argmin((x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2, -1)
        mix = points[near, 2]
    shown = one + (other - one) * mix[..., None]
    return np.clip(shown * (1 + rng.uniform(0, 0.3) * (_noise(rng)[..., None] - 0.5)), 0, 1)


def _poster(rng: np.random.Generator) -> np.ndarray:
    """Discs, bars and lines like those of print on a ground: what a picture, a screen or a sign shows."""
    shown = np.ones((SIDE, SIDE, 3)) * _colour(rng) * (0.7 + 0.3 * _noise(rng)[..., None])
    x, y = np.meshgrid(np.arange(SIDE) / SIDE, np.arange(SIDE) / SIDE)
    for _ in range(int(rng.integers(3, 14))):
        a, b, w, h = rng.random(4) * [1, 1, 0.4, 0.4]
        disc = rng.random() < 0.5
        mask = np.hypot((x - a) / (w + 0.02), (y - b) / (h + 0.02)) < 1 if disc else (abs(x - a) < w) & (abs(y - b) < h)
        shown[mask] = _colour(rng) * (0.8 + 0.2 * y[mask][:, None])
    for row in range(int(rng.integers(0, 9))):
        top, wide = 0.1 + 0.09 * row, rng.uniform(0.3, 0.8)
        mask = (abs(y - top) < 0.02) & (x > 0.1) & (x < 0.1 + wide) & (np.sin(x * 190 + row) > -0.3)
        shown[mask] = _colour(rng) * 0.3
    return shown


def _colour(rng: np.random.Generator) -> np.ndarray:
    """A colour [3] in sRGB: mostly muted."""
    grey, hue, spread = rng.uniform(0.08, 0.98), rng.random(3), rng.random() ** 2
    return np.clip(grey * (1 - spread) + spread * hue, 0.02, 1)
