"""Measures the collider that is read off Gaussians where walls are known: rooms of `space build` of which only Gaussians are kept.

python benchmarks/collider.py [--walks 1000] [--steps 240] [--fit-steps 1000]

Exported: the room as a .ply, read again. Sparse: 15,000 Gaussians. Fitted: 100 pictures of 192 x 144 pixels with depth, as
`space fit` fits a recording. Agreement: of places 10 cm apart on the floor, also 1 m around the rooms, the share at which the
collider and the layout's boxes agree whether a body comes there from the start. Walks: how many random walks come deeper than
10 cm into a wall, and how many leave the rooms (more than 0.3 m beyond their walls, or below the floor).
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np
import torch
from layout import in_a_wall
from scipy import ndimage

from terrella.core import make_rng
from terrella.space.camera import FAR_M, planar_pose
from terrella.space.enclosure import ColliderKind
from terrella.space.files import read_scene, write_scene
from terrella.space.fitting import Fit, FitConfig, PosedViews
from terrella.space.layout import BuiltPlace, build, parse_text
from terrella.space.raster import Gaussians, rasterise
from terrella.space.solids import Solids
from terrella.space.walkable import Collider
from terrella.workflows.build_space import WALKER
from terrella.worlds.splat import BUTTONS, SplatConfig, SplatWorld

ROOMS = {
    "two rooms": "a long room with two pillars and a red door, two windows, and a library with a sofa, a table and four chairs",
    "kitchen": "a bright scandinavian kitchen at noon",
    "dungeon": "a dungeon with torches, and a cellar",
}
CELL_M, AROUND_M = 0.1, 1.0


def pictures(place: BuiltPlace, rooms: torch.Tensor, count: int = 100) -> PosedViews:
    """Pictures of rooms [R, 4] with depth, taken from where one can stand."""
    rng, poses, camera = np.random.default_rng(0), [], (0.5, 0.667, 0.5, 0.5)
    while len(poses) < count:
        x0, y0, x1, y1 = rooms[len(poses) % len(rooms)].tolist()
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        if not bool(Solids(place.solids).blocked(torch.tensor([[x, y, WALKER.eye_m]]), WALKER)):
            poses.append(planar_pose(*(torch.tensor([one]) for one in (x, y, 1.4, rng.uniform(0, 2 * math.pi)))))
    with torch.no_grad():
        seen = [rasterise(place.gaussians, one, camera, (144, 192)) for one in poses]
    rgb = torch.cat([(255 * one.rgb.clamp(0, 1)).round().byte() for one in seen])
    depth = torch.cat([torch.where(one.alpha > 0.9, one.depth / one.alpha.clamp_min(0.9), FAR_M) for one in seen])
    return PosedViews(rgb, depth, torch.cat(poses), camera)


def fitted(views: PosedViews, steps: int) -> Gaussians:
    """Gaussians fitted to pictures."""
    fit = Fit(views, FitConfig(steps=steps))
    while fit.done < steps:
        fit.step()
    gaussians = fit.gaussians.each(torch.Tensor.detach)
    return gaussians.at(gaussians.opacities > 0.01)


def world_of_room(gaussians: Gaussians, starts: torch.Tensor, collider: ColliderKind) -> SplatWorld:
    config = SplatConfig(size=(96, 128), body=WALKER, collider=collider)
    return SplatWorld("room", gaussians, torch.ones(len(gaussians), dtype=torch.uint8), starts, config)


def floor_places(rooms: torch.Tensor) -> tuple[torch.Tensor, tuple[int, int]]:
    """Places of eyes [X * Y, 3] on the floor of rooms [R, 4] (x0 y0 x1 y1) and around, and X, Y."""
    axes = [
        torch.arange(float(rooms[:, k].min()) - AROUND_M, float(rooms[:, k + 2].max()) + AROUND_M, CELL_M)
        for k in (0, 1)
    ]
    x, y = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), torch.full_like(x, WALKER.eye_m).flatten()], 1), (
        len(axes[0]),
        len(axes[1]),
    )


def reached(collider: Collider, places: torch.Tensor, size: tuple[int, int], start: torch.Tensor) -> np.ndarray:
    """Which of the places a body comes to from `start` over the floor: bool [X, Y]."""
    level = collider.surface(places, WALKER)
    free = level.isfinite() & (level.abs() < WALKER.step_m) & ~collider.blocked(places, WALKER)
    parts: np.ndarray = ndimage.label(free.view(size).numpy())[0]  # pyright: ignore
    here = parts.flatten()[(places - start).norm(dim=1).argmin()]
    return (parts == here) & (here > 0)


def walks(
    world: SplatWorld, start: torch.Tensor, truth: torch.Tensor, rooms: torch.Tensor, count: int, steps: int
) -> tuple[int, int]:
    """How many random walks come into a wall, and how many leave the rooms."""
    rng, state = torch.Generator().manual_seed(1), world.observe({"pose": start.expand(count, -1)}, None, make_rng(1))
    leaked, gone = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    for step in range(steps):
        if step % 10 == 0:
            odds = torch.tensor([0.9, 0.05, 0.2, 0.2, 0.3, 0.3, 0.0, 0.1])
            action = (torch.rand(count, len(BUTTONS), generator=rng) < odds).to(torch.int8)
        state = world.imagine(state, action, make_rng(step))
        eye = state["pose"][:, :3]
        if step % 6 == 5:
            leaked |= in_a_wall(eye, truth, WALKER.radius_m - 0.1)
        off = torch.maximum(rooms[:, :2] - eye[:, None, :2], eye[:, None, :2] - rooms[:, 2:]).amax(2).amin(1)
        gone |= (off > 0.3) | (eye[:, 2] < WALKER.eye_m - 0.5)
    return int(leaked.sum()), int(gone.sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--fit-steps", type=int, default=1000)
    given = parser.parse_args()
    for name, text in ROOMS.items():
        parsed = parse_text(text, 3)
        place = build(parsed.layout)
        rooms = torch.tensor(
            [[*room.at[:2], room.at[0] + room.size[0], room.at[1] + room.size[1]] for room in parsed.layout.rooms]
        )
        with tempfile.TemporaryDirectory() as folder:
            write_scene(place.gaussians, file := Path(folder) / "room.ply")
            exported = read_scene(file)
        views = pictures(place, rooms)
        kinds = {
            "exported": exported,
            "sparse": build(parsed.layout, 15_000).gaussians,
            "fitted": fitted(views, given.fit_steps),
        }
        start = place.starts[:1].clone()
        start[:, 2] += WALKER.eye_m
        places, size = floor_places(rooms)
        truth = reached(Solids(place.solids), places, size, start[0, :3])
        for kind, gaussians in kinds.items():
            starts = start if kind != "fitted" else torch.cat([start, views.pose])
            for collider in ("open", "indoor"):
                world = world_of_room(gaussians, starts, collider)
                said = reached(world.collider, places, size, start[0, :3])
                leaked, gone = walks(world, start, place.solids, rooms, given.walks, given.steps)
                print(
                    f"{name}, {kind}, {collider}: {len(gaussians):,} Gaussians, agrees at {100 * (said == truth).mean():.2f}% of "
                    f"{truth.size:,} places, blocks {100 * (truth & ~said).sum() / truth.sum():.1f}% of the {truth.sum():,} free, "
                    f"opens {(said & ~truth).sum()}; of {given.walks} walks {leaked} in walls, {gone} outside",
                    flush=True,
                )


if __name__ == "__main__":
    main()
