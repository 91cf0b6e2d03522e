"""What is solid by the surfaces that show in panoramas drawn from points in free space: cells before them are free, and cells that
contain them solid. What Gaussians fill by their size alone is too thick: soft ones, as fits have, reach far into rooms."""

import math
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F

from .camera import directions
from .flooring import floored, standing
from .occupancy import SOLID, Occupancy, Walker
from .raster import Gaussians, rasterise
from .walkable import spread_out, walkable

ROWS = 192  # of a panorama
EYES = (40, 12, 12)  # points at most that are looked from, in rounds; later ones are those walked to after those before
PLACES = 3000  # at most, that are walked to
OPAQUE = 0.5  # alpha of pixels that show a surface
HARDER = 2.0  # opacities times this show: behind the thin surfaces of fits the depth is that of what shines through
KEPT = 0.5  # cells whose middle lies less than this many cells before a surface are kept: they reach into it
FAR_M, SMOOTH = (
    8.0,
    0.1,
)  # surfaces are solid up to this distance, where depth differs by less than this share between pixels


def carved(place: Occupancy, gaussians: Gaussians, eyes: torch.Tensor, body: Walker) -> Occupancy:
    """The grid of Gaussians without the solid cells that lie before surfaces seen from `eyes` [E, 3], points in free space, and
    from where one can walk to from the first. The height of what is solid is that of the surfaces seen. Gaussians are drawn as if
    they were harder."""
    rng, filled, first = np.random.default_rng(0), place.solid, eyes[:1]
    some = gaussians.at(gaussians.opacities > SOLID)
    hard = replace(some, opacities=(HARDER * some.opacities).clamp_max(0.99))
    free = torch.zeros_like(filled)
    hits, height = torch.zeros(filled.numel()), torch.zeros(filled.numel())
    for count in EYES:
        for eye in spread_out(eyes, count, rng):
            free |= _look(place, filled, hard, eye, hits, height)
        place = replace(place, solid=filled & ~free)
        walked = floored(place, first[0], body, math.inf)
        eyes = torch.cat([first, walkable(walked, standing(place, first[0], body)[None], body, PLACES)])
    top = torch.where(hits > 0, height / hits.clamp_min(1), place.top.flatten()).view_as(filled)
    return replace(place, top=top)


@torch.no_grad()
def _look(
    place: Occupancy,
    filled: torch.Tensor,
    gaussians: Gaussians,
    eye: torch.Tensor,
    hits: torch.Tensor,
    height: torch.Tensor,
) -> torch.Tensor:
    """Which of the cells `filled` lie before a surface seen from `eye` [3]: bool [X, Y, Z]. Adds the points of surfaces to `hits`
    and their heights to `height`, both [X * Y * Z]."""
    pose = torch.cat([eye, torch.tensor([1.0, 0, 0, 0])])
    drawn = rasterise(gaussians, pose[None], None, (ROWS, 2 * ROWS))
    shows, depth = drawn.alpha[0] >= OPAQUE, drawn.depth[0] / drawn.alpha[0].clamp_min(OPAQUE)
    around = F.pad(torch.where(shows, depth, 0.0)[None, None], (1, 1, 1, 1), mode="replicate")
    nearest, farthest = -F.max_pool2d(-around, 3, 1)[0, 0], F.max_pool2d(around, 3, 1)[0, 0]
    points = (eye + depth[..., None] * directions(ROWS))[(farthest < (1 + SMOOTH) * nearest) & (depth < FAR_M)]
    cells, inside = place.cells(points)
    _, wide, tall = filled.shape
    flat = ((cells[0] * wide + cells[1]) * tall + cells[2])[inside]
    hits.index_add_(0, flat, torch.ones(len(flat)))
    height.index_add_(0, flat, points[inside, 2])
    some = filled.nonzero()
    off = place.origin + (some + 0.5) * place.cell_m - eye
    far = off.norm(dim=1).clamp_min(1e-6)
    row = ((0.5 - (off[:, 2] / far).asin() / math.pi) * ROWS).long().clamp(0, ROWS - 1)
    column = ((1 - torch.atan2(off[:, 1], off[:, 0]) / math.pi) * ROWS).long() % (2 * ROWS)
    before = torch.zeros_like(filled)
    before[tuple(some[far < nearest[row, column] - KEPT * place.cell_m].T)] = True
    return before
