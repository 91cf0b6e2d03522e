"""Makes places of Gaussians: fitted to a recording or pictures, built of words, a layout or triangles, or read from a file."""

import contextlib
import json
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch

from ..core.errors import DatasetError, TerrellaError
from ..learn.recipes.splat import SplatFit, Watch, fit_splat
from ..serve.live_place import live_page
from ..space.enclosure import ColliderChoice
from ..space.files import read_scene, replace_whole
from ..space.files.gltf_scene import GLTF_ENDINGS, GltfScene, read_gltf
from ..space.layout import BuiltPlace, ParsedText, build, parse_text, read_layout
from ..space.layout.drawn_plan import layout_of_plan
from ..space.layout.meshes import of_triangles
from ..space.occupancy import Walker
from ..space.raster import Gaussians
from ..space.raster.move import transform
from ..worlds.additions import INVENTED, OBSERVED
from ..worlds.splat import SolidBoxes, SplatConfig, SplatWorld
from ..worlds.splat_folder import check_free, save_splat, world_of
from .progress import Progress, silent, stage
from .results import command
from .splat_places import SpaceResult, page_scene, unheeded

LAYOUT_FILE = "layout.json"
MOST_NAMES = 20  # of what is left out on one line
WALKER = Walker(eye_m=1.65, step_m=0.35)  # in places that are built


@dataclass(frozen=True)
class BuildSpaceConfig:
    """How a place is built."""

    text: str | None = None
    """Words instead of a file: "a long room with two pillars and a red door". Their layout is saved as OUT/layout.json."""
    gaussians: int = 120_000  # Approximate number of Gaussians.
    seed: int | None = None  # Seed of everything that the words or the layout leave open.
    size: tuple[int, int] = (192, 256)  # Height and width of the pictures, in pixels.


@dataclass(frozen=True)
class ImportSpaceConfig:
    """How a file is read."""

    axes: Literal["rdf", "rub", "flu"] | None = None
    """Axes of the file: rdf (x right, y down, z forward: usual in .ply), rub (x right, y up, z back: usual in .spz), or flu
    (x forward, y left, z up: Terrella's)."""
    scale: float = 1.0  # Metres per unit of the file.
    size: tuple[int, int] = (192, 256)  # Height and width of the pictures, in pixels.
    collider: ColliderChoice = "auto"
    """How what stops walkers is closed: indoor, outdoor (also without walls: floors go on, the inside of things is solid), object
    (solid, on a level floor), or open: only what the Gaussians fill. auto chooses by what surrounds the start."""
    inside: tuple[float, float, float] | None = None
    """A point in free space (x y z in metres, z up) where one begins, and the flood fill, too. Default: the free
    place nearest to the middle."""


def fit_space(
    data: str, out: str, config: SplatFit, *, watch_port: int | None = None, progress: Progress = silent
) -> SpaceResult:
    """Fits Gaussians to a recording with poses or to pictures, and saves OUT/world. An earlier run goes on.

    watch_port: serves a page that shows the fit meanwhile; 0 takes any free port.
    """
    with contextlib.ExitStack() as stack:
        watch = None if watch_port is None else stack.enter_context(_watched(watch_port, progress))
        facts = fit_splat(data, out, config, stack.enter_context(stage("fitting", progress)), watch)
    (ours, ours_by), (copied, copied_by) = facts["held_out_db"], facts["nearest_picture_db"]
    lines = [
        f"{facts['gaussians']:,} Gaussians from {facts['pictures']} pictures in {facts['seconds']:.0f} s",
        f"{facts['held_out']} held-out pictures: {ours:.1f} dB (+-{ours_by:.1f}); copying the nearest picture: "
        f"{copied:.1f} (+-{copied_by:.1f})",
        f"walk in it: {command('terrella', 'play', facts['world'])} (collider: {facts['collider']})",
    ]
    lines += facts["doubts"]
    if left_out := facts["left_out"]:
        more = f", and {len(left_out) - MOST_NAMES} more" if len(left_out) > MOST_NAMES else ""
        lines.append(f"left out (blurred, without overlap, or as named): {', '.join(left_out[:MOST_NAMES])}{more}")
    return SpaceResult(facts, tuple(lines))


