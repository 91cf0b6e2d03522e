"""Measures places of panoramas, and places that grow from one picture, against rooms of `space build`, whose geometry is known.

python benchmarks/places.py panorama|grow|rooms [--out DIR]

panorama: closure (PSNR of the panorama drawn again from its middle), and the error of depth within two pixels of seams, where
another view begins to weigh most, over that elsewhere: of depth itself after one factor, and of its steps on smooth surfaces.

grow: one picture of a room is lifted, scaled by the median ratio to the truth, and grown. Surface: the share of all directions from
points in the room's true free space in which the place shows something. Intrusions: steps of which more than INTRUDING of the
Gaussians lie more than 10 cm within true free space. Beyond: the median distance by which they lie outside the true room. Revisit:
the start's view after all steps against that before. Each also with the true depth of the picture in place of the lifter's.

rooms: the same of TEXTS, each with two seeds, with the lifter's depth.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image

from terrella.space.camera import rotation
from terrella.space.growing import coverage, known_around
from terrella.space.layout import BuiltPlace, build, parse_text
from terrella.space.lifting.layers import layers_of
from terrella.space.lifting.network import load_lifter
from terrella.space.lifting.panorama import panorama_gaussians, panorama_layers
from terrella.space.occupancy import Walker
from terrella.space.raster import join, rasterise
from terrella.space.solids import Solids
from terrella.space.walkable import walkable
from terrella.workflows.grow_space import GrowSpaceConfig, growth, viewpoints
from terrella.workflows.lift_space import place_of

EYE_M, SEED = 1.6, 5
INTRUDING, FREE_M = 0.05, 0.1
WALL_M = 0.1  # thickness of the outer walls
ROOMS = {
    "living room": "a bright scandinavian living room at noon",
    "library": "a cosy library with a red door",
    "empty library": "a library with a red door",
    "dungeon": "a dungeon with torches",
}
TEXTS = (
    "a bright scandinavian living room at noon",
    "a cosy library with a red door",
    "a dungeon with torches",
    "a bright scandinavian kitchen at noon",
    "a cosy library at night",
    "a loft with a large window",
    "a bedroom in the evening",
    "an office with two windows",
)
SEEDS = (5, 11)
MEASURED = {"panorama": ("living room", "empty library", "dungeon"), "grow": ("living room", "library", "dungeon")}


def built(text: str, gaussians: int = 200_000, seed: int = SEED) -> BuiltPlace:
    """A room that the lifter's training never saw: its words have a seed of their own."""
    return build(parse_text(text, seed).layout, gaussians)


