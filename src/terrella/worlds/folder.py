"""Learned and latent worlds on disk: a folder of world.json, weights.safetensors, memory.safetensors and README.md.

world.json names each part's kind and settings; the weights are tensors named PART.NAME. Keyframes are stored as JPEG (colour)
and zlib-packed uint16 millimetres (depth); nothing is ever unpickled. A folder is replaced as a whole (checkpoint.py).
"""

import json
import shlex
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
import torch
from safetensors import SafetensorError
from torch import nn

from ..core.errors import CheckpointError
from ..core.files import remedy_of
from ..core.spec import Camera, Spec
from ..space.estimator import Estimator, EstimatorConfig, half_weights, load_weights
from ..space.keyframes import Keyframes
from . import splat_folder
from .body import Motion, MotionBody
from .checkpoint import WORLD_FILE, Tensors, data_file, read_about, read_data, write_about, write_checkpoint
from .config import GeneratorConfig, HistoryConfig, KeyframesConfig, MotionConfig
from .controls import Controls
from .flow import FlowConfig, FlowNetwork
from .frame_history import FrameHistory, StartClips
from .generator import UNet
from .keyframe_scene import KeyframeScene
from .latent import LatentWorld
from .latent_network import LatentConfig, LatentNetwork
from .learned import About, LearnedWorld
from .objects import Billboards, BillboardsConfig
from .outcome import ConstantConfig, ConstantOutcome, FrameOutcome, OutcomeConfig
from .parts import Absent
from .splat import SplatWorld
from .uncertainty import UncertaintyConfig, UncertaintyNetwork

KIND, VERSION = "learned", 3
LATENT, LATENT_VERSION = "latent", 1
Make = Callable[[Any, Tensors, Tensors], Any]
# What reading a damaged folder may raise.
DAMAGE = OSError, SafetensorError, RuntimeError, LookupError, AttributeError, TypeError, ValueError, zlib.error

RETIRED = ("fog_px",)  # settings that no longer exist
HALVED = ("uncertainty", "estimator")  # parts stored in half precision; so are the weights of a flow network


def save_world(
    world: LearnedWorld,
    path: str | Path,
    card: Mapping | None = None,
    quality: int = 92,
    remembered: str | Path | None = None,
) -> None:
    """Makes or replaces the folder as a whole. card: facts in place of the world's own. quality: of JPEG, 1..100. remembered: the
    folder that the world was loaded from, whose pictures stay as they are; to pack them again would lose a little.

    CheckpointError where it cannot be written, for example on a full disk: the old world stays.
    """
    weights, parts = {}, {}
    for name, part in world.parts.items():
        weights |= {f"{name}.{key}": value for key, value in _weights(name, part).items()}
        parts[name] = {"kind": part.kind, "config": part.config and asdict(part.config)}
    about = _described(KIND, VERSION, world.about, parts) | ({} if card is None else {"card": dict(card)})
    try:
        if remembered is None:
            memory = PACKED[world.scene.kind](world.scene, quality)
        else:
            memory = data_file(remembered, "memory").read_bytes()
        write_world(path, about, weights, memory)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be written ({error}); {remedy_of(error)} and save it again.") from error


def save_latent(world: LatentWorld, path: str | Path) -> None:
    """Makes or replaces the folder of a latent world; CheckpointError where it cannot be written."""
    network = world.network
    parts = {"network": {"kind": network.kind, "config": asdict(network.config)}}
    try:
        about = _described(LATENT, LATENT_VERSION, world.about, parts)
        write_world(path, about, network.state_dict(), {"starts": world.starts})
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be written ({error}); {remedy_of(error)} and save it again.") from error


def _described(kind: str, version: int, about: About, parts: Mapping[str, Any]) -> dict[str, Any]:
    """What world.json says."""
    return {
        "kind": kind,
        "version": version,
        "name": about.name,
        "about": {
            "controls": asdict(about.controls), "dt_s": about.dt_s, "action_names": list(about.action_names),
            "keys": dict(about.keys), "ignored": list(about.ignored), "idle": list(about.idle),
            "max_episode_steps": about.max_episode_steps,
            "cameras": {name: asdict(camera) for name, camera in about.cameras.items()},
        },
        "parts": dict(parts),
        "card": dict(about.card),
    }  # fmt: skip


