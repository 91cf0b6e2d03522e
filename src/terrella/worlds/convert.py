"""convert_world: a world folder of format version 2 (one config for all, weights by older names) as one of version 3."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from ..core.errors import CheckpointError
from .config import VideoConfig
from .controls import Controls
from .folder import KIND, MEMORY_FILE, VERSION, WEIGHTS_FILE, first_line, load_world, read_about, write_folder
from .parts import Absent

OLD_KIND, OLD_VERSION = "video", 2
PARTS = {"motion": "body", "cast": "objects", "eye": "estimator", "doubt": "uncertainty"}  # the others keep their names
LAYERS = {"leave": "output", "time": "context"}  # of generator, estimator and uncertainty
RETIRED = ("own_keyframes",)  # settings that mean nothing any more


def convert_world(old: str | Path, new: str | Path) -> None:
    """Writes the world in the folder `old`, of format version 2, to the folder `new`. Nothing is lost: weights are copied, and
    the remembered pictures stay byte for byte.

    CheckpointError where `old` is no such world, or `new` is a folder with files in it, `old` itself among them.
    """
    old, new = Path(old), Path(new)
    about = read_about(old)
    if (about.get("kind"), about.get("version")) != (OLD_KIND, OLD_VERSION):
        found = f"kind {about.get('kind')!r}, version {about.get('version')}"
        raise CheckpointError(f"{old} is {found}; only kind '{OLD_KIND}' of version {OLD_VERSION} needs converting.")
    if new.resolve() == old.resolve():
        raise CheckpointError(f"{old} cannot be converted in place; name a new folder.")
    if new.exists() and any(new.iterdir()):
        raise CheckpointError(f"{new} is not empty; name a new folder.")
    try:
        weights, remembered = load_file(old / WEIGHTS_FILE), (old / MEMORY_FILE).read_bytes()
        starts = load_file(old / MEMORY_FILE)
        told = _described(about, starts)
        write_folder(new, told, {_renamed(name): value for name, value in weights.items()}, remembered)
    except (OSError, SafetensorError, LookupError, TypeError, ValueError) as error:
        raise CheckpointError(f"{old} cannot be converted ({first_line(error)}); copy or train it again.") from error
    load_world(new)


def _described(about: dict, starts: dict[str, torch.Tensor]) -> dict:
    """What world.json of version 3 says of such a world."""
    config = _config(about["config"])
    posed, (usual, ending) = config.geometry, about["rewards"]
    outcome = _part("constant", {"usual": usual, "ending": ending if posed else 0.0})
    if about.get("outcome"):
        begins = list(config.vitals)
        if not posed and "starts.vitals" in starts:  # such worlds took those that recordings usually begin with
            begins = starts["starts.vitals"].median(0).values.tolist()
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
    said = {name: about[name] for name in ("dt_s", "action_names", "keys")}
    card = {
        {"eye": "estimator"}.get(name, name).replace("cast_", "objects_"): fact for name, fact in about["card"].items()
    }
    return {
        "kind": KIND,
        "version": VERSION,
        "name": about["name"],
        "about": {"controls": controls, **said, "ignored": []},
        "parts": parts,
        "card": card,
    }


def _config(told: dict) -> VideoConfig:
    settings: dict[str, Any] = {}
    for name, value in told.items():
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
