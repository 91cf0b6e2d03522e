"""What a world remembers, for the page: the map of its keyframes, and its pictures with what it invented tinted.

It knows no kind of world: a world with the channels `pose` and `keyframes` [N, 4] (x, y in metres, heading in radians, kind:
0 empty, 1 recorded, 2 observed, 3 imagined) is drawn as a map, one with `known` [H, W] in 0..1 can be tinted.
"""

from __future__ import annotations

import torch

from ..core.spec import Spec
from ..core.state import State
from ..core.world import World
from ..space.camera import yaw

AMBER = (1.25, 0.95, 0.5)  # of what is invented: its brightness in this colour
STRENGTH = 0.85


def mapped(spec: Spec) -> bool:
    return {"pose", "keyframes"} <= set(spec.channels)


def knows_share(spec: Spec) -> bool:
    return "known" in spec.channels


def chart(world: World, state: State) -> dict:
    """The map of the first entry of `state`, as the page gets it: camera [x, y, heading], to the millimetre; known, the share
    of the picture that memory knew (None where the world does not say); keyframes, x, y, heading and kind of each, to the
    centimetre, in one flat list without the empty slots."""
    wanted = ["pose", "keyframes", *(["known"] if knows_share(world.spec) else [])]
    seen = {name: tensor[0].cpu() for name, tensor in world.render(state, wanted).items()}
    held = seen["keyframes"][seen["keyframes"][:, 3] > 0]
    return {
        "camera": [round(number, 3) for number in (*seen["pose"][:2].tolist(), float(yaw(seen["pose"])))],
        "known": round(float(seen["known"].mean()), 3) if "known" in seen else None,
        "keyframes": held.flatten().double().round(decimals=2).tolist(),
    }


def tinted(rgb: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """rgb uint8 [B, H, W, 3] in which what memory does not know (`known` [B, H, W] in 0..1) has turned to amber."""
    picture = rgb.float()
    brightness = picture @ torch.tensor([0.299, 0.587, 0.114], device=rgb.device)
    amber = brightness[..., None] * torch.tensor(AMBER, device=rgb.device) + 8
    share = STRENGTH * (1 - known)[..., None]
    return (picture + share * (amber - picture)).round().clamp(0, 255).to(torch.uint8)
