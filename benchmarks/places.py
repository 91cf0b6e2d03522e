"""Measures places of panoramas against rooms of `space build`, whose geometry is known.

python benchmarks/places.py panorama [--out DIR]

panorama: closure (PSNR of the panorama drawn again from its middle), and the error of depth within two pixels of seams, where
another view begins to weigh most, over that elsewhere: of depth itself after one factor, and of its steps on smooth surfaces.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image

from terrella.space.layout import BuiltPlace, build, parse_text
from terrella.space.lifting.network import load_lifter
from terrella.space.lifting.panorama import panorama_gaussians, panorama_layers
from terrella.space.raster import rasterise

EYE_M, SEED = 1.6, 5
ROOMS = {
    "living room": "a bright scandinavian living room at noon",
    "library": "a library with a red door",
    "dungeon": "a dungeon with torches",
}


def built(text: str) -> BuiltPlace:
    """A room that the lifter's training never saw: its words have a seed of their own."""
    return build(parse_text(text, SEED).layout, 400_000)


def to_bytes(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 [H, W, 3] of [3, H, W] in 0..1."""
    return (rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0)


@torch.no_grad()
def panorama(name: str, text: str, out: Path | None, height: int = 512) -> None:
    """Figures of one room."""
    place = built(text)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("panorama",))
    parser.add_argument("--out", type=Path, help="folder for pictures")
    given = parser.parse_args()
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
    for name, text in ROOMS.items():
        panorama(name, text, given.out)


if __name__ == "__main__":
    main()
