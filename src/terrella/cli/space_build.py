"""The command `terrella space build`: words or a layout as a place to walk in."""

from __future__ import annotations

import json as json_text
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from .say import Json, result

LAYOUT_FILE = "layout.json"


def build(
    layout: Positional[Path | None] = None,
    text: str | None = None,
    *,
    out: Path,
    gaussians: int = 120_000,
    seed: int | None = None,
    size: tuple[int, int] = (192, 256),
    json: Json = False,
) -> None:
    """Make a place to walk in: of a layout.json (rooms, doors, windows, stairs, furniture), or of words. Same seed, same bytes.

    Args:
        layout: The layout.
        text: Words instead: "a long room with two pillars and a red door". The layout that they became lies in OUT/layout.json.
        out: Folder of the world.
        gaussians: About how many.
        seed: Of what the words or the layout leave to chance.
        size: Height and width of the pictures.
    """
    from ..core.errors import TerrellaError
    from ..space.layout import build as built
    from ..space.layout import read_plan, understood

    if (layout is None) == (text is None):
        raise TerrellaError('give a layout.json, or --text "a long room with two pillars and a red door".')
    if not 1000 <= gaussians <= 2_000_000 or min(size) < 8 or max(size) > 4096:
        raise TerrellaError("--gaussians is from 1,000 to 2,000,000, and --size from 8 to 4096 pixels a side.")
    unknown: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    if text is not None:
        heard = understood(text, seed or 0)
        plan, unknown, left_out, said = heard.plan, heard.unknown, heard.left_out, heard.layout
    else:
        plan = read_plan(layout or "")
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
    from ..space.occupancy import Body
    from ..worlds.additions import INVENTED, OBSERVED
    from ..worlds.splat import SplatConfig, SplatWorld
    from ..worlds.splat_folder import save_splat

    body = Body(eye_m=1.65, step_m=0.35)
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
