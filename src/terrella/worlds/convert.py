"""convert_world: a world folder of format version 2 (one config for all, weights by older names) as one of version 3."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from ..core.errors import CheckpointError
from .checkpoint import data_file, read_about, read_data
from .config import VideoConfig
from .controls import Controls
from .folder import KIND, VERSION, first_line, load_world, write_world
from .parts import Absent

OLD_KIND, OLD_VERSION = "video", 2
PARTS = {"motion": "body", "cast": "objects", "eye": "estimator", "doubt": "uncertainty"}  # the others are the same
LAYERS = {"leave": "output", "time": "context"}  # in generator, estimator and uncertainty
RETIRED = ("own_keyframes",)  # settings that no longer exist


def convert_world(old: str | Path, new: str | Path) -> None:
    """Writes the world in the folder `old`, of format version 2, to the new folder `new`; pictures stay byte for byte.
    CheckpointError where `old` is no such world, or `new` holds files."""
    old, new = Path(old), Path(new)
    about = read_about(old)
    if (about.get("kind"), about.get("version")) != (OLD_KIND, OLD_VERSION):
        kind = f"kind {about.get('kind')!r}, version {about.get('version')}"
        raise CheckpointError(f"{old} is {kind}; only kind '{OLD_KIND}' of version {OLD_VERSION} needs converting.")
    if new.resolve() == old.resolve():
        raise CheckpointError(f"{old} cannot be converted in place; name a new folder.")
    if new.exists() and any(new.iterdir()):
        raise CheckpointError(f"{new} is not empty; name a new folder.")
    try:
        about, (weights, memory) = read_data(old, about, "weights", "memory")
        renamed = {_renamed(name): value for name, value in weights.items()}
        write_world(new, _described(about, memory), renamed, data_file(old, "memory", about).read_bytes())
    except (OSError, SafetensorError, LookupError, TypeError, ValueError) as error:
        raise CheckpointError(f"{old} cannot be converted ({first_line(error)}); copy or train it again.") from error
    load_world(new)


def _described(about: dict, memory: dict[str, torch.Tensor]) -> dict:
    """What world.json of version 3 says of such a world."""
    config = _config(about["config"])
    posed, (usual, ending) = config.geometry, about["rewards"]
    outcome = _part("constant", {"usual": usual, "ending": ending if posed else 0.0})
    if about.get("outcome"):
        begins = list(config.vitals)
        if not posed and "starts.vitals" in memory:  # such worlds began with the usual ones of recordings
            begins = memory["starts.vitals"].median(0).values.tolist()
        outcome = _part("frames", {**about["outcome"], "begins": begins})
    parts = {
        "body": _part("motion", asdict(config.motion) if posed else None),
        "scene": _part("keyframes", asdict(config.keyframes)) if posed else _part("history", asdict(config.frames)),
        "generator": _part("unet", asdict(config.generator)),
        "objects": _part("billboards", about.get("cast")),
        "outcome": outcome,
        "uncertainty": _part("network", about.get("doubt")),
        "estimator": _part("network", about.get("eye")),
    }
    controls = about.get("controls") or asdict(Controls.buttons(config.actions))
    played = {name: about[name] for name in ("dt_s", "action_names", "keys")}
    card = {
        {"eye": "estimator"}.get(name, name).replace("cast_", "objects_"): fact for name, fact in about["card"].items()
    }
    return {
        "kind": KIND,
        "version": VERSION,
        "name": about["name"],
        "about": {"controls": controls, **played, "ignored": []},
        "parts": parts,
        "card": card,
    }


def _config(saved: dict) -> VideoConfig:
    settings: dict[str, Any] = {}
    for name, value in saved.items():
        if name not in RETIRED:
            settings["objects" if name == "cast" else name] = tuple(value) if isinstance(value, list) else value
    return VideoConfig(**settings)


def _part(kind: str, config: dict | None) -> dict:
    """A part of this kind, or none without its settings."""
    return {"kind": kind, "config": config} if config else {"kind": Absent.kind, "config": None}


def _renamed(name: str) -> str:
    part, *rest = name.split(".")
    if part in ("generator", "eye", "doubt"):
        rest = [LAYERS.get(word, word) for word in rest]
    return ".".join([PARTS.get(part, part), *rest])
