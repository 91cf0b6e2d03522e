"""Meshes of places: fused from the depth of views all around (TSDF, Curless and Levoy 1996), or of what stops bodies."""

import math
from dataclasses import dataclass

import torch

from ..core.errors import ContractError
from .occupancy import Occupancy, Walker
from .raster import Drawing, Gaussians, rasterise
from .solids import Solids

MOST_CELLS = 6_000_000
VIEW = (256, 512)  # pixels of a panorama
VIEWS = 12
_BEYOND = 3.0  # cells behind a surface that are still counted to it


@dataclass(frozen=True)
class Mesh:
    """vertices float32 [V, 3], world frame, metres; faces int64 [F, 3], counter-clockwise from before; colours uint8 [V, 3]."""

    vertices: torch.Tensor
    faces: torch.Tensor
    colours: torch.Tensor


def fused(gaussians: Gaussians, eyes: torch.Tensor, cell_m: float = 0.05) -> Mesh:
    """The surfaces that are seen from `eyes` [E, 7], poses; cells wider than asked where the place is very large. ContractError
    where nothing is seen."""
    views = [rasterise(gaussians, eye[None], None, VIEW) for eye in eyes]
    low, high = torch.quantile(
        gaussians.means[:: max(len(gaussians) // 500_000, 1)], torch.tensor([0.002, 0.998]), dim=0
    )
    low, high = low - 4 * cell_m, high + 4 * cell_m
    cell_m = max(cell_m, float(((high - low).prod() / MOST_CELLS) ** (1 / 3)))
    size = ((high - low) / cell_m).ceil().long().clamp_min(4)
    distance, weight = torch.zeros(int(size.prod())), torch.zeros(int(size.prod()))
    axes = [low[k] + cell_m * torch.arange(int(size[k])) for k in range(3)]
    places = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, 2)
    reach = _BEYOND * cell_m
    for eye, view in zip(eyes, views):
        for first in range(0, len(places), 500_000):
            part = slice(first, first + 500_000)
            depth, _, far = seen(view, eye, places[part])
            ahead = depth - far
            counts = (depth > 0) & (ahead > -reach)
            near = counts / far.clamp_min(0.5)  # far views know less
            distance[part] += near * (ahead / reach).clamp(-1, 1)
            weight[part] += near
    field = torch.where(weight > 0, distance / weight.clamp_min(1e-9), -1.0)
    shape = tuple(size.tolist())
    vertices, faces = _surface(field.view(shape), (weight > 0).view(shape))
    vertices = low + cell_m * vertices
    return Mesh(vertices, faces, _colours(vertices, eyes, views, 2 * cell_m))


def seen(view: Drawing, eye: torch.Tensor, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What a panorama shows towards places [N, 3]: distance [N] (0: nothing), colour [N, 3], and how far the places are [N]."""
    heading = 2 * math.atan2(float(eye[6]), float(eye[3]))
    x, y, z = (places - eye[:3]).unbind(1)
    far = (x * x + y * y + z * z).sqrt().clamp_min(1e-6)
    height, width = VIEW
    left = (torch.atan2(y, x) - heading + math.pi) % (2 * math.pi) - math.pi
    u = ((0.5 - left / (2 * math.pi)) * width).long().clamp(0, width - 1)
    v = ((0.5 - torch.asin((z / far).clamp(-1, 1)) / math.pi) * height).long().clamp(0, height - 1)
    depth, alpha = view.depth[0][v, u], view.alpha[0][v, u]
    return torch.where(alpha > 0.5, depth / alpha.clamp_min(0.5), 0.0), view.rgb[0][:, v, u].T, far


def _colours(vertices: torch.Tensor, eyes: torch.Tensor, views: list[Drawing], slack: float) -> torch.Tensor:
    total, weight = torch.zeros(len(vertices), 3), torch.zeros(len(vertices), 1)
    for eye, view in zip(eyes, views):
        depth, colour, far = seen(view, eye, vertices)
        counts = (((depth - far).abs() < slack) / far.square().clamp_min(0.1))[:, None] + 1e-6
        total, weight = total + counts * colour, weight + counts
    return ((total / weight).clamp(0, 1) * 255).round().to(torch.uint8)


def _surface(field: torch.Tensor, known: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where a field [X, Y, Z] that is below 0 inside things crosses 0: vertices in cells [V, 3] and faces [F, 3]."""
    try:
        from skimage.measure import marching_cubes  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ContractError("meshes need scikit-image; pip install 'terrella[mesh]'.") from error
    try:
        surface = marching_cubes(field.numpy(), 0.0, gradient_direction="descent", mask=known.numpy())
    except (ValueError, RuntimeError) as error:
        raise ContractError(f"no surface is seen in this place ({error}); give it another start.") from error
    return torch.from_numpy(surface[0].copy()).float(), torch.from_numpy(surface[1].copy()).long()


def collider_mesh(collider: Solids | Occupancy) -> Mesh:
    """What stops bodies: twelve triangles a box, or the outside of all solid cells."""
    if isinstance(collider, Solids):
        low, high = collider.boxes[:, :3], collider.boxes[:, 3:]
    else:
        cells = collider.solid.nonzero().float()
        low = collider.origin + collider.cell_m * cells
        high = low + collider.cell_m
    which = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=torch.bool)
    corners = torch.where(which, high[:, None], low[:, None])  # [K, 8, 3]
    sides = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    keep = torch.ones(len(low), 6, dtype=torch.bool)
    if isinstance(collider, Occupancy):  # sides between two solid cells are inside
        solid = torch.nn.functional.pad(collider.solid, (1, 1, 1, 1, 1, 1))
        at = collider.solid.nonzero() + 1
        for side in range(6):
            beside = at.clone()
            beside[:, side // 2] += 1 if side % 2 else -1
            keep[:, side] = ~solid[tuple(beside.T)]
    quads = (8 * torch.arange(len(low))[:, None, None] + sides)[keep]  # [Q, 4]
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = corners.reshape(-1, 3)
    return Mesh(vertices, faces, torch.full((len(vertices), 3), 180, dtype=torch.uint8))


def viewpoints(gaussians: Gaussians, collider: Solids | Occupancy, starts: torch.Tensor, body: Walker) -> torch.Tensor:
    """Poses [E, 7] from which a place is looked over: where one begins, and free places from which it is as closed all around, far
    from one another."""
    rng = torch.Generator().manual_seed(0)
    low, high = torch.quantile(gaussians.means[:: max(len(gaussians) // 100_000, 1)], torch.tensor([0.03, 0.97]), dim=0)
    some = low + (high - low) * torch.rand(300, 3, generator=rng)
    some = torch.cat([some[:, :2], (collider.floor(some, body) + body.eye_m)[:, None]], 1)
    some = some[~collider.blocked(some, body)][:48]
    turn = torch.tensor([1.0, 0, 0, 0])
    poses = torch.cat([starts[:4], torch.cat([some, turn.expand(len(some), 4)], 1)])
    closed = torch.stack([rasterise(gaussians, pose[None], None, (16, 32)).alpha.mean() for pose in poses])
    poses = poses[closed > 0.9 * closed[: len(starts[:4])].min()]
    chosen = [0]
    apart = (poses[:, :3] - poses[0, :3]).norm(dim=1)
    while len(chosen) < min(VIEWS, len(poses)):
        chosen.append(int(apart.argmax()))
        apart = apart.minimum((poses[:, :3] - poses[chosen[-1], :3]).norm(dim=1))
    return poses[chosen]
