"""VideoWorld: a first-person world learned from posed RGB-D recordings, that draws the next frame and remembers places.

State is where the eye stands, how it moves, the frame it sees, and the keyframes of its own dream; the keyframes of the
recordings travel with the world as its long-term memory. `imagine` predicts the motion that the action causes (`Motion`,
then the walls that the keyframes saw), asks memory what the new view shows (space/keyframes.py), and a generator
completes it (`Generator`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import ContractError, ObservationError
from ..core.spec import Spec
from ..core.state import State
from ..space.camera import Intrinsics, planar_pose, yaw
from ..space.floorplan import floor_plan, slide
from ..space.keyframes import Glimpse, Keyframes, look, retrieve
from ..space.reproject import warp

FAR_DEPTH_M, NEAR_DEPTH_M = 60.0, 0.1
MOOD = (3, 4)  # rows and columns of the tiny picture of the last frame that the generator is always told


@dataclass(frozen=True)
class VideoConfig:
    """size: (height, width) of the frames; camera: intrinsics as in Spec; actions: numbers in an action."""

    camera: Intrinsics
    actions: int
    size: tuple[int, int] = (96, 128)
    channels: tuple[int, ...] = (32, 56, 88, 128)  # of the generator at 1/2, 1/4, 1/8 and 1/16 of the size
    sources: int = 6  # keyframes that are warped into a view
    slots: int = 3  # of them, those that the generator sees at each pixel
    history: int = 8  # actions that the motion model remembers
    body_m: float = 0.0  # half the width of the body that slides along walls, as recordings show it; 0: none stops it
    short: float = 0.0  # the share of a step by which it stops short of a wall
    own_keyframes: int = 24  # of its dream, the oldest is forgotten first
    known_enough: float = 0.95  # share of a dreamt frame that memory knew, above which it is not kept as a keyframe
    new_view: tuple[float, float] = (0.4, 0.2)  # metres and radians from the nearest keyframe of its own
    geometry: bool = True  # False: no depth and pose, the last frames stand for memory (worlds/history.py)
    steps: int = 1  # flow-matching steps a frame


class Block(nn.Module):
    """Two 3x3 convolutions around a SiLU, told the flow time and more (see Generator), with a residual path."""

    def __init__(self, channels: int, told: int):
        super().__init__()
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))
        self.time = nn.Linear(told, channels)

    def forward(self, x: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
        inner = F.silu(self.first(x) + self.time(told)[:, :, None, None])
        return F.silu(x + self.second(inner))


class Generator(nn.Module):
    """A U-Net that, from noise and what memory knows, predicts the clean frame (flow matching, x-prediction).

    Each pixel is a mixture of the warped colours, the last frame carried over, and a colour of the net's own; so what
    is known comes through as sharp as it was seen. It begins with a 2x pixel-unshuffle: a quarter of the cost.
    """

    def __init__(self, config: VideoConfig):
        super().__init__()
        self.slots = config.slots
        self.choices = config.slots + 2  # merged, slots, last frame
        inputs = 3 + 4 * config.slots + 4 + 2 + 4
        widths = config.channels
        self.enter = nn.Conv2d(4 * inputs, widths[0], 1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:]))
        told = 1 + 3 * MOOD[0] * MOOD[1] + (0 if config.geometry else config.actions * config.slots)
        self.before = nn.ModuleList(Block(width, told) for width in widths)
        self.after = nn.ModuleList(Block(width, told) for width in widths)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.leave = nn.Conv2d(widths[0], 4 * (self.choices + 1 + 3 + 1), 3, padding=1)
        nn.init.zeros_(self.leave.weight)
        bias = torch.zeros(self.choices + 5)
        bias[0] = 3.0  # at first, trust the merged colours
        self.leave.bias.data = bias.repeat_interleave(4)

    def forward(
        self,
        noisy: torch.Tensor,
        time: torch.Tensor,
        glimpse: Glimpse,
        last: torch.Tensor,
        told: torch.Tensor,
    ) -> torch.Tensor:
        """noisy [B, 4, H, W] = rgb in [-1, 1] and depth code; time [B]; last [B, 4, H, W] = the last frame's colour
        warped into this view and its trust; told [B, n]: the last frame's `mood`, and where there is no geometry to say
        what they cause, the actions [slots * A], the newest first. Returns the clean frame in the code of `noisy`."""
        told = torch.cat([time[:, None], told], 1)
        colours, trust = glimpse.rgb * 2 - 1, glimpse.trust
        merged = merge(glimpse) * 2 - 1
        depth = encode_depth(glimpse.depth)[:, None]
        last_rgb, last_trust = last[:, :3] * 2 - 1, last[:, 3:]
        parts = [
            merged,
            (colours * (trust > 0)[:, :, None]).flatten(1, 2),
            trust,
            last_rgb * (last_trust > 0),
            last_trust,
        ]
        parts += [depth, glimpse.known[:, None], noisy]
        x = F.silu(self.enter(F.pixel_unshuffle(torch.cat(parts, 1), 2)))
        kept = []
        for level, block in enumerate(self.before):
            x = block(x, told)
            if level < len(self.down):
                kept.append(x)
                x = self.down[level](x)
        x = self.after[-1](x, told)
        for level in reversed(range(len(self.down))):
            x = kept[level] + F.interpolate(self.up[level](x), kept[level].shape[-2:], mode="nearest")
            x = self.after[level](x, told)
        out = F.pixel_shuffle(self.leave(x), 2)
        share = out[:, : self.choices + 1].softmax(1)
        own = out[:, self.choices + 1 : self.choices + 4]
        known = torch.cat([merged[:, None], colours, last_rgb[:, None]], 1)
        rgb = (share[:, :-1, None] * known).sum(1) + share[:, -1:] * own
        return torch.cat([rgb, depth + out[:, -1:]], 1)


def channels_last(generator: Generator) -> Generator:
    """The same network with its weights laid out for faster convolutions on a CPU (a third less time)."""
    for weight in generator.parameters():
        if weight.ndim == 4:
            weight.data = weight.data.contiguous(memory_format=torch.channels_last)
    return generator


def merge(glimpse: Glimpse) -> torch.Tensor:
    """The slots' colours averaged by their squared trust: [B, 3, H, W] in [0, 1]."""
    weight = (glimpse.trust + 1e-4) ** 2
    return (glimpse.rgb * weight[:, :, None]).sum(1) / weight.sum(1)[:, None]


