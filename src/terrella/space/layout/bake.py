"""Blocks as flat Gaussians in a grid on every visible side, lit by radiosity (Goral et al. 1984): a light map of texels gathers the
light of lamps, windows and the sun, and of three bounces between texels."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ..camera import planar_pose
from ..edits import REVEALED
from ..kernels_numba import light as kernels
from ..raster import Gaussians
from ..raster.gaussians import plain_sh
from ..views import over_views
from .blocks import Blocks, blocks_of
from .looks import FINE, texture_colours
from .room_layout import RoomLayout

TEXEL_M = 0.14
RAYS = 64
LAMPS = 40  # point lights that approximate all light sources, per room
BOUNCES = 3
SLIM_M = 0.05  # narrower sides emit no light
SUN = 14.0  # brightness, relative to a white wall outdoors
OPACITY = REVEALED
OVERLAP = 0.7  # standard deviation of a Gaussian as a share of the grid's spacing
FINEST_M, THIN_M = 0.006, 0.0015
_AXES = ((1, 2), (0, 2), (0, 1))  # the two axes along a side, for each axis across it


@dataclass(frozen=True)
class BuiltPlace:
    """A place built from a layout."""

    gaussians: Gaussians
    objects: (
        torch.Tensor
    )  # int32 [N], the object of each Gaussian (0: the building; -k: the building beneath the object k)
    names: tuple[str, ...]  # of objects 1, 2, ...
    solids: torch.Tensor  # float32 [S, 6], boxes that stop walkers
    bodies: torch.Tensor  # int32 [S], the movable object of each box (0: none)
    starts: torch.Tensor  # float32 [R, 7], a pose in each room, at the height of its floor


@dataclass
class _Grid:
    """Cells on the sides of K blocks."""

    points: np.ndarray  # [N, 3], middles of the cells
    sides: np.ndarray  # [N], the side 0..5 of the block
    blocks: np.ndarray  # [N]
    widths: np.ndarray  # [N, 2], along both axes of the side
    starts: np.ndarray  # [6 K], the first cell of each side
    counts: np.ndarray  # [6 K, 2], cells along both axes of each side

    @property
    def normals(self) -> np.ndarray:
        normals = np.zeros_like(self.points)
        normals[np.arange(len(normals)), self.sides // 2] = np.where(self.sides % 2, 1.0, -1.0)
        return normals


def build(plan: RoomLayout, count: int = 120_000) -> BuiltPlace:
    """Builds a layout with about `count` Gaussians. The same layout gives the same place. ContractError if parts do not fit."""
    blocks = blocks_of(plan)
    boxes, bodies = blocks.boxes, blocks.bodies
    air = np.array([[*low, *high] for low, high in blocks.air])
    texels = _grid(boxes, np.full(len(boxes), TEXEL_M))
    bare = _bare(texels, boxes, air)
    light = _light(plan, blocks, boxes, texels, bare)
    area = texels.widths.prod(1) * bare
    fine = np.array([FINE.get(look.material, 1.0) for look in blocks.looks])
    apart = math.sqrt((area * fine[texels.blocks]).sum() / count)
    spacing = np.clip(apart / np.sqrt(fine), FINEST_M, 0.3)
    cells, objects = _surfaces(_grid(boxes, spacing), boxes, air, np.asarray(blocks.objects, np.int32), bodies)
    colours = _brightness(plan, blocks, boxes, cells, texels, bare, light)
    return BuiltPlace(
        _gaussians(cells, colours, objects >= 0),
        torch.from_numpy(objects),
        tuple(blocks.names),
        torch.from_numpy(blocks.solids),
        torch.from_numpy(bodies[np.asarray(blocks.solid)]),
        _starts(plan, blocks),
    )


def _grid(boxes: np.ndarray, spacing: np.ndarray) -> _Grid:
    """Cells of about `spacing` [K] on all six sides of boxes [K, 6]."""
    points, sides, owners, widths = [], [], [], []
    starts, counts, total = np.zeros(6 * len(boxes), np.int64), np.zeros((6 * len(boxes), 2), np.int64), 0
    for k, box in enumerate(boxes):
        for side in range(6):
            axis, (a, b) = side // 2, _AXES[side // 2]
            size = box[[3 + a, 3 + b]] - box[[a, b]]
            many = np.maximum(np.ceil(size / spacing[k] - 1e-6).astype(int), 1)
            step = size / many
            u = box[a] + step[0] * (np.arange(many[0]) + 0.5)
            v = box[b] + step[1] * (np.arange(many[1]) + 0.5)
            place = np.empty((many[0], many[1], 3))
            place[..., axis] = box[3 + axis] if side % 2 else box[axis]
            place[..., a], place[..., b] = u[:, None], v[None]
            points.append(place.reshape(-1, 3))
            n = len(points[-1])
            sides.append(np.full(n, side))
            owners.append(np.full(n, k))
            widths.append(np.tile(step, (n, 1)))
            starts[6 * k + side], counts[6 * k + side] = total, many
            total += n
    join = np.concatenate
    return _Grid(join(points), join(sides), join(owners), join(widths), starts, counts)


def _bare(grid: _Grid, boxes: np.ndarray, air: np.ndarray) -> np.ndarray:
    """Whether cells have air in front of them: bool [N]."""
    front = grid.points + 0.004 * grid.normals
    return _in(front, air) & ~_in(front, boxes)


def _in(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    inside = np.empty(len(points), np.bool_)
    over_views(len(points), lambda first, last: kernels.in_any(first, last, points, boxes, 0.0, inside))
    return inside


def _surfaces(
    grid: _Grid, boxes: np.ndarray, air: np.ndarray, objects: np.ndarray, bodies: np.ndarray
) -> tuple[_Grid, np.ndarray]:
    """The cells that are visible, now or after objects were pushed, moved or deleted; and of each the object [N], as in a world:
    -k for what is hidden beneath the fixed object k."""
    front, whose = grid.points + 0.004 * grid.normals, objects[grid.blocks]
    kept = _in(front, air) & ~_in(front, boxes[objects == 0])
    for number in range(1, objects.max(initial=0) + 1):
        rows, own = np.flatnonzero(whose == number), boxes[objects == number]
        kept[rows] = ~_in(front[rows], own) & ((bodies[objects == number].max() > 0) | kept[rows])
        rows = np.flatnonzero(kept & (whose == 0))
        if bodies[objects == number].max() == 0:
            whose[rows[_in(front[rows], own)]] = -number
    cells = _Grid(grid.points[kept], grid.sides[kept], grid.blocks[kept], grid.widths[kept], grid.starts, grid.counts)
    return cells, whose[kept]


def _light(plan: RoomLayout, blocks: Blocks, boxes: np.ndarray, texels: _Grid, bare: np.ndarray) -> np.ndarray:
    """Irradiance of each texel: [T, 3]."""
    rows = np.flatnonzero(bare)
    normals = texels.normals[rows]
    points = texels.points[rows] + 0.003 * normals
    look = [blocks.looks[k] for k in texels.blocks[rows]]
    colour = np.array([one.colour for one in look]) ** 2.2
    shines = np.array([one.glow for one in look]) * (_narrow(texels, boxes)[rows] > SLIM_M)
    glow = shines[:, None]
    direct = _direct(plan, blocks, boxes, points, normals, texels.widths[rows].prod(1), glow * colour)
    hits = np.empty((len(rows), RAYS), np.int32)
    ways, sides = _ways(), texels.sides[rows]
    over_views(
        len(rows),
        lambda first, last: kernels.meet(first, last, points, sides, ways, boxes, texels.starts, texels.counts, hits),
    )
    at = np.full(len(bare) + 1, -1)
    at[rows] = np.arange(len(rows))
    hits = at[hits]  # the number among the bare, the last for none
    albedo = np.where(glow > 0, 0.0, 0.9 * colour)
    light, total = np.zeros((len(bare), 3)), direct
    for _ in range(BOUNCES):
        thrown = np.concatenate([albedo * total, np.zeros((1, 3))]).astype(np.float32)
        light[rows] = thrown[hits].mean(1)
        total = direct + _smooth(texels, bare, light)[rows]
    light[rows] = total
    return light


def _narrow(grid: _Grid, boxes: np.ndarray) -> np.ndarray:
    """The shorter edge of each cell's side [N]."""
    axes = np.array(_AXES)[grid.sides // 2]
    return (boxes[grid.blocks[:, None], axes + 3] - boxes[grid.blocks[:, None], axes]).min(1)


def _smooth(grid: _Grid, bare: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [T, 3] smoothed twice over visible neighbours on the same side."""
    for part, shape in _sides_of(grid):
        for _ in range(2 if bare[part].any() else 0):
            values[part], _ = _neighbours(values[part], bare[part], shape)
    return values


def _carried(grid: _Grid, bare: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values [T, 3] of visible texels, carried on to the hidden ones of the same side; bool [T], which texels have one then."""
    values, known = values.copy(), bare.copy()
    for part, shape in _sides_of(grid):
        while known[part].any() and not known[part].all():
            means, several = _neighbours(values[part], known[part], shape)
            fresh = (several > 0) & ~known[part]
            values[part][fresh], known[part] = means[fresh], several > 0
    return values, known


def _sides_of(grid: _Grid) -> Iterator[tuple[slice, tuple[int, int]]]:
    """The rows of each side, and its cells along both axes."""
    for first, (rows, columns) in zip(grid.starts, grid.counts):
        yield slice(first, first + rows * columns), (rows, columns)


def _neighbours(values: np.ndarray, known: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The means [n, 3] of known values around each cell of one side (0 without any), and how many these are [n]."""
    rows, columns = shape
    open_ = np.pad(known.reshape(rows, columns, 1).astype(float), ((1, 1), (1, 1), (0, 0)))
    held = np.pad(values.reshape(rows, columns, 3), ((1, 1), (1, 1), (0, 0))) * open_
    total = sum(held[i : i + rows, j : j + columns] for i in range(3) for j in range(3))
    weight = sum(open_[i : i + rows, j : j + columns] for i in range(3) for j in range(3))
    return (total / np.maximum(weight, 1)).reshape(-1, 3), np.asarray(weight).ravel()


def _direct(plan, blocks, boxes, points, normals, areas, glow) -> np.ndarray:
    """Direct light of lamps, windows and the sun at points [T, 3]; glow [T, 3] is their own emission."""
    light = np.zeros((len(points), 3))
    weight = areas * glow.sum(1)
    if weight.sum() > 0:
        rng = np.random.default_rng(plan.seed)
        many = LAMPS * len(plan.rooms)
        ends = np.cumsum(weight) / weight.sum()
        picked = np.minimum(np.searchsorted(ends, (np.arange(many) + rng.random(many)) / many), len(points) - 1)
        power = glow[picked] * (weight.sum() / many / glow[picked].sum(1))[:, None]
        given = points, normals, points[picked], power, normals[picked], boxes, light
        over_views(len(points), lambda first, last: kernels.shine(first, last, *given))
    return light + _sun(plan, blocks, boxes, points, normals)


def _sun(plan: RoomLayout, blocks: Blocks, boxes: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Sunlight through windows and open roofs [T, 3]."""
    if plan.sun is None:
        return np.zeros((len(points), 3))
    heading, height = (math.radians(v) for v in plan.sun)
    sun = np.array([math.cos(heading) * math.cos(height), math.sin(heading) * math.cos(height), math.sin(height)])
    clear = np.array([look.material in ("glass", "sky") for look in blocks.looks])
    lit = np.empty(len(points))
    over_views(len(points), lambda first, last: kernels.sunlit(first, last, points, normals, sun, boxes, clear, lit))
    return lit[:, None] * SUN * np.array([1.0, 0.9, 0.72])


def _ways() -> np.ndarray:
    """RAYS cosine-weighted directions about z: [R, 3]."""
    at = (np.arange(RAYS) + 0.5) / RAYS
    turn = np.arange(RAYS) * (math.pi * (3 - math.sqrt(5)))
    across = np.sqrt(at)
    return np.stack([across * np.cos(turn), across * np.sin(turn), np.sqrt(1 - at)], 1)


def _brightness(plan, blocks, boxes, cells, texels, bare, light) -> np.ndarray:
    """Colours [N, 3] of cells as a camera shows them."""
    own = np.empty((len(cells.points), 3))
    glow = np.array([look.glow for look in blocks.looks])[cells.blocks]
    face = 6 * cells.blocks + cells.sides
    ends = [*np.flatnonzero(np.diff(face, prepend=-1)), len(face)]
    for first, last in zip(ends, ends[1:]):
        rows, k, axis = slice(first, last), cells.blocks[first], cells.sides[first] // 2
        a, b = _AXES[axis]
        u, v = cells.points[rows, a], cells.points[rows, b]
        size = boxes[k, 3:] - boxes[k, :3]
        if axis == 2 and size[1] > size[0]:  # planks run along
            u, v = v, u
        own[rows] = texture_colours(blocks.looks[k], u, v, float(cells.widths[first].max()), plan.seed + 31 * int(axis))
    falls = _between(cells, texels, bare, light, boxes)
    coarse = _between(cells, texels, bare, _sun_on(plan, blocks, boxes, texels), boxes)
    falls = np.maximum(falls - coarse, 0) + _sun_on(plan, blocks, boxes, cells)
    return exposed(own, falls, glow > 0)


def exposed(own: np.ndarray, falls: np.ndarray, shines: np.ndarray) -> np.ndarray:
    """Colours [N, 3] as a camera shows them: surfaces of the colours `own` under the light `falls` [N, 3]; light sources, `shines`
    bool [N], keep their colours."""
    shown = own**2.2 * falls
    middle = np.exp(np.log(np.maximum(falls[~shines].mean(1), 1e-4)).mean()) if not shines.all() else 1.0
    shown = shown * (0.62 / middle)
    mapped = shown * (1 + shown / 9) / (1 + shown * 0.78)  # Reinhard's curve with a white point
    pictured = np.clip(mapped, 0, 1) ** (1 / 2.2)
    pictured[shines] = own[shines]
    return pictured


def _sun_on(plan, blocks, boxes, grid) -> np.ndarray:
    return _sun(plan, blocks, boxes, grid.points + 0.003 * grid.normals, grid.normals)


def _between(cells: _Grid, texels: _Grid, bare: np.ndarray, values: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Values [T, 3] of visible texels interpolated at cells of the same side: [N, 3]. Hidden cells get those around them, or
    the mean of their block."""
    near, weight = _interpolated(cells, texels, bare, values, boxes)
    if (weight <= 0).any():
        carried, known = _carried(texels, bare, values)
        beneath, some = _interpolated(cells, texels, known, carried, boxes)
        total, count = np.zeros((len(boxes), 3)), np.zeros(len(boxes))
        np.add.at(total, texels.blocks[bare], values[bare])
        np.add.at(count, texels.blocks[bare], 1)
        means = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], values[bare].mean(0))
        beneath = np.where(some[:, None] > 0, beneath, means[cells.blocks])
        near = np.where(weight[:, None] > 0, near, beneath)
    return near


def _interpolated(
    cells: _Grid, texels: _Grid, known: np.ndarray, values: np.ndarray, boxes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values of the known among the four texels around each cell [N, 3], and their weight [N], 0 without any."""
    face = 6 * cells.blocks + cells.sides
    axes = np.array(_AXES)[cells.sides // 2]
    rows = np.arange(len(face))
    many, start = texels.counts[face], texels.starts[face]
    low = boxes[cells.blocks[:, None], axes]
    size = boxes[cells.blocks[:, None], axes + 3] - low
    at = (cells.points[rows[:, None], axes] - low) / np.maximum(size, 1e-9) * many - 0.5
    first = np.floor(at).astype(int)
    share = at - first
    total, weight = np.zeros((len(face), 3)), np.zeros(len(face))
    for i in (0, 1):
        for j in (0, 1):
            a, b = (np.clip(first[:, c] + d, 0, many[:, c] - 1) for c, d in ((0, i), (1, j)))
            texel = start + a * many[:, 1] + b
            w = (share[:, 0] if i else 1 - share[:, 0]) * (share[:, 1] if j else 1 - share[:, 1]) + 1e-4
            w = w * known[texel]
            total += w[:, None] * values[texel]
            weight += w
    return total / np.maximum(weight, 1e-9)[:, None], weight


def _gaussians(cells: _Grid, colours: np.ndarray, shown: np.ndarray) -> Gaussians:
    """Flat Gaussians of the cells; those that are not `shown` [N] are transparent."""
    count = len(cells.points)
    scales = np.full((count, 3), THIN_M)
    scales[np.arange(count)[:, None], np.array(_AXES)[cells.sides // 2]] = OVERLAP * cells.widths
    means = cells.points - THIN_M * cells.normals
    to = lambda part: torch.from_numpy(np.ascontiguousarray(part, np.float32))  # noqa: E731
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(to(means), quats, to(scales), to(OPACITY * shown), plain_sh(to(colours)))


def _starts(plan: RoomLayout, blocks: Blocks) -> torch.Tensor:
    """The starts: that of the layout, or in each room the free place with the longest view along its longer side."""
    if plan.start is not None:
        x, y, degrees = plan.start
        room = next(r for r in plan.rooms if all(r.low[k] <= plan.start[k] <= r.high[k] for k in range(2)))
        return planar_pose(*(torch.tensor([v]) for v in (x, y, room.at[2], math.radians(degrees))))
    solids, poses = blocks.solids, []
    for room in plan.rooms:
        low, high = np.array(room.low), np.array(room.high)
        x, y = np.meshgrid(*(np.linspace(low[k] + 0.35, max(high[k] - 0.35, low[k] + 0.36), 40) for k in range(2)))
        places = np.stack([x.ravel(), y.ravel()], 1)
        off = np.maximum(np.maximum(solids[None, :, :2] - places[:, None], places[:, None] - solids[None, :, 3:5]), 0)
        meets = (solids[:, 2] < low[2] + 1.8) & (solids[:, 5] > low[2] + 0.05)
        room_there = np.where(meets, np.hypot(off[..., 0], off[..., 1]), 9.0).min(1)
        middle = (low + high)[:2] / 2
        long = int(high[1] - low[1] > high[0] - low[0])
        fits = np.minimum(room_there, 0.6) * 4 - np.abs(places[:, 1 - long] - middle[1 - long] - 0.4)
        best = places[np.argmax(fits - 1.0 * (places[:, long] - low[long]))]
        heading = math.atan2(middle[1] - best[1], middle[0] - best[0])
        poses.append(planar_pose(*(torch.tensor([float(v)]) for v in (*best, low[2], heading))))
    return torch.cat(poses)
