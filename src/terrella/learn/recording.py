"""Recording: rows of a recording as tensors on demand, which of them may be trained on, and keyframes of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ..core.errors import DatasetError
from ..core.spec import Camera, Spec, kind_of
from ..data import ClipCache, Dataset, split
from ..data.training.cache import array_for, episodes_with, further_cameras
from ..space.camera import Intrinsics, relative_pose, yaw
from ..space.floorplan import Box, horizon, sees_into
from ..space.keyframes import Keyframes, doubled
from ..space.reproject import least_around
from ..worlds.carried_frames import covered_pixels, static_depth
from ..worlds.config import VideoConfig
from ..worlds.controls import AXES, CHOICE, Controls
from ..worlds.frame_history import split_pictures
from .trainer import Report

THINGS = "observation.things"  # the mask of what may move or vanish
OBJECTS, INSTANCES = "observation.objects", "observation.instances"  # the table of objects, and their segmentation
FEWEST = 64  # rows that can be trained on
MOUNT_ROWS = 256  # rows of which cameras' poses are compared
MOST = 96 * 128  # pixels of a frame by default


@dataclass(frozen=True)
class Recording:
    """Rows of a clip cache as tensors on demand; `start[row]` is the first row of the episode of `row`."""

    cache: ClipCache
    start: np.ndarray
    usable: np.ndarray  # bool: rows that may be trained on
    controls: Controls | None = None  # the meaning of its actions; None: buttons
    dataset: Dataset | None = None  # its pictures at full size
    held_out: tuple[int, ...] = ()  # episodes for validation
    cameras: tuple[
        str, ...
    ] = ()  # picture channels that lie side by side in `cache.rgb`, from the left; (): the main one alone

    @staticmethod
    def open(
        data: str | Path | Dataset,
        size: tuple[int, int] | None,
        report: Report,
        keep_out: Box | None = None,
        needs: tuple[str, ...] = ("rgb",),
        why: str = "a world of pictures is learned from them",
        cameras: Sequence[str] = (),
        joined: Sequence[str] = (),
    ) -> Recording:
        """The recording `data`, a folder or an address, with pictures at `size` (height, width; None: see `fitted_size`). A clip
        cache of it is kept on this machine, for rows are read in random order. Every 20th episode is held out, and so are the
        rows in which something in the box `keep_out` is visible; episodes without a channel of `needs` are left out. cameras:
        further pictures to keep, at the same size. joined: picture channels whose pictures of `size` are put side by side, from the
        left, in the place of those of the main camera. DatasetError if it lacks a channel of `needs`, or rows."""
        dataset = data if isinstance(data, Dataset) else Dataset(data)
        size = size or fitted_size(dataset, len(joined) or 1)
        further = further_cameras(dataset, cameras)
        shown = lambda done, total: report(done, total, "building the clip cache")  # noqa: E731
        side_by_side = [dataset.feature(name) or name for name in joined]
        cache = ClipCache.open(dataset, size, shown, further, joined=side_by_side)
        lacks = [name for name in needs if not has_channel(cache, name)]
        if lacks:
            raise DatasetError(f"{dataset.root} holds no {', '.join(lacks)}; {why}.")
        if keep_out is not None and not has_channel(cache, "pose"):
            raise DatasetError(f"{dataset.root} has no poses, so no part of its map can be kept out; drop --keep-out.")
        train, held_out = split(len(cache.episodes))
        recording = Recording.of(cache, train, keep_out)
        recording = replace(
            recording, controls=controls_of(cache), dataset=dataset, held_out=tuple(held_out), cameras=tuple(joined)
        )
        return recording.having(needs)

    @staticmethod
    def of(cache: ClipCache, episodes: list[int], keep_out: Box | None) -> Recording:
        """The rows of `episodes` in which nothing in the box `keep_out` is visible."""
        start = np.zeros(cache.length, np.int64)
        for first, last in cache.episodes:
            start[first:last] = first
        fx, fy, cx, cy = cache.world.get("camera") or (1.0, 1.0, 0.5, 0.5)
        return Recording(cache, start, usable_rows(cache, episodes, keep_out, (fx, fy, cx, cy)))

    def having(self, channels: Iterable[str]) -> Recording:
        """The recording without the episodes that have no reading of one of the channels: their rows of it are padding."""
        cache = self.cache
        names = [cache.keys.get(name, name) for name in channels]
        whole = set(episodes_with(names, np.arange(len(cache.episodes)), cache.absent).tolist())
        held_out = tuple(number for number in self.held_out if number in whole)
        if self.held_out and not held_out and len(whole) > 1:
            held_out = (max(whole),)
        usable = self.usable.copy()
        for number, (first, stop) in enumerate(cache.episodes):
            usable[first:stop] &= number in whole and number not in held_out
        return replace(self, usable=usable, held_out=held_out)

    def require_rows(self) -> Recording:
        """The recording itself; DatasetError if it has too few rows to train on."""
        if self.usable.sum() < FEWEST:
            raise DatasetError(
                f"{self.name} leaves {self.usable.sum()} frames to train on; record more, or a smaller keep_out."
            )
        return self

    @property
    def name(self) -> str:
        return "the recording" if self.dataset is None else str(self.dataset.root)

    @property
    def embodiment(self) -> str:
        """The body that its actions drove; "" where it is not known."""
        world = self.cache.world
        return str(world.get("embodiment") or world.get("name") or (self.dataset.embodiment if self.dataset else ""))

    @property
    def seen(self) -> list[int]:
        """The episodes for training."""
        return [number for number in range(len(self.cache.episodes)) if number not in self.held_out]

    @property
    def ignored(self) -> tuple[str, ...]:
        """Cameras of the recording that are not used."""
        source = self.dataset
        used = () if source is None else (source.rgb_key, *map(source.feature, self.cameras))
        return () if source is None else tuple(name for name in source.cameras if name not in used)

    def lenses(self) -> dict[str, Camera]:
        """The cameras that are joined, if a body carries them, mounted as their poses say relative to the main one. {} where that
        was not recorded, where one turns by itself (as at a wrist), and where all stand still."""
        cache, known = self.cache, self.cache.world.get("cameras") or {}
        names = {name: f"pose{name.removeprefix('rgb')}" for name in self.cameras if name in known}
        arrays = {name: array_for(pose, cache.arrays, cache.keys) for name, pose in names.items()}
        if not arrays or None in arrays.values() or "rgb" not in arrays:
            return {}
        lacking = {number for array in arrays.values() for number in cache.absent.get(str(array), ())}
        rows = np.flatnonzero(self.usable & ~np.isin(self.start, [cache.episodes[number][0] for number in lacking]))
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOUNT_ROWS).astype(int))]
        exact = {name: np.asarray(cache.arrays[array][rows], np.float64) for name, array in arrays.items()}
        origin = np.append(exact["rgb"][0, :3], np.zeros(4))  # large coordinates are inexact in float32
        poses = {name: torch.tensor(pose - origin, dtype=torch.float32) for name, pose in exact.items()}
        mounts = {name: relative_pose(poses["rgb"], pose) for name, pose in poses.items()}
        if _all_alike(poses["rgb"]) or not all(_all_alike(mount) for mount in mounts.values()):
            return {}
        size = cache.rgb.shape[1], cache.rgb.shape[2] // len(self.cameras)
        views = {name: (tuple(known[name]["intrinsics"]), tuple(mount[0].tolist())) for name, mount in mounts.items()}
        return {name: Camera(intrinsics, size, None, mount) for name, (intrinsics, mount) in views.items()}

    @property
    def posed(self) -> bool:
        """Whether it has depth, poses and a camera."""
        return all(has_channel(self.cache, name) for name in ("depth", "pose", "camera"))

    def episode_returns(self) -> np.ndarray | None:
        """float64 [E], the sum of each episode's rewards; None without rewards."""
        if self.cache.reward is None:
            return None
        total = np.append(0.0, np.cumsum(np.asarray(self.cache.reward, np.float64).reshape(-1)))
        return total[self.cache.ranges[:, 1]] - total[self.cache.ranges[:, 0]]

    def rows_within(self, before: int, after: int, acted: bool = False) -> np.ndarray:
        """Rows with `before` usable rows before them and `after` after them in their episode, all with valid actions if `acted`."""
        seen = self.usable & np.asarray(self.cache.action_valid) if acted else self.usable
        upto, rows = np.append(0, np.cumsum(seen)), np.arange(before, len(seen) - after)
        whole = upto[rows + after + 1] - upto[rows - before] == before + after + 1
        return rows[whole & (self.start[rows - before] == self.start[rows + after])]

    def steps_ahead(self) -> np.ndarray:
        """For each row [N], the number of steps that can be rolled out from it: consecutive usable rows of its episode."""
        fine = self.usable & np.asarray(self.cache.action_valid)
        if self.cache.done is not None:
            fine &= ~np.asarray(self.cache.done)
        last = np.append(self.start[1:] != self.start[:-1], True)
        ends = np.flatnonzero(~fine | last)
        rows = np.arange(len(fine))
        end = ends[np.searchsorted(ends, rows)]
        return np.where(fine, end - rows + fine[end], 0)

    def rgb(self, rows) -> torch.Tensor:
        """uint8 [n, 3, H, W]"""
        return torch.from_numpy(np.ascontiguousarray(self.cache.rgb[rows])).permute(0, 3, 1, 2).contiguous()

    def action(self, rows) -> torch.Tensor:
        """float32 [n, A], encoded for networks."""
        action = torch.from_numpy(np.array(self.cache.action[rows], np.float32))
        return action if self.controls is None else self.controls.encode(action)

    def actions_before(self, rows: np.ndarray, back: np.ndarray) -> torch.Tensor:
        """float32 [n, len(back), A]: the actions `back` rows before `rows`; zero before an episode's first."""
        at = rows[:, None] - back
        action = self.action(np.maximum(at, 0).ravel()).view(*at.shape, -1)
        return torch.where(torch.from_numpy(at >= self.start[rows][:, None])[..., None], action, 0.0)

    def depth(self, rows) -> torch.Tensor:
        """float32 [n, H, W] in metres, resized to the frames."""
        depth = torch.from_numpy(np.asarray(self.cache.depth[rows], np.float32)).clamp(0.1, 60.0)
        return F.interpolate(depth[:, None], self.cache.rgb.shape[1:3], mode="nearest-exact")[:, 0]

    def pose(self, rows) -> torch.Tensor:
        return torch.from_numpy(np.asarray(self.cache.pose[rows], np.float32))

    def things(self, rows) -> torch.Tensor:
        """float32 [n, H, W], 1 for pixels of what may move or vanish; 0 everywhere if that was not recorded."""
        recorded = self.cache.arrays.get(THINGS)
        height, width = self.cache.rgb.shape[1:3]
        if recorded is None:
            return torch.zeros(len(rows), height, width)
        things = torch.from_numpy(np.asarray(recorded[rows], np.float32))
        return F.adaptive_max_pool2d(things[:, None], (height, width))[:, 0]

    def instances(self, rows) -> torch.Tensor:
        """uint8 [n, H, W], the row of the object table that is visible at a pixel, counted from 1 (0: none)."""
        recorded = torch.from_numpy(np.asarray(self.cache.arrays[INSTANCES][rows], np.float32))
        return F.adaptive_max_pool2d(recorded[:, None], self.cache.rgb.shape[1:3])[:, 0].to(torch.uint8)

    def covered(self, rows) -> torch.Tensor:
        """bool [n, H, W], see worlds/carried_frames.covering."""
        return covered_pixels(self.instances(rows), self.things(rows))

    def static_depth(self, rows) -> torch.Tensor:
        """The depth [n, H, W] for keyframes: 0 at moving things and right beside them, where compressed video bleeds."""
        kept = static_depth(self.depth(rows), self.things(rows))
        return torch.where(least_around(kept) > 0, kept, 0.0)

    def evidence(self, config: VideoConfig, rows) -> dict[str, torch.Tensor]:
        """Observations of `rows` for a world of this config."""
        seen = dict(split_pictures(self.rgb(rows).permute(0, 2, 3, 1), self.cameras or ("rgb",)))
        if config.geometry:
            seen |= {"depth": self.depth(rows), "pose": self.pose(rows)}
        if config.moving:
            seen["things"] = self.things(rows)
        if config.objects:
            seen["instances"] = self.instances(rows)
            seen["objects"] = torch.from_numpy(np.array(self.cache.arrays[OBJECTS][rows], np.float32))
        return seen

    def recorded_actions(self, spec: Spec, rows) -> torch.Tensor:
        """The actions of `rows` in the space of `spec`: [n, *spec.action.shape]."""
        actions = np.asarray(self.cache.action[rows]).astype(spec.action.dtype)
        return torch.from_numpy(actions).view(len(rows), *(spec.action.shape or ()))

    def keyframes(self, rows, camera: Intrinsics) -> Keyframes:
        """Keyframes of `rows`, made as in play."""
        return Keyframes.of(doubled(self.rgb(rows)), self.static_depth(rows), self.pose(rows), camera)

    def sharp_keyframes(self, rows: np.ndarray, camera: Intrinsics) -> Keyframes:
        """Keyframes at twice the size of the frames, as in play, from the pictures at full size."""
        rgb = torch.from_numpy(self.dataset.rgb_at(rows)).permute(0, 3, 1, 2).float()
        size = [2 * length for length in self.cache.rgb.shape[1:3]]
        rgb = F.interpolate(rgb, size, mode="area" if rgb.shape[-1] >= size[1] else "nearest-exact")
        return Keyframes.of(rgb.round().to(torch.uint8), self.static_depth(rows), self.pose(rows), camera)


