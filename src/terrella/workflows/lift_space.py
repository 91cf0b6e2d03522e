"""space lift: a place to walk in from one picture or one panorama."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image

from ..core.errors import DatasetError, TerrellaError
from ..space.camera import planar_pose
from ..space.enclosure import ColliderKind
from ..space.lifting.depth_teacher import with_teacher
from ..space.lifting.layers import HIDES, PictureLayers, floor_below, layers_of, to_gaussians
from ..space.lifting.network import Lifter, load_lifter
from ..space.lifting.panorama import PanoramaLayers, panorama_gaussians, panorama_layers, wraps
from ..space.occupancy import Walker
from ..space.pictures import is_pictures
from ..space.pictures.reading import opaque_part, read_picture
from ..space.raster import join
from ..worlds.additions import INVENTED, OBSERVED
from ..worlds.splat import SplatConfig, SplatWorld
from ..worlds.splat_folder import check_free, save_splat
from .progress import Progress, silent
from .results import command, folder_name
from .splat_places import SpaceResult

MOST_ASPECT = 4.0
NARROWEST = 256  # pixels of the width of a panorama
UNSURE, FLAT, PLAIN = 0.27, 1.35, 0.02  # expected error of depth; farthest over nearest; contrast of the picture
ONE_COLOUR, RIM = 0.6, 0.95  # share of pixels of one colour; of the dark ones outside the circle that a fisheye fills
DARK, STEEP = 0.3, -0.65  # share of white; pitch in radians, lower than of most pictures that the network learned from
EYE_M = (0.3, 2.2)  # heights of eyes that walk
AXES = "x forward, y left, z up; metres; floor at 0"


@dataclass(frozen=True)
class LiftSpaceConfig:
    """How a picture becomes a place."""

    longest: int = 512
    """Pixels of the longer side (of a panorama: of half of it). Larger pictures are scaled down; every pixel becomes a Gaussian."""
    # Horizontal field of view of the lens in degrees. Default: estimated from the picture.
    fov: float | None = None
    panorama: bool = False
    """The picture shows all directions (equirectangular, 2:1). A picture of 2:1 whose left and right edges meet is taken as one
    unless --fov is given."""
    # Height of the camera above the floor in metres, which gives the scale. Default: both estimated from the picture.
    eye: float | None = None
    # A depth network of others for what is seen: an .onnx file, or depth-anything-v2-small (of the hub). Default: the lifter's own.
    depth: str | None = None
    collider: ColliderKind = "indoor"
    """How what stops walkers is closed: indoor (the floor goes on for 1 m beyond what is seen, and ends there), outdoor (it goes on
    for as long as the place is), object, or open: only what the Gaussians fill."""


def lift_space(picture: Path, out: Path, config: LiftSpaceConfig, *, progress: Progress = silent) -> SpaceResult:
    """Makes a place of one picture and saves it in `out`. Its Gaussians are those of the picture (OBSERVED) and of what lies behind
    edges (INVENTED); metres, z up, the floor at 0, the camera above the origin, looking along x. DatasetError for a file
    that cannot be lifted."""
    if not 64 <= config.longest <= 2048:
        raise TerrellaError("--longest is from 64 to 2048 pixels.")
    if config.fov is not None and not 20 <= config.fov <= 130 or config.eye is not None and not 0.1 <= config.eye <= 20:
        raise TerrellaError("--fov is from 20 to 130 degrees, and --eye from 0.1 to 20 metres.")
    check_free(out)
    progress("estimating depth and what lies behind edges")
    notes, lifter = _frames(picture), load_lifter()
    if config.panorama and config.fov is not None:
        raise TerrellaError("--fov is for pictures of one direction, --panorama for those of all; leave one out.")
    rgb = read_picture(picture, longest=2 * config.longest)
    if config.panorama or config.fov is None and wraps(rgb):
        if config.depth is not None:
            raise TerrellaError(
                "--depth is for pictures of one direction; leave it out, or give --fov for a plain picture."
            )
        notes += (
            []
            if config.panorama
            else ["taken as a panorama: it is 2:1 and its edges meet (--fov makes it a plain picture)."]
        )
        return _lift_panorama(picture, rgb, out, config, lifter, notes)
    if config.fov is None and abs(rgb.shape[1] / rgb.shape[0] - 2) < 0.01:
        notes.append(
            "taken as a picture of one direction, for its left and right edges do not meet (--panorama: of all)."
        )
    rgb = read_picture(picture, longest=config.longest)
    height, width = rgb.shape[:2]
    focal = None
    if config.fov is not None:
        focal = 0.5 * width / math.tan(math.radians(config.fov) / 2) / max(height, width)
    layers = layers_of(rgb, lifter, focal, config.eye)
    if (opaque := opaque_part(picture, (height, width))) is not None and not opaque.all():
        if not opaque.any():
            raise DatasetError(f"{picture} is transparent throughout; save it without its alpha channel.")
        layers = replace(layers, opaque=torch.from_numpy(opaque))
        notes.append(f"{1 - opaque.mean():.0%} of the picture is transparent: nothing stands there.")
    if config.depth is not None:
        progress("running the depth network")
        layers, agreement = with_teacher(layers, config.depth)
        notes.append(f"depth by {config.depth}, scaled to the lifter's (correlation {agreement:.2f}).")
    doubtful = doubts(layers)
    card = {"picture": picture.name} | ({"doubts": doubtful} if doubtful else {})
    world = place_of(layers, picture.stem, card, config.collider)
    save_splat(world, out)
    facts = {
        "fov_deg": round(_fov(layers), 1), "pitch_deg": round(math.degrees(layers.pitch), 1),
        "roll_deg": round(math.degrees(layers.roll), 1), "hidden_share": round(float((layers.hides > HIDES).float().mean()), 3),
    }  # fmt: skip
    camera = f"lens {facts['fov_deg']:.0f} degrees wide, pitch {facts['pitch_deg']:.0f} degrees, "
    seen = _Seen(layers.depth, layers.error, layers.height_m, facts, camera)
    return _result(seen, world, out, lifter.measured, [*notes, *doubtful])


def _lift_panorama(
    picture: Path, rgb: np.ndarray, out: Path, config: LiftSpaceConfig, lifter: Lifter, notes: list[str]
) -> SpaceResult:
    """The place of a panorama uint8 [H, W, 3], seen from its middle."""
    height, width = rgb.shape[:2]
    if abs(width / height - 2) > 0.02 or width < NARROWEST:
        raise DatasetError(
            f"{picture} is {width} x {height} pixels after scaling; a panorama is equirectangular, twice as wide as high, "
            f"and {NARROWEST} wide or more. Leave --panorama out for a picture of one direction."
        )
    if not wraps(rgb):
        notes.append("its left and right edges do not meet, as those of all directions do: expect a seam behind you.")
    even = np.asarray(Image.fromarray(rgb).resize((width // 4 * 4, width // 4 * 2), Image.Resampling.BOX))
    layers = panorama_layers(even, lifter, config.eye)
    notes += (doubtful := [*_doubts_of_colours(layers.rgb.flatten(1)), *_doubts_of_error(layers.error)])
    card = {"panorama": picture.name} | ({"doubts": doubtful} if doubtful else {})
    world = panorama_place(layers, picture.stem, card, config.collider)
    save_splat(world, out)
    seen = _Seen(layers.distance, layers.error, layers.height_m, {"panorama": True}, "all directions, ")
    return _result(seen, world, out, lifter.measured, notes)


def panorama_place(layers: PanoramaLayers, name: str, card: dict, collider: ColliderKind = "indoor") -> SplatWorld:
    """The place of a panorama's layers: one begins in its middle, in eight directions."""
    gaussians, seen = panorama_gaussians(layers)
    high = torch.full((8,), layers.height_m)
    starts = planar_pose(torch.zeros(8), torch.zeros(8), high, torch.arange(8) * (math.pi / 4))
    origin = torch.where(seen, OBSERVED, INVENTED).to(torch.uint8)
    config = SplatConfig((0.5, 0.5 * 4 / 3, 0.5, 0.5), (192, 256), body=_walker(layers.height_m), collider=collider)
    facts = {"axes": AXES, "depth_error": round(float(layers.error.mean()), 3)}
    return SplatWorld(name, gaussians, origin, starts, config, card | facts)