def write_world(path: str | Path, about: dict, weights: Tensors, memory: Tensors | bytes) -> None:
    """The files of a world: what world.json says, the weights, and the memory as tensors or as a file's bytes."""
    write_checkpoint(path, about, {"weights": weights, "memory": memory}, _readme(about))


def save_keys(path: str | Path, spec: Spec) -> None:
    """Writes the keys, the names of the actions and the idle action into a world's folder; the rest of it stays.

    CheckpointError where it is no world's folder, or cannot be written."""
    about = read_about(path)
    try:
        about["about"] |= {
            "keys": {code: list(value) for code, value in spec.keys.items()},
            "action_names": list(spec.action_names),
            "idle": list(spec.idle),
        }
        write_about(Path(path), about)
    except (OSError, LookupError, TypeError) as error:
        raise CheckpointError(f"the keys cannot be written to {path} ({error}).") from error


def load_world(
    path: str | Path, memory: bool = True, device: str = "cpu", memory_mb: float | None = None
) -> LearnedWorld:
    """Reads what `save_world` wrote. memory=False leaves the recordings' keyframes out (starts stay); memory_mb: another budget
    in MiB for an episode's own memory; device: where all of it runs.

    CheckpointError says what is missing or foreign.
    """
    path = Path(path)
    about = read_about(path)
    if about.get("version") != VERSION or about.get("kind") != KIND:
        raise CheckpointError(_foreign(path, about))
    try:
        if about["parts"]["generator"]["kind"] == "codec":
            raise CheckpointError(
                f"{path} is drawn by a codec, which this release no longer has; learn it again from its recording: "
                "terrella train video RECORDING --out NEW."
            )
        about, (weights, remembered) = read_data(path, about, "weights", "memory")
        made = {}
        for name, part in about["parts"].items():
            if part["kind"] != Absent.kind:
                config, make = KINDS[name][part["kind"]]
                made[name] = make(_settings(config, part["config"] or {}), _below(weights, name), remembered)
        world = LearnedWorld(_about(about), **made)
    except DAMAGE as error:
        raise CheckpointError(
            f"{path} is damaged or incomplete ({first_line(error)}); copy or train it again."
        ) from error
    if memory_mb is not None:
        world = world.with_memory_budget(memory_mb)
    world = world if memory else world.without_memory()
    return world if torch.device(device).type == "cpu" else world.to(device)


def load_latent(path: str | Path, device: str = "cpu") -> LatentWorld:
    """Reads what `save_latent` wrote; CheckpointError says what is missing or foreign."""
    path = Path(path)
    about = read_about(path)
    if (about.get("kind"), about.get("version")) != (LATENT, LATENT_VERSION):
        raise CheckpointError(_foreign(path, about))
    try:
        about, (weights, remembered) = read_data(path, about, "weights", "memory")
        config, make = NETWORKS[about["parts"]["network"]["kind"]]
        network = make(_settings(config, about["parts"]["network"]["config"]))
        network.load_state_dict(weights)
        world = LatentWorld(_about(about), network, remembered["starts"])
    except DAMAGE as error:
        raise CheckpointError(
            f"{path} is damaged or incomplete ({first_line(error)}); copy or train it again."
        ) from error
    return world if torch.device(device).type == "cpu" else world.to(device)


def open_world(
    path: str | Path, memory: bool = True, device: str = "cpu", memory_mb: float | None = None
) -> LearnedWorld | LatentWorld | SplatWorld:
    """The world of a folder, of any kind. Parameters as in `load_world`; latent worlds and places of Gaussians have no memory."""
    about = read_about(Path(path))
    kind = about.get("kind")
    if kind not in (LATENT, splat_folder.KIND):
        return load_world(path, memory, device, memory_mb)
    if memory_mb is not None:
        what = "latent world" if kind == LATENT else "world of Gaussians"
        raise CheckpointError(f"{path} is a {what}, which keeps no pictures of an episode; leave `memory_mb` out.")
    # Gaussians are always on the CPU
    return splat_folder.load_splat(path, about) if kind == splat_folder.KIND else load_latent(path, device)


def _about(world: dict) -> About:
    """The About of what world.json says."""
    about = world["about"]
    return About(
        world["name"],
        _settings(Controls, about["controls"]),
        about["dt_s"],
        action_names=tuple(about["action_names"]),
        keys=about["keys"],
        card=world["card"],
        ignored=tuple(about["ignored"]),
        idle=tuple(about.get("idle", ())),
        max_episode_steps=about.get("max_episode_steps"),
        cameras={name: _settings(Camera, facts) for name, facts in about.get("cameras", {}).items()},
    )


