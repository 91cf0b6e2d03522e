"""A Doom map as geometry: the maps of a WAD, and exact depth by ray casting its sectors."""

import math
import re
import struct
from collections import Counter, defaultdict
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..core.errors import TerrellaError
from ..space.camera import Intrinsics
from .kernels_numba import cast_prisms

SKY = b"F_SKY1"


@lru_cache(maxsize=8)
def lumps(wad: Path) -> list[tuple[str, int, int]]:
    """The directory of a WAD: (name, offset, length) of each lump; TerrellaError where it is not a WAD."""
    try:
        with open(wad, "rb") as file:
            kind, count, where = struct.unpack("<4sii", file.read(12))
            file.seek(where)
            table = file.read(16 * count)
        if kind not in (b"IWAD", b"PWAD") or len(table) != 16 * count:
            raise struct.error("not a WAD")
    except (OSError, struct.error) as error:
        raise TerrellaError(f"{wad} is not a Doom WAD ({error}); install ViZDoom again.") from error
    entries = struct.iter_unpack("<ii8s", table)
    return [(name.rstrip(b"\0").decode("latin-1"), offset, length) for offset, length, name in entries]


def map_names(wad: Path) -> list[str]:
    return [name for name, _, _ in lumps(wad) if re.fullmatch(r"MAP\d\d|E\dM\d", name)]


def skies(wad: Path, name: str) -> np.ndarray:
    """bool [S]: whether the ceiling of each sector of map `name` is open sky; empty where the map does not say."""
    table = lumps(wad)
    at = [entry[0].upper() for entry in table].index(name.upper())
    for kind, offset, length in table[at + 1 : at + 12]:
        if kind not in ("SECTORS", "TEXTMAP"):
            continue
        with open(wad, "rb") as file:
            file.seek(offset)
            data = file.read(length)
        if kind == "SECTORS":  # floor and ceiling int16, floor and ceiling texture 8 bytes, three more int16
            return np.array([data[i + 12 : i + 20].rstrip(b"\0") == SKY for i in range(0, length, 26)], bool)
        sectors = re.findall(rb"\bsector\b[^{]*\{([^}]*)\}", data)
        return np.array([re.search(rb'textureceiling\s*=\s*"F_SKY1"', text) is not None for text in sectors], bool)
    return np.zeros(0, bool)


def wall_textures(wad: Path, name: str) -> list[str]:
    """Of each sector of map `name` the texture of most of its walls, by length; [] where the map is not in the text format."""
    table = lumps(wad)
    at = [entry[0].upper() for entry in table].index(name.upper())
    for kind, offset, length in table[at + 1 : at + 12]:
        if kind == "TEXTMAP":
            with open(wad, "rb") as file:
                file.seek(offset)
                text = file.read(length).decode("latin-1")
            break
    else:
        return []
    blocks: dict[str, list[dict[str, str]]] = {kind: [] for kind in ("vertex", "linedef", "sidedef", "sector")}
    for kind, body in re.findall(r"\b(vertex|linedef|sidedef|sector)\b[^{]*\{([^}]*)\}", text):
        blocks[kind].append({key: value.strip('"') for key, value in re.findall(r"(\w+)\s*=\s*([^;]+);", body)})
    corners = [(float(one["x"]), float(one["y"])) for one in blocks["vertex"]]
    lengths = [defaultdict[str, float](float) for _ in blocks["sector"]]
    for line in blocks["linedef"]:
        length_of = math.dist(corners[int(line["v1"])], corners[int(line["v2"])])
        for side in (blocks["sidedef"][int(line[end])] for end in ("sidefront", "sideback") if end in line):
            if "texturemiddle" in side:
                lengths[int(side["sector"])][side["texturemiddle"].upper()] += length_of
    return [max(one, key=lambda texture: one[texture], default="") for one in lengths]


class Sectors:
    """The map as prisms. `update` reads the heights of floors and ceilings again; `dynamic` marks sectors that differ from the
    start of the episode (an open door, a moving lift) or have no height (a closed door)."""

    def __init__(self, sectors, sky: np.ndarray):
        lines = [np.array([(w.x1, w.y1, w.x2, w.y2) for w in s.lines], np.float64).reshape(-1, 4) for s in sectors]
        blocking = [np.array([w.is_blocking for w in s.lines], bool) for s in sectors]
        owner = np.repeat(np.arange(len(lines)), [len(group) for group in lines])
        self.lines, blocks = np.concatenate(lines), np.concatenate(blocking)
        ends = [tuple(sorted([(x1, y1), (x2, y2)])) for x1, y1, x2, y2 in self.lines]
        times = Counter(ends)
        alone = np.array(
            [times[pair] == 1 for pair in ends]
        )  # lines of one sector only: walls, or lines inside the sector
        keep = ~(alone & ~blocks)
        for _ in range(4):  # a fence inside a sector has a loose end
            corners = Counter((s, point) for s, pair, kept in zip(owner, ends, keep) if kept for point in pair)
            loose = [any(corners[s, point] == 1 for point in pair) for s, pair in zip(owner, ends)]
            keep &= ~(alone & np.array(loose))
        self.lines, self.solid, owner = self.lines[keep].copy(), alone[keep].copy(), owner[keep]
        self.first = np.searchsorted(owner, np.arange(len(lines) + 1))
        self.sky = sky if len(sky) == len(lines) else np.zeros(len(lines), bool)
        self.update(sectors)
        self.initial_heights = self.heights

    def update(self, sectors) -> None:
        """Reads the current heights of the sectors."""
        self.heights = np.array([(sector.floor_height, sector.ceiling_height) for sector in sectors], np.float64)

    def dynamic(self) -> np.ndarray:
        """bool [S]: the sectors that have moved or are closed."""
        return (self.heights != self.initial_heights).any(1) | (self.heights[:, 0] >= self.heights[:, 1])

    def depth(
        self, x: float, y: float, eye: float, yaw: float, camera: Intrinsics, size: tuple[int, int], farthest: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth along the optical axis float64 [H, W], and the visible sector int32 [H, W] (-1: a wall, the sky), in map units;
        yaw in radians."""
        depth, sector = np.empty(size), np.empty(size, np.int32)
        parts = self.lines, self.solid, self.first, self.heights, self.sky
        cast_prisms(*parts, x, y, eye, yaw, camera, farthest, depth, sector)
        return depth, sector