def place_of(layers: PictureLayers, name: str, card: dict, collider: ColliderKind = "indoor") -> SplatWorld:
    """The place of a picture's layers, with a walker whose eyes are where its camera was."""
    gaussians, seen = to_gaussians(layers)
    if float(layers.error.mean()) <= UNSURE:
        floor = floor_below(gaussians.at(seen), layers)
        gaussians, seen = join([gaussians, floor]), torch.cat([seen, torch.zeros(len(floor), dtype=torch.bool)])
    height, width = layers.depth.shape
    share = 256 / max(height, width)
    size = (max(round(height * share), 8), max(round(width * share), 8))
    origin = torch.where(seen, OBSERVED, INVENTED).to(torch.uint8)
    facts = {"axes": AXES, "fov_deg": round(_fov(layers), 1), "depth_error": round(float(layers.error.mean()), 3)}
    config = SplatConfig(layers.camera, size, body=_walker(layers.height_m), collider=collider)
    return SplatWorld(name, gaussians, origin, layers.pose[None], config, card | facts)


def _walker(height_m: float) -> Walker:
    """A body whose eyes are where the camera was."""
    eye = min(max(height_m, EYE_M[0]), EYE_M[1])
    return Walker(radius_m=min(0.25, 0.3 * eye), eye_m=eye, step_m=min(0.35, 0.3 * eye))