@contextlib.contextmanager
def _watched(port: int, progress: Progress) -> Iterator[Watch]:
    with live_page("127.0.0.1", port, lambda address: progress(f"watch it at {address}")) as show:
        yield lambda make, facts: show(lambda: page_scene(make()), facts)


def import_space(file: Path, out: Path, config: ImportSpaceConfig) -> SpaceResult:
    """Makes a world of a file of Gaussians, or of the triangles of a .glb or .gltf."""
    if not 0 < config.scale < float("inf") or not _is_size(config.size):
        raise TerrellaError("--scale is above 0, and --size from 8 to 4096 pixels a side.")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        is_gltf = file.suffix.lower() in GLTF_ENDINGS and config.axes is None
        scene = read_gltf(file, config.scale) if is_gltf else None
        if not isinstance(scene, GltfScene):
            scene = read_scene(file, config.axes)
    if isinstance(scene, GltfScene):
        if config.collider != "auto" or config.inside is not None:
            raise TerrellaError(
                f"{file} holds triangles, which stop walkers as they are; leave --collider and --inside out."
            )
        return _of_triangles(scene, file, out, BuildSpaceConfig.gaussians, config.size)
    if config.scale != 1:
        scene = transform(scene, torch.eye(3), config.scale)
    left_out = list(dict.fromkeys(str(warning.message) for warning in caught))
    look = replace(_splat_config(config.size), inside=config.inside)
    world = world_of(scene, file.stem, {"file": file.name}, look, choice=config.collider)
    save_splat(world, out)
    kind = world.config.collider
    facts = {"gaussians": len(scene), "world": str(out), "collider": kind, "left_out": left_out}
    chosen = f"collider: {kind}" + (" (--collider sets another)" if config.collider == "auto" else "")
    return SpaceResult(facts, (f"{len(scene):,} Gaussians; {chosen}; {command('terrella', 'play', out)}", *left_out))


def build_space(
    source: str | Path | None, out: Path, config: BuildSpaceConfig, *, progress: Progress = silent
) -> SpaceResult:
    """Builds a world of a layout.json, of the triangles of a .glb or .gltf, or of words. The same seed gives the same bytes."""
    layout, text = _layout_or_words(source)
    if (layout is None) == (text is None and config.text is None) or (text and config.text):
        raise TerrellaError('give words ("a long room with two pillars and a red door"), a layout.json or a .glb.')
    if not 1000 <= config.gaussians <= 2_000_000 or not _is_size(config.size):
        raise TerrellaError("--gaussians is from 1,000 to 2,000,000, and --size from 8 to 4096 pixels a side.")
    if layout is not None and layout.suffix.lower() in GLTF_ENDINGS:
        return _of_triangles(read_gltf(layout), layout, out, config.gaussians, config.size)
    if layout is None:
        parsed = parse_text(text or config.text or "", config.seed or 0)
    else:
        rooms = read_layout(layout)
        rooms = rooms if rooms.name else replace(rooms, name=_file_name(layout))
        rooms = rooms if config.seed is None else replace(rooms, seed=config.seed)
        parsed = ParsedText(rooms, asdict(rooms), (), ())
    return _built(parsed, out, config, progress)


def build_plan(plan: Mapping[str, Any], out: Path, *, progress: Progress = silent) -> SpaceResult:
    """Builds a world of a floor plan that was drawn: rectangles for rooms, spots for things, words for the style
    (space/layout/drawn_plan.py). ContractError for a plan that cannot be built."""
    return _built(layout_of_plan(plan), out, BuildSpaceConfig(), progress)


def _built(parsed: ParsedText, out: Path, config: BuildSpaceConfig, progress: Progress) -> SpaceResult:
    check_free(out)
    place = build(parsed.layout, config.gaussians, progress)
    progress("saving the place")
    card: dict[str, Any] = {"objects": list(place.names), "gaussians_asked": config.gaussians}
    if parsed.text:
        card |= {"text": parsed.text, "not_understood": list(parsed.unknown), "no_place_for": list(parsed.left_out)}
    save_built(place, parsed, out, config.size, card)
    return _built_result(place, parsed, out)


def _layout_or_words(source: str | Path | None) -> tuple[Path | None, str | None]:
    """A file, or words: whatever is no file and does not end like one."""
    if source is None:
        return None, None
    file = Path(source)
    words = isinstance(source, str) and not file.is_file() and file.suffix.lower() not in (".json", *GLTF_ENDINGS)
    return (None, str(source)) if words else (file, None)


