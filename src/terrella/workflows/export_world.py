"""Writes a learned world of frames as one HTML file, which runs in a browser without a server."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from .. import library
from ..core.errors import TerrellaError
from ..serve.world_page import world_html
from ..space.files import replace_whole
from ..worlds.config import THUMBNAIL
from ..worlds.flow import FlowNetwork, times_of
from ..worlds.frame_history import FrameHistory
from ..worlds.learned import LearnedWorld
from ..worlds.parts import Evidence

STARTS = 12  # places of a world where episodes begin, at most
PANEL = 8  # outputs of a layer that kernels.c computes at once
WIDEST = 8192  # numbers that an output of a layer is computed from, at most
SHUFFLED = {"up.0": 2, "up.1": 2, "detail": 4}  # layers that draw squares of this side


def export_world(name: str, file: Path) -> dict[str, Any]:
    """Writes the world `name` to `file` (.html). TerrellaError for worlds that a browser cannot run. Facts of the file."""
    if file.suffix.lower() != ".html":
        raise TerrellaError(f"{file}: a world is written as a page; give a name that ends in .html.")
    world = library.load(name)
    if not isinstance(world, LearnedWorld) or not isinstance(world.generator, FlowNetwork):
        raise TerrellaError(
            f"{name} is no learned world of frames alone, such as `terrella learn` makes of a game without depth; only these run "
            "in a browser. Places are written by `terrella space export`."
        )
    if isinstance(world.scene, FrameHistory) and len(world.scene.cameras) > 1:
        raise TerrellaError(f"{name} shows several cameras at once, which the page cannot.")
    content = page_of(world, world.generator)
    replace_whole(file, lambda staged: staged.write_bytes(content))
    parameters = sum(weight.numel() for weight in world.generator.parameters())
    return {"file": str(file), "bytes": len(content), "parameters": parameters}


def page_of(world: LearnedWorld, network: FlowNetwork) -> bytes:
    """The page of a world and its network, as HTML in UTF-8."""
    about, weights = _packed_network(network)
    return world_html(world.spec, about, weights, *_memory(world))


def _packed_network(network: FlowNetwork) -> tuple[dict[str, Any], bytes]:
    """The network as web/world/network.js reads it: a description, and its weights in float16."""
    config, parts = network.config, []
    layers, vectors = [], []
    for name, weight, bias in _layers(network):
        matrix = _matrix(name, weight)
        if len(matrix) > WIDEST:
            raise TerrellaError(
                f"its network is too wide for a page ({name} reads {len(matrix)} numbers): distil a student of it."
            )
        layers.append((name, *matrix.shape))
        parts += [_panels(matrix), _panels(_rows(name, bias)[None])]
    for name, vector in network.named_parameters():
        if name.split(".")[-2:-1] == ["norm"]:
            vectors.append((name, len(vector)))
            parts.append(vector.detach())
    weights = torch.cat([part.flatten().float() for part in parts]).half().numpy().tobytes()
    about = {"size": config.size, "slots": config.slots, "channels": config.channels, "steps": config.steps}
    about |= {"recalls": config.recalls, "remembers": config.moves > 0 or config.recalls}
    about["times"] = [times_of(steps, config.recalls) for steps in range(1, config.steps + 1)]
    return {**about, "layers": layers, "vectors": vectors}, weights


def _layers(network: FlowNetwork) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
    """Name, weight and bias of each layer."""
    attention = network.attention
    yield "attention.in", attention.in_proj_weight, attention.in_proj_bias
    yield "attention.out", attention.out_proj.weight, attention.out_proj.bias
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d | nn.Linear) and not name.startswith("attention."):
            assert layer.bias is not None
            yield name, _by_pixels(network, name, layer.weight), layer.bias


def _by_pixels(network: FlowNetwork, name: str, weight: torch.Tensor) -> torch.Tensor:
    """The weights of the layer that sees maps as one vector, pixel by pixel instead of channel by channel; others as they are."""
    if name != "scrolling.glance.6":
        return weight
    channels = len(network.get_parameter("scrolling.glance.3.weight"))
    return weight.unflatten(1, (channels, -1)).transpose(1, 2).flatten(1)


def _matrix(name: str, weight: torch.Tensor) -> torch.Tensor:
    """Weights [outputs, channels, side, side] or [outputs, inputs] as [inputs, outputs], inputs pixel by pixel."""
    flat = weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).flatten(1)
    return _rows(name, flat.detach()).T


def _rows(name: str, outputs: torch.Tensor) -> torch.Tensor:
    """The outputs [outputs, ...] of a layer that draws squares, pixel by pixel; of others as they are."""
    side = SHUFFLED.get(name, 1)
    return outputs.detach().unflatten(0, (-1, side * side)).transpose(0, 1).flatten(0, 1)


def _panels(matrix: torch.Tensor) -> torch.Tensor:
    """[inputs, outputs] as [outputs / PANEL, inputs, PANEL], with zeros where outputs end."""
    padded = nn.functional.pad(matrix, (0, -matrix.shape[1] % PANEL))
    return padded.unflatten(1, (-1, PANEL)).transpose(0, 1)


def _memory(world: LearnedWorld) -> tuple[dict[str, Any], bytes]:
    """Starts, ground and what does not scroll as web/world/world.js reads them: a description with [first byte, bytes] of the data,
    and the data."""
    scene, data = world.scene, bytearray()
    assert isinstance(scene, FrameHistory)

    def put(pixels: torch.Tensor) -> tuple[int, int]:
        content = np.ascontiguousarray(pixels.cpu().numpy().astype(np.uint8)).tobytes()
        data.extend(content)
        return len(data) - len(content), len(content)

    clips, scrolls = scene.starts, bool(scene.config.moves)
    starts: list[Mapping[str, Any]] = []
    for number in range(0, len(clips.frames), max(1, -(-len(clips.frames) // STARTS))):
        frames = clips.frames[number : number + 1]
        state = scene.observe(None, Evidence(1, world.device, None, {"frames": frames}))
        starts.append(
            {
                "frames": put(frames[0].permute(0, 2, 3, 1)),
                "actions": clips.actions[number].flip(0).tolist(),
                "known": put(clips.known[number].permute(1, 2, 0)) if scrolls else None,
                "scroll": int(state["scroll"][0]) if scrolls else 0,
                "place": state["place"][0].tolist() if scene.grounded else None,
            }
        )
    controls = {"kind": world.controls.kind, "low": world.controls.low, "high": world.controls.high}
    about = {"thumbnail": THUMBNAIL, "controls": controls, "starts": starts, "ground": None, "over": put(scene.over)}
    about["moves"] = scene.config.moves or [(0, 0)]
    if scene.grounded:
        about["ground"] = {"size": scene.ground.shape[1:], "bytes": put(scene.ground.permute(1, 2, 0))}
    return about, bytes(data)
