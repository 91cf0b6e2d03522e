"""Remembering: gives any world that generates pictures a spatial memory, so that it shows again what it showed before.

After each step of the inner world, the known part of the picture is rendered from memory (memory.py) and blended with the inner
world's picture; the inner world observes the blend."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces

from ..core.errors import ContractError, ObservationError
from ..core.spec import PLACES_UNIT, POSE, POSE_UNIT, Camera, Spec, shape_of
from ..core.state import State
from ..core.world import World
from .camera import Intrinsics, planar_pose, rays, yaw
from .estimator import Estimator
from .keyframes import Glimpse
from .memory import ROWS, Memory
from .reproject import least_around

SHELL_M = 8.0  # distance of everything where depth is unknown: right for turning on the spot
_INNER = "world_"  # prefix of the inner world's tensors
_DREAMT = ("gone", "uncertainty")  # tensors in the states of worlds with an uncertainty
_OWN_CHANNELS = ("rgb", "depth", "pose", "reward", "done")


def remember(
    world: World, memory_mb: float = 16.0, estimator: Estimator | None = None, camera: Intrinsics | None = None
) -> World:
    """`world` with a spatial memory. A world that shows the channel `known` has its own and is returned unchanged."""
    return world if "known" in world.spec.channels else Remembering(world, memory_mb, estimator, camera)


class Remembering:
    """The wrapped world. Missing pose and depth come from the estimator: level visual odometry from the origin. Without both,
    depth is that of a sphere around the camera. memory_mb: budget of an episode; camera: intrinsics, if neither spec nor estimator
    has them."""

    def __init__(
        self,
        world: World,
        memory_mb: float = 16.0,
        estimator: Estimator | None = None,
        camera: Intrinsics | None = None,
    ):
        spec = world.spec
        camera = camera or spec.camera or (estimator.config.camera if estimator is not None else None)
        if "known" in spec.channels:
            raise ContractError(f"{spec.name} remembers by itself: it shows what it knows; use it as it is.")
        if "rgb" not in spec.channels or "rgb" not in spec.observes:
            raise ContractError(f"{spec.name} does not show and observe rgb, so memory cannot draw into its pictures.")
        if "pose" not in spec.channels and estimator is None:
            raise ContractError(
                f"{spec.name} shows no pose, so memory cannot know where its pictures belong: give an estimator."
            )
        if camera is None:
            raise ContractError(f"{spec.name} has no camera in its spec, nor the estimator: give the intrinsics.")
        height, width, _ = shape_of(spec.channels["rgb"])
        self.world, self.estimator = world, estimator
        self.memory = Memory(camera, (height, width), memory_mb, device=str(getattr(world, "device", "cpu")))
        if not self.memory.capacity:
            least = math.ceil(100 * self.memory.keyframe_bytes / 2**20) / 100
            raise ContractError(f"a budget of {memory_mb} MiB has no room for a keyframe; give {least:.2f} or more.")
        self.spec = _spec(spec, self.memory, camera, estimator is not None)
        self._shown = tuple(name for name in _OWN_CHANNELS if name in spec.channels)

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._witnessed(self.world.start(batch, rng), None)

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """The inner world observes. A picture is kept in memory; without one, the new view is rendered from memory."""
        if "rgb" not in observation and not set(observation) & set(self.world.spec.observes):
            raise ObservationError(
                f"{self.spec.name} observes {', '.join(self.world.spec.observes)}; got {list(observation)}."
            )
        prior, again = None if prior is None else self.memory.adopted(prior), rng.clone_state()
        inner = self.world.observe(observation, None if prior is None else _inner(prior), rng)
        if "rgb" in observation or prior is None:
            return self._witnessed(inner, prior)
        return self._drawn(inner, prior, again)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        state, again = self.memory.adopted(state), rng.clone_state()
        after = self._drawn(self.world.imagine(_inner(state), action, rng), state, again)
        if "done" not in state or not state["done"].any():
            return after
        still = state["done"]  # what is over stays as it is, and pays no more
        ended = state.replace(reward=torch.zeros_like(state["reward"])) if "reward" in state else state
        return ended.where(still, after)

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        state = self.memory.adopted(state)
        show = {
            "rgb": lambda: state["rgb"].permute(0, 2, 3, 1).contiguous(),
            "known": lambda: state["known"].float() / 255,
            "places": lambda: self.memory.table(state),
            **{name: lambda name=name: state[name] for name in ("pose", "depth", "reward", "done") if name in state},
        }
        theirs = [name for name in channels if name not in show]
        seen = dict(self.world.render(_inner(state), theirs)) if theirs else {}
        return {name: show[name]() if name in show else seen[name] for name in channels}

    # -- inside -------------------------------------------------------------------------------------------------------

    def _witnessed(self, inner: State, prior: State | None) -> State:
        """The state after an observed picture."""
        seen, rgb, depth, pose = self._seen(inner, prior)
        held = State(self.memory.empty(len(rgb)), self.memory.arenas) if prior is None else prior
        held = held.replace(**self.memory.observed(held, rgb, depth, pose))
        known = torch.full(depth.shape, 255, dtype=torch.uint8, device=rgb.device)
        return self._joined(inner, seen, held, rgb=rgb, depth=depth, pose=pose, known=known)

    def _drawn(self, inner: State, before: State, rng: torch.Generator) -> State:
        """The state after the inner world's picture and the known part of the view are blended. rng: as before the inner world's
        step, so that a batch equals its single entries if both methods of the inner world draw once an entry, or `observe` draws
        nothing."""
        seen, rgb, depth, pose = self._seen(inner, before)
        glimpse = self.memory.look(before, pose)
        rgb, known = blend(glimpse, rgb)
        depth = torch.where(known > 0.5, glimpse.depth, depth)
        evident = (*self.world.spec.observes, *self.world.spec.may_observe)
        evidence = self.world.render(inner, [name for name in evident if name != "rgb"])
        blended = self.world.observe({**evidence, "rgb": rgb.permute(0, 2, 3, 1).contiguous()}, inner, rng)
        # a blend is no observation: the uncertainty, and the distance from the last observation, stay the same
        inner = blended.replace(**{name: inner[name] for name in _DREAMT if name in inner})
        held = before.replace(**self.memory.dreamt(before, rgb, depth, pose, glimpse.known))
        known = (known * 255).round().to(torch.uint8)
        return self._joined(inner, seen, held, rgb=rgb, depth=depth, pose=pose, known=known)

    def _seen(self, inner: State, before: State | None) -> tuple[dict, torch.Tensor, torch.Tensor, torch.Tensor]:
        """The inner world's channels, and of them rgb uint8 [B, 3, H, W], depth [B, H, W] metres and pose [B, 7]."""
        seen = dict(self.world.render(inner, self._shown))
        rgb = seen["rgb"].permute(0, 3, 1, 2).contiguous()
        if "depth" in seen:
            depth = F.interpolate(seen["depth"].float()[:, None], self.memory.size, mode="nearest-exact")[:, 0]
            depth = depth.clamp_min(0.05)
        elif self.estimator is not None:
            depth = self.estimator.depth(rgb)
        else:
            beams = rays(self.memory.camera, *self.memory.size, rgb.device)
            depth = (SHELL_M / beams.norm(dim=-1)).expand(len(rgb), -1, -1)
        return seen, rgb, depth, seen["pose"].float() if "pose" in seen else self._felt(rgb, before)

    def _felt(self, rgb: torch.Tensor, before: State | None) -> torch.Tensor:
        """The pose by odometry from the state `before`; the origin for a first picture."""
        assert self.estimator is not None
        zero = torch.zeros(len(rgb), device=rgb.device)
        if before is None:
            return planar_pose(zero, zero, zero, zero)
        forward, left, turn = self.estimator.motion(before["rgb"], rgb, before["depth"]).unbind(-1)
        pose, heading = before["pose"], yaw(before["pose"])
        x = pose[:, 0] + forward * heading.cos() - left * heading.sin()
        y = pose[:, 1] + forward * heading.sin() + left * heading.cos()
        return planar_pose(x, y, pose[:, 2], heading + turn)

    def _joined(self, inner: State, seen: Mapping, held: State, **own: torch.Tensor) -> State:
        """The inner world's state with its reward and done, memory's tensors from `held`, and the shown channels."""
        tensors = {f"{_INNER}{name}": tensor for name, tensor in inner.items()}
        followed = {name: seen[name] for name in ("reward", "done") if name in seen}
        arenas = {**{f"{_INNER}{name}": arena for name, arena in inner.arenas.items()}, ROWS: held.arenas[ROWS]}
        return State({**tensors, **followed, **own, **self.memory.of(held)}, arenas)


