"""Textures by code: colours of materials at places on a surface, fixed by a seed."""

from collections.abc import Callable

import numpy as np

from ..kernels_numba import cells as kernels

Size = tuple[float, float]
_SPINES = "8c2f24 22335c 3f6b45 6f4a30 e8dcc0 2b7073 c9a13b 1f1f22 a65a35 d8d2c4 4d5f73"
_ART = ("e9dfc9 c65f3a 2f4858 d9a441 7d8f69", "f1ece2 24476b 8fb0c4 c9b18a 1f2a36", "f3e9dc 3d5a45 a3b18a d98c5f 5c3b2e",
        "efe6d5 8c3b3b d8a08a 2d2d34 b8b08d")  # fmt: skip


def hexes(words: str) -> np.ndarray:
    """Colours [n, 3] of words like "8c2f24"."""
    return np.array([[int(one[at : at + 2], 16) / 255 for at in (0, 2, 4)] for one in words.split()])


def texture_colours(
    material: str, colour: tuple[float, ...], uv: tuple[np.ndarray, np.ndarray], size: Size, step: float, seed: int
) -> np.ndarray:
    """Colours [N, 3] of a surface at uv [N] each, metres from a corner of a side of a size in metres, averaged over squares of
    side `step`; wood and planks run along u, and v points up on walls."""
    pattern, fine = _PATTERNS.get(material), material in _LINES
    u, v = uv
    if pattern is None:
        return np.repeat(np.array(colour)[None], len(u), 0)
    offsets = (-step / 4, step / 4) if fine else (0.0,)
    total = sum(_three(pattern(u + a, v + b, size, seed)) * 1.0 for a in offsets for b in offsets)
    shade = np.asarray(total) / len(offsets) ** 2
    return np.clip(shade if material in _OWN else np.array(colour) * shade, 0, 1)


def _three(shade: np.ndarray) -> np.ndarray:
    return shade[:, None] if shade.ndim == 1 else shade


def hashed(seed: int, *parts: np.ndarray) -> np.ndarray:
    """Chance in 0..1 that integers fix."""
    mixed = np.full(np.broadcast(*parts).shape, (seed * 2654435761 + 97) & 0xFFFFFFFF, np.uint32)
    for part in parts:
        mixed = (mixed ^ np.floor(part).astype(np.int32).view(np.uint32)) * np.uint32(0x9E3779B1)
        mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(0x85EBCA77)
        mixed = mixed ^ (mixed >> np.uint32(13))
    return mixed / 0xFFFFFFFF


def noise(u: np.ndarray, v: np.ndarray, wide: float, seed: int, tall: float = 0.0) -> np.ndarray:
    """Smooth noise in 0..1 whose blobs are wide by tall (default: wide) metres."""
    out = np.empty(len(u))
    kernels.noise(np.ascontiguousarray(u, float), np.ascontiguousarray(v, float), wide, tall or wide, seed, out)
    return out


def _line(at: np.ndarray, half: float | np.ndarray) -> np.ndarray:
    """1 within `half` of whole numbers, 0 elsewhere."""
    return (np.abs(at - np.round(at)) < half) * 1.0


def _plaster(u, v, size, seed):
    return (
        0.965 + 0.02 * noise(u, v, 0.9, seed) + 0.025 * noise(u, v, 0.16, seed + 1) + 0.02 * noise(u, v, 0.05, seed + 2)
    )


def _paint(u, v, size, seed):
    return 0.985 + 0.015 * noise(u, v, 0.7, seed)


def _grain(u, v, seed):
    """Fibres and the rings of a board that was cut along the trunk."""
    bend = noise(u, v, 0.9, seed, 0.16)
    rings = v / 0.022 + 5.5 * bend
    ring = np.abs(rings - np.floor(rings) - 0.5) * 2
    return (
        0.14 * (ring - 0.5)
        + 0.13 * (noise(u, v, 0.3, seed + 1, 0.006) - 0.5)
        + 0.1 * (noise(u, v, 0.5, seed + 2, 0.04) - 0.5)
    )