def _file_name(file: Path) -> str:
    """The name of a place that a file describes: the file's, or that of its folder if it is a layout.json."""
    folder = file.resolve().parent.name
    return folder if file.name == LAYOUT_FILE and folder else file.stem


def _built_result(place: BuiltPlace, parsed: ParsedText, out: Path) -> SpaceResult:
    movable = [place.names[number - 1] for number in sorted(set(place.bodies.tolist()) - {0})]
    facts = {
        "world": str(out), "gaussians": len(place.gaussians), "rooms": len(parsed.layout.rooms), "objects": list(place.names),
        "movable": movable, "not_understood": list(parsed.unknown), "no_place_for": list(parsed.left_out),
    }  # fmt: skip
    contents = [amount(many, name) for name, many in Counter(place.names).items()]
    lines = [", ".join([f"{len(place.gaussians):,} Gaussians", amount(len(parsed.layout.rooms), "room"), *contents])]
    if movable:
        without = "" if find_spec("mujoco") else " (once MuJoCo is installed: pip install 'terrella[mujoco]')"
        lines.append(f"can be pushed: {', '.join(movable)}{without}")
    lines += unheeded(facts)
    return SpaceResult(facts, (*lines, f"walk in it: {command('terrella', 'play', out)}"))


def amount(many: int, what: str) -> str:
    """A number of things in words: "1 room", "1,200 frames"."""
    plural = what if what.endswith("s") else re.sub("(ch|sh|x)$", r"\1e", re.sub("f$", "ve", what)) + "s"
    return f"{many:,} {what if many == 1 else plural}"


def save_built(
    place: BuiltPlace,
    parsed: ParsedText,
    out: Path,
    size: tuple[int, int],
    card: dict[str, Any],
    keep_edits: bool = False,
) -> None:
    """Saves a built place and its layout in the folder `out`. size: height and width of its pictures; card: what world.json says
    of it; keep_edits: it replaces the place there, whose edits stay."""
    starts = place.starts.clone()
    starts[:, 2] += WALKER.eye_m
    origin = torch.where(place.objects < 0, INVENTED, OBSERVED).to(torch.uint8)
    world = SplatWorld(
        parsed.layout.name, place.gaussians, origin, starts, _splat_config(size, WALKER), card, place.objects,
        SolidBoxes(place.solids, place.bodies),
    )  # fmt: skip
    save_splat(world, out, keep_edits)
    replace_whole(out / LAYOUT_FILE, lambda file: file.write_text(json.dumps(parsed.document, indent=1) + "\n"))


def _of_triangles(
    scene: GltfScene | Gaussians, file: Path, out: Path, gaussians: int, size: tuple[int, int]
) -> SpaceResult:
    """Makes a world of the triangles of a file."""
    if not isinstance(scene, GltfScene):
        raise DatasetError(f"{file} holds Gaussians; `terrella space import` makes a world of them.")
    splats, objects, solids = of_triangles(scene, gaussians)
    names = list(scene.names)
    card = {"file": file.name, "objects": names}
    save_splat(world_of(splats, file.stem, card, _splat_config(size, WALKER), objects, SolidBoxes.of(solids)), out)
    facts: Mapping[str, Any] = {
        "world": str(out), "gaussians": len(splats), "triangles": len(scene.corners), "objects": names,
        "lights": len(scene.lights), "boxes": None if solids is None else len(solids), "left_out": list(scene.left_out),
    }  # fmt: skip
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    text = f"{len(splats):,} Gaussians of {len(scene.corners):,} triangles, {len(scene.lights)} light(s): {shown}"
    more = [f"left out: {', '.join(scene.left_out)}"] if scene.left_out else []
    return SpaceResult(facts, (text, *more, f"walk in it: {command('terrella', 'play', out)}"))


def _is_size(size: tuple[int, int]) -> bool:
    """Whether pictures may have this height and width, in pixels."""
    return min(size) >= 8 and max(size) <= 4096


def _splat_config(size: tuple[int, int], walker: Walker | None = None) -> SplatConfig:
    """A camera with square pixels whose picture is 90 degrees wide."""
    return SplatConfig((0.5, 0.5 * size[1] / size[0], 0.5, 0.5), size, body=walker or Walker())
