"""Clips: windows of held-out recordings that every arm of a scorecard is asked to dream again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ..core.errors import DatasetError, ObservationError
from ..core.spec import Spec, kind_of
from ..space.floorplan import horizon, sees_into

Where = Callable[
    [Any, int, int], np.ndarray
]  # clip cache, first, stop -> bool [stop - first]: rows that may be in a clip


@dataclass(frozen=True)
class Clip:
    """T = context + horizon rows of one episode; row t's action led from observation t to t + 1.

    channels: what was recorded, by the world's names, [T, ...] each: rgb and rgb.wrist uint8 [T, H, W, 3], depth metres,
    pose float32 [T, 7], reward [T] and done [T] (what followed each action), vectors. action [T, A]. The first `context`
    rows are shown to a world, the rest are the truth. Arrays may be views of a memory-mapped file.
    """

    channels: Mapping[str, np.ndarray]
    action: np.ndarray
    context: int
    episode: int
    start: int

    @property
    def horizon(self) -> int:
        return len(self.action) - self.context

    @property
    def pose(self) -> np.ndarray | None:
        return self.channels.get("pose")

    def walked_m(self, channel: str = "pose") -> np.ndarray:
        """Length of the true path from the last context row to each later one: metres, float64 [horizon]."""
        places = np.asarray(self.channels[channel], np.float64)[self.context - 1 :, :3]
        return np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()

    def moves(self) -> bool:
        """True where the camera goes more than half a metre or turns more than 20 degrees after the context, or, without
        poses, where anything changes."""
        if self.pose is None:
            main = next(iter(self.channels.values()))
            return bool((main[self.context :] != main[self.context - 1]).any())
        turned = 2 * np.arccos(np.clip(np.abs(self.pose[self.context :, 3:] @ self.pose[self.context - 1, 3:]), 0, 1))
        return bool(self.walked_m()[-1] > 0.5 or turned.max() > np.deg2rad(20))


def recorded_channels(cache) -> dict[str, np.ndarray]:
    """A clip cache's arrays by the names of the world's channels."""
    named = {name: getattr(cache, name, None) for name in ("rgb", "depth", "pose", "reward", "done")}
    keyed = {channel: cache.arrays.get(key) for channel, key in cache.keys.items()}
    return {name: array for name, array in {**named, **cache.further, **keyed}.items() if array is not None}


def check_recording(cache, spec: Spec) -> None:
    """DatasetError in one sentence where the recording holds other actions, or lacks what the world observes."""
    low, high = spec.action_limits
    held = np.asarray(cache.action[:: max(1, len(cache.action) // 10000)]).reshape(-1, *(spec.action.shape or ()))
    if (held < low - 1e-3).any() or (held > high + 1e-3).any():
        raise DatasetError(
            f"the recording holds actions outside of {spec.name}'s {spec.action}: it is of another game."
        )
    there = recorded_channels(cache)
    lacking = [name for name in spec.observes if name not in there]
    if lacking:
        raise DatasetError(
            f"{spec.name} observes {' and '.join(lacking)}, and the recording holds only {', '.join(there)}: "
            "score it on a recording of its own game."
        )


def in_box(*box: float) -> Where:
    """Rows whose place lies inside the box x0, y0, x1, y1 on the map, metres."""
    x0, y0, x1, y1 = box

    def inside(cache, first: int, stop: int) -> np.ndarray:
        x, y = np.asarray(cache.pose[first:stop, :2]).T
        return (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)

    return inside


def out_of_sight(*box: float) -> Where:
    """Rows whose place lies outside the box and, where depth and camera are recorded, from which it is not seen into."""

    def outside(cache, first: int, stop: int) -> np.ndarray:
        away = ~in_box(*box)(cache, first, stop)
        camera = cache.world.get("camera")
        if cache.depth is None or not camera:
            return away
        level = cache.depth[first:stop, horizon(camera, cache.depth.shape[1])]
        seen, pose = (torch.from_numpy(np.array(part, np.float32)) for part in (level, cache.pose[first:stop]))
        return away & ~sees_into((box[0], box[1], box[2], box[3]), seen, pose, tuple(camera)).numpy()

    return outside


def clips_from_cache(
    cache,
    episodes: Sequence[int],
    context: int,
    horizon: int,
    count: int,
    rng: torch.Generator,
    where: Where | None = None,
) -> list[Clip]:
    """Up to `count` windows that do not overlap, drawn at random from `episodes` of a clip cache.

    No window holds a row without a valid action or an end (`done`), nor a row that `where` refuses. Still windows are
    kept: Clip.moves tells them apart. Fewer come back where the recording has no more; DatasetError where it has none.
    """
    if where is not None and cache.pose is None:
        raise DatasetError("clips can be chosen by place only where the recording has poses; leave `where` out.")
    length = context + horizon
    starts: list[tuple[int, int]] = []
    for episode in episodes:
        begin, end = cache.episodes[episode]
        for first, stop in runs(cache, begin, end, where):
            spare = (stop - first) % length
            if stop - first < length:
                continue
            offset = int(torch.randint(spare + 1, (1,), generator=rng))
            starts += [(episode, row) for row in range(first + offset, stop - length + 1, length)]
    if not starts:
        raise DatasetError(
            f"no window of {length} rows ({context} of context, {horizon} of horizon) fits in these {len(episodes)} "
            "episodes; record longer episodes or ask for a shorter horizon."
        )
    order = torch.randperm(len(starts), generator=rng).tolist()[:count]
    return [_cut(cache, starts[pick], length, context) for pick in order]


def check_clips(place: str, clips: Sequence[Clip], steps: int) -> None:
    """DatasetError unless there are clips of `place`, all of one shape, with `steps` steps or more to dream."""
    if not clips:
        raise DatasetError(f"there are no clips of {place} places; draw some, or leave the place out.")
    if len({(clip.context, clip.horizon) for clip in clips}) != 1:
        raise DatasetError(f"the clips of {place} places differ in length; draw them with one context and one horizon.")
    if clips[0].horizon < steps:
        raise DatasetError(
            f"the clips of {place} places have {clips[0].horizon} steps to dream, the largest horizon is {steps}; "
            "draw longer ones."
        )


def evidence(clips: Sequence[Clip], spec: Spec, row: int) -> dict[str, torch.Tensor]:
    """What `spec` observes, and may_observe where it was recorded, of row `row` of each clip: name -> tensor [B, ...];
    ObservationError where it cannot."""
    seen = {}
    for name in (*spec.observes, *spec.may_observe):
        arrays = [clip.channels[name] for clip in clips if name in clip.channels]
        if len(arrays) < len(clips) and name in spec.may_observe:
            continue
        if len(arrays) < len(clips):
            raise ObservationError(f"{spec.name} observes '{name}', which the recording lacks; record it as well.")
        stacked = torch.from_numpy(np.stack([np.asarray(array[row]) for array in arrays]))
        wanted = tuple(spec.channels[name].shape or ()) if name in spec.channels else tuple(stacked.shape[1:])
        if kind_of(name) == "depth" and len(wanted) == 2:  # depth is recorded at a size of its own
            stacked = F.interpolate(stacked.float()[:, None], wanted, mode="nearest-exact")[:, 0]
        marks = stacked.ndim == 3 and stacked.dtype in (torch.bool, torch.uint8)
        if name in spec.may_observe and marks and len(wanted) == 2:  # and so are marks: one pixel of many counts
            stacked = F.adaptive_max_pool2d(stacked.float()[:, None], wanted)[:, 0].to(stacked.dtype)
        if wanted == () and stacked[0].numel() == 1:
            stacked = stacked.reshape(-1)
        fits = tuple(stacked.shape[1:]) == wanted
        if name in spec.may_observe and not (fits and torch.isfinite(stacked.float()).all()):
            continue
        if not fits:
            raise ObservationError(
                f"{spec.name} observes '{name}' of shape {wanted}, the clips hold {tuple(stacked.shape[1:])}; "
                "open the clip cache at the world's size."
            )
        seen[name] = stacked if stacked.dtype in (torch.uint8, torch.bool) else stacked.float()
    return seen


def runs(cache, first: int, stop: int, where: Where | None, unbroken: bool = True) -> list[tuple[int, int]]:
    """Stretches [first, stop) of the rows of an episode that `where` allows; where `unbroken`, each row is reached from the one
    before by a valid action."""
    allowed = np.ones(stop - first, bool) if where is None else np.asarray(where(cache, first, stop), bool)
    linked = allowed[1:] & allowed[:-1]
    if unbroken:
        linked &= np.asarray(cache.action_valid[first : stop - 1], bool)
        if cache.done is not None:
            linked &= ~np.asarray(cache.done[first : stop - 1], bool)
    edges = [0, *(np.flatnonzero(~linked) + 1).tolist(), stop - first]
    return [(first + a, first + b) for a, b in zip(edges[:-1], edges[1:]) if allowed[a]]


def _cut(cache, start: tuple[int, int], length: int, context: int) -> Clip:
    episode, row = start
    channels = {name: array[row : row + length] for name, array in recorded_channels(cache).items()}
    return Clip(channels, cache.action[row : row + length], context, episode, row)