def _planks(u, v, size, seed, wide=0.14):
    row = np.floor(v / wide)
    long_ = 1.0 + 0.9 * hashed(seed + 5, row)
    along = u / long_ + hashed(seed, row) * 7
    board = np.floor(along)
    own = hashed(seed + 3, row, board)
    seam = np.maximum(_line(v / wide, 0.0018 / wide), _line(along, 0.0018 / long_))
    grain = _grain(u + 37 * own, v + 11 * own, seed)
    tone = 0.8 + 0.32 * own + 1.15 * grain
    warm = 1 + np.outer(hashed(seed + 9, row, board) - 0.5, np.array([0.02, -0.03, -0.12]))
    return warm * (tone * (1 - 0.55 * seam))[:, None]


def _wood(u, v, size, seed):
    return 0.95 + 0.9 * _grain(u, v, seed)


def _boards(u, v, size, seed):
    return _planks(v, u, size, seed, 0.11)


def _tiles(u, v, size, seed, wide=0.3, tall=0.3):
    i, j = np.floor(u / wide), np.floor(v / tall)
    grout = np.maximum(_line(u / wide, 0.0035 / wide), _line(v / tall, 0.0035 / tall))
    body = 0.94 + 0.08 * hashed(seed, i, j) + 0.05 * (noise(u + 9 * i, v, 0.12, seed) - 0.5)
    return body * (1 - 0.3 * grout)


def _checker(u, v, size, seed):
    i, j = np.floor(u / 0.33), np.floor(v / 0.33)
    return _tiles(u, v, size, seed, 0.33, 0.33) * np.where((i + j) % 2 == 0, 1.0, 0.3)


def _subway(u, v, size, seed):
    row = np.floor(v / 0.075)
    return _tiles(u + 0.075 * (row % 2), v, size, seed, 0.15, 0.075)


def _brick(u, v, size, seed):
    row = np.floor(v / 0.08)
    along = u / 0.24 + 0.5 * (row % 2) + 0.02 * hashed(seed + 4, row)
    brick = np.floor(along)
    ragged = 0.4 * (noise(u, v, 0.02, seed + 7) - 0.5)
    mortar = np.maximum(_line(v / 0.08, 0.085 + 0.06 * ragged), _line(along, 0.03 + 0.02 * ragged))
    tone = 0.72 + 0.5 * hashed(seed, row, brick) + 0.25 * (noise(u, v, 0.03, seed) - 0.5)
    warm = 1 + np.outer(hashed(seed + 2, row, brick) - 0.5, np.array([0.15, -0.15, -0.25]))
    grey = np.array([1.15, 1.6, 1.75]) * (1 + 0.12 * (noise(u, v, 0.05, seed + 8) - 0.5))[:, None]
    return np.where(mortar[:, None] > 0, grey, warm * tone[:, None])


def _masonry(u, v, seed, tall, long_, joint):
    """Rows of hewn blocks of varying length with dark joints and rounded faces."""
    row = np.floor(v / tall + 0.06 * (noise(u, v, 0.5, seed + 3) - 0.5))
    stride = long_ * (0.8 + 0.5 * hashed(seed + 6, row))
    along = u / stride + 5 * hashed(seed, row) + 0.05 * (noise(u, v, 0.2, seed + 4) - 0.5)
    block = np.floor(along)
    off = np.minimum(np.abs(v / tall - np.round(v / tall)) * tall, np.abs(along - np.round(along)) * stride)
    edge = np.clip(off / joint - 0.4, 0, 1)
    rough = 0.3 * noise(u, v, 0.13, seed) + 0.28 * noise(u, v, 0.028, seed + 1)
    tone = 0.49 + 0.34 * hashed(seed, row, block) + rough
    warm = 1 + np.outer(hashed(seed + 2, row, block) - 0.5, np.array([0.1, 0.0, -0.12]))
    return warm * (tone * (0.42 + 0.58 * edge))[:, None]


def _stone(u, v, size, seed):
    return _masonry(u, v, seed, 0.36, 0.6, 0.018)


