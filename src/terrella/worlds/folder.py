"""A learned world on disk: a folder of world.json, weights.safetensors, memory.safetensors and README.md.

Keyframes are stored as JPEG (colour) and zlib-packed uint16 millimetres (depth); nothing is ever unpickled.
"""

from __future__ import annotations

import io
import json
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
import torch
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ..core.errors import CheckpointError
from ..core.spec import DONE, REWARD, Camera, Spec
from ..space.estimator import Estimator, estimator_of, estimator_weights
from ..space.keyframes import Keyframes
from .controls import Controls
from .generator import Generator, VideoConfig
from .history import HistoryWorld, Starts
from .motion import Motion
from .objects import ROWS, Objects, ObjectsConfig
from .outcome import Outcome, OutcomeConfig
from .uncertainty import Uncertainty, uncertainty_of, uncertainty_weights
from .video import VideoWorld

KIND, VERSION = "video", 2
MEMORY_FILE = "memory.safetensors"
Learned = VideoWorld | HistoryWorld
VITAL = spaces.Box(-np.inf, np.inf, (), np.float32)
RETIRED = ("own_keyframes",)  # settings of older worlds that mean nothing any more
RENAMED = {"cast": "objects"}


def save_world(world: Learned, path: str | Path, card: dict, quality: int = 92) -> None:
    """Writes the folder; each file is replaced whole. CheckpointError where it cannot be (a full disk): the old stay."""
    try:
        _save(world, Path(path), card, quality)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be written ({error}); free some space and save it again.") from error


def _save(world: Learned, path: Path, card: dict, quality: int) -> None:
    path.mkdir(parents=True, exist_ok=True)
    weights = {f"generator.{k}": v for k, v in world.generator.state_dict().items()}
    if isinstance(world, VideoWorld):
        weights |= {f"motion.{k}": v for k, v in world.motion.state_dict().items()}
        packed = {f"memory.{k}": v for k, v in _pack(world.memory, quality).items()}
        packed |= {f"starts.{k}": v for k, v in _pack(world.starts, quality).items()}
        rewards = list(world.rewards)
        controls, outcome = Controls.buttons(world.config.actions), world.outcome
    else:
        starts = world.starts
        packed = {f"starts.{k}": v for k, v in _pack_frames(starts.frames.flatten(0, 1), max(quality, 99)).items()}
        packed |= {"starts.actions": starts.actions, "starts.vitals": starts.vitals}
        rewards, controls, outcome = [world.reward, 0.0], world.controls, world.outcome
    if outcome is not None:
        weights |= {f"outcome.{k}": v for k, v in outcome.state_dict().items()}
    estimator, uncertainty = world.estimator if isinstance(world, VideoWorld) else None, world.uncertainty
    objects = world.objects if isinstance(world, VideoWorld) else None
    if objects is not None:
        weights |= {f"cast.{k}": v for k, v in objects.state_dict().items()}
    if estimator is not None:
        weights |= {f"eye.{k}": v for k, v in estimator_weights(estimator).items()}
    if uncertainty is not None:
        weights |= {f"doubt.{k}": v for k, v in uncertainty_weights(uncertainty).items()}
    about = {
        "kind": KIND,
        "version": VERSION,
        "name": world.spec.name,
        "config": asdict(world.config),
        "rewards": rewards,
        "controls": asdict(controls),
        "outcome": asdict(outcome.config) if outcome is not None else None,
        "cast": asdict(objects.config) if objects is not None else None,
        "eye": asdict(estimator.config) if estimator is not None else None,
        "doubt": asdict(uncertainty.config) if uncertainty is not None else None,
        "dt_s": world.spec.dt_s,
        "action_names": list(world.spec.action_names),
        "keys": dict(world.spec.keys),
        "card": card,
    }
    _replace(path / "weights.safetensors", lambda file: save_file(_whole(weights), file))
    _replace(path / MEMORY_FILE, lambda file: save_file(_whole(packed), file))
    _replace(path / "README.md", lambda file: Path(file).write_text(_readme(about)))
    _replace(path / "world.json", lambda file: Path(file).write_text(json.dumps(about, indent=1) + "\n"))


def save_again(world: Learned, path: str | Path, card: dict, source: str | Path) -> None:
    """The same of a world that was loaded from the folder `source`, whose remembered pictures stay as they are: packed again
    they would lose a little."""
    remembered = (Path(source) / MEMORY_FILE).read_bytes()
    save_world(world, path, card)
    _replace(Path(path) / MEMORY_FILE, lambda file: Path(file).write_bytes(remembered))


