"""Measures places of photographs and of a video without poses (pip install 'terrella[colmap]').

python benchmarks/photographs.py pictures|video [--text "a cosy library with a red door"] [--steps 1000] [--longest 256]

Pictures of a built room, 640x480, are taken on a walk sideways: 12, or 150 frames of a video of 10 s. `terrella.generate_place`
finds poses and fits the place. Printed: how many pictures were placed, how far their cameras are from the true ones once both
paths are laid over each other, and PSNR on the pictures kept out of the fit.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import simplejpeg
import torch
from PIL import Image

import terrella
from terrella.learn.recipes.splat_views import PICTURES, SplatFit
from terrella.serve.clip import make_clip
from terrella.space.camera import planar_pose
from terrella.space.fitting import FitConfig
from terrella.space.layout import BuiltPlace, build, parse_text
from terrella.space.pictures import posed_pictures
from terrella.space.raster import rasterise
from terrella.space.solids import Solids
from terrella.workflows.build_space import WALKER

CAMERA, SIZE, FPS = (0.6, 0.8, 0.5, 0.5), (480, 640), 15
AHEAD_M = 3.0  # what the cameras look at lies so far before the middle of the walk


def walk(place: BuiltPlace, count: int, rng: np.random.Generator) -> torch.Tensor:
    """Poses [count, 7] of a walk sideways at the start, as wide as the room allows, looking at one spot, with a shaking hand."""
    (x, y), wide = place.starts[0, :2].tolist(), 1.3
    while wide > 0.3:
        side = np.linspace(-wide, wide, count) + rng.normal(0, 0.02, count)
        ahead = 0.4 * np.sin(np.linspace(0, 3, count)) + 0.3
        at = np.stack([x + ahead, y + side, np.full(count, WALKER.eye_m)], 1)
        if not bool(Solids(place.solids).blocked(torch.from_numpy(at).float(), WALKER).any()):
            break
        wide -= 0.1
    turn = np.arctan2(y - at[:, 1], x + AHEAD_M - at[:, 0]) + rng.normal(0, 0.02, count)
    at[:, 2] = 1.5 + rng.normal(0, 0.03, count)
    return planar_pose(*(torch.from_numpy(one).float() for one in (*at.T, turn)))


def distances(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """How far cameras `found` [N, 3] lie from `true` ones [N, 3], in metres, after the similarity that fits them best."""
    one, two = found - found.mean(0), true - true.mean(0)
    u, s, v = np.linalg.svd(two.T @ one)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ v))])
    scale = float((s * np.diag(flip)).sum() / (one**2).sum())
    return np.linalg.norm(scale * one @ (u @ flip @ v).T - two, axis=1)


@torch.no_grad()
def taken(text: str, count: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Pictures uint8 [480, 640, 3] of a built room, and where they were taken [N, 3]."""
    place = build(parse_text(text, 5).layout, 300_000)
    poses = walk(place, count, np.random.default_rng(0))
    drawn = (rasterise(place.gaussians, pose[None], CAMERA, SIZE).rgb[0].clamp(0, 1) for pose in poses)
    return [(255 * one).round().byte().permute(1, 2, 0).numpy() for one in drawn], poses[:, :3].numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("pictures", "video"))
    parser.add_argument("--text", default="a cosy library with a red door")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--longest", type=int, default=256)
    given = parser.parse_args()
    film = given.what == "video"
    frames, true = taken(given.text, 10 * FPS if film else 12)
    config = SplatFit(longest=given.longest, frames=40 if film else 300, fit=FitConfig(steps=given.steps))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "place"
        if film:
            jpegs = [(simplejpeg.encode_jpeg(np.ascontiguousarray(frame), quality=95),) for frame in frames]
            (source := Path(folder) / "film.mp4").write_bytes(make_clip(jpegs, 1 / FPS))
            result = terrella.generate_place(out, video=source, config=config)
        else:
            (source := Path(folder) / "photos").mkdir()
            for k, frame in enumerate(frames):
                Image.fromarray(frame).save(source / f"{k:03d}.jpg", quality=95)
            result = terrella.generate_place(out, images=source, config=config)
        shots, unplaced = posed_pictures(source, out / PICTURES, config.frames)
    print(result.summary())
    count = len(shots.files)
    if not film:
        off = distances(shots.pose[:, :3].double().numpy(), true[[int(file.stem[:3]) for file in shots.files]])
        print(f"cameras off by {100 * np.median(off):.1f} cm (median), {100 * off.max():.1f} cm (most)")
    print(f"{count} of {count + len(unplaced)} pictures placed")


if __name__ == "__main__":
    main()
