"""Films of bodies and walls, drawn from motion alone, for any world whose bodies are known."""

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw

from ..physics.gaps import rotated
from ..physics.trajectory import Trajectory

SIZE = 220  # pixels
_BACK, _WALL, _EDGE = (16, 20, 27), (70, 78, 92), (13, 15, 19)
_COLOURS = ((111, 211, 193), (227, 168, 87), (142, 166, 255), (224, 122, 155), (182, 211, 111))
_DRIVEN = (139, 147, 163)
_RED, _FRAME = (214, 69, 69), 4  # pixels
_CORNERS = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]).double()


def film_of_bodies(motion: Trajectory, like: Trajectory | None = None) -> np.ndarray:
    """Frames uint8 [T + 1, SIZE, SIZE, 3] of the first rollout. like: the motion whose bodies fill the picture (itself)."""
    across, up = _plane(motion)
    low, high = _window(like or motion, across, up)
    scale = SIZE / float((high - low).max())
    middle = 0.5 * (low + high)

    def at(points: torch.Tensor) -> list[tuple[float, float]]:
        flat = points[..., [across, up]]
        shifted = (flat - middle) * scale
        return [(SIZE / 2 + x, SIZE / 2 - y) for x, y in shifted.tolist()]

    frames = []
    for instant in range(motion.steps + 1):
        canvas = Image.new("RGB", (SIZE, SIZE), _BACK)
        draw = ImageDraw.Draw(canvas)
        _draw_walls(draw, motion, at, (across, up))
        for body in range(motion.position.shape[2]):
            if bool(motion.present[instant, 0, body]):
                _draw_body(draw, motion, instant, body, at, scale)
        frames.append(np.asarray(canvas))
    return np.stack(frames)


def framed(frames: np.ndarray, marked: Sequence[bool]) -> np.ndarray:
    """Frames uint8 [T, H, W, 3], those that are marked with a red frame."""
    frames = frames.copy()
    for at in np.flatnonzero(marked):
        inner = frames[at, _FRAME:-_FRAME, _FRAME:-_FRAME].copy()
        frames[at] = _RED
        frames[at, _FRAME:-_FRAME, _FRAME:-_FRAME] = inner
    return frames


def _plane(motion: Trajectory) -> tuple[int, int]:
    """The axes across and up: from the side where gravity pulls, else in the plane of motion."""
    axes = motion.system.axes
    if len(axes) == 2:
        return axes[0], axes[1]
    spread = (motion.position[..., :2].amax((0, 1, 2)) - motion.position[..., :2].amin((0, 1, 2))).tolist()
    if float(motion.gravity[2].abs()) > 0 and float(motion.position[..., 2].std()) > 0.2 * max(spread):
        return (0 if spread[0] >= spread[1] else 1), 2
    return 0, 1


def _window(motion: Trajectory, across: int, up: int) -> tuple[torch.Tensor, torch.Tensor]:
    places = motion.position[:, 0][motion.present[:, 0]][:, [across, up]]
    margin = 2 * float((motion.size + motion.half.norm(dim=-1))[:, 0].max())
    return places.amin(0) - margin, places.amax(0) + margin


def _draw_walls(draw: ImageDraw.ImageDraw, motion: Trajectory, at, plane: tuple[int, int]) -> None:
    for wall in motion.system.walls:
        centre = torch.tensor(wall.centre_m).double()
        if wall.normal is not None:
            normal = torch.tensor(wall.normal).double()
            if float(normal[list(plane)].norm()) < 0.5:
                continue  # seen from above
            along = torch.zeros(3).double()
            along[plane[0]], along[plane[1]] = -normal[plane[1]], normal[plane[0]]
            ends = [
                centre - 99 * along,
                centre + 99 * along,
                centre + 99 * (along - normal),
                centre - 99 * (along + normal),
            ]
            draw.polygon(at(torch.stack(ends)), fill=_WALL)
            continue
        turn = rotated(torch.tensor(wall.rotation).double())
        corners = centre + (_CORNERS * torch.tensor(wall.half_m).double()) @ turn.T
        draw.polygon(_outline(at(corners)), fill=_WALL, outline=_WALL)


def _draw_body(draw: ImageDraw.ImageDraw, motion: Trajectory, instant: int, body: int, at, scale: float) -> None:
    driven = bool(motion.driven[body])
    colour = _DRIVEN if driven else _COLOURS[body % len(_COLOURS)]
    place, half = motion.position[instant, 0, body], motion.half[body]
    if float(half.max()) == 0:
        (x, y), reach = at(place[None])[0], max(2.0, scale * float(motion.radius[instant, 0, body]))
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=colour, outline=_EDGE)
        return
    corners = place + (_CORNERS * half) @ rotated(motion.rotation[instant, 0, body]).T
    draw.polygon(_outline(at(corners)), fill=colour, outline=_EDGE)


def _outline(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The convex hull of points, by Andrew's monotone chain."""
    ordered = sorted({(round(x, 1), round(y, 1)) for x, y in points})
    if len(ordered) < 3:
        return ordered * 2

    def half(some: list[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for x, y in some:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2], chain[-1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    return half(ordered) + half(ordered[::-1])
