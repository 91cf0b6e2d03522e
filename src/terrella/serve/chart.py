"""A world's memory, for the page: its map, and its pictures with the invented part tinted. The channels decide:

`pose` and `places` [N, 4] (x, y in metres, heading in radians, kind: 0 empty, 1 recorded, 2 observed, 3 imagined, 4 walkable) give
a map of places; `mosaic` [H', W', 4] is a map as a picture; `known` [H, W] in 0..1 tints pictures."""

import base64
import io

import numpy as np
import simplejpeg
import torch
from PIL import Image

from ..core.spec import WALKABLE, Spec
from ..core.state import State
from ..core.world import World
from ..space.camera import yaw

AMBER = (1.25, 0.95, 0.5)  # the tint of invented pixels, times their brightness
STRENGTH = 0.85
PLACES, MOSAIC = "places", "mosaic"  # kinds of maps
IMAGINED, NEAREST = 3, 6  # kind of views, and how many of them a picture is drawn from
EVERY_S = {PLACES: 0.1, MOSAIC: 0.25}  # between two maps
FINEST, QUALITY = 640, 85  # of the JPEG of a mosaic: most pixels across, and quality


def map_kind(spec: Spec) -> str:
    """The kind of map that the world has; "" for none."""
    if {"pose", "places"} <= set(spec.channels):
        return PLACES
    return MOSAIC if {"rgb", "mosaic"} <= set(spec.channels) else ""


def has_known_share(spec: Spec) -> bool:
    return "known" in spec.channels


def map_event(world: World, state: State) -> dict:
    """The map of the first entry of `state`, in the form that protocol.encode_event documents."""
    return {PLACES: _places, MOSAIC: _mosaic}[map_kind(world.spec)](world, state)


def _places(world: World, state: State) -> dict:
    """camera: [x, y, heading], to the millimetre. known: the share of the picture that comes from memory of what was recorded or
    observed (None if the world has no such channel); imagined: that from memory of what it imagined itself. places: x, y, heading
    and kind of each, to the centimetre, in one flat list without empty slots."""
    wanted = ["pose", "places", *(["known"] if has_known_share(world.spec) else [])]
    seen = {name: tensor[0].cpu() for name, tensor in world.render(state, wanted).items()}
    held = seen["places"][seen["places"][:, 3] > 0]
    share = float(seen["known"].mean()) if "known" in seen else None
    imagined = 0.0 if share is None else share * _imagined_share(seen["pose"], held)
    return {
        "camera": [round(number, 3) for number in (*seen["pose"][:2].tolist(), float(yaw(seen["pose"])))],
        "known": None if share is None else round(share - imagined, 3),
        "imagined": round(imagined, 3),
        "places": held.flatten().double().round(decimals=2).tolist(),
    }


def _imagined_share(pose: torch.Tensor, held: torch.Tensor) -> float:
    """The share of imagined views among those views [n, 4] of memory that are nearest to a pose [7], a radian counting as 2 m."""
    views = held[held[:, 3] < WALKABLE]
    if not len(views):
        return 0.0
    turn = (views[:, 2] - yaw(pose) + torch.pi) % (2 * torch.pi) - torch.pi
    apart = (views[:, :2] - pose[:2]).norm(dim=1) + 2 * turn.abs()
    nearest = views[apart.argsort()[:NEAREST], 3]
    return float((nearest == IMAGINED).float().mean())


def _mosaic(world: World, state: State) -> dict:
    """mosaic: the part around its middle that was seen. size: of that part. view: size of the picture in its middle. image: the
    part as a JPEG. mask: a PNG that is transparent where nothing was seen. Both in base64."""
    whole = world.render(state, ("mosaic",))["mosaic"][0].cpu().numpy()
    height, width = world.spec.channels["rgb"].shape[:2]
    seen = whole[..., 3] > 0
    top, left = (_margin(np.atleast_1d(seen.any(1 - axis)), least) for axis, least in enumerate((height, width)))
    part = whole[top : whole.shape[0] - top, left : whole.shape[1] - left]
    size = part.shape[1::-1]
    step = -(-size[0] // FINEST)
    part, mask = np.ascontiguousarray(part[::step, ::step]), io.BytesIO()
    Image.fromarray(part[..., 3]).convert("1").save(mask, "PNG", compress_level=1, transparency=0)
    image = simplejpeg.encode_jpeg(np.ascontiguousarray(part[..., :3]), quality=QUALITY, colorspace="RGB")
    image, shape = (base64.b64encode(data).decode() for data in (image, mask.getvalue()))
    return {"mosaic": {"size": size, "view": (width, height), "image": image, "mask": shape}}


def _margin(seen: np.ndarray, least: int) -> int:
    """How much can be cut off both ends of `seen` [n] without losing a seen entry or one of the `least` in the middle."""
    ends = np.flatnonzero(seen)
    empty = min(int(ends[0]), len(seen) - 1 - int(ends[-1])) if len(ends) else len(seen)
    return min(empty, (len(seen) - least) // 2)


def tint_invented(rgb: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """rgb uint8 [B, H, W, 3] with the pixels that are not `known` ([B, H, W] in 0..1) tinted in amber."""
    picture = rgb.float()
    brightness = picture @ torch.tensor([0.299, 0.587, 0.114], device=rgb.device)
    amber = brightness[..., None] * torch.tensor(AMBER, device=rgb.device) + 8
    share = STRENGTH * (1 - known)[..., None]
    return (picture + share * (amber - picture)).round().clamp(0, 255).to(torch.uint8)
