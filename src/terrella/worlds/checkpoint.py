"""A checkpoint on disk: a folder of world.json and data files, replaced as a whole.

New data goes to files of new names; the rename of a new world.json, which names them, then swaps all of it in one step. So a
reader sees the old world or the new one, also when the writer is killed at any point.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import torch
from safetensors.torch import load_file, save

from ..core.errors import CheckpointError
from ..core.files import write_bytes, write_text

WORLD_FILE, README_FILE = "world.json", "README.md"
FILES = "files"  # the key of world.json: data files by name; one that is not listed is NAME.safetensors
Tensors = Mapping[str, torch.Tensor]


def write_checkpoint(path: str | Path, about: Mapping, data: Mapping[str, Tensors | bytes], readme: str) -> None:
    """Makes or replaces the checkpoint in the folder `path`. about: what world.json says; data: by name, such as "weights", the
    tensors or the bytes of a safetensors file. OSError or SafetensorError where it cannot be written: the old one stays."""
    path = Path(path)
    replaces = (path / WORLD_FILE).exists()
    files = {}
    for name, content in data.items():
        whole = content if isinstance(content, bytes) else save(_whole(content))
        files[name] = f"{name}-{hashlib.sha256(whole).hexdigest()[:16]}.safetensors" if replaces else _plain(name)
        write_bytes(path / files[name], whole)
    renamed = {name: file for name, file in files.items() if file != _plain(name)}
    write_about(path, {**about, **({FILES: renamed} if renamed else {})})
    write_text(path / README_FILE, readme)
    for old in path.glob("*.safetensors"):
        if old.name not in files.values() and re.fullmatch(rf"({'|'.join(files)})(-[0-9a-f]{{16}})?", old.stem):
            with suppress(OSError):  # on Windows a reader may still have it open; the next save removes it
                old.unlink()


def write_about(path: Path, about: Mapping) -> None:
    """Replaces world.json."""
    write_text(path / WORLD_FILE, json.dumps(about, indent=1) + "\n")


def read_about(path: str | Path) -> dict:
    """What world.json says; CheckpointError where there is none, or none that can be read."""
    path = Path(path)
    try:
        about = json.loads((path / WORLD_FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(f"{path} holds no world.json: it is no Terrella world; give the folder of one.") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}/world.json cannot be read ({error}).") from error
    if not isinstance(about, dict) or not isinstance(about.get(FILES, {}), dict):
        raise CheckpointError(f"{path}/world.json describes no world; copy it again.")
    return about


def data_file(path: str | Path, name: str, about: Mapping | None = None) -> Path:
    """The data file `name` of a checkpoint; CheckpointError where world.json names one outside of the folder."""
    about = read_about(path) if about is None else about
    file = str(about.get(FILES, {}).get(name, _plain(name)))
    if Path(file).name != file:
        raise CheckpointError(f"{path}/world.json names the file {file!r}, which is not in its folder; copy it again.")
    return Path(path) / file


def read_data(path: str | Path, about: dict, *names: str) -> tuple[dict, list[dict[str, torch.Tensor]]]:
    """What world.json says, and the tensors of the data files `names`, of one save: of a newer one than `about`, where the
    checkpoint was replaced since that was read."""
    while True:
        try:
            return about, [load_file(data_file(path, name, about)) for name in names]
        except FileNotFoundError:
            newer = read_about(path)
            if newer == about:
                raise
            about = newer


def _plain(name: str) -> str:
    return f"{name}.safetensors"


def _whole(tensors: Tensors) -> dict[str, torch.Tensor]:
    """Tensors on the CPU that share no memory."""
    return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
