"""A SplatWorld on disk: a folder of world.json, scene.safetensors and README.md; and one made of a file of another tool."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ..core.errors import CheckpointError
from ..space.camera import planar_pose
from ..space.files import replace_whole
from ..space.occupancy import Body
from ..space.raster import Gaussians
from .splat import OBSERVED, SplatConfig, SplatWorld

KIND, VERSION = "splat", 1
WORLD_FILE, SCENE_FILE = "world.json", "scene.safetensors"


def save_splat(world: SplatWorld, path: str | Path) -> None:
    """Writes the folder; each file is replaced whole."""
    path = Path(path)
    about = {
        "kind": KIND, "version": VERSION, "name": world.name, "config": asdict(world.config), "card": dict(world.card),
    }  # fmt: skip
    tensors = {**vars(world.gaussians), "provenance": world.provenance, "starts": world.starts}
    whole = {name: part.detach().clone().contiguous() for name, part in tensors.items()}
    replace_whole(path / SCENE_FILE, lambda file: save_file(whole, file))
    lines = (
        f"# {world.name}\n\nA place of {len(world.gaussians):,} Gaussians: `terrella play {path.name}` walks in it.\n"
    )
    replace_whole(path / "README.md", lambda file: file.write_text(lines))
    replace_whole(path / WORLD_FILE, lambda file: file.write_text(json.dumps(about, indent=1) + "\n"))


def load_splat(path: str | Path, about: dict[str, Any]) -> SplatWorld:
    """Reads what `save_splat` wrote; `about`: what its world.json says. CheckpointError where it is foreign or damaged."""
    path = Path(path)
    if about.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {about.get('version')}, this release reads {VERSION}; update Terrella."
        )
    try:
        tensors, said = load_file(path / SCENE_FILE), dict(about["config"])
        body = Body(**said.pop("body"))
        given: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in said.items()}
        config = SplatConfig(body=body, **given)
        provenance, starts = tensors.pop("provenance"), tensors.pop("starts")
        if len(provenance) != len(tensors["means"]) or starts.ndim != 2 or starts.shape[1] != 7 or not len(starts):
            raise ValueError("its parts do not fit one another")
        return SplatWorld(str(about["name"]), Gaussians(**tensors), provenance, starts, config, dict(about["card"]))
    except (OSError, SafetensorError, LookupError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path} is damaged or incomplete ({error}); make it again.") from error


def world_of(gaussians: Gaussians, name: str, card: dict[str, Any], config: SplatConfig) -> SplatWorld:
    """A world of Gaussians of which nobody said where one stands in them: in the free place with a floor that is nearest to their
    middle, looking eight ways."""
    observed = torch.full((len(gaussians),), OBSERVED, dtype=torch.uint8)
    world = SplatWorld(name, gaussians, observed, torch.zeros(1, 7), config, card)
    some = gaussians.means[:: max(len(gaussians) // 100_000, 1)]
    low, middle, high = torch.quantile(some, torch.tensor([0.05, 0.5, 0.95]), dim=0)
    rng = torch.Generator().manual_seed(0)
    wide = low + (high - low) * torch.rand(400, 3, generator=rng)
    places = torch.cat([middle[None], wide])
    grounded = torch.cat([places[:, :2], (world.occupancy.floor(places, config.body) + config.body.eye_m)[:, None]], 1)
    stands = ~world.occupancy.blocked(grounded, config.body)
    places = torch.where(stands[:, None], grounded, places)
    order = (places - middle).norm(dim=1) + 1e3 * ~stands
    x, y, z = places[order.argmin()].expand(8, 3).unbind(1)
    return SplatWorld(name, gaussians, observed, planar_pose(x, y, z, torch.arange(8) * (torch.pi / 4)), config, card)