def with_saved_keys(about: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """`about` of a recording's world, with the keys and names of the world in `folder`, if there is one: a player may have
    changed them."""
    kept = read_about(folder)["about"] if (folder / WORLD_FILE).exists() else {}
    return {**about, **{name: kept[name] for name in ("keys", "action_names", "idle") if kept.get(name)}}


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _foreign(path: Path, about: dict) -> str:
    kind, version = about.get("kind"), about.get("version")
    if (kind, version) == ("video", 2):
        return (
            f"{path} was saved by an earlier release; convert it: terrella convert-world {shlex.quote(str(path))} NEW."
        )
    if kind == LATENT and version == LATENT_VERSION:
        return f"{path} is a latent world, which draws nothing but for people; give a world that `train video` made."
    if kind not in (KIND, LATENT):
        return f"{path} is a world of kind {kind!r}; this loads kind '{KIND}'."
    latest = LATENT_VERSION if kind == LATENT else VERSION
    return f"{path} has version {version}, this release reads {latest}; update Terrella."


# -- parts ----------------------------------------------------------------------------------------------------------------


def _settings(config: type, settings: dict) -> Any:
    """A config of its JSON, with tuples for lists."""
    return config(**{name: _tuple(value) for name, value in settings.items() if name not in RETIRED})


def _tuple(value: Any) -> Any:
    return tuple(map(_tuple, value)) if isinstance(value, list) else value


def _network(kind: type) -> Make:
    return lambda config, weights, remembered: load_weights(kind(config), weights)


def _uncertainty(config: UncertaintyConfig, weights: Tensors, remembered: Tensors) -> UncertaintyNetwork:
    """Of an older world without a ceiling: the largest error that it was calibrated to, and the usual drift."""
    network = UncertaintyNetwork(config)
    older = {"ceiling": weights["meant"][-1], "drift": network.drift}
    return load_weights(network, {**older, **weights})


def _weights(name: str, part: Any) -> Tensors:
    """The tensors of a part, its weights in half precision where that is enough."""
    network = part.motion if name == "body" and part else part
    if not isinstance(network, nn.Module):
        return {}
    return half_weights(network) if name in HALVED or isinstance(network, FlowNetwork) else network.state_dict()


def _places(config: KeyframesConfig, weights: Tensors, remembered: Tensors) -> KeyframeScene:
    return KeyframeScene(config, *(_unpack(_below(remembered, name), config) for name in ("memory", "starts")))


def _frames(config: HistoryConfig, weights: Tensors, remembered: Tensors) -> FrameHistory:
    starts = _below(remembered, "starts")
    begun = StartClips.of(_unpack_frames(starts).unflatten(0, (-1, config.slots)), config.actions)
    if "actions" in starts:
        begun = replace(
            begun, actions=starts["actions"], vitals=starts["vitals"], known=starts.get("known", begun.known)
        )
    packed, ground = _below(remembered, "ground"), None
    if packed:
        plane = np.frombuffer(zlib.decompress(packed["bytes"].numpy().tobytes()), np.uint8)
        ground = torch.from_numpy(plane.reshape(4, *packed["size"].tolist()).copy())
    return FrameHistory(config, begun, remembered.get("over"), ground)


# By part and kind: its settings, and how it is made from them, its weights and the memory.
KINDS: dict[str, dict[str, tuple[type, Make]]] = {
    "body": {"motion": (MotionConfig, lambda config, weights, _: MotionBody(load_weights(Motion(config), weights)))},
    "scene": {"keyframes": (KeyframesConfig, _places), "history": (HistoryConfig, _frames)},
    "generator": {
        "unet": (GeneratorConfig, _network(UNet)),
        "flow": (FlowConfig, _network(FlowNetwork)),
    },
    "objects": {"billboards": (BillboardsConfig, _network(Billboards))},
    "outcome": {
        "constant": (ConstantConfig, lambda config, weights, _: ConstantOutcome(config)),
        "frames": (OutcomeConfig, _network(FrameOutcome)),
    },
    "uncertainty": {"network": (UncertaintyConfig, _uncertainty)},
    "estimator": {"network": (EstimatorConfig, _network(Estimator))},
}


# By kind of a latent world's network: its settings, and how it is made from them.
NETWORKS: dict[str, tuple[type, Callable[[Any], LatentNetwork]]] = {LatentNetwork.kind: (LatentConfig, LatentNetwork)}


def _packed_places(scene: KeyframeScene, quality: int) -> dict[str, torch.Tensor]:
    parts = {"memory": scene.recorded, "starts": scene.starts}
    return {f"{name}.{key}": value for name, keys in parts.items() for key, value in _pack(keys, quality).items()}


def _packed_frames(scene: FrameHistory, quality: int) -> dict[str, torch.Tensor]:
    starts = _pack_frames(scene.starts.frames.flatten(0, 1), max(quality, 99))
    starts |= {name: getattr(scene.starts, name) for name in ("actions", "vitals", "known")}
    packed = {**{f"starts.{name}": value for name, value in starts.items()}, "over": scene.over}
    if scene.grounded:
        data = zlib.compress(scene.ground.cpu().numpy().tobytes(), 9)
        packed["ground.bytes"] = torch.from_numpy(np.frombuffer(data, np.uint8).copy())
        packed["ground.size"] = torch.tensor(scene.ground.shape[1:])
    return packed


# By kind of scene: what it remembers, as tensors for a file.
PACKED: dict[str, Callable[[Any, int], Tensors]] = {"keyframes": _packed_places, "history": _packed_frames}


def _below(tensors: Tensors, name: str) -> dict[str, torch.Tensor]:
    return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}