def _flagstone(u, v, size, seed):
    return _masonry(u, v, seed, 0.55, 0.75, 0.016)


def _concrete(u, v, size, seed):
    wide, tall = 1.2, 1.2
    seam = np.maximum(_line(u / wide, 0.0025 / wide), _line(v / tall, 0.0025 / tall))
    a, b = (u / wide) % 1 * wide, (v / tall) % 1 * tall
    hole = np.minimum(np.hypot(np.minimum(a, wide - a) - 0.2, np.minimum(b, tall - b) - 0.2), 1)
    tone = 0.8 + 0.18 * noise(u, v, 0.8, seed) + 0.12 * noise(u, v, 0.17, seed + 1) + 0.08 * noise(u, v, 0.03, seed + 2)
    tone += 0.05 * (hashed(seed, np.floor(u / wide), np.floor(v / tall)) - 0.5)
    return tone * (1 - 0.35 * seam) * np.where(hole < 0.018, 0.55, 1.0)


def _marble(u, v, size, seed):
    wave = 2.2 * u + 1.3 * v + 5 * noise(u, v, 0.6, seed) + 2.2 * noise(u, v, 0.15, seed + 1)
    vein, thin = np.abs(np.sin(wave)), np.abs(np.sin(2.7 * wave + 1))
    return 1 - 0.3 * np.clip(1 - vein / 0.16, 0, 1) - 0.12 * np.clip(1 - thin / 0.1, 0, 1)


def _carpet(u, v, size, seed):
    return 0.82 + 0.2 * noise(u, v, 0.014, seed) + 0.12 * noise(u, v, 0.5, seed + 1)


def _grass(u, v, size, seed):
    return 0.6 + 0.5 * noise(u, v, 0.03, seed) + 0.3 * noise(u, v, 0.6, seed + 1)


def _cloth(u, v, size, seed):
    weave = 0.05 * np.sin(u * 2 * np.pi / 0.016) * np.sin(v * 2 * np.pi / 0.016)
    return 0.93 + weave + 0.06 * noise(u, v, 0.25, seed) + 0.04 * noise(u, v, 0.02, seed + 1)


def _rug(u, v, size, seed):
    """A border, and one of three fields: diamonds, stripes or a plain field with flecks."""
    edge = np.minimum(np.minimum(u, size[0] - u), np.minimum(v, size[1] - v))
    kind, a, b = seed % 3, u - size[0] / 2, v - size[1] / 2
    if kind == 0:
        wave = np.abs(((a / 0.4) % 1) - 0.5) + np.abs(((b / 0.4) % 1) - 0.5)
        field = np.where(np.abs(wave - 0.5) < 0.09, 1.9, np.where(wave < 0.2, 0.55, 1.0))
    elif kind == 1:
        field = np.where(np.floor(a / 0.11) % 4 == 0, 1.8, np.where(np.floor(a / 0.11) % 4 == 2, 0.6, 1.0))
    else:
        field = 1 + 0.35 * (noise(u, v, 0.16, seed) > 0.62)
    tone = np.where(edge < 0.03, 1.7, np.where(edge < 0.11, 0.5, np.where(edge < 0.14, 1.7, field)))
    pile = 0.88 + 0.2 * noise(u, v, 0.012, seed + 1)
    return np.clip(tone, 0, 2.2) * pile


def _tatami(u, v, size, seed):
    i, j = np.floor(u / 1.8), np.floor(v / 0.9)
    hem = _line(v / 0.9, 0.022 / 0.9)
    seam = _line(u / 1.8, 0.003 / 1.8)
    straw = (
        0.93
        + 0.07 * hashed(seed, i, j)
        + 0.06 * (noise(u, v, 0.008, seed, 0.3) - 0.5)
        + 0.04 * np.sin(u * 2 * np.pi / 0.02)
    )
    return (straw * (1 - 0.5 * seam))[:, None] * np.where(hem[:, None] > 0, np.array([0.16, 0.24, 0.2]), 1.0)


