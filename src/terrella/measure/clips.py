"""Clips: windows of held-out recordings that every arm of a scorecard predicts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ..core.errors import DatasetError, ObservationError
from ..core.spec import Spec, kind_of
from ..space.floorplan import horizon, sees_into

# (clip cache, first, stop) -> bool [stop - first]: rows allowed in a clip
Where = Callable[[Any, int, int], np.ndarray]


@dataclass(frozen=True)
class Clip:
    """T = context + horizon rows of one episode; the action of row t leads from observation t to t + 1.

    The first `context` rows are observed by a world, the rest are the truth. Arrays may be views of a memory-mapped file.
    """

    # Recorded channels by the world's names, [T, ...]: rgb uint8 [T, H, W, 3], depth in metres, pose float32 [T, 7], reward [T]
    # and done [T] (after each action), vectors.
    channels: Mapping[str, np.ndarray]
    action: np.ndarray  # [T, A]
    context: int  # rows
    episode: int
    start: int  # row of the cache

    @property
    def horizon(self) -> int:
        return len(self.action) - self.context

    @property
    def pose(self) -> np.ndarray | None:
        return self.channels.get("pose")

    def walked_m(self, channel: str = "pose") -> np.ndarray:
        """The length of the true path from the last context row to each later one: metres, float64 [horizon]."""
        places = np.asarray(self.channels[channel], np.float64)[self.context - 1 :, :3]
        return np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()

    def moves(self) -> bool:
        """Whether the camera moves more than half a metre or turns more than 20 degrees after the context; without poses, whether
        anything changes."""
        if self.pose is None:
            main = next(iter(self.channels.values()))
            return bool((main[self.context :] != main[self.context - 1]).any())
        turned = 2 * np.arccos(np.clip(np.abs(self.pose[self.context :, 3:] @ self.pose[self.context - 1, 3:]), 0, 1))
        return bool(self.walked_m()[-1] > 0.5 or turned.max() > np.deg2rad(20))


def recorded_channels(cache) -> dict[str, np.ndarray]:
    """The arrays of a clip cache, by channel."""
    named = {name: getattr(cache, name, None) for name in ("rgb", "depth", "pose", "reward", "done")}
    keyed = {channel: cache.arrays.get(key) for channel, key in cache.keys.items()}
    return {name: array for name, array in {**named, **cache.further, **keyed}.items() if array is not None}


def check_recording(cache, spec: Spec) -> None:
    """DatasetError if the recording has other actions, or lacks channels that the world observes."""
    low, high = spec.action_limits
    held = np.asarray(cache.action[:: max(1, len(cache.action) // 10000)]).reshape(-1, *(spec.action.shape or ()))
    if (held < low - 1e-3).any() or (held > high + 1e-3).any():
        raise DatasetError(f"the recording has actions outside of {spec.name}'s {spec.action}: it is of another game.")
    recorded = recorded_channels(cache)
    missing = [name for name in spec.observes if name not in recorded]
    if missing:
        raise DatasetError(
            f"{spec.name} observes {' and '.join(missing)}, and the recording has only {', '.join(recorded)}: "
            "score it on a recording of its own game."
        )


def in_box(*box: float) -> Where:
    """Rows with a position inside the box x0, y0, x1, y1 on the map, metres."""
    x0, y0, x1, y1 = box

    def inside(cache, first: int, stop: int) -> np.ndarray:
        x, y = np.asarray(cache.pose[first:stop, :2]).T
        return (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)

    return inside


def out_of_sight(*box: float) -> Where:
    """Rows with a position outside the box that, if depth and camera are recorded, do not see into it."""

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
    advice: str = "record longer episodes or ask for a shorter horizon",
) -> list[Clip]:
    """Up to `count` windows without overlap, drawn at random from `episodes` of a clip cache.

    Windows have valid actions, no end (`done`), and only rows that `where` allows. Windows without motion are kept (see
    Clip.moves). Fewer are returned if the recording has no more; DatasetError with `advice` if it has none.
    """
    if where is not None and cache.pose is None:
        raise DatasetError("choosing clips by place needs recorded poses; leave `where` out.")
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
        inside = "" if where is None else " and lies in the part of the map that is scored"
        raise DatasetError(
            f"no window of {length} rows ({context} of context, {horizon} of horizon) fits in an episode{inside}; "
            f"{advice}."
        )
    order = torch.randperm(len(starts), generator=rng).tolist()[:count]
    return [_cut(cache, starts[pick], length, context) for pick in order]


def check_clips(place: str, clips: Sequence[Clip], steps: int) -> None:
    """DatasetError unless there are clips of `place`, all of one length, with `steps` steps or more to predict."""
    if not clips:
        raise DatasetError(f"there are no clips of {place} places; draw some, or leave the place out.")
    if len({(clip.context, clip.horizon) for clip in clips}) != 1:
        raise DatasetError(f"the clips of {place} places differ in length; draw them with one context and one horizon.")
    if clips[0].horizon < steps:
        raise DatasetError(
            f"the clips of {place} places have {clips[0].horizon} steps to predict, the largest horizon is {steps}; "
            "draw longer ones."
        )


def evidence(clips: Sequence[Clip], spec: Spec, row: int) -> dict[str, torch.Tensor]:
    """The channels of row `row` of each clip that `spec` observes, and those of may_observe that were recorded: name -> tensor
    [B, ...]. ObservationError if one is missing or of another shape."""
    seen = {}
    for name in (*spec.observes, *spec.may_observe):
        arrays = [clip.channels[name] for clip in clips if name in clip.channels]
        if len(arrays) < len(clips) and name in spec.may_observe:
            continue
        if len(arrays) < len(clips):
            raise ObservationError(f"{spec.name} observes '{name}', which the recording lacks; record it as well.")
        stacked = torch.from_numpy(np.stack([np.asarray(array[row]) for array in arrays]))
        wanted = tuple(spec.channels[name].shape or ()) if name in spec.channels else tuple(stacked.shape[1:])
        if kind_of(name) == "depth" and len(wanted) == 2:  # depth may be recorded at another size
            stacked = F.interpolate(stacked.float()[:, None], wanted, mode="nearest-exact")[:, 0]
        is_mask = stacked.ndim == 3 and stacked.dtype in (torch.bool, torch.uint8)
        if name in spec.may_observe and is_mask and len(wanted) == 2:  # masks too; a set pixel stays set
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
    """Runs [first, stop) of the rows of an episode that `where` allows. unbroken: each row follows from the one before by a valid
    action."""
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
