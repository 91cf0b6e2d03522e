"""space lift: a place to walk in from one picture."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image

from ..core.errors import DatasetError, TerrellaError
from ..space.lifting.layers import HIDES, PictureLayers, floor_below, layers_of, to_gaussians
from ..space.lifting.network import load_lifter
from ..space.occupancy import Walker
from ..space.pictures.reading import read_picture
from ..space.raster import join
from ..worlds.additions import INVENTED, OBSERVED
from ..worlds.splat import SplatConfig, SplatWorld
from ..worlds.splat_folder import check_free, save_splat
from .splat_places import SpaceResult

MOST_ASPECT = 4.0
UNSURE, FLAT, PLAIN = 0.27, 1.35, 0.02  # expected error of depth; farthest over nearest; contrast of the picture
EYE_M = (0.3, 2.2)  # heights of eyes that walk


@dataclass(frozen=True)
class LiftSpaceConfig:
    """How a picture becomes a place."""

    longest: int = 512  # Pixels of the longer side; larger pictures are scaled down. Every pixel becomes a Gaussian.
    # Horizontal field of view of the lens in degrees. Default: estimated from the picture.
    fov: float | None = None
    # Height of the camera above the floor in metres, which gives the scale. Default: both estimated from the picture.
    eye: float | None = None


def lift_space(picture: Path, out: Path, config: LiftSpaceConfig) -> SpaceResult:
    """Makes a place of one picture and saves it in `out`. Its Gaussians are those of the picture (OBSERVED) and of what lies behind
    edges (INVENTED); metres, z up, the floor at 0, the camera above the origin, looking along x. DatasetError for a file
    that cannot be lifted."""
    if not 64 <= config.longest <= 2048:
        raise TerrellaError("--longest is from 64 to 2048 pixels.")
    if config.fov is not None and not 20 <= config.fov <= 130 or config.eye is not None and not 0.1 <= config.eye <= 20:
        raise TerrellaError("--fov is from 20 to 130 degrees, and --eye from 0.1 to 20 metres.")
    check_free(out)
    notes = _frames(picture)
    rgb = read_picture(picture, longest=config.longest)
    height, width = rgb.shape[:2]
    if max(height, width) > MOST_ASPECT * min(height, width):
        raise DatasetError(f"{picture} is {width} x {height} pixels after scaling; crop it to at most 4 to 1.")
    focal = None
    if config.fov is not None:
        focal = 0.5 * width / math.tan(math.radians(config.fov) / 2) / max(height, width)
    lifter = load_lifter()
    layers = layers_of(rgb, lifter, focal, config.eye)
    world = place_of(layers, picture.stem, {"picture": picture.name})
    save_splat(world, out)
    return _result(layers, world, out, lifter.measured, [*notes, *doubts(layers)])


def place_of(layers: PictureLayers, name: str, card: dict) -> SplatWorld:
    """The place of a picture's layers, with a walker whose eyes are where its camera was."""
    gaussians, seen = to_gaussians(layers)
    if float(layers.error.mean()) <= UNSURE:
        floor = floor_below(gaussians.at(seen), layers)
        gaussians, seen = join([gaussians, floor]), torch.cat([seen, torch.zeros(len(floor), dtype=torch.bool)])
    height, width = layers.depth.shape
    share = 256 / max(height, width)
    size = (max(round(height * share), 8), max(round(width * share), 8))
    eye = min(max(layers.height_m, EYE_M[0]), EYE_M[1])
    body = Walker(radius_m=min(0.25, 0.3 * eye), eye_m=eye, step_m=min(0.35, 0.3 * eye))
    origin = torch.where(seen, OBSERVED, INVENTED).to(torch.uint8)
    facts = {"axes": "x forward, y left, z up; metres; floor at 0", "fov_deg": round(_fov(layers), 1)}
    return SplatWorld(
        name, gaussians, origin, layers.pose[None], SplatConfig(layers.camera, size, body=body), card | facts
    )


def doubts(layers: PictureLayers) -> list[str]:
    """Why the place may be poor, by what was measured."""
    error, reach = float(layers.error.mean()), layers.depth.flatten()[::7].quantile(torch.tensor([0.05, 0.95]))
    ratio, contrast = float(reach[1] / reach[0]), float(layers.rgb.std(dim=(1, 2)).max())
    notes = []
    if contrast < PLAIN:
        notes.append(
            f"the picture is plain (contrast {contrast:.3f}; below {PLAIN} nothing shows depth): the place is a guess."
        )
    elif ratio < FLAT:
        notes.append(
            f"the picture shows little depth (its far parts are {ratio:.2f} times as far as its near ones): a wall, a logo or text?"
        )
    if error > UNSURE:
        notes.append(
            f"the network is unsure of the depth (it estimates an error of {100 * error:.0f}%, of pictures like its training's "
            f"below {100 * UNSURE:.0f}%): the place may be wrong."
        )
    return notes


def _frames(picture: Path) -> list[str]:
    """A note on pictures with several frames; DatasetError for a missing or unreadable one."""
    if not picture.exists():
        raise DatasetError(f"{picture} does not exist; check the path.")
    try:
        with Image.open(picture) as opened:
            many = getattr(opened, "n_frames", 1)
    except Image.DecompressionBombError:
        return []  # read_picture names the limit
    except (OSError, ValueError) as fault:
        raise DatasetError(f"{picture} cannot be read as a picture; save it as JPEG or PNG.") from fault
    return [f"the first of its {many} frames is used."] if many > 1 else []


def _fov(layers: PictureLayers) -> float:
    return 2 * math.degrees(math.atan(0.5 / layers.camera[0]))


def expected_error(measured: Mapping[str, float]) -> str:
    """In words what is known of the error of depth: that of kinds of pictures that training never saw, as it was measured."""
    if not measured:
        return "the error of depth was not measured with these weights"
    known = ", ".join(f"{100 * error:.0f}% of {kind}" for kind, error in measured.items())
    return f"error of depth to expect: {known}; of any other kind of picture it may be anything"


def _result(
    layers: PictureLayers, world: SplatWorld, out: Path, measured: Mapping[str, float], notes: list[str]
) -> SpaceResult:
    near, far = layers.depth.flatten()[::7].quantile(torch.tensor([0.05, 0.95])).tolist()
    seen = int((world.provenance == OBSERVED).sum())
    facts = {
        "world": str(out), "gaussians": len(world.gaussians), "seen": seen, "invented": len(world.gaussians) - seen,
        "fov_deg": round(_fov(layers), 1), "pitch_deg": round(math.degrees(layers.pitch), 1),
        "roll_deg": round(math.degrees(layers.roll), 1), "height_m": round(layers.height_m, 2),
        "near_m": round(near, 2), "far_m": round(far, 2), "expected_error": dict(measured),
        "own_error": round(float(layers.error.mean()), 3),
        "hidden_share": round(float((layers.hides > HIDES).float().mean()), 3), "notes": notes,
    }  # fmt: skip
    lines = [
        f"{len(world.gaussians):,} Gaussians, {facts['invented']:,} of them invented: behind edges, and floor below the camera",
        f"lens {facts['fov_deg']:.0f} degrees wide, camera {facts['height_m']:.2f} m above the floor, "
        f"pitch {facts['pitch_deg']:.0f} degrees; depth {near:.1f} to {far:.1f} m",
        expected_error(measured),
        *notes,
        f"walk in it: terrella play {out}",
    ]
    return SpaceResult(facts, tuple(lines))