def _paper(u, v, size, seed):
    """Paper between thin bars of wood."""
    rows, columns = max(round(size[1] / 0.3), 1), max(round(size[0] / 0.24), 1)
    a, b = size[0] / columns, size[1] / rows
    bar = np.maximum(_line(u / a, 0.009 / a), _line(v / b, 0.009 / b))
    edge = np.minimum(np.minimum(u, size[0] - u), np.minimum(v, size[1] - v)) < 0.035
    fibre = 0.95 + 0.05 * noise(u, v, 0.06, seed)
    return np.where((bar + edge)[:, None] > 0, np.array([0.28, 0.2, 0.14]), fibre[:, None] * np.ones(3))


def _books(u, v, size, seed):
    """Spines of books of varying width and height before a dark back."""
    stride = 0.042
    at = np.floor(u / stride + 0.35 * hashed(seed, np.floor(u / stride)))
    place = u / stride + 0.35 * hashed(seed, np.floor(u / stride)) - at
    palette = hexes(_SPINES)
    own = palette[(hashed(seed, at) * len(palette)).astype(int) % len(palette)]
    tall = size[1] * (0.68 + 0.3 * hashed(seed + 1, at))
    tall = np.where(hashed(seed + 4, np.floor(at / 9)) > 0.86, size[1] * 0.25, tall)  # a gap, with some lying
    round_ = 0.72 + 0.38 * np.sin(np.pi * np.clip(place, 0, 1))
    bands = (np.abs(v / tall - 0.8) < 0.025) | (np.abs(v / tall - 0.2) < 0.025)
    band = np.where(bands & (hashed(seed + 2, at) > 0.5), 1.5, 1.0)
    shown = own * (round_ * band * (0.8 + 0.3 * hashed(seed + 3, at)))[:, None]
    return np.where((v > tall)[:, None], np.array([0.06, 0.045, 0.035]), shown)


def _art(u, v, size, seed):
    """An abstract painting: hills or discs in one of four palettes, in a pale mount."""
    palette = hexes(_ART[seed % len(_ART)])
    a, b = u / max(size[0], 1e-6), v / max(size[1], 1e-6)
    out = np.repeat(palette[:1], len(u), 0)
    for k in range(1, 4):
        if seed % 2:
            ridge = 0.82 - 0.2 * k + 0.22 * (noise(a + 5 * k, 0 * a, 0.3, seed + k) - 0.3)
            inside = b < ridge
        else:
            x, y, r = (float(hashed(seed + 7 * k + m, np.array([k]))[0]) for m in range(3))
            inside = np.hypot(a - 0.2 - 0.6 * x, (b - 0.2 - 0.6 * y) * size[1] / size[0]) < 0.1 + 0.2 * r
        out = np.where(inside[:, None], palette[k], out)
    mount = (np.minimum(a, 1 - a) < 0.1) | (np.minimum(b, 1 - b) < 0.12)
    return np.where(
        mount[:, None], np.array([0.93, 0.91, 0.87]), out * (0.94 + 0.12 * noise(u, v, 0.02, seed))[:, None]
    )


def _metal(u, v, size, seed):
    return 0.93 + 0.1 * noise(u, v, 0.5, seed, 0.004)


_PATTERNS: dict[str, Callable[..., np.ndarray]] = {
    "plaster": _plaster, "paint": _paint, "planks": _planks, "wood": _wood, "boards": _boards, "tiles": _tiles, "checker": _checker,
    "subway": _subway, "brick": _brick, "stone": _stone, "flagstone": _flagstone, "concrete": _concrete, "marble": _marble,
    "carpet": _carpet, "grass": _grass, "cloth": _cloth, "rug": _rug, "tatami": _tatami, "paper": _paper, "books": _books,
    "art": _art, "metal": _metal,
}  # fmt: skip
_LINES = {"planks", "boards", "tiles", "checker", "subway", "brick", "concrete", "tatami", "paper", "books", "rug"}
_OWN = {"books", "art", "paper"}  # these have colours of their own