def doubts(layers: PictureLayers) -> list[str]:
    """Why the place may be poor, by what was measured."""
    shown = torch.ones_like(layers.depth, dtype=torch.bool) if layers.opaque is None else layers.opaque
    near, far = layers.depth[shown][::7].quantile(torch.tensor([0.05, 0.95])).tolist()
    notes = _doubts_of_colours(layers.rgb[:, shown])
    if not notes and far / near < FLAT:
        notes.append(
            f"the picture shows little depth (its far parts are {far / near:.2f} times as far as its near ones): a wall, a "
            "logo or text?"
        )
    if layers.opaque is None and _is_round(layers.rgb):
        notes.append("the picture is round, as a fisheye's: straight lines come out bent; rectify it before.")
    if layers.pitch < STEEP:
        notes.append(
            f"it is taken for a view from above (the camera looks {-math.degrees(layers.pitch):.0f} degrees down), as of a table: "
            "a portrait, a logo or a close-up comes out tilted."
        )
    return [*notes, *_doubts_of_error(layers.error)]


def _doubts_of_colours(colours: torch.Tensor) -> list[str]:
    """What colours [3, N] in 0..1 say against a picture: it is plain, or dark, or mostly of one colour."""
    contrast, bright = float(colours.std(dim=1).max()), float(colours.max())
    if bright < DARK and contrast > 0:
        return [f"the picture is dark (its brightest pixel has {bright:.0%} of white): brighten it and lift it again."]
    if contrast < PLAIN:
        return [
            f"the picture is plain (contrast {contrast:.3f}; below {PLAIN} nothing shows depth): the place is a guess."
        ]
    steps = (63 * colours).round().long()
    share = float(((steps[0] * 64 + steps[1]) * 64 + steps[2]).bincount().max() / steps.shape[1])
    if share > ONE_COLOUR:
        return [
            f"{share:.0%} of the picture is one colour, as of text, a logo or a cut-out figure: nothing shows its depth."
        ]
    return []


def _doubts_of_error(expected: torch.Tensor) -> list[str]:
    """What the network's own estimate of its error, as a share of depth, says against a picture."""
    if (error := float(expected.mean())) <= UNSURE:
        return []
    return [
        f"the network is unsure of the depth (it estimates an error of {error:.0%}; for pictures like those "
        f"it learned from, below {UNSURE:.0%}): the place may be wrong."
    ]


