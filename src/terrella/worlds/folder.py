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
from .history import HistoryWorld
from .video import Generator, Motion, VideoConfig, VideoWorld

KIND, VERSION = "video", 2


def save_world(world: VideoWorld | HistoryWorld, path: str | Path, card: dict, quality: int = 92) -> None:
    """Writes the folder; each file is replaced whole. CheckpointError where it cannot be (a full disk): the old stay."""
    try:
        _save(world, Path(path), card, quality)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be written ({error}); free some space and save it again.") from error


def _save(world: VideoWorld | HistoryWorld, path: Path, card: dict, quality: int) -> None:
    path.mkdir(parents=True, exist_ok=True)
    weights = {f"generator.{k}": v for k, v in world.generator.state_dict().items()}
    if isinstance(world, VideoWorld):
        weights |= {f"motion.{k}": v for k, v in world.motion.state_dict().items()}
        packed = {f"memory.{k}": v for k, v in _pack(world.memory, quality).items()}
        packed |= {f"starts.{k}": v for k, v in _pack(world.starts, quality).items()}
        rewards = list(world.rewards)
    else:
        packed = {f"starts.{k}": v for k, v in _pack_frames(world.starts.flatten(0, 1), quality).items()}
        rewards = [world.reward, 0.0]
    about = {
        "kind": KIND,
        "version": VERSION,
        "name": world.spec.name,
        "config": asdict(world.config),
        "rewards": rewards,
        "dt_s": world.spec.dt_s,
        "action_names": list(world.spec.action_names),
        "keys": dict(world.spec.keys),
        "card": card,
    }
    _replace(path / "weights.safetensors", lambda file: save_file(_whole(weights), file))
    _replace(path / "memory.safetensors", lambda file: save_file(_whole(packed), file))
    _replace(path / "README.md", lambda file: Path(file).write_text(_readme(about)))
    _replace(path / "world.json", lambda file: Path(file).write_text(json.dumps(about, indent=1) + "\n"))


def load_world(path: str | Path, memory: bool = True, device: str = "cpu") -> VideoWorld | HistoryWorld:
    """Reads what `save_world` wrote; `memory=False` leaves the recordings' keyframes out (starts stay); the generator runs on
    `device`, geometry on the CPU.

    CheckpointError says what is missing or foreign.
    """
    path = Path(path)
    about = _read_about(path)
    try:
        weights = load_file(path / "weights.safetensors")
        packed = load_file(path / "memory.safetensors")
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in about["config"].items()}
        config = VideoConfig(**settings)
        generator = Generator(config)
        generator.load_state_dict({k[10:]: v for k, v in weights.items() if k.startswith("generator.")})
        spec = video_spec(about["name"], config, about["dt_s"], about["action_names"], about["keys"], about["card"])
        starts = {k[7:]: v for k, v in packed.items() if k.startswith("starts.")}
        if not config.geometry:
            frames = _unpack_frames(starts).unflatten(0, (-1, config.slots))
            return HistoryWorld(spec, config, generator.to(device), frames, float(about["rewards"][0]))
        motion = Motion(config)
        motion.load_state_dict({k[7:]: v for k, v in weights.items() if k.startswith("motion.")})
        kept = _unpack({k[7:]: v for k, v in packed.items() if k.startswith("memory.")}, config)
        rewards = (float(about["rewards"][0]), float(about["rewards"][1]))
        world = VideoWorld(spec, config, generator, motion, kept, _unpack(starts, config), rewards)
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError, zlib.error) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is damaged or incomplete ({first}); copy or train it again.") from error
    world.generator.to(device)
    return world if memory else world.without_memory()


def video_spec(name: str, config: VideoConfig, dt_s: float, action_names, keys, card) -> Spec:
    """The spec of a VideoWorld that was learned from a world with these actions and this clock."""
    height, width = config.size
    seen: dict[str, spaces.Space] = {"rgb": spaces.Box(0, 255, (height, width, 3), np.uint8)}
    units = {}
    if config.geometry:
        seen["depth"] = spaces.Box(0, 100, (height, width), np.float32)
        seen["pose"] = spaces.Box(-np.inf, np.inf, (7,), np.float32)
        units = {"depth": "m", "pose": "m, quaternion wxyz of T_world_cam"}
    return Spec(
        name=name,
        action=spaces.MultiBinary(config.actions),
        channels={**seen, "reward": REWARD, "done": DONE},
        observes=tuple(seen),
        dt_s=dt_s,
        units=units,
        action_names=tuple(action_names),
        keys=keys,
        camera=config.camera if config.geometry else None,
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
    depths = [zlib.compress((d * 1000).round().clamp(0, 65535).numpy().astype("<u2").tobytes(), 9) for d in keys.depth]
    about = {"pose": keys.pose, "depth_size": torch.tensor(keys.depth.shape[-2:])}
    return {**about, **_pack_frames(keys.rgb, quality), **_pack_parts("depth", depths)}


def _pack_frames(rgb: torch.Tensor, quality: int) -> dict[str, torch.Tensor]:
    """uint8 [N, 3, H, W] as JPEG without chroma subsampling."""
    frames = rgb.permute(0, 2, 3, 1).contiguous().numpy()
    return _pack_parts("rgb", [simplejpeg.encode_jpeg(frame, quality, colorsubsampling="444") for frame in frames])


def _pack_parts(name: str, parts: list[bytes]) -> dict[str, torch.Tensor]:
    data = torch.from_numpy(np.frombuffer(b"".join(parts) or b"\0", np.uint8).copy())
    return {f"{name}_bytes": data, f"{name}_ends": torch.tensor([len(p) for p in parts], dtype=torch.int64).cumsum(0)}


def _unpack(packed: dict[str, torch.Tensor], config: VideoConfig) -> Keyframes:
    height, width = (int(n) for n in packed["depth_size"])
    depth = [np.frombuffer(zlib.decompress(p), "<u2").reshape(1, height, width) for p in _parts(packed, "depth")]
    metres = torch.from_numpy(np.concatenate([np.zeros((0, height, width), "<u2"), *depth]).astype(np.float32) / 1000)
    return Keyframes.of(_unpack_frames(packed), metres, packed["pose"], config.camera)


def _unpack_frames(packed: dict[str, torch.Tensor]) -> torch.Tensor:
    decoded = [simplejpeg.decode_jpeg(part) for part in _parts(packed, "rgb")]
    frames = np.stack(decoded) if decoded else np.zeros((0, 2, 2, 3), np.uint8)
    return torch.from_numpy(frames).permute(0, 3, 1, 2).contiguous()


def _parts(packed: dict[str, torch.Tensor], name: str) -> list[bytes]:
    data, ends = packed[f"{name}_bytes"].numpy().tobytes(), packed[f"{name}_ends"].tolist()
    return [data[a:b] for a, b in zip([0, *ends], ends)]


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
