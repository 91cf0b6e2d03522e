"""The command `terrella space build`: words, a layout or a scene of triangles as a place to walk in."""

from __future__ import annotations

import json as json_text
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from .say import Json, result

if TYPE_CHECKING:
    from ..space.files.gltf_scene import GltfScene
    from ..space.raster import Gaussians

LAYOUT_FILE, COUNT = "layout.json", 120_000


def build(
    layout: Positional[Path | None] = None,
    text: str | None = None,
    *,
    out: Path,
    gaussians: int = COUNT,
    seed: int | None = None,
    size: tuple[int, int] = (192, 256),
    json: Json = False,
) -> None:
    """Make a place to walk in: of a layout.json (rooms, doors, windows, stairs, furniture), of triangles of another tool (.glb,
    .gltf), or of words. Same seed, same bytes.

    Args:
        layout: The layout, or the .glb or .gltf.
        text: Words instead: "a long room with two pillars and a red door". The layout that they became lies in OUT/layout.json.
        out: Folder of the world.
        gaussians: About how many.
        seed: Of what the words or the layout leave to chance.
        size: Height and width of the pictures.
    """
    from ..core.errors import TerrellaError
    from ..space.files.gltf_scene import GLTF_ENDINGS, read_gltf
    from ..space.layout import build as built
    from ..space.layout import parse_text, read_layout

    if (layout is None) == (text is None):
        raise TerrellaError('give a layout.json or a .glb, or --text "a long room with two pillars and a red door".')
    if not 1000 <= gaussians <= 2_000_000 or min(size) < 8 or max(size) > 4096:
        raise TerrellaError("--gaussians is from 1,000 to 2,000,000, and --size from 8 to 4096 pixels a side.")
    if layout is not None and layout.suffix.lower() in GLTF_ENDINGS:
        return of_scene(read_gltf(layout), layout, out, gaussians, size, json)
    unknown: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    if text is not None:
        heard = parse_text(text, seed or 0)
        plan, unknown, left_out, said = heard.layout, heard.unknown, heard.left_out, heard.document
    else:
        plan = read_layout(layout or "")
        plan = plan if seed is None else replace(plan, seed=seed)
        said = asdict(plan)
    place = built(plan, gaussians)
    _save(place, plan.name, text, size, out, said)
    pushed = [place.names[number - 1] for number in sorted(set(place.bodies.tolist()) - {0})]
    facts = {
        "world": str(out), "gaussians": len(place.gaussians), "rooms": len(plan.rooms), "objects": list(place.names),
        "movable": pushed, "not_understood": list(unknown), "no_place_for": list(left_out),
    }  # fmt: skip
    lines = [
        f"{len(place.gaussians):,} Gaussians, {len(plan.rooms)} room(s), {', '.join(place.names) or 'nothing'} in them"
    ]
    if pushed:
        without = "" if find_spec("mujoco") else " (once MuJoCo is installed: pip install 'terrella[mujoco]')"
        lines.append(f"can be pushed: {', '.join(pushed)}{without}")
    if unknown:
        lines.append(f"not understood: {', '.join(unknown)}")
    if left_out:
        lines.append(f"no place was left for: {', '.join(left_out)}")
    result(facts, json, "\n".join([*lines, f"walk in it: terrella play {out}"]))


def _save(place: Any, name: str, text: str | None, size: tuple[int, int], out: Path, said: dict[str, Any]) -> None:
    import torch

    from ..space.files import replace_whole
    from ..space.occupancy import Walker
    from ..worlds.additions import INVENTED, OBSERVED
    from ..worlds.splat import SplatConfig, SplatWorld
    from ..worlds.splat_folder import save_splat

    body = Walker(eye_m=1.65, step_m=0.35)
    starts = place.starts.clone()
    starts[:, 2] += body.eye_m
    known = OBSERVED if text is None else INVENTED  # what a layout states is given; of words much is guessed
    config = SplatConfig((0.5, 0.5 * size[1] / size[0], 0.5, 0.5), size, body=body)
    card = {"objects": list(place.names), **({"text": text} if text else {})}
    origin = torch.full((len(place.gaussians),), known, dtype=torch.uint8)
    save_splat(
        SplatWorld(name, place.gaussians, origin, starts, config, card, place.objects, place.solids, place.bodies), out
    )
    replace_whole(out / LAYOUT_FILE, lambda file: file.write_text(json_text.dumps(said, indent=1) + "\n"))


def of_scene(
    scene: GltfScene | Gaussians, file: Path, out: Path, gaussians: int, size: tuple[int, int], json: bool
) -> None:
    """Make a place to walk in of the triangles of a file."""
    from ..core.errors import DatasetError
    from ..space.files.gltf_scene import GltfScene
    from ..space.layout.meshes import of_triangles
    from ..space.occupancy import Walker
    from ..worlds.splat import SplatConfig
    from ..worlds.splat_folder import save_splat, world_of

    if not isinstance(scene, GltfScene):
        raise DatasetError(f"{file} holds Gaussians; `terrella space import` makes a world of them.")
    config = SplatConfig((0.5, 0.5 * size[1] / size[0], 0.5, 0.5), size, body=Walker(eye_m=1.65, step_m=0.35))
    found, objects, solids = of_triangles(scene, gaussians)
    names = list(scene.names)
    world = world_of(found, file.stem, {"file": file.name, "objects": names}, config, objects, solids)
    save_splat(world, out)
    facts = {
        "world": str(out), "gaussians": len(found), "triangles": len(scene.corners), "objects": names, "lights": len(scene.lights),
        "boxes": None if solids is None else len(solids),
    }  # fmt: skip
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    text = f"{len(found):,} Gaussians of {len(scene.corners):,} triangles, {len(scene.lights)} light(s): {shown}"
    result(facts, json, f"{text}\nwalk in it: terrella play {out}")
