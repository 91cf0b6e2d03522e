"""A learned world on disk: a folder of world.json, weights.safetensors, memory.safetensors and README.md.

Keyframes are stored as JPEG (colour) and zlib-packed uint16 millimetres (depth); nothing is ever unpickled.
"""

from __future__ import annotations

import io
import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
import torch
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ..core.errors import CheckpointError
from ..core.spec import DONE, REWARD, Spec
from ..space.keyframes import Keyframes
from .video import Generator, Motion, VideoConfig, VideoWorld

KIND, VERSION = "video", 1


def save_video_world(world: VideoWorld, path: str | Path, card: dict, quality: int = 92) -> None:
    """Writes the folder; each file is replaced whole. OSError (a full disk) leaves the old files in place."""
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    weights = {f"generator.{k}": v for k, v in world.generator.state_dict().items()}
    weights |= {f"motion.{k}": v for k, v in world.motion.state_dict().items()}
    packed = {f"memory.{k}": v for k, v in _pack(world.memory, quality).items()}
    packed |= {f"starts.{k}": v for k, v in _pack(world.starts, quality).items()}
    about = {
        "kind": KIND,
        "version": VERSION,
        "name": world.spec.name,
        "config": asdict(world.config),
        "rewards": list(world.rewards),
        "dt_s": world.spec.dt_s,
        "action_names": list(world.spec.action_names),
        "keys": dict(world.spec.keys),
        "card": card,
    }
    _replace(path / "weights.safetensors", lambda file: save_file(_whole(weights), file))
    _replace(path / "memory.safetensors", lambda file: save_file(_whole(packed), file))
    _replace(path / "README.md", lambda file: Path(file).write_text(_readme(about)))
    _replace(path / "world.json", lambda file: Path(file).write_text(json.dumps(about, indent=1) + "\n"))


def load_video_world(path: str | Path, memory: bool = True, device: str = "cpu") -> VideoWorld:
    """Reads what `save_video_world` wrote; `memory=False` leaves the recordings' keyframes out (starts stay).

    CheckpointError says what is missing or foreign.
    """
    path = Path(path)
    about = _read_about(path)
    try:
        weights = load_file(path / "weights.safetensors", device)
        packed = load_file(path / "memory.safetensors")
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in about["config"].items()}
        config = VideoConfig(**settings)
        generator, motion = Generator(config), Motion(config)
        generator.load_state_dict({k[10:]: v for k, v in weights.items() if k.startswith("generator.")})
        motion.load_state_dict({k[7:]: v for k, v in weights.items() if k.startswith("motion.")})
        kept = _unpack({k[7:]: v for k, v in packed.items() if k.startswith("memory.")}, config)
        starts = _unpack({k[7:]: v for k, v in packed.items() if k.startswith("starts.")}, config)
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError, zlib.error) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is damaged or incomplete ({first}); copy or train it again.") from error
    spec = video_spec(about["name"], config, about["dt_s"], about["action_names"], about["keys"], about["card"])
    return VideoWorld(
        spec, config, generator, motion, kept if memory else kept.at(slice(0, 0)), starts, tuple(about["rewards"])
    )


def video_spec(name: str, config: VideoConfig, dt_s: float, action_names, keys, card) -> Spec:
    """The spec of a VideoWorld that was learned from a world with these actions and this clock."""
    height, width = config.size
    return Spec(
        name=name,
        action=spaces.MultiBinary(config.actions),
        channels={
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, 100, (height, width), np.float32),
            "pose": spaces.Box(-np.inf, np.inf, (7,), np.float32),
            "reward": REWARD,
            "done": DONE,
        },
        observes=("rgb", "depth", "pose"),
        dt_s=dt_s,
        units={"depth": "m", "pose": "m, quaternion wxyz of T_world_cam"},
        action_names=tuple(action_names),
        keys=keys,
        camera=config.camera,
        card=card,
    )


def _read_about(path: Path) -> dict:
    try:
        about = json.loads((path / "world.json").read_text())
    except FileNotFoundError:
        raise CheckpointError(f"{path} holds no world.json: it is no Terrella world; give the folder of one.") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}/world.json cannot be read ({error}).") from error
    if not isinstance(about, dict) or about.get("kind") != KIND:
        kind = about.get("kind") if isinstance(about, dict) else about
        raise CheckpointError(f"{path} is a world of kind {kind!r}; this loads kind '{KIND}'.")
    if about.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {about.get('version')}, this release reads {VERSION}; train it again."
        )
    return about


def _pack(keys: Keyframes, quality: int) -> dict[str, torch.Tensor]:
    frames = keys.rgb.permute(0, 2, 3, 1).contiguous().numpy()
    jpegs = [simplejpeg.encode_jpeg(frame, quality, colorsubsampling="444") for frame in frames]
    depths = [zlib.compress((d * 1000).round().clamp(0, 65535).numpy().astype("<u2").tobytes(), 9) for d in keys.depth]
    packed = {"pose": keys.pose, "depth_size": torch.tensor(keys.depth.shape[-2:])}
    for name, parts in (("rgb", jpegs), ("depth", depths)):
        packed[f"{name}_bytes"] = torch.from_numpy(np.frombuffer(b"".join(parts) or b"\0", np.uint8).copy())
        packed[f"{name}_ends"] = torch.tensor([len(part) for part in parts], dtype=torch.int64).cumsum(0)
    return packed


def _unpack(packed: dict[str, torch.Tensor], config: VideoConfig) -> Keyframes:
    def parts(name):
        data = packed[f"{name}_bytes"].numpy().tobytes()
        ends = packed[f"{name}_ends"].tolist()
        return [data[a:b] for a, b in zip([0, *ends], ends)]

    height, width = (int(n) for n in packed["depth_size"])
    if len(packed["pose"]) == 0:
        raise CheckpointError("the memory of this world is empty.")
    rgb = np.stack([simplejpeg.decode_jpeg(part) for part in parts("rgb")])
    depth = np.stack([np.frombuffer(zlib.decompress(part), "<u2").reshape(height, width) for part in parts("depth")])
    return Keyframes.of(
        torch.from_numpy(rgb).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(depth.astype(np.float32) / 1000),
        packed["pose"],
        config.camera,
    )


def _whole(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}


def _replace(path: Path, write) -> None:
    partial = path.with_name(path.name + ".partial")
    write(partial)
    partial.replace(path)


def _readme(about: dict) -> str:
    out = io.StringIO()
    out.write(f"# {about['name']}\n\nA world of Terrella, kind `{about['kind']}`: `terrella play` this folder.\n\n")
    for name, value in about["card"].items():
        out.write(f"- **{name}**: {value if not isinstance(value, dict) else json.dumps(value)}\n")
    return out.getvalue()
