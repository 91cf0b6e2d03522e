"""Measures `terrella space lift` on rooms, maps and tables that its training never saw.

python benchmarks/lift.py [--rooms 60] [--views 24] [--games 60] [--store]

Depth: AbsRel, the mean of |error| / truth, as it is and scaled by the median ratio, beside two baselines: a plane at the mean
depth of the training (3 m), and a level floor at eye height with walls at 5 m. Views: the camera moves by 0.3 and 0.6 m; PSNR on
pixels that the picture did not show. Holes of one-layer places are filled with the nearest colour drawn.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import distance_transform_edt

from terrella.space.camera import rays
from terrella.space.lifting.layers import PictureLayers, layers_of, to_gaussians
from terrella.space.lifting.network import WEIGHTS, load_lifter, save_lifter
from terrella.space.lifting.pictures import random_pictures, render
from terrella.space.lifting.scenes import Shot
from terrella.space.lifting.textures import atlas_of
from terrella.space.raster import rasterise

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
HELD_OUT = 2
MEAN_M, EYE_M, WALL_M = 3.0, 1.5, 5.0


ATLAS = atlas_of(1000 * HELD_OUT)


def abs_rel(depth: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Metric, and after scaling by the median ratio."""
    some = (truth > 0) & (truth < 40)
    ratio = np.median(truth[some] / depth[some])
    return tuple(float(np.abs(depth[some] * one / truth[some] - 1).mean()) for one in (1.0, ratio))


def floor_only(shape: tuple[int, int], focal: float) -> np.ndarray:
    """Depth of a level camera EYE_M above a floor, in a box of walls WALL_M away."""
    long = focal * max(shape)
    up = np.asarray(rays((long / shape[1], long / shape[0], 0.5, 0.5), *shape))[..., 2]
    return np.where(up < 0, np.minimum(EYE_M / np.maximum(-up, 1e-6), WALL_M), WALL_M)


def depth_table(name: str, rows: list[tuple[np.ndarray, np.ndarray, list[float]]], lifter) -> float:
    """Prints AbsRel over pictures [H, W, 3] with depth [H, W] and lens; returns that of the lifter."""
    results: dict[str, list[tuple[float, float]]] = {}
    lens = []
    for rgb, truth, (focal, pitch, _, height) in rows:
        layers = layers_of(rgb, lifter)
        known = layers_of(rgb, lifter, focal)
        both = {"lifted": layers.depth.numpy(), "lifted, lens given": known.depth.numpy()}
        both |= {"plane at 3 m": np.full(truth.shape, MEAN_M), "floor and walls": floor_only(truth.shape, focal)}
        for label, depth in both.items():
            results.setdefault(label, []).append(abs_rel(depth, truth))
        lens.append(
            (abs(math.log(layers.focal / focal)), abs(layers.pitch - pitch), abs(math.log(layers.height_m / height)))
        )
    for label, values in results.items():
        metric, scaled = np.array(values).mean(0)
        by = 1.96 * np.array(values).std(0)[0] / len(values) ** 0.5
        print(f"{name}, {label}: AbsRel {metric:.3f} (+-{by:.3f}), scaled {scaled:.3f}; {len(values)} pictures")
    focal, pitch, height = np.array(lens).T
    height = f", height by {100 * height.mean():.0f}%" if np.isfinite(height).all() else ""
    print(f"{name}: lens off by {100 * focal.mean():.0f}%, pitch by {math.degrees(pitch.mean()):.1f} degrees{height}")
    return round(float(np.mean(results["lifted"], 0)[0]), 3)


def held_out(count: int, size: tuple[int, int]):
    """Rooms with layouts and textures of other seeds than the training's."""
    pictures = random_pictures(np.random.default_rng([HELD_OUT, 0]), ATLAS, size)
    return [row for _, row in zip(range(count), pictures)]


def true_layers(shown, shot: Shot) -> PictureLayers:
    """The layers of a picture as they are."""
    rgb, more = (torch.from_numpy(part).permute(2, 0, 1).float() / 255 for part in (shown.rgb, shown.behind_rgb))
    depth, behind = (torch.from_numpy(part.copy()).clamp_min(0.05) for part in (shown.depth, shown.behind))
    hides = torch.from_numpy((shown.behind > 0).astype(np.float32))
    return PictureLayers(rgb, depth, behind, hides, more, 0 * depth, shot.focal, shot.pitch, shot.roll, shot.height_m)


