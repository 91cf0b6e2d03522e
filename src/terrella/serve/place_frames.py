"""Frames of a place, rendered on the server for browsers that cannot."""

import json
import threading
from collections.abc import Callable, Mapping, Sequence

import simplejpeg
import torch

from ..core.errors import ServeError
from ..space.camera import tilted_pose
from ..space.edits import Contents, Edit, apply_edits
from ..space.raster import Gaussians, rasterise

NAMES = ("x", "y", "z", "heading", "pitch", "wide", "tall", "width", "height")
SMALLEST, LARGEST, NARROWEST, WIDEST = 8, 1280, 1e-3, 20.0
FARTHEST_M = 1e6


class FrameRenderer:
    """Renders Gaussians (objects int32 [N]) after the current `edits`, one frame at a time. `other` opens the places that they
    merge."""

    def __init__(
        self,
        gaussians: Gaussians,
        objects: torch.Tensor,
        edits: Callable[[], Sequence[Edit]],
        other: Callable[[Edit], Contents] | None = None,
    ):
        self._source, self._objects, self._edits, self._alone = gaussians, objects, edits, threading.Lock()
        self._scene, self._done, self._other = gaussians, "[]", other

    def draw(self, view: Mapping[str, str]) -> bytes:
        """A JPEG from a camera at x, y, z (metres) that looks along `heading` and `pitch` (radians, upwards). `wide` and `tall` are
        half the size of its view at distance 1; width and height are in pixels. ServeError for a malformed view."""
        try:
            x, y, z, heading, pitch, wide, tall, width, height = (float(view[name]) for name in NAMES)
        except (KeyError, ValueError) as error:
            raise ServeError(f"a view is {', '.join(NAMES)}; reload the page.") from error
        inside = all(abs(one) < FARTHEST_M for one in (x, y, z, heading, pitch))  # false for NaN
        inside = inside and all(NARROWEST < half < WIDEST for half in (wide, tall))
        if not inside or not all(SMALLEST <= size <= LARGEST for size in (width, height)):
            raise ServeError(
                f"a view has numbers below {FARTHEST_M:g}, and {SMALLEST} to {LARGEST} pixels a side; reload the page."
            )
        pose = tilted_pose(*torch.tensor([[x], [y], [z], [heading], [pitch]]))
        with self._alone, torch.no_grad():
            text = json.dumps(list(edits := self._edits()))
            if text != self._done:
                self._scene, self._done = apply_edits(self._source, edits, self._objects, self._other).gaussians, text
            lens = (0.5 / wide, 0.5 / tall, 0.5, 0.5)
            seen = rasterise(self._scene, pose, lens, (round(height), round(width))).rgb[0]
        picture = (seen.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous()
        return simplejpeg.encode_jpeg(picture.numpy(), quality=85, colorspace="RGB")
