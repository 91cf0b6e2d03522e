"""Closure: go away and come back; does the world still hold what it showed before?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..core.errors import ObservationError
from ..core.world import World, make_rng
from .clips import Clip
from .fidelity import psnr
from .roll import fold_context, poses_at
from .statistics import Figure, mean_interval

STATIC_DB = 20.0  # a far view this like the first one means that the picture hardly changed at all
WALKED_M = 1.0  # who goes less far does not leave


@dataclass(frozen=True)
class Closure:
    """There and back, and there again. closed: PSNR of the frame after coming back against the first; far: of the view at
    the far end against the first; again: of the far view, mostly dreamt, when it is come to a second time against the first
    time. void: the far views are not different (far >= 20 dB), so `closed` proves nothing; void_again: the frames after
    coming back are like the far ones, so `again` proves nothing (fog looks alike wherever it is drawn). acted: gone by keys,
    not along poses; far_deg and far_m: how far the way leads, the latter a mean over clips; steps: there and back. `picture`
    holds the first clip's frames, uint8 [6, H, W, 3]: first, half way out, far, half way back, back, far again."""

    arm: str
    place: str
    way: str
    acted: bool
    far_deg: float
    far_m: float
    steps: int
    closed: Figure
    far: Figure
    again: Figure
    void: bool
    void_again: bool
    picture: np.ndarray = field(repr=False, compare=False)


@dataclass(frozen=True)
class Way:
    """There and back. `steps(clips, pose)`: 2n tensors that lead away from the first poses [B, 7] (None for a world that
    shows none) and to them again, each a pose [B, 7] to be observed or, where `acted`, an action [B, A] to be played."""

    name: str
    steps: Callable[[Sequence[Clip], torch.Tensor | None], list[torch.Tensor]]
    far_deg: float = 0.0
    acted: bool = False


def yaw_way(far_deg: float, step_deg: float = 3.0) -> Way:
    """Turns on the spot to `far_deg` and back, in steps of `step_deg` or a little less."""
    half = math.ceil(far_deg / step_deg)
    turns = [far_deg * step / half for step in (*range(1, half + 1), *range(half - 1, -1, -1))]
    steps = lambda clips, pose: [turned(pose, math.radians(turn)) for turn in turns]  # noqa: E731
    return Way(f"yaw 0-{far_deg:g}-0", steps, far_deg)


def walk_way(steps: int = 100) -> Way:
    """Walks as the recording did for half of the steps, and backwards the same way."""
    half = steps // 2

    def path(clips: Sequence[Clip], pose: torch.Tensor | None) -> list[torch.Tensor]:
        first = clips[0].context - 1
        return [poses_at(clips, first + step) for step in (*range(1, half + 1), *range(half - 1, -1, -1))]

    return Way(f"walk of {2 * half} steps", path)


def key_way(there: torch.Tensor, back: torch.Tensor, name: str, steps: int) -> Way:
    """Holds the action `there` [A] for half of the steps, then `back`: for worlds that take no poses."""
    half = steps // 2

    def path(clips: Sequence[Clip], pose: torch.Tensor | None) -> list[torch.Tensor]:
        return [action.expand(len(clips), *action.shape) for action in (*[there] * half, *[back] * half)]

    return Way(name, path, acted=True)


def closure(
    world: World,
    clips: Sequence[Clip],
    rng: torch.Generator,
    way: Way,
    arm: str = "",
    place: str = "",
    batch: int = 8,
) -> Closure:
    """Goes the way from each clip's context on, there and back, and there again.

    The first frame is what the world shows after its context (for most worlds the observed frame itself), so the last,
    dreamt frame is held against the strictest reference. ObservationError where the way is one of poses and the world
    takes none.
    """
    if not way.acted and "pose" not in world.spec.observes:
        raise ObservationError(f"{world.spec.name} does not observe 'pose', so nothing can move its camera.")
    size, seed = min(batch, world.spec.max_batch or batch), int(torch.randint(2**31 - 1, (1,), generator=rng).item())
    shows = ("rgb", "pose") if "pose" in world.spec.channels else ("rgb",)
    closed, away, again, alike, picture, went, count = [], [], [], [], [], [], 0
    for start in range(0, len(clips), size):
        own, some = make_rng(seed + start), clips[start : start + size]
        state = fold_context(world, some, own)
        seen = world.render(state, shows)
        first, pose = seen["rgb"].cpu(), seen.get("pose")
        steps = way.steps(some, pose)
        count = len(steps)
        half, shown, frame, far_frame = count // 2, [first[0]], first, first
        for number, step in enumerate([*steps, *steps[: count // 2]], start=1):
            state = world.imagine(state, step, own) if way.acted else world.observe({"pose": step}, state, own)
            if number in (half // 2, half, count - half // 2, count, count + half):
                frame = world.render(state, ("rgb",))["rgb"].cpu()
                shown.append(frame[0])
            if number == count:
                closed.append(psnr(frame, first))
                alike.append(psnr(frame, far_frame))
            if number == half:
                far_frame = frame
                away.append(psnr(frame, first))
                if pose is not None:
                    went.append((world.render(state, ("pose",))["pose"] - pose)[:, :3].norm(dim=1).cpu())
        again.append(psnr(frame, far_frame))
        picture = picture or shown
    back, there, twice = (mean_interval(torch.cat(values), rng) for values in (closed, away, again))
    far_m = float(torch.cat(went).mean()) if went else 0.0
    void, void_again = (bool(torch.cat(values).mean() >= STATIC_DB) for values in (away, alike))
    return Closure(
        arm,
        place,
        way.name,
        way.acted,
        way.far_deg,
        far_m,
        count,
        back,
        there,
        twice,
        void,
        void_again,
        torch.stack(picture).numpy(),
    )


def walkers(clips: Sequence[Clip], steps: int) -> list[Clip]:
    """Those of the clips that walk at least a metre in half of the steps: others would close without having left."""
    half = steps // 2
    able = [clip for clip in clips if clip.pose is not None and clip.horizon >= half]
    return [clip for clip in able if clip.walked_m()[half - 1] >= WALKED_M]


def turned(pose: torch.Tensor, angle_rad: float) -> torch.Tensor:
    """Poses [B, 7] turned about the world's vertical by `angle_rad`, counter-clockwise from above; the place stays."""
    c, s = math.cos(angle_rad / 2), math.sin(angle_rad / 2)
    w, x, y, z = pose[:, 3:].unbind(-1)
    around = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    return torch.cat([pose[:, :3], around], -1)
