"""Training samples of a VideoWorld: which rows may be learned from, which become its memory, and what it is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..core.spec import Spec
from ..data import ClipCache
from ..space.camera import Intrinsics, yaw
from ..space.floorplan import Box, horizon, sees_into
from ..space.keyframes import Glimpse, Keyframes, doubled, gathered, look, retrieve
from ..space.reproject import least_around
from ..worlds.controls import AXES, CHOICE, Controls
from ..worlds.generator import VideoConfig
from ..worlds.moving import covering, still
from ..worlds.video import carry

THINGS = "observation.things"  # the channel that marks what may move or vanish
CAST, INSTANCES = "observation.objects", "observation.instances"  # those that tell it apart


@dataclass(frozen=True)
class Recording:
    """Rows of a clip cache as tensors on demand; `start[row]` is the first row of its episode."""

    cache: ClipCache
    start: np.ndarray
    usable: np.ndarray  # rows that training may see
    controls: Controls | None = None  # what its actions mean; None: buttons

    def rgb(self, rows) -> torch.Tensor:
        """uint8 [n, 3, H, W]"""
        return torch.from_numpy(np.ascontiguousarray(self.cache.rgb[rows])).permute(0, 3, 1, 2).contiguous()

    def action(self, rows) -> torch.Tensor:
        """float32 [n, A], as networks are told it."""
        action = torch.from_numpy(np.array(self.cache.action[rows], np.float32))
        return action if self.controls is None else self.controls.tell(action)

    def depth(self, rows) -> torch.Tensor:
        """float32 [n, H, W] metres at the size of the frames, whatever size was recorded."""
        depth = torch.from_numpy(np.asarray(self.cache.depth[rows], np.float32)).clamp(0.1, 60.0)
        return F.interpolate(depth[:, None], self.cache.rgb.shape[1:3], mode="nearest-exact")[:, 0]

    def pose(self, rows) -> torch.Tensor:
        return torch.from_numpy(np.asarray(self.cache.pose[rows], np.float32))

    def things(self, rows) -> torch.Tensor:
        """float32 [n, H, W], 1 where something is that may move or vanish; 0 everywhere where that was not recorded."""
        recorded = self.cache.arrays.get(THINGS)
        height, width = self.cache.rgb.shape[1:3]
        if recorded is None:
            return torch.zeros(len(rows), height, width)
        things = torch.from_numpy(np.asarray(recorded[rows], np.float32))
        return F.adaptive_max_pool2d(things[:, None], (height, width))[:, 0]

    def instances(self, rows) -> torch.Tensor:
        """uint8 [n, H, W], which row of `cast` is seen at a pixel, counted from 1 (0: none)."""
        told = torch.from_numpy(np.asarray(self.cache.arrays[INSTANCES][rows], np.float32))
        return F.adaptive_max_pool2d(told[:, None], self.cache.rgb.shape[1:3])[:, 0].to(torch.uint8)

    def covered(self, rows) -> torch.Tensor:
        """bool [n, H, W], see worlds/moving.covering."""
        return covering(self.instances(rows), self.things(rows))

    def lasting(self, rows) -> torch.Tensor:
        """The depth [n, H, W] that a keyframe may hold: 0 where things are and right beside them, where a film bleeds."""
        kept = still(self.depth(rows), self.things(rows))
        return torch.where(least_around(kept) > 0, kept, 0.0)

    def evidence(self, config: VideoConfig, rows) -> dict[str, torch.Tensor]:
        """What a world of this make observes of `rows`."""
        seen = {"rgb": self.rgb(rows).permute(0, 2, 3, 1).contiguous()}
        if config.geometry:
            seen |= {"depth": self.depth(rows), "pose": self.pose(rows)}
        if config.moving:
            seen["things"] = self.things(rows)
        if config.objects:
            seen["instances"] = self.instances(rows)
            seen["objects"] = torch.from_numpy(np.array(self.cache.arrays[CAST][rows], np.float32))
        return seen

    def played(self, spec: Spec, rows) -> torch.Tensor:
        """The actions of `rows` as the world of `spec` takes them: [n, *spec.action.shape]."""
        actions = np.asarray(self.cache.action[rows]).astype(spec.action.dtype)
        return torch.from_numpy(actions).view(len(rows), *(spec.action.shape or ()))

    def keyframes(self, rows, camera: Intrinsics) -> Keyframes:
        """As a dream keeps its own."""
        return Keyframes.of(doubled(self.rgb(rows)), self.lasting(rows), self.pose(rows), camera)


def controls_of(cache: ClipCache) -> Controls:
    """What the actions of a recording mean: as its world said, else as they look (buttons where all are 0 or 1)."""
    low, high = cache.world.get("action_low"), cache.world.get("action_high")
    whole = bool(cache.world.get("discrete"))
    if low is None or high is None:
        action = np.asarray(cache.action)
        low, high = action.min(0).tolist(), action.max(0).tolist()
        buttons = not whole and bool(np.isin(action, (0, 1)).all())
    else:
        buttons = str(cache.world.get("action_space")).startswith("MultiBinary")
    if buttons:
        return Controls.buttons(cache.action.shape[1])
    return Controls(CHOICE if whole else AXES, tuple(map(float, low)), tuple(map(float, high)))


def usable_rows(cache: ClipCache, episodes: list[int], keep_out: Box | None, camera: Intrinsics) -> np.ndarray:
    """Rows of `episodes` in which the eye neither stands in the box `keep_out` nor sees into it by more than 0.5 m."""
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
    """`count` of `rows` that cover places and headings evenly: farthest-point sampling of (x, y, heading)."""
    turn = yaw(torch.from_numpy(np.array(pose[rows]))).numpy()
    scale = metres_per_turn / (2 * np.pi)
    points = np.concatenate([pose[rows][:, :2], scale * np.cos(turn)[:, None], scale * np.sin(turn)[:, None]], 1)
    picks, gap = [0], np.full(len(rows), np.inf)
    while len(picks) < min(count, len(rows)):
        gap = np.minimum(gap, np.square(points - points[picks[-1]]).sum(1))
        picks.append(int(gap.argmax()))
    return np.sort(rows[picks])


def open_views(memory: Keyframes, count: int) -> Keyframes:
    """`count` of the keyframes, spread over the map, among the quarter that looks farthest: a good place to begin a story."""
    far = memory.depth.flatten(1).median(1).values.argsort(descending=True)[: max(count, len(memory) // 4)]
    return memory.at(torch.from_numpy(choose_keyframes(memory.pose.numpy(), far.sort().values.numpy(), count)))


@dataclass(frozen=True)
class Lesson:
    """One batch for the generator: what it is shown and told, and the true frames it should find, in its own code."""

    glimpse: Glimpse
    last: torch.Tensor
    told: torch.Tensor
    truth: torch.Tensor
    weight: torch.Tensor | None = None  # [B, 1, H, W], how much each pixel counts; None: all alike

    def judged(self, clean: torch.Tensor) -> torch.Tensor:
        """Drawn frames `clean`, with the truth where nothing counts: no loss and no critic sees what was drawn there."""
        if self.weight is None:
            return clean
        truth = torch.cat([self.truth[:, :4], 40 * self.truth[:, 4:] - 20], 1)  # things are drawn as logits
        return torch.where(self.weight > 0, clean, truth)

    def to(self, device) -> Lesson:
        weight = None if self.weight is None else self.weight.to(device)
        glimpse, last = self.glimpse.to(device), self.last.to(device)
        return Lesson(glimpse, last, self.told.to(device), self.truth.to(device), weight)


# Dream(lesson without truth) -> clean frames [B, 4, H, W] in the generator's code
Dream = Callable[[Lesson], torch.Tensor]


@dataclass(frozen=True)
class Shown:
    """What the generator is shown for B target rows, and the truth."""

    chosen: list[Keyframes]
    before: np.ndarray  # the row before each target
    target: np.ndarray


def draw(
    recording: Recording, memory: Keyframes, config: VideoConfig, batch: int, rng: np.random.Generator, back: int = 2
) -> Shown:
    """Half of the samples stand in recorded places (memory, thinned at random), half see only their own episode's past.

    Both learn to complete: the first where memory is dense, the second where it is sparse. `back` rows before each target
    are of its episode and usable.
    """
    rows = recording.usable & (np.arange(len(recording.usable)) - recording.start >= back)
    for age in range(1, back + 1):
        rows &= np.roll(recording.usable, age)
    target = rng.choice(np.flatnonzero(rows), batch)
    chosen = []
    for index, row in enumerate(target):
        pose = recording.pose([row])[0]
        if index % 2 == 0:
            picks = _retrieved(memory, pose, config)
            if rng.random() < 0.4:
                picks = [pick for pick in picks if rng.random() < 0.6]
            chosen.append(memory.at(picks))
        else:
            past = _past(recording, int(row), rng)
            own = recording.keyframes(past, config.camera)
            chosen.append(own.at(_retrieved(own, pose, config)))
    return Shown(chosen, target - 1, target)


def _retrieved(memory: Keyframes, pose: torch.Tensor, config: VideoConfig) -> list[int]:
    """The keyframes to use for the view from `pose` [7]."""
    picks = retrieve(memory, pose[None], config.camera, config.size, config.sources)[0]
    return picks[picks >= 0].tolist()


def _past(recording: Recording, row: int, rng: np.random.Generator) -> np.ndarray:
    """A few rows of the same episode's past, the newest some steps ago, as a dream far from its keyframes has them."""
    newest = row - int(rng.choice([2, 4, 8, 16, 32, 64]))
    gaps = rng.integers(3, 24, size=int(rng.integers(1, 7))).cumsum() - 3
    past = np.maximum(newest - gaps, recording.start[row])
    past = np.unique(np.minimum(past, row - 1))
    seen = past[recording.usable[past]]  # what training must not see is not shown either
    return seen if len(seen) else np.array([row - 1])


def glimpse_of(shown: Shown, rows: np.ndarray, recording: Recording, config: VideoConfig):
    """What the chosen keyframes know of the views at `rows`."""
    memory, picks = gathered(shown.chosen, config.size)
    return look(memory, picks, recording.pose(rows), config.camera, config.size, config.slots)


def carried(rgb, depth, from_rows, to_rows, glimpse, recording: Recording, config: VideoConfig) -> torch.Tensor:
    """The frame at `from_rows` (given, dreamt or true) carried into the views at `to_rows`."""
    poses = recording.pose(from_rows), recording.pose(to_rows)
    return carry(rgb, depth, poses[0], glimpse, poses[1], config.camera)