def _is_round(rgb: torch.Tensor) -> bool:
    """Whether a picture [3, H, W] in 0..1 is black outside the circle that touches its nearer sides, and not within."""
    high, wide = rgb.shape[1:]
    row, column = torch.meshgrid(torch.arange(high) - 0.5 * high, torch.arange(wide) - 0.5 * wide, indexing="ij")
    far, dark = (row.square() + column.square()).sqrt() / (0.5 * min(high, wide)), rgb.amax(0) < 0.06
    return float(dark[far > 1.05].float().mean()) > RIM and float(dark[far < 0.9].float().mean()) < 0.5


def _frames(picture: Path) -> list[str]:
    """A note on pictures with several frames; DatasetError for a missing, unreadable or very long one."""
    if is_pictures(picture):
        raise DatasetError(
            f"{picture} is a video or a folder of pictures, of which "
            f"`{command('terrella', 'space', 'fit', picture, out=f'{folder_name(picture.stem)}-place')}` makes one place."
        )
    if not picture.exists():
        raise DatasetError(
            f"{picture} does not exist; check the path (of words, `terrella space build` makes a place)."
        )
    if picture.is_dir():
        raise DatasetError(f"{picture} is a folder without pictures; give a picture, or a folder of them to space fit.")
    try:
        with Image.open(picture) as opened:
            many, (width, height) = getattr(opened, "n_frames", 1), opened.size
    except Image.DecompressionBombError:
        return []  # read_picture names the limit
    except (OSError, ValueError) as fault:
        raise DatasetError(f"{picture} cannot be read as a picture; save it as JPEG or PNG.") from fault
    if (aspect := max(height, width) / min(height, width)) > MOST_ASPECT:
        way = "wide as it is high" if width > height else "high as it is wide"
        raise DatasetError(f"{picture} is {aspect:.3g} times as {way}; crop it to at most {MOST_ASPECT:.0f} times.")
    return [f"the first of its {many} frames is used."] if many > 1 else []


def _fov(layers: PictureLayers) -> float:
    return 2 * math.degrees(math.atan(0.5 / layers.camera[0]))


def expected_error(measured: Mapping[str, float]) -> str:
    """In words what is known of the error of depth: that of kinds of pictures that training never saw, as it was measured."""
    if not measured:
        return "the error of depth was not measured with these weights"
    known = ", ".join(f"{100 * error:.0f}% of {kind}" for kind, error in measured.items())
    return f"error of depth to expect: {known}; of any other kind of picture it may be anything"


class _Seen(NamedTuple):
    """Of layers: depth and its error [H, W], the camera's height, figures for JSON, and the camera in words."""

    depth: torch.Tensor
    error: torch.Tensor
    height_m: float
    facts: dict[str, Any]
    camera: str


def _result(
    layers: _Seen, world: SplatWorld, out: Path, measured: Mapping[str, float], notes: list[str]
) -> SpaceResult:
    near, far = layers.depth.flatten()[::7].quantile(torch.tensor([0.05, 0.95])).tolist()
    seen = int((world.provenance == OBSERVED).sum())
    facts = {
        "world": str(out), "gaussians": len(world.gaussians), "seen": seen, "invented": len(world.gaussians) - seen,
        "height_m": round(layers.height_m, 2), "near_m": round(near, 2), "far_m": round(far, 2), **layers.facts,
        "expected_error": dict(measured), "own_error": round(float(layers.error.mean()), 3), "notes": notes,
    }  # fmt: skip
    nothing = f"beside and behind the camera is nothing: `{command('terrella', 'space', 'grow', out)}` invents it"
    around = [] if "panorama" in facts else [nothing]
    lines = [
        f"{len(world.gaussians):,} Gaussians, {facts['invented']:,} of them invented: behind edges, and floor below the camera",
        f"{layers.camera}camera {layers.height_m:.2f} m above the floor; depth {near:.1f} to {far:.1f} m",
        expected_error(measured),
        *notes,
        *around,
        f"walk in it: {command('terrella', 'play', out)}",
    ]
    return SpaceResult(facts, tuple(lines))