def disoccluded(truth: np.ndarray, shot: Shot, source: np.ndarray, first: Shot) -> np.ndarray:
    """Which pixels of a view show what the first picture's camera had in its frame, but hidden: bool [H, W]."""
    height, width = truth.shape
    long = first.focal * max(height, width)
    at = truth[..., None] * np.asarray(rays((long / width, long / height, 0.5, 0.5), height, width))
    local = (at @ shot.turn.T + shot.place - first.place) @ first.turn
    ahead = np.maximum(local[..., 0], 1e-3)
    column, row = width / 2 - long * local[..., 1] / ahead, height / 2 - long * local[..., 2] / ahead
    inside = (local[..., 0] > 0.05) & (column > 1) & (column < width - 2) & (row > 1) & (row < height - 2) & (truth > 0)
    i, j = np.clip(row.astype(int), 1, height - 2), np.clip(column.astype(int), 1, width - 2)
    around = np.stack([source[i + a, j + b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    return inside & (around.max(0) < 0.97 * ahead)


def filled(drawn) -> np.ndarray:
    """A drawing [H, W, 3] in 0..1, its holes filled with the nearest colour."""
    rgb, alpha = drawn.rgb[0].permute(1, 2, 0).numpy(), drawn.alpha[0].numpy()
    rgb = rgb / np.maximum(alpha, 0.3)[..., None]
    _, at = distance_transform_edt(alpha < 0.5, return_indices=True)
    return np.clip(rgb[at[0], at[1]], 0, 1)


def views(rows, lifter, out: Path | None) -> None:
    """PSNR of moved views on the disoccluded pixels."""
    errors: dict[str, dict[float, list[float]]] = {}
    covered: dict[float, list[float]] = {}
    for number, (shown, scene, shot, exposure) in enumerate(rows):
        layers = layers_of(shown.rgb, lifter)
        ratio = float((torch.from_numpy(shown.depth) / layers.depth)[torch.from_numpy(shown.depth > 0)].median())
        layers = replace(layers, depth=ratio * layers.depth, behind=ratio * layers.behind)
        exact = true_layers(shown, shot)
        places = {"two layers": to_gaussians(layers)[0], "one layer": to_gaussians(layers, two=False)[0]}
        places["unprojected"] = replace(places["one layer"], scales=_round(layers))
        places |= {"truth, two layers": to_gaussians(exact)[0], "truth, one layer": to_gaussians(exact, two=False)[0]}
        cameras = dict.fromkeys(places, (layers, layers.camera)) | dict.fromkeys(
            ("truth, two layers", "truth, one layer"), (exact, exact.camera)
        )
        for by in (0.3, 0.6):
            side = 1 if number % 2 else -1
            moved = shot_moved(shot, by * side)
            if not scene.is_free(shot.place, shot.turn @ [0, by * side, 0]):
                continue
            true = render(scene, moved, ATLAS, shown.depth.shape, exposure, layers=False)[0]
            mask = disoccluded(true.depth, moved, shown.depth, shot)
            if mask.sum() < 40:
                continue
            covered.setdefault(by, []).append(float(mask.mean()))
            strip = [shown.rgb, true.rgb]
            for name, place in places.items():
                seen, lens = cameras[name]
                pose = seen.pose.clone()
                pose[:3] += seen.turn @ torch.tensor([0.0, by * side, 0.0])
                with torch.no_grad():
                    drawn = rasterise(place, pose[None], lens, shown.depth.shape)
                picture = filled(drawn)
                off = np.square(picture - true.rgb / 255.0)[mask].mean()
                errors.setdefault(name, {}).setdefault(by, []).append(-10 * math.log10(max(off, 1e-6)))
                strip.append((255 * picture).astype(np.uint8))
            if out is not None and number < 12:
                strip.append(np.repeat(255 * mask[..., None].astype(np.uint8), 3, 2))
                Image.fromarray(np.concatenate(strip, 1)).save(out / f"view-{number:02d}-{by}.png")
    for by, shares in covered.items():
        print(f"moved {by} m: {len(shares)} views, {100 * np.mean(shares):.1f}% of the pixels disoccluded")
        for name, values in errors.items():
            print(
                f"  {name}: {np.mean(values[by]):.2f} dB (+-{1.96 * np.std(values[by]) / len(values[by]) ** 0.5:.2f})"
            )


def _round(layers: PictureLayers) -> torch.Tensor:
    """Scales of round Gaussians of one pixel each."""
    size = (layers.depth / (layers.camera[0] * layers.depth.shape[1])).flatten()
    return 0.5 * size[:, None].expand(-1, 3)


def shot_moved(shot: Shot, left_m: float) -> Shot:
    """The camera moved to its left."""
    return replace(shot, place=shot.place + shot.turn @ [0, left_m, 0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=60)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--games", type=int, default=60)
    parser.add_argument("--out", type=Path, help="folder for pictures of the views")
    parser.add_argument(
        "--store", action="store_true", help="write the errors of depth into the weights, for `space lift`"
    )
    given = parser.parse_args()
    lifter = load_lifter()
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
    rows = held_out(max(given.rooms, given.views), (256, 256))
    lenses = [[shot.focal, shot.pitch, shot.roll, shot.height_m] for _, _, shot, _ in rows]
    rooms = depth_table(
        "rooms", [(row[0].rgb, row[0].depth, lens) for row, lens in zip(rows, lenses)][: given.rooms], lifter
    )
    views(rows[: given.views], lifter, given.out)
    measured = {"rooms": rooms} | (games(given.games, lifter) if given.games else {})
    if given.store:
        lifter.measured = measured
        save_lifter(lifter, WEIGHTS)
    picture = np.asarray(Image.fromarray(rows[0][0].rgb).resize((512, 512)))
    began, used = time.monotonic(), time.process_time()
    to_gaussians(layers_of(picture, lifter))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"512 x 512: {time.process_time() - used:.1f} s of processor, {time.monotonic() - began:.1f} s by the clock; bar 10 s; "
        f"peak {peak:.2f} GB"
    )


def games(count: int, lifter) -> dict[str, float]:
    """AbsRel of maps of Doom and tables that training never saw."""
    from lifter_games import UNSEEN_MAPS, doom_pictures, robot_tables, table_pictures

    doom = depth_table("Doom's unseen maps", list(doom_pictures(UNSEEN_MAPS[:3], count, 9)), lifter)
    rng = np.random.default_rng([HELD_OUT, 1])
    tables = depth_table("MuJoCo's robots at tables", list(table_pictures(robot_tables(), count, rng)), lifter)
    return {"Doom's maps": doom, "tables": tables}


if __name__ == "__main__":
    main()