def blend(glimpse: Glimpse, invented: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The known colours over the invented picture uint8 [B, 3, H, W], and their share [B, H, W]. The share falls to 0 within three
    pixels of the unknown and where keyframes were much farther away; there the invented colours are shifted to nearby known
    ones."""
    inside = least_around(glimpse.known)[:, None]
    share = F.avg_pool2d(inside, 5, 1, 2, count_include_pad=False) * glimpse.known[:, None]
    share = share * (3 * glimpse.trust[:, :1]).clamp(0, 1)
    recalled, guess = glimpse.merged, invented.float() / 255
    cell = max(min(invented.shape[-2:]) // 6, 1)
    near = F.avg_pool2d(share, cell, ceil_mode=True)
    off = F.avg_pool2d((recalled - guess) * share, cell, ceil_mode=True) / (near + 0.1)
    off = F.interpolate(off, invented.shape[-2:], mode="bilinear", align_corners=False)
    mixed = share * recalled + (1 - share) * (guess + off)
    return (mixed * 255).round().clamp(0, 255).to(torch.uint8), share[:, 0]


def _spec(spec: Spec, memory: Memory, camera: Intrinsics, estimates: bool) -> Spec:
    """The spec with pose and depth; `known` [H, W]: 1 where the picture is from memory; `places` (keyframe_table)."""
    channels, units = {"pose": POSE, **spec.channels}, {"pose": POSE_UNIT, **spec.units}
    if "depth" in channels or estimates:  # of the pictures' size
        channels["depth"], units["depth"] = spaces.Box(0, np.inf, memory.size, np.float32), "m"
    channels["known"] = spaces.Box(0, 1, memory.size, np.float32)
    channels["places"] = spaces.Box(-np.inf, np.inf, (memory.capacity, 4), np.float32)
    units["places"] = PLACES_UNIT
    return replace(spec, channels=channels, units=units, cameras={**spec.cameras, "rgb": Camera(camera, memory.size)})


def _inner(state: State) -> State:
    """The inner world's part of the state."""
    arenas = {name[len(_INNER) :]: arena for name, arena in state.arenas.items() if name.startswith(_INNER)}
    return State({name[len(_INNER) :]: state[name] for name in state if name.startswith(_INNER)}, arenas)
