"""The box of a room, from what is known of its surfaces: planes of walls, floor and ceiling, with colours that go on where nothing
was seen. Walls stand at right angles; a wall that was not seen is put behind all that was."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from .camera import rotation
from .raster import Gaussians

CELL_M = 0.05  # of a plane's colours
NEAR_M = 0.2  # Gaussians this near a plane give its colours
FAR_M = 0.8  # farther from the known the usual colour at that height takes over
LEAST_M2 = 0.15  # area of a surface that makes a plane
CEILING_M, BEHIND_M = (
    2.5,
    (1.5, 4.0),
)  # without evidence; how far behind one an unseen wall stands, at least and at most
OUTER = 0.35  # share of the strongest peak from which the outermost one is a wall
WALLS, BLOCK = (0, 1, 3, 4), 20  # planes; cells of a block of colours that is repeated
OUTERMOST = 0.85  # quantile of a surface's distance that is taken for its plane: rather too far than within free space
BULGE_M = 0.5  # metres from what was seen over which a plane bends outwards
BULGE_STEPS = 3  # of the search for where a ray meets such a plane
FACING = 0.9  # cosine between a surface's normal and a plane's


@dataclass(frozen=True)
class RoomPlanes:
    """A box in a frame that is turned by `heading` radians: planes 0 to 5 are low x, y, z, high x, y, z."""

    heading: float
    low: torch.Tensor  # [3]
    high: torch.Tensor  # [3]
    seen: tuple[bool, ...]  # [6], whether each plane was measured
    colours: tuple[
        torch.Tensor, ...
    ]  # of each plane [rows, columns, 3] in 0..1: y (or z) by x (or y) in cells from the low corner
    bulges: tuple[torch.Tensor, ...]  # of each plane [rows, columns]: by how many metres its cells lie farther out

    @property
    def turn(self) -> torch.Tensor:
        """[3, 3], from the box's frame to the world's."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def hit(self, eye: torch.Tensor, ways: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How many times `ways` [N, 3] lead from `eye` [3] to the box, and the colours [N, 3] there."""
        turn = self.turn
        at, ways = eye @ turn, ways @ turn
        far, colour = torch.full((len(ways),), torch.inf), torch.zeros(len(ways), 3)
        for plane, (picture, bulge) in enumerate(zip(self.colours, self.bulges)):
            axis, side = plane % 3, 1.0 if plane > 2 else -1.0
            mine = (side * ways[:, axis] > 1e-6).nonzero()[:, 0]
            to, way = (self.high if plane > 2 else self.low)[axis] - at[axis], ways[mine]
            reach, cell = to / way[:, axis], (torch.zeros(0), torch.zeros(0))
            for _ in range(BULGE_STEPS):
                spot = at + reach.clamp_min(0.05)[:, None] * way
                cell = tuple(
                    ((spot[:, k] - self.low[k]) / CELL_M).long().clamp(0, size - 1)
                    for k, size in zip(_axes(plane), bulge.shape)
                )
                reach = (to + side * bulge[cell]) / way[:, axis]
            nearer = reach.clamp_min(0.05) < far[mine]
            far[mine[nearer]] = reach.clamp_min(0.05)[nearer]
            colour[mine[nearer]] = picture[cell][nearer]
        return far, colour


def _axes(plane: int) -> tuple[int, int]:
    """The axes of a plane's rows and columns."""
    return ((2, 1), (2, 0), (1, 0))[plane % 3]