def load_world(path: str | Path, memory: bool = True, device: str = "cpu", memory_mb: float | None = None) -> Learned:
    """Reads what `save_world` wrote; `memory=False` leaves the recordings' keyframes out (starts stay); `memory_mb` is the
    budget of a story's own memory, where it is not to be the saved one; the generator runs on `device`, geometry on the CPU.

    CheckpointError says what is missing or foreign.
    """
    path = Path(path)
    about = _read_about(path)
    try:
        weights = load_file(path / "weights.safetensors")
        packed = load_file(path / MEMORY_FILE)
        told = {RENAMED.get(k) or k: v for k, v in about["config"].items() if k not in RETIRED}
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in told.items()}
        config = VideoConfig(**settings)
        if memory_mb is not None:
            config = replace(config, memory_mb=memory_mb)
        generator = Generator(config)
        generator.load_state_dict({k[10:]: v for k, v in weights.items() if k.startswith("generator.")})
        controls, outcome = _controls(about, config), _outcome(about, weights)
        vitals = outcome.config.vitals if outcome is not None else ()
        named = (about["dt_s"], about["action_names"], about["keys"], about["card"])
        spec = video_spec(about["name"], config, *named, controls, vitals)
        starts = {k[7:]: v for k, v in packed.items() if k.startswith("starts.")}
        if not config.geometry:
            begun = Starts.of(_unpack_frames(starts).unflatten(0, (-1, config.slots)), config.actions)
            if "actions" in starts:
                begun = replace(begun, actions=starts["actions"], vitals=starts["vitals"])
            told = None if outcome is None else outcome.to(device)
            usual = float(about["rewards"][0])
            uncertainty = _uncertainty(about, weights)
            return HistoryWorld(spec, config, generator.to(device), begun, usual, told, controls, uncertainty)
        motion = Motion(config)
        motion.load_state_dict({k[7:]: v for k, v in weights.items() if k.startswith("motion.")})
        kept = _unpack({k[7:]: v for k, v in packed.items() if k.startswith("memory.")}, config)
        rewards = (float(about["rewards"][0]), float(about["rewards"][1]))
        senses = _estimator(about, weights), _uncertainty(about, weights)
        parts = generator, motion, kept, _unpack(starts, config), rewards, *senses, outcome, _objects(about, weights)
        world = VideoWorld(spec, config, *parts)
    except (
        OSError,
        SafetensorError,
        RuntimeError,
        LookupError,
        AttributeError,
        TypeError,
        ValueError,
        zlib.error,
    ) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is damaged or incomplete ({first}); copy or train it again.") from error
    world.generator.to(device)
    return world if memory else world.without_memory()


def _controls(about: dict, config: VideoConfig) -> Controls:
    """What actions mean; in worlds of earlier releases they are buttons."""
    told = about.get("controls")
    if told is None:
        return Controls.buttons(config.actions)
    return Controls(told["kind"], tuple(told["low"]), tuple(told["high"]))


def _outcome(about: dict, weights: dict[str, torch.Tensor]) -> Outcome | None:
    told = about.get("outcome")
    if told is None:
        return None
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in told.items()}
    outcome = Outcome(OutcomeConfig(**{**settings, "changes": tuple(map(tuple, told["changes"]))}))
    outcome.load_state_dict({k[8:]: v for k, v in weights.items() if k.startswith("outcome.")})
    return outcome


def _objects(about: dict, weights: dict[str, torch.Tensor]) -> Objects | None:
    told = about.get("cast")
    if told is None:
        return None
    objects = Objects(ObjectsConfig(**told))
    try:
        objects.load_state_dict({k[5:]: v for k, v in weights.items() if k.startswith("cast.")})
    except RuntimeError as error:
        raise ValueError("its things are of another make of Terrella, or lost") from error
    return objects


def _estimator(about: dict, weights: dict[str, torch.Tensor]) -> Estimator | None:
    told = about.get("eye")
    return None if told is None else estimator_of(told, {k[4:]: v for k, v in weights.items() if k.startswith("eye.")})


def _uncertainty(about: dict, weights: dict[str, torch.Tensor]) -> Uncertainty | None:
    told = about.get("doubt")
    return (
        None if told is None else uncertainty_of(told, {k[6:]: v for k, v in weights.items() if k.startswith("doubt.")})
    )


def video_spec(
    name: str,
    config: VideoConfig,
    dt_s: float,
    action_names,
    keys,
    card,
    controls: Controls | None = None,
    vitals: tuple[str, ...] = (),
) -> Spec:
    """The spec of a VideoWorld or HistoryWorld that was learned from a world with these actions, clock and vitals."""
    height, width = config.size
    seen: dict[str, spaces.Space] = {"rgb": spaces.Box(0, 255, (height, width, 3), np.uint8)}
    units = {}
    if config.geometry:
        seen["depth"] = spaces.Box(0, 100, (height, width), np.float32)
        seen["pose"] = spaces.Box(-np.inf, np.inf, (7,), np.float32)
        units = {"depth": "m", "pose": "m, quaternion wxyz of T_world_cam"}
    marks: dict[str, spaces.Space] = {}
    if config.moving:
        marks["things"] = spaces.Box(0, 1, (height, width), np.bool_)  # pyright: ignore
    if config.objects:
        marks["instances"] = spaces.Box(0, ROWS, (height, width), np.uint8)
        marks["objects"] = spaces.Box(-np.inf, np.inf, (ROWS, 4), np.float32)
    return Spec(
        name=name,
        action=(controls or Controls.buttons(config.actions)).space(),
        channels={**seen, **marks, "reward": REWARD, "done": DONE, **dict.fromkeys(vitals, VITAL)},
        observes=tuple(seen),
        dt_s=dt_s,
        units=units,
        action_names=tuple(action_names),
        keys=keys,
        cameras={"rgb": Camera(config.camera, config.size)} if config.geometry else {},
        card=card,
        may_observe=(*marks, *vitals),
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