def encode_depth(depth: torch.Tensor) -> torch.Tensor:
    """Metres -> about [-1, 1], logarithmic."""
    return depth.clamp(NEAR_DEPTH_M, FAR_DEPTH_M).log() / 2 - 0.6


def decode_depth(code: torch.Tensor) -> torch.Tensor:
    return ((code + 0.6) * 2).exp().clamp(NEAR_DEPTH_M, FAR_DEPTH_M)


class Motion(nn.Module):
    """How the eye moves where nothing is in its way: it turns by the actions, and glides by drag and thrust in its own
    frame. Walls come after (space/floorplan.slide)."""

    middle: torch.Tensor  # of the recorded places, and how far they reach, in metres
    span: torch.Tensor

    def __init__(self, config: VideoConfig):
        super().__init__()
        acts = config.actions * (config.history + 1)
        self.turn = nn.Sequential(nn.Linear(acts, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1))
        self.glide = nn.Linear(2 + config.actions, 2)
        self.ending = nn.Sequential(
            nn.Linear(2 + config.actions, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1)
        )
        self.register_buffer("middle", torch.zeros(2))
        self.register_buffer("span", torch.ones(()))

    def forward(self, heading, speed, actions):
        """heading [B] radians; speed [B, 2] metres a step, world frame; actions [B, history + 1, A], the newest last.
        Returns the new heading [B] and the displacement that this step wishes for [B, 2]."""
        heading = heading + 0.1 * self.turn(actions.flatten(1))[:, 0]
        glide = self.glide(torch.cat([10 * turned(speed, -heading), actions[:, -1]], -1))
        return heading, 0.1 * turned(glide, heading)

    def ends(self, place: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Logit that the episode ends at `place` [B, 2]: [B]."""
        return self.ending(torch.cat([2 * (place - self.middle) / self.span, action], -1))[:, 0]


def turned(vector: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """[B, 2] rotated counter-clockwise by [B] radians."""
    c, s = angle.cos(), angle.sin()
    return torch.stack([vector[:, 0] * c - vector[:, 1] * s, vector[:, 0] * s + vector[:, 1] * c], -1)


class VideoWorld:
    """The learned world; worlds/folder.py saves and loads it.

    `memory` are the recordings' keyframes (may be empty), `starts` those that a story may begin from.
    """

    def __init__(
        self, spec: Spec, config: VideoConfig, generator: Generator, motion: Motion,
        memory: Keyframes, starts: Keyframes, rewards: tuple[float, float],
    ):  # fmt: skip
        self.spec, self.config = spec, config
        self.generator = channels_last(generator.eval())
        self.motion = motion.eval()
        self.memory, self.starts, self.rewards = memory, starts, rewards

    @cached_property
    def _walls(self) -> torch.Tensor:
        return floor_plan(self.memory.walls, self.memory.pose)

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins where one of the recordings was, standing still."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        pick = torch.randint(len(self.starts), (batch,), generator=rng)
        keys = self.starts.at(pick)
        rgb = F.interpolate(keys.rgb.float(), self.config.size, mode="area")
        seen = {"rgb": rgb.round().to(torch.uint8).permute(0, 2, 3, 1), "depth": keys.depth, "pose": keys.pose}
        return self.observe(seen, None, rng)

    @torch.inference_mode()
    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """Evidence: rgb, depth and pose together become a keyframe of the state; a pose alone moves the eye there
        (it needs a prior) and the frame is dreamt."""
        if "pose" not in observation:
            raise ObservationError(
                f"{self.spec.name} observes rgb, depth and pose, or a pose alone; got {list(observation)}."
            )
        pose = torch.as_tensor(observation["pose"]).float()
        batch = len(pose)
        if pose.shape != (batch, 7) or not torch.isfinite(pose).all():
            raise ObservationError(f"pose is finite float [B, 7] (x, y, z, quaternion wxyz); got {tuple(pose.shape)}.")
        if prior is None:
            if not {"rgb", "depth"} <= set(observation):
                raise ObservationError(
                    "a pose alone says nothing of what is seen there: give rgb and depth, or a prior."
                )
            prior = self._blank(batch, pose)
        speed = pose[:, :2] - prior["pose"][:, :2]
        speed = speed + torch.where(
            prior["dreamt"][:, None], prior["speed"], 0.0
        )  # what was dreamt, and how wrong it was
        speed = torch.where((speed.norm(dim=-1) < 1.0)[:, None], speed, 0.0)
        no, nothing = torch.zeros(batch, dtype=torch.bool), torch.zeros(batch)
        state = prior.replace(pose=pose, speed=speed, dreamt=no, done=no, reward=nothing)
        if not {"rgb", "depth"} <= set(observation):
            return self._draw(state, prior, rng)
        height, width = self.config.size
        rgb, depth = torch.as_tensor(observation["rgb"]), torch.as_tensor(observation["depth"])
        if rgb.shape != (batch, height, width, 3) or depth.shape != (batch, height, width):
            raise ObservationError(f"rgb is uint8 [B, {height}, {width}, 3] and depth [B, {height}, {width}].")
        if rgb.dtype != torch.uint8 or not (torch.isfinite(depth).all() and (depth > 0).all()):
            raise ObservationError("rgb must be uint8, and depth finite and above 0 metres.")
        state = state.replace(rgb=rgb.permute(0, 3, 1, 2).contiguous(), depth=depth.float())
        return self._remember(state, torch.ones(batch, dtype=torch.bool))

    @torch.inference_mode()
    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """One step: move, then draw what is seen from there."""
        action = self.spec.check_action(action, state.batch).float().view(state.batch, -1)
        pose, acts = state["pose"], torch.cat([state["actions"], action[:, None]], 1)
        heading, wish = self.motion(yaw(pose), state["speed"], acts)
        moved, speed = self._walk(state, wish)
        place = pose[:, :2] + moved
        pose = planar_pose(place[:, 0], place[:, 1], pose[:, 2], heading)
        still = state["done"]
        done = still | (self.motion.ends(place, action) > 0)
        next_state = state.replace(
            pose=torch.where(still[:, None], state["pose"], pose), speed=torch.where(still[:, None], 0.0, speed),
            actions=acts[:, 1:], dreamt=torch.ones_like(done), done=done,
            reward=torch.where(still, 0.0, self.rewards[0] + self.rewards[1] * done.float()),
        )  # fmt: skip
        return self._draw(next_state, state, rng)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        show = {"rgb": lambda: state["rgb"].permute(0, 2, 3, 1).contiguous()}
        return {name: show[name]() if name in show else state[name] for name in channels}

    def without_memory(self) -> VideoWorld:
        """The same world, with nothing of its recordings but where they began."""
        none = self.memory.at(slice(0, 0))
        return VideoWorld(self.spec, self.config, self.generator, self.motion, none, self.starts, self.rewards)

    def _blank(self, batch: int, pose: torch.Tensor) -> State:
        config = self.config
        (height, width), own = config.size, config.own_keyframes
        nothing = Keyframes.of(
            torch.zeros(1, 3, 2 * height, 2 * width, dtype=torch.uint8),
            torch.ones(1, height, width),
            pose[:1],
            config.camera,
        )
        keys = {f"key_{name}": tensor.expand(batch, own, *tensor.shape[1:]) for name, tensor in vars(nothing).items()}
        return State(
            {
                "pose": pose, "speed": torch.zeros(batch, 2), "dreamt": torch.zeros(batch, dtype=torch.bool),
                "actions": torch.zeros(batch, config.history, config.actions),
                "reward": torch.zeros(batch), "done": torch.zeros(batch, dtype=torch.bool),
                "rgb": torch.zeros(batch, 3, height, width, dtype=torch.uint8), "depth": torch.ones(batch, height, width),
                "key_count": torch.zeros(batch, dtype=torch.int64), **keys,
            }
        )  # fmt: skip

    def _own(self, state: State, view: int) -> Keyframes:
        """The keyframes of one story's own dream."""
        count = min(int(state["key_count"][view]), self.config.own_keyframes)
        return Keyframes(*(state[f"key_{name}"][view, :count] for name in vars(self.memory)))

    def _walk(self, state: State, wish: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The displacement [B, 2] and the speed left [B, 2] of a body that wishes to move by `wish` [B, 2] among the walls
        that memory and the dream have seen."""
        walks = []
        for view in range(state.batch):
            one, own = slice(view, view + 1), self._own(state, view)
            walls = torch.cat([self._walls, own.walls.flatten(0, 1)])
            walks.append(slide(walls, state["pose"][one, :2], wish[one], self.config.body_m, self.config.short))
        moved, speed = zip(*walks)
        return torch.cat(moved), torch.cat(speed)

    def _draw(self, state: State, before: State, rng: torch.Generator) -> State:
        """The frame at `state`'s pose, from memory, `before`'s frame and the generator."""
        config, pose = self.config, state["pose"]
        chosen = []
        for view in range(state.batch):
            memories = [keys for keys in (self.memory, self._own(state, view)) if len(keys)]
            picks = retrieve(memories, pose[view], config.camera, config.size, config.sources)
            chosen.append(_joined([keys.at(pick) for keys, pick in zip(memories, picks)]))
        glimpse = look(chosen, pose, config.camera, config.size, config.slots)
        last = carry(before["rgb"], before["depth"], before["pose"], glimpse, pose, config.camera)
        noise = torch.randn(state.batch, 4, *config.size, generator=rng)
        there = next(self.generator.parameters()).device
        told = mood(before["rgb"]).to(there)
        clean = generate(self.generator, noise.to(there), glimpse.to(there), last.to(there), told, config.steps).cpu()
        rgb = ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        drawn = state.replace(rgb=rgb, depth=decode_depth(clean[:, 3]))
        invented = glimpse.known.mean((1, 2)) < self.config.known_enough
        return self._remember(drawn, invented & (self._nearest_own(drawn)[0] > 1))

    def _nearest_own(self, state: State) -> tuple[torch.Tensor, torch.Tensor]:
        """How far [B] the eye is from the nearest keyframe of the story's own, above 1 for a new view; and its slot."""
        far, turn = self.config.new_view
        pose, kept = state["pose"][:, None], state["key_pose"]
        away = (kept[..., :3] - pose[..., :3]).norm(dim=-1) / far
        angle = yaw(kept) - yaw(pose)
        apart = away + torch.atan2(angle.sin(), angle.cos()).abs() / turn
        used = torch.arange(kept.shape[1]) < state["key_count"][:, None]
        return torch.where(used, apart, 9.0).min(1)

    def _remember(self, state: State, which: torch.Tensor) -> State:
        """The current frame kept as a keyframe in the stories `which` [B]; the oldest is forgotten when full."""
        if not which.any():
            return state
        new = Keyframes.of(doubled(state["rgb"]), state["depth"], state["pose"], self.config.camera)
        apart, nearest = self._nearest_own(state)
        fresh = apart > 1  # else it takes the place of the keyframe that it is too near to: evidence beats a dream
        slot = torch.where(fresh, state["key_count"] % self.config.own_keyframes, nearest)
        rows = which.nonzero()[:, 0]
        changed = {"key_count": state["key_count"] + (which & fresh).long()}
        for name, tensor in vars(new).items():
            kept = state[f"key_{name}"].clone()
            kept[rows, slot[rows]] = tensor[rows].to(kept.dtype)
            changed[f"key_{name}"] = kept
        return state.replace(**changed)


def mood(rgb: torch.Tensor) -> torch.Tensor:
    """The look of frames (uint8 [B, 3, H, W]) as a tiny picture in [-1, 1]: [B, 36]. Where nothing is known of a view,
    what was just seen says best what the place is like."""
    return F.adaptive_avg_pool2d(rgb.float() / 127.5 - 1, MOOD).flatten(1)


def generate(
    generator: Generator, noise: torch.Tensor, glimpse: Glimpse, last: torch.Tensor, told: torch.Tensor, steps: int
) -> torch.Tensor:
    """Noise to frame in `steps` Euler steps of the straight flow."""
    x = noise
    for step in range(steps):
        now, after = step / steps, (step + 1) / steps
        clean = generator(x, torch.full((len(x),), now, device=x.device), glimpse, last, told)
        x = clean if after == 1 else x + (clean - x) * (after - now) / (1 - now)
    return x


def carry(
    rgb: torch.Tensor,
    depth: torch.Tensor,
    pose: torch.Tensor,
    glimpse: Glimpse,
    target_pose: torch.Tensor,
    camera: Intrinsics,
) -> torch.Tensor:
    """The last frame (rgb uint8 [B, 3, H, W]) warped into the new view where no keyframe knows it, and its trust:
    [B, 4, H, W], 0 elsewhere. A frame that is warped again at every step blurs; a keyframe is warped once."""
    colour, agreement, _ = warp(
        rgb.float().div(255)[:, None], depth[:, None], pose[:, None], glimpse.depth, target_pose, camera
    )
    trust = agreement * (1 - glimpse.known[:, None])
    return torch.cat([colour[:, 0] * (trust > 0), trust], 1)


def doubled(rgb: torch.Tensor) -> torch.Tensor:
    """uint8 [..., 3, H, W] -> [..., 3, 2H, 2W], every pixel four times: a warp then blurs it by half a pixel only."""
    return rgb.repeat_interleave(2, -1).repeat_interleave(2, -2)


def _joined(parts: list[Keyframes]) -> Keyframes:
    full = [part for part in parts if len(part)] or parts[:1]
    return Keyframes(*(torch.cat([vars(part)[name] for part in full]) for name in vars(full[0])))