def room_planes(known: Gaussians, eye: torch.Tensor, error: float = 0.0) -> RoomPlanes:
    """The box around `eye` [3] of the Gaussians that are known. error: the expected error of their depth, as a share of it; away
    from where a plane was seen it lies this much farther out, so that what is invented does not fill space that may be free."""
    some = known.at(known.opacities > 0.3)
    some = some.at(torch.arange(0, len(some), max(len(some) // 150_000, 1)))
    turns = rotation(torch.cat([some.means, some.quats], 1))
    normals = turns.gather(2, some.scales.argmin(1)[:, None, None].expand(-1, 3, 1))[..., 0]
    area = some.scales.sort(1).values[:, 1:].prod(1) * 2.6 * max(len(known) / max(len(some), 1), 1)
    heading = _heading(normals, area)
    box = RoomPlanes(heading, torch.zeros(3), torch.zeros(3), (), (), ())
    points, normals, at = some.means @ box.turn, normals @ box.turn, eye @ box.turn
    bounds = [_bound(points, normals, area, at, plane) for plane in range(6)]
    reach = torch.quantile(points[:: max(len(points) // 100_000, 1)], torch.tensor([0.02, 0.98]), dim=0)
    ends = [_unseen(bounds, reach, at, plane) if one is None else one for plane, one in enumerate(bounds)]
    low, high = torch.tensor(ends[:3]), torch.tensor(ends[3:])
    pictures, known_cells = _pictures(points, normals, some.colours, low, high)
    measured, apart = tuple(one is not None for one in bounds), torch.cat([at - low, high - at])
    bulges = [
        error * was * far * (_nearest(cells)[0] * CELL_M / BULGE_M).clamp(0, 1)
        for was, far, cells in zip(measured, apart, known_cells)
    ]
    return RoomPlanes(heading, low, high, measured, pictures, tuple(bulges))


def _heading(normals: torch.Tensor, area: torch.Tensor) -> float:
    """The direction of most walls, within a quarter turn: radians."""
    upright = normals[:, 2].abs() < 0.35
    angle = torch.atan2(normals[upright, 1], normals[upright, 0]) % (math.pi / 2)
    counts = torch.zeros(90).index_add_(0, (angle * (180 / math.pi)).long().clamp_max(89), area[upright])
    smooth = torch.stack([counts.roll(k) * (3 - abs(k)) for k in range(-2, 3)]).sum(0)
    best = (int(smooth.argmax()) + 0.5) * math.pi / 180
    off = (angle - best + math.pi / 4) % (math.pi / 2) - math.pi / 4
    near = off.abs() < 0.05
    return best + float((off * area[upright])[near].sum() / area[upright][near].sum().clamp_min(1e-9))


def _bound(points, normals, area, at: torch.Tensor, plane: int) -> float | None:
    """Where a plane of the box lies: the outermost of the surfaces that face it and are large enough; None without one."""
    axis, side = plane % 3, 1.0 if plane > 2 else -1.0
    away = side * (points[:, axis] - at[axis])
    some = (normals[:, axis].abs() > FACING) & (away > 0.15)
    if float(area[some].sum()) < LEAST_M2:
        return None
    bins = (away[some] / 0.1).long().clamp_max(399)
    counts = torch.zeros(400).index_add_(0, bins, area[some])
    smooth = counts + counts.roll(1) + counts.roll(-1)
    outer = int((smooth > OUTER * smooth.max()).nonzero()[-1])
    near = some & ((away / 0.1 - outer).abs() < 2)
    return float(at[axis] + side * away[near].quantile(OUTERMOST))


def _unseen(bounds: list[float | None], reach: torch.Tensor, at: torch.Tensor, plane: int) -> float:
    """Where a plane is put that was not seen."""
    axis, high = plane % 3, plane > 2
    if axis == 2:
        return max(CEILING_M, float(at[2]) + 0.7, float(reach[1, 2])) if high else min(0.0, float(reach[0, 2]))
    opposite = bounds[(plane + 3) % 6]
    across = BEHIND_M[1] if opposite is None else abs(opposite - float(at[axis]))
    behind = min(max(0.6 * across, BEHIND_M[0]), BEHIND_M[1])
    if high:
        return max(float(at[axis]) + behind, float(reach[1, axis]) + 0.1)
    return min(float(at[axis]) - behind, float(reach[0, axis]) - 0.1)


def _pictures(
    points, normals, colours, low: torch.Tensor, high: torch.Tensor
) -> tuple[tuple[torch.Tensor, ...], list[torch.Tensor]]:
    """The colours of the six planes (those of near surfaces; beside them their mirror image; far from them the usual colour), and
    which cells near surfaces give."""
    pictures, known, usual = [], [], []
    for plane in range(6):
        axis, end = plane % 3, (high if plane > 2 else low)[plane % 3]
        near = ((points[:, axis] - end).abs() < NEAR_M) & (normals[:, axis].abs() > FACING)
        one, two = _axes(plane)
        size = [max(int((high[k] - low[k]) / CELL_M) + 1, 1) for k in (one, two)]
        at = [((points[near, k] - low[k]) / CELL_M).long() for k in (one, two)]
        inside = (at[0] >= 0) & (at[0] < size[0]) & (at[1] >= 0) & (at[1] < size[1])
        flat, shown = (at[0] * size[1] + at[1])[inside], colours[near][inside]
        count = torch.zeros(size[0] * size[1]).index_add_(0, flat, torch.ones(len(flat)))
        total = torch.zeros(size[0] * size[1], 3).index_add_(0, flat, shown)
        pictures.append((total / count.clamp_min(1)[:, None]).view(*size, 3))
        known.append((count > 0).view(*size))
        usual.append(shown)
    plain = [
        torch.cat([usual[k] for k in ((plane,) if plane % 3 == 2 and len(usual[plane]) > 50 else WALLS)])
        for plane in range(6)
    ]
    middle = [one.median(0).values if len(one) else torch.full((3,), 0.6) for one in plain]
    best = max(WALLS, key=lambda plane: int(known[plane].sum()))
    sources = [best if plane in WALLS else plane for plane in range(6)]
    tiles = [_tile(pictures[source], known[source], one) for source, one in zip(sources, middle)]
    return tuple(_continued(*part) for part in zip(pictures, known, tiles)), known


def _tile(picture: torch.Tensor, known: torch.Tensor, usual: torch.Tensor) -> torch.Tensor:
    """The block of a picture [h, w, 3] that is known and nearest to the usual colour [3], or without one that colour: [n, m, 3]."""
    size = [min(BLOCK, side) for side in known.shape]
    off = (picture - usual).abs().sum(2) + 10.0 * ~known
    cost = F.avg_pool2d(off[None], size, 1)[0]
    row, column = divmod(int(cost.argmin()), cost.shape[1])
    if float(cost.min()) > 0.5:
        return usual[None, None]
    block = picture[row : row + size[0], column : column + size[1]].clone()
    block[~known[row : row + size[0], column : column + size[1]]] = usual
    return block


def _repeated(tile: torch.Tensor, shape: torch.Size) -> torch.Tensor:
    """A tile repeated over a picture, each time as its mirror image: [h, w, 3]."""
    at = []
    for side, wide in zip(tile.shape[:2], shape[:2]):
        place = torch.arange(wide) % (2 * side)
        at.append(torch.where(place < side, place, 2 * side - 1 - place))
    return tile[at[0][:, None], at[1]]


def _continued(picture: torch.Tensor, known: torch.Tensor, tile: torch.Tensor) -> torch.Tensor:
    """A picture [h, w, 3] whose unknown cells are filled: near the known by its mirror image, farther by the tile."""
    usual = _repeated(tile, picture.shape)
    if not bool(known.any()):
        return usual
    far, nearest = _nearest(known)
    row, column = (~known).nonzero(as_tuple=True)
    at, part = nearest[row, column], torch.stack([row, column], 1)
    mirror = (2 * at - part).clamp_min(0).minimum(torch.tensor(known.shape) - 1)
    source = torch.where(known[mirror[:, 0], mirror[:, 1]][:, None], mirror, at)
    share = (far[row, column] * CELL_M / FAR_M).clamp(0, 1)[:, None]
    shown = picture.clone()
    shown[row, column] = (1 - share) * picture[source[:, 0], source[:, 1]] + share * usual[row, column]
    return shown


def _nearest(known: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """For each cell of `known` [h, w] the distance to the nearest one that is, in cells [h, w], and that one [h, w, 2]."""
    cells, every = known.nonzero(), torch.ones_like(known).nonzero()
    if not len(cells):
        return torch.full(known.shape, torch.inf), every.view(*known.shape, 2)
    pairs = [torch.cdist(part.float(), cells.float()).min(1) for part in every.split(2048)]
    far, at = torch.cat([one.values for one in pairs]), torch.cat([cells[one.indices] for one in pairs])
    return far.view(known.shape), at.view(*known.shape, 2)
