"""What is no surface: leaves, flames, and what lies outside of windows."""

import numpy as np
import torch

from ..raster import Gaussians
from ..raster.gaussians import plain_sh
from .cells import quaternions
from .daylight import Daylight
from .room_layout import WALLS, RoomLayout
from .textures import hashed, hexes, noise

LEAF_M = (0.1, 0.19)
AWAY_M, ASIDE_M = 3.2, 6.0  # how far outside the view lies; how far it reaches beyond a window
EYE_M = 1.6  # the horizon
_FOLIAGE = {"trees": "3f6b3a 6f8f4e 2c4a2c", "hills": "5f7f4a 8fa36a 4a6a4f", "city": "8a8f98 a8a29a 6a7078"}


def leaves_in(low: np.ndarray, high: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leaves of a plant in a box: places [N, 3], columns of their turns [N, 3, 3] (along, across, normal) and sizes [N, 2]."""
    rng, size = np.random.default_rng(seed), high - low
    many = int(np.clip(260 * size.prod() / 0.4, 50, 420))
    turn, up = rng.uniform(0, 2 * np.pi, many), rng.uniform(0.05, 1, many)
    out = np.stack([np.cos(turn), np.sin(turn)], 1)
    far = np.sqrt(rng.uniform(0.08, 1, many)) * np.sin(np.pi * np.clip(0.12 + 0.8 * up, 0, 1))
    middle, half = (low + high) / 2, size / 2
    places = np.concatenate(
        [middle[:2] + out * half[:2] * far[:, None] * 0.86, (low[2] + size[2] * 0.94 * up)[:, None]], 1
    )
    droop = rng.uniform(-0.5, 0.9, many)
    along = np.concatenate([out, droop[:, None]], 1) + 0.5 * rng.normal(size=(many, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, np.array([0, 0, 1.0]) + 0.4 * rng.normal(size=(many, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normal = np.cross(along, across)
    long = rng.uniform(*LEAF_M, many) * min(1.0, float(size[0]) / 0.6)
    return places, np.stack([along, across, normal], 2), np.stack([long, 0.36 * long], 1)


def flame(low: np.ndarray, high: np.ndarray) -> Gaussians:
    """A flame in a box, with its glow around it."""
    middle, size = (low + high) / 2, high - low
    rows = [  # height, width, tall, opacity, colour
        (0.5, 4.2, 1.9, 0.05, "ff9a3c"), (0.5, 2.2, 1.1, 0.12, "ffa040"), (0.5, 0.4, 0.36, 0.6, "ff8a24"),
        (0.72, 0.24, 0.28, 0.5, "ff7a1c"),
        (0.36, 0.3, 0.22, 0.9, "ffc65a"), (0.3, 0.18, 0.14, 0.97, "fff3c8"),
    ]  # fmt: skip
    means = np.array([[*middle[:2], low[2] + at * size[2]] for at, *_ in rows])
    scales = np.array([[wide * size[0] / 2, wide * size[1] / 2, tall * size[2] / 2] for _, wide, tall, _, _ in rows])
    quats = np.repeat([[1.0, 0, 0, 0]], len(rows), 0)
    colours = hexes(" ".join(one[-1] for one in rows))
    return _gaussians(means, quats, scales, np.array([one[3] for one in rows]), colours)


def _gaussians(means, quats, scales, opacities, colours) -> Gaussians:
    to = lambda part: torch.from_numpy(np.ascontiguousarray(part, np.float32))  # noqa: E731
    return Gaussians(to(means), to(quats), to(scales), to(opacities), plain_sh(to(colours)))


def foliage(parts: tuple[np.ndarray, np.ndarray, np.ndarray], colours: np.ndarray) -> Gaussians:
    """Leaves with colours [N, 3]: each two flat Gaussians, the inner half darker."""
    places, turns, sizes = parts
    means, scales = [], []
    for share, wide in ((-0.2, 1.0), (0.22, 0.8)):
        means.append(places + turns[:, :, 0] * (share * sizes[:, :1]))
        scales.append(
            np.concatenate([0.27 * sizes[:, :1], 0.33 * wide * sizes[:, 1:], np.full((len(sizes), 1), 0.0015)], 1)
        )
    quats = np.repeat(quaternions(turns)[None], 2, 0).reshape(-1, 4)
    shown = np.concatenate([colours * 0.82, np.clip(colours * 1.08, 0, 1)])
    return _gaussians(np.concatenate(means), quats, np.concatenate(scales), np.full(2 * len(places), 0.97), shown)


def outside(plan: RoomLayout, kind: str, daylight: Daylight) -> list[Gaussians]:
    """What is seen through each window: a blurred view on an upright plane. Parts of it that would lie in a room are left out."""
    views = []
    for window in plan.windows:
        room = next(one for one in plan.rooms if one.name == window.room)
        axis, upper = WALLS[window.wall]
        face, way = (room.high[axis] if upper else room.low[axis]), (1 if upper else -1)
        middle = lambda one: (one.at if one.at is not None else room.size[1 - axis] / 2) + room.low[1 - axis]  # noqa: E731, B023
        beside = sorted(
            middle(one)
            for one in plan.windows
            if one is not window and (one.room, one.wall) == (window.room, window.wall)
        )
        here = middle(window)
        low = max([(here + other) / 2 for other in beside if other <= here], default=here - window.width / 2 - ASIDE_M)
        high = min([(here + other) / 2 for other in beside if other > here], default=here + window.width / 2 + ASIDE_M)
        views.append(_view(plan, kind, daylight, (axis, face + way * AWAY_M, low, high, room.at[2])))
    return views


def _view(plan: RoomLayout, kind: str, daylight: Daylight, plane: tuple[int, float, float, float, float]) -> Gaussians:
    axis, face, low, high, floor = plane
    rows = []
    for bottom, top, step in ((-1.4, 0.9, 0.3), (0.9, 3.0, 0.11), (3.0, 6.5, 0.4)):
        many, tall = max(round((high - low) / step), 1), max(round((top - bottom) / step), 1)
        a, z = np.meshgrid(
            (np.arange(many) + 0.5) / many * (high - low) + low,
            (np.arange(tall) + 0.5) / tall * (top - bottom) + bottom,
        )
        rows.append(np.stack([a.ravel(), z.ravel(), np.full(a.size, step)], 1))
    a, z, step = np.concatenate(rows).T
    means = np.empty((len(a), 3))
    means[:, axis], means[:, 1 - axis], means[:, 2] = face, a, z + floor
    inside = np.zeros(len(a), np.bool_)
    for room in plan.rooms:
        inside |= ((means > np.array(room.low) - 0.3) & (means < np.array(room.high) + 0.3)).all(1)
    scales = np.stack([step * 0.68] * 3, 1)
    scales[:, axis] = 0.002
    colours = view_colours(kind, daylight, a, z - EYE_M, plan.seed)
    quats = np.repeat([[1.0, 0, 0, 0]], len(a), 0)
    return _gaussians(means, quats, scales, np.full(len(a), 0.99), colours).at(torch.from_numpy(~inside))


def view_colours(kind: str, daylight: Daylight, a: np.ndarray, z: np.ndarray, seed: int) -> np.ndarray:
    """Colours [N, 3] of an outside at a metres along it and z metres above the horizon."""
    zenith, pale = hexes(f"{daylight.zenith} {daylight.horizon}")
    share = np.clip(z / 3.2, 0, 1)[:, None] ** 0.6
    sky = pale * (1 - share) + zenith * share
    cloud = np.clip(noise(a, 3 * z, 2.2, seed + 40) + 0.5 * noise(a, 3 * z, 0.7, seed + 41) - 0.85, 0, 1)[:, None]
    sky = sky + 0.6 * cloud * (np.clip(pale * 1.12, 0, 1) - sky)
    light = np.array(daylight.sky) + 0.12 * np.array(daylight.sunlight)
    lit = np.clip(light / 6.5, 0.03, 1) ** 0.45
    far, near, dark = hexes(_FOLIAGE[kind]) * lit
    none = np.zeros(len(a))
    hills = 0.12 + 0.4 * noise(a, none, 3.4, seed + 42)
    shown = np.where((z < hills)[:, None], 0.55 * far + 0.45 * pale * lit, sky)
    if kind == "city":
        for k, (wide, tall, haze) in enumerate(((1.3, 1.5, 0.55), (1.9, 1.0, 0.2))):
            house = np.floor(a / wide + 0.3 * hashed(seed + 50 + k, np.floor(a / wide)))
            top = tall * (0.25 + 0.75 * hashed(seed + 52 + k, house))
            wall = (far if k == 0 else near) * (0.75 + 0.4 * hashed(seed + 54 + k, house))[:, None]
            i, j = np.floor(a / 0.24), np.floor(z / 0.28)
            pane = (a / 0.24 - i > 0.3) & (z / 0.28 - j > 0.35)
            bright = hashed(seed + 56 + k, i, j) > 0.55
            glow = (
                np.where(bright[:, None], np.array([1.0, 0.82, 0.5]), wall * 0.5)
                if daylight.sky[0] < 0.6
                else wall * 0.7
            )
            wall = np.where(pane[:, None], glow, wall * (1 - haze) + pale * lit * haze)
            shown = np.where((z < top)[:, None], wall, shown)
    else:
        for k, (tall, haze) in enumerate(((0.75, 0.35), (1.15, 0.0))):
            crown = tall * (0.05 + 1.1 * noise(a + 13 * k, none, 1.5 - 0.4 * k, seed + 44 + k) ** 1.4) + 0.16 * noise(
                a, none, 0.22, seed + 46
            )
            crown = crown * (0.35 if kind == "hills" else 1.0) - (0.12 if k else 0.0)
            tone = (near if k == 0 else dark) * (
                0.65 + 0.8 * noise(a, z, 0.3, seed + 48 + k) * np.clip(0.6 + z, 0.4, 1.3)
            )[:, None]
            shown = np.where((z < crown)[:, None], tone * (1 - haze) + pale * lit * haze, shown)
    ground = (
        (hexes("6f8f4a")[0] if kind != "city" else hexes("8b8a86")[0])
        * lit
        * (0.8 + 0.3 * noise(a, 3 * z, 0.5, seed + 49))[:, None]
    )
    return np.clip(np.where((z < -0.06)[:, None], ground, shown), 0, 1)