def _pack(keys: Keyframes, quality: int) -> dict[str, torch.Tensor]:
    millimetres = ((depth * 1000).round().clamp(0, 65535).cpu().numpy().astype("<u2") for depth in keys.depth)
    depths = [zlib.compress(picture.tobytes(), 9) for picture in millimetres]
    about = {"pose": keys.pose, "depth_size": torch.tensor(keys.depth.shape[-2:])}
    return {**about, **_pack_frames(keys.rgb, quality), **_pack_parts("depth", depths)}


def _pack_frames(rgb: torch.Tensor, quality: int) -> dict[str, torch.Tensor]:
    """uint8 [N, 3, H, W] as JPEG without chroma subsampling."""
    frames = rgb.permute(0, 2, 3, 1).contiguous().cpu().numpy()
    return _pack_parts("rgb", [simplejpeg.encode_jpeg(frame, quality, colorsubsampling="444") for frame in frames])


def _pack_parts(name: str, parts: list[bytes]) -> dict[str, torch.Tensor]:
    data = torch.from_numpy(np.frombuffer(b"".join(parts) or b"\0", np.uint8).copy())
    return {f"{name}_bytes": data, f"{name}_ends": torch.tensor([len(p) for p in parts], dtype=torch.int64).cumsum(0)}


def _unpack(packed: Tensors, config: KeyframesConfig) -> Keyframes:
    height, width = (int(n) for n in packed["depth_size"])
    depth = [np.frombuffer(zlib.decompress(p), "<u2").reshape(1, height, width) for p in _parts(packed, "depth")]
    metres = torch.from_numpy(np.concatenate([np.zeros((0, height, width), "<u2"), *depth]).astype(np.float32) / 1000)
    return Keyframes.of(_unpack_frames(packed), metres, packed["pose"], config.camera)


def _unpack_frames(packed: Tensors) -> torch.Tensor:
    decoded = [simplejpeg.decode_jpeg(part) for part in _parts(packed, "rgb")]
    frames = np.stack(decoded) if decoded else np.zeros((0, 2, 2, 3), np.uint8)
    return torch.from_numpy(frames).permute(0, 3, 1, 2).contiguous()


def _parts(packed: Tensors, name: str) -> list[bytes]:
    data, ends = packed[f"{name}_bytes"].numpy().tobytes(), packed[f"{name}_ends"].tolist()
    return [data[a:b] for a, b in zip([0, *ends], ends)]


def _readme(about: dict) -> str:
    text = f"# {about['name']}\n\nA world of Terrella, kind `{about['kind']}`: `terrella play` this folder.\n\n"
    for name, value in about["card"].items():
        text += f"- **{name}**: {value if not isinstance(value, dict) else json.dumps(value)}\n"
    return text