def to_bytes(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 [H, W, 3] of [3, H, W] in 0..1."""
    return (rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0)


@torch.no_grad()
def panorama(name: str, text: str, out: Path | None, height: int = 512) -> None:
    """Figures of one room."""
    place = built(text, 400_000)
    pose = torch.tensor([[*place.starts[0, :2].tolist(), float(place.starts[0, 2]) + EYE_M, 1, 0, 0, 0]])
    seen = rasterise(place.gaussians, pose, None, (height, 2 * height))
    truth, picture = (seen.depth / seen.alpha.clamp_min(0.01))[0], to_bytes(seen.rgb[0]).numpy()
    used = time.process_time()
    layers = panorama_layers(picture, load_lifter())
    gaussians, _ = panorama_gaussians(layers)
    used = time.process_time() - used
    known = (truth > 0.1) & (seen.alpha[0] > 0.9) & (layers.view >= 0)
    scaled = layers.distance * (truth / layers.distance)[known].median()
    error = (scaled / truth - 1).abs()
    across, down = layers.view != layers.view.roll(1, 1), layers.view != layers.view.roll(1, 0)
    seam = F.max_pool2d((across | down).float()[None, None], 5, 1, 2)[0, 0] > 0
    step, smooth = (scaled / truth).log(), (truth / truth.roll(1, 1)).log().abs() < 0.05
    step = (step - step.roll(1, 1)).abs()
    ratio = float(error[seam & known].mean() / error[~seam & known].mean())
    steps = float(step[across & known & smooth].mean() / step[~across & known & smooth].mean())
    middle = torch.tensor([[0, 0, layers.height_m, 1, 0, 0, 0]])
    again = rasterise(gaussians, middle, None, (height, 2 * height)).rgb[0].clamp(0, 1)
    closure = -10 * math.log10(float((again - layers.rgb).square().mean()))
    metric = float((layers.distance / truth - 1).abs()[known].mean())
    print(
        f"{name}: closure {closure:.1f} dB; seams over inside: depth {ratio:.2f}, steps {steps:.2f}; AbsRel {metric:.3f}, "
        f"scaled {float(error[known].mean()):.3f}; {len(gaussians):,} Gaussians, {used:.1f} s of processor",
        flush=True,
    )
    if out is not None:
        Image.fromarray(picture).save(out / f"panorama-{name.replace(' ', '-')}.png")


def depth_to_solids(points: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
    """How far points [N, 3] lie within free space, between the outermost of boxes [K, 6]: metres, 0 in or beyond them."""
    deep = []
    for part in points.split(4096):
        off = torch.maximum(boxes[:, :3] - part[:, None], part[:, None] - boxes[:, 3:])
        deep.append(off.clamp_min(0).norm(dim=2).amin(1))
    inside = ((points > boxes[:, :3].amin(0)) & (points < boxes[:, 3:].amax(0))).all(1)
    return torch.cat(deep) * inside


@torch.no_grad()
def grow(name: str, place: BuiltPlace, out: Path | None, exact: bool) -> list[float]:
    """Figures of one room; returns which share of each step's Gaussians intrudes."""
    pose = place.starts[0].clone()
    pose[2] += EYE_M
    seen = rasterise(place.gaussians, pose[None], (0.5, 0.5, 0.5, 0.5), (384, 384))
    truth = (seen.depth / seen.alpha.clamp_min(0.01))[0].clamp_min(0.1)
    layers = layers_of(to_bytes(seen.rgb[0]).numpy(), load_lifter())
    if exact:
        known = {"depth": truth, "behind": truth[::2, ::2], "hides": 0 * layers.hides}
        layers = replace(layers, **known, error=0 * layers.error, focal=0.5, pitch=0.0, roll=0.0, height_m=EYE_M)
    ratio = float((truth / layers.depth).median())
    world = place_of(layers, name, {})
    began, parts, intrusions, seams, outside = time.monotonic(), [world.gaussians], [], [], []
    low, high = place.solids[:, :3].amin(0) + WALL_M, place.solids[:, 3:].amax(0) - WALL_M
    turn = rotation(pose) @ rotation(world.starts[0]).T
    eyes, steps = viewpoints(world, 0), []
    for step, (more, _) in growth(world, GrowSpaceConfig(), eyes):
        points = ratio * (more.means - world.starts[0, :3]) @ turn.T + pose[:3]
        intrusions.append(float((depth_to_solids(points, place.solids) > FREE_M).float().mean()))
        outside.append(torch.maximum(low - points, points - high).clamp_min(0).norm(dim=1))
        seams.append(step.seam)
        parts.append(more)
        steps.append(step)
    whole, body = join(parts), Walker(eye_m=EYE_M, step_m=0.35)
    free = walkable(Solids(place.solids), pose[None, :3], body, 4000)
    free = free[(free - pose[:3]).norm(dim=1) < 4][::7][:8]
    at = (free - pose[:3]) @ turn / ratio + world.starts[0, :3]
    surface = [coverage(known_around(whole, one[None])) for one in at]
    bad = sum(one > INTRUDING for one in intrusions) / max(len(intrusions), 1)
    kind, last = "true" if exact else "lifted", steps[-1]
    print(
        f"{name}, {kind} depth: {len(steps)} steps in {time.monotonic() - began:.0f} s; own coverage "
        f"{100 * last.coverage:.1f}%, surface {100 * sum(surface) / len(surface):.1f}% (least {100 * min(surface):.1f}%); "
        f"intruding steps {100 * bad:.0f}% (Gaussians {', '.join(f'{100 * one:.0f}' for one in intrusions)}%); seam "
        f"{100 * sum(seams) / len(seams):.1f}%; beyond {float(torch.cat(outside).median()):.2f} m; "
        f"revisit {last.closure_db:.1f} dB after "
        f"{max(one.away_deg for one in steps):.0f} degrees",
        flush=True,
    )
    if out is not None:
        around = torch.cat([world.starts[0, :3], torch.tensor([1.0, 0, 0, 0])])[None]
        rows = [rasterise(one, around, None, (256, 512)).rgb[0] for one in (world.gaussians, whole)]
        file = f"grow-{name}-{kind}.png".replace(" ", "-")
        Image.fromarray(to_bytes(torch.cat(rows, 1)).numpy()).save(out / file)
    return intrusions


def rooms(out: Path | None) -> None:
    """Figures of many rooms."""
    steps = []
    for seed in SEEDS:
        for text in TEXTS:
            steps += grow(f"{text} {seed}", built(text, seed=seed), out, False)
    bad = sum(one > INTRUDING for one in steps)
    print(f"{bad} of {len(steps)} steps intrude ({100 * bad / len(steps):.0f}%)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("panorama", "grow", "rooms"))
    parser.add_argument("--out", type=Path, help="folder for pictures")
    parser.add_argument("--room", choices=tuple(ROOMS), help="one room alone")
    given = parser.parse_args()
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
    if given.what == "rooms":
        return rooms(given.out)
    for name in [given.room] if given.room else MEASURED[given.what]:
        if given.what == "panorama":
            panorama(name, ROOMS[name], given.out)
        else:
            place = built(ROOMS[name])
            grow(name, place, given.out, False)
            grow(name, place, given.out, True)


if __name__ == "__main__":
    main()