def has_channel(cache: ClipCache, name: str) -> bool:
    """Whether a recording has a channel, given by name or key ("observation.things")."""
    if name == "camera":
        return bool(cache.world.get("camera"))
    return getattr(cache, name, None) is not None or name in cache.arrays


def fitted_size(dataset: Dataset, cameras: int = 1) -> tuple[int, int]:
    """Height and width of a recording's frames in multiples of 8: their own, or scaled down to at most MOST pixels of all cameras
    together."""
    if dataset.rgb_key is None:
        return (96, 128)
    height, width = dataset.sensors[dataset.rgb_key].shape[:2]
    return learned_size(height, width, MOST // cameras)


def joined_cameras(dataset: Dataset, geometry: bool = True) -> tuple[str, ...]:
    """The picture channels of a recording that are learned as one wide picture: all, if their sizes are equal, from the left to the
    right where their poses say which is where, the main one first otherwise. () for a single camera, and (with `geometry`) for
    recordings with depth, whose main camera alone is learned."""
    known = {name: feature for name in dataset.channels if (feature := dataset.feature(name))}
    names = [name for name, feature in known.items() if kind_of(name) == "rgb" and feature in dataset.cameras]
    sizes = {tuple(dataset.sensors[known[name]].shape) for name in names}
    if len(names) < 2 or len(sizes) > 1 or (geometry and dataset.has("depth") and dataset.has("pose")):
        return ()
    names.sort(key=lambda name: (name != "rgb", name))
    poses = [known.get(f"pose{name.removeprefix('rgb')}", "") for name in names]
    if "" in poses:
        return tuple(names)
    shown = dataset.episode(0, poses)
    first = torch.tensor(np.stack([shown[name][0].ravel() for name in poses]), dtype=torch.float32)
    turned = yaw(first) - yaw(first[:1])
    to_left = torch.atan2(turned.sin(), turned.cos())
    return tuple(names[at] for at in to_left.argsort(descending=True).tolist())


def _all_alike(poses: torch.Tensor) -> bool:
    """Whether poses [N, 7] differ by less than a centimetre and a degree or two."""
    near = (poses[:, :3] - poses[:1, :3]).norm(dim=1) < 0.01
    return bool((near & ((poses[:, 3:] * poses[:1, 3:]).sum(1).abs() > 0.9999)).all())


def learned_size(height: int, width: int, most: int = MOST) -> tuple[int, int]:
    """The size at which pictures are learned, scaled down to at most `most` pixels."""
    scale = min(1.0, math.sqrt(most / (height * width)))
    return max(16, 8 * round(scale * height / 8)), max(16, 8 * round(scale * width / 8))


def controls_of(cache: ClipCache) -> Controls | None:
    """The meaning of a recording's actions: from its world's facts, else inferred (buttons if all are 0 or 1); None if it has no
    actions."""
    if cache.action is None:
        return None
    low, high = cache.world.get("action_low"), cache.world.get("action_high")
    space = str(cache.world.get("action_space"))
    whole = bool(cache.world.get("discrete")) or space.startswith("MultiDiscrete")
    if low is None or high is None:
        action = np.asarray(cache.action)
        low, high = action.min(0).tolist(), action.max(0).tolist()
        buttons = not whole and bool(np.isin(action, (0, 1)).all())
    else:
        buttons = space.startswith("MultiBinary")
    if buttons:
        return Controls.buttons(cache.action.shape[1])
    limits = tuple(map(float, low)), tuple(map(float, high))
    if whole:
        return Controls(CHOICE, *limits)
    mode, frame = (str(cache.world.get(f"action_{name}") or "") for name in ("mode", "frame"))
    return Controls(AXES, *limits, mode, tuple(cache.world.get("action_units") or ()), frame)


def usable_rows(cache: ClipCache, episodes: list[int], keep_out: Box | None, camera: Intrinsics) -> np.ndarray:
    """bool: rows of `episodes` in which the camera is not in the box `keep_out`, nor sees more than 0.5 m into it."""
    usable = np.zeros(cache.length, bool)
    for episode in episodes:
        usable[slice(*cache.episodes[episode])] = True
    if keep_out is None:
        return usable
    x0, y0, x1, y1 = keep_out
    pose = torch.from_numpy(np.array(cache.pose))
    usable &= ~((pose[:, 0] > x0) & (pose[:, 0] < x1) & (pose[:, 1] > y0) & (pose[:, 1] < y1)).numpy()
    rows = np.flatnonzero(usable)
    row = horizon(camera, cache.depth.shape[1])
    for some in np.array_split(rows, max(1, len(rows) // 4096)):
        level = torch.from_numpy(np.asarray(cache.depth[some, row], np.float32))
        usable[some[sees_into(keep_out, level, pose[some], camera).numpy()]] = False
    return usable


def choose_keyframes(pose: np.ndarray, rows: np.ndarray, count: int, metres_per_turn: float = 6.0) -> np.ndarray:
    """`count` of `rows` that cover places and headings evenly, by farthest-point sampling of (x, y, heading)."""
    turn = yaw(torch.from_numpy(np.array(pose[rows]))).numpy()
    scale = metres_per_turn / (2 * np.pi)
    points = np.concatenate([pose[rows][:, :2], scale * np.cos(turn)[:, None], scale * np.sin(turn)[:, None]], 1)
    picks, gap = [0], np.full(len(rows), np.inf)
    while len(picks) < min(count, len(rows)):
        gap = np.minimum(gap, np.square(points - points[picks[-1]]).sum(1))
        picks.append(int(gap.argmax()))
    return np.sort(rows[picks])


def open_views(memory: Keyframes, count: int) -> Keyframes:
    """`count` keyframes to start from, spread over the map, among the quarter with the farthest views."""
    far = memory.depth.flatten(1).median(1).values.argsort(descending=True)[: max(count, len(memory) // 4)]
    return memory.at(torch.from_numpy(choose_keyframes(memory.pose.numpy(), far.sort().values.numpy(), count)))


def box_of(card: Any) -> Box | None:
    """The box x0 y0 x1 y1 on a world's card that was kept out of its training."""
    return (float(card[0]), float(card[1]), float(card[2]), float(card[3])) if isinstance(card, (list, tuple)) else None
