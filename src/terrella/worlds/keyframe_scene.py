"""KeyframeScene: what is known of a view from posed RGB-D keyframes, of the recordings and of an episode's own memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces

from ..core import chance
from ..core.backend import kernels_do
from ..core.errors import ObservationError
from ..core.spec import PLACES_UNIT
from ..core.state import State
from ..space.camera import FAR_M, Intrinsics, turn_between
from ..space.floorplan import floor_plan
from ..space.keyframes import Keyframes
from ..space.memory import RECORDED, Memory, keyframe_table
from ..space.recognise import thumbnails
from ..space.reproject import MovingFrames, fill_holes
from .carried_frames import covered_pixels, static_depth
from .config import KeyframesConfig
from .generator import Conditioning, DrawnFrame, context_thumbnail
from .localisation import localise
from .parts import STARTS, Channels, Evidence, Tensors, Walls, check_prior, newest_frame, picture_of

SEEN: tuple[str, ...] = "rgb", "depth", "things", "pose", "instances"  # state entries of a frame
NEAR_M = 1.0  # from a recorded keyframe, within which only walls of recordings and evidence count
CELL_M = 0.25  # side of a cell of the map of that
BLIND = " For a picture alone it needs an estimator of depth: `terrella train uncertainty`."
EXACTLY = "donot_use_mm_for_euclid_dist"


@final
class KeyframeScene:
    """`recorded`: the recordings' keyframes (may be empty); `starts`: those that an episode may begin from."""

    kind, history = "keyframes", 0

    def __init__(self, config: KeyframesConfig, recorded: Keyframes, starts: Keyframes):
        self.config, self.recorded, self.starts = config, recorded, starts
        self.camera: Intrinsics | None = config.camera
        self.device = starts.pose.device
        self.own = own_memory(config, str(recorded.pose.device))
        # where things move, how a frame looked is still needed two steps later
        self.earlier_names: tuple[str, ...] = SEEN if config.moving else ()
        moving = ("things", "instances", *(f"earlier_{name}" for name in SEEN)) if config.moving else ()
        self.drawn_names: tuple[str, ...] = "rgb", "depth", "known", *moving, *self.own.empty(1)

    def to(self, device) -> KeyframeScene:
        scene = KeyframeScene(self.config, self.recorded.to(device), self.starts.to(device))
        vars(scene).update({name: getattr(self, name).to(device) for name in ("_plan", "_cells", "_table", "_small")})
        return scene

    def with_memory(self, recorded: Keyframes | None = None, budget_mb: float | None = None) -> KeyframeScene:
        config = self.config if budget_mb is None else replace(self.config, memory_mb=budget_mb)
        return KeyframeScene(config, self.recorded if recorded is None else recorded, self.starts)

    @cached_property
    def _table(self) -> torch.Tensor:
        """Recorded keyframes in the channel `places`."""
        return keyframe_table(self.recorded.pose, torch.full((len(self.recorded),), RECORDED, device=self.device))

    @cached_property
    def _small(self) -> torch.Tensor:
        """Thumbnails in which a picture's place is looked up."""
        return thumbnails(self.recorded.rgb)

    @cached_property
    def _plan(self) -> torch.Tensor:
        return floor_plan(self.recorded.walls, self.recorded.pose)

    @cached_property
    def _cells(self) -> torch.Tensor:
        """Codes of the map's cells within NEAR_M of a recorded keyframe, ascending; never empty."""
        reach = int(NEAR_M / CELL_M) + 1
        steps = CELL_M * torch.arange(-reach, reach + 1, device=self.device)
        around = torch.cartesian_prod(steps, steps)
        around = around[around.norm(dim=1) <= NEAR_M]
        codes = _cell_codes((self.recorded.pose[:, None, :2] + around).flatten(0, 1))
        return torch.cat([codes, codes.new_full((1,), 2**62)]).unique()

    def channels(self) -> Channels:
        height, width = self.config.size
        shows: dict[str, spaces.Space] = {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, 100, (height, width), np.float32),
            "known": spaces.Box(0, 1, (height, width), np.float32),
        }
        units = {"depth": "m"}
        if self.config.moving:
            shows["things"] = spaces.Box(0, 1, (height, width), np.bool_)  # pyright: ignore
        if count := len(self.recorded) + self.own.capacity:
            shows["places"] = spaces.Box(-np.inf, np.inf, (count, 4), np.float32)
            units["places"] = PLACES_UNIT
        return Channels(shows, units, ("rgb", "depth"), ("things",) * self.config.moving)

    # -- evidence -----------------------------------------------------------------------------------------------------

    def start(self, seeds: torch.Tensor) -> tuple[Evidence, torch.Tensor]:
        """Evidence of places where recordings were, by chance; which of the starts they are [B]."""
        pick = (chance.uniform(seeds, (), stream=STARTS) * len(self.starts)).long()
        keys = self.starts.at(pick)
        rgb, depth = F.interpolate(keys.rgb.float(), self.config.size, mode="area"), keys.depth
        seen = {"rgb": rgb.round().to(torch.uint8), "depth": depth}
        if self.config.moving:  # a keyframe has no depth where things were
            seen["depth"] = fill_holes(torch.where(depth > 0, depth, FAR_M))
            seen["things"] = (depth <= 0).float()
        return Evidence(len(pick), self.device, keys.pose, seen), pick

    def evidence(self, observation: Mapping[str, torch.Tensor], prior: State | None, estimator: Any) -> Evidence:
        """One of three: rgb, depth and pose; a pose alone with a prior, whose frame is then drawn; or a picture alone with depth of
        the estimator, at the prior's pose, or without a prior at the place that it is recognised as (localisation.py)."""
        lone = None
        if set(observation) & {"rgb", "depth", "pose"} == {"rgb"} and estimator:
            observation, lone = self._arrived(observation, prior, estimator)
        if "pose" not in observation:
            alone, blind = (", a picture alone", "") if estimator else ("", BLIND)
            raise ObservationError(
                f"it observes rgb, depth and pose{alone}, or a pose alone; got {list(observation)}.{blind}"
            )
        pose = torch.as_tensor(observation["pose"]).float().to(self.device)
        batch = len(pose)
        if pose.shape != (batch, 7) or not torch.isfinite(pose).all():
            raise ObservationError(f"pose is finite float [B, 7] (x, y, z, quaternion wxyz); got {tuple(pose.shape)}.")
        if prior is not None:
            check_prior(prior.batch, batch)
        if not {"rgb", "depth"} <= set(observation):
            if prior is None:
                raise ObservationError(
                    "a pose alone says nothing of what is seen there: give rgb and depth, or a prior."
                )
            return Evidence(batch, self.device, pose)
        rgb, depth = picture_of(observation, self.config.size, self.device), torch.as_tensor(observation["depth"])
        depth = depth.to(self.device).float()
        if depth.shape != (batch, *self.config.size) or len(rgb) != batch:
            raise ObservationError(
                f"depth is [B, {self.config.size[0]}, {self.config.size[1]}]; got {tuple(depth.shape)}."
            )
        if not (torch.isfinite(depth).all() and (depth > 0).all()):
            raise ObservationError("depth must be finite and above 0 metres.")
        seen = {"rgb": rgb, "depth": depth, **self._things(observation, prior, depth)}
        return Evidence(batch, self.device, pose, seen, lone)

    def _things(self, observation: Mapping, prior: State | None, depth: torch.Tensor) -> dict[str, torch.Tensor]:
        """Where things are: as observed, else as the prior has them."""
        if not self.config.moving:
            return {}
        if "things" not in observation:
            return {"things": torch.zeros_like(depth) if prior is None else prior["things"]}
        things = torch.as_tensor(observation["things"]).float().to(self.device)
        if things.shape != depth.shape:
            raise ObservationError(f"things is bool {list(depth.shape)}; got {tuple(things.shape)}.")
        return {"things": things}

    def _arrived(self, observation: Mapping, prior: State | None, estimator: Any) -> tuple[dict, torch.Tensor | None]:
        """The observation of a picture alone, with its pose and depth; which are outside of the recordings [B]."""
        rgb = picture_of(observation, self.config.size, self.device)
        if prior is not None:
            check_prior(prior.batch, len(rgb))
            lone = prior["gone"][:, 3] > 0 if "gone" in prior else None
            return {**observation, "pose": prior["pose"], "depth": estimator.depth(rgb)}, lone
        config = self.config
        seen = localise(rgb, estimator, self.recorded, self._small, self.starts, config.camera, config.sources)
        return {**observation, "pose": seen.pose, "depth": seen.depth}, ~seen.recognised

    def observe(self, prior: State | None, evidence: Evidence) -> State:
        """With the picture of the evidence, which memory always keeps."""
        state = self._blank(evidence) if prior is None else prior
        known = torch.full_like(state["known"], 255)
        state = state.replace(**{**evidence.seen, "pose": evidence.pose}, known=known)
        state = state.replace(**self.own.observed(state, state["rgb"], self._lasting(state), state["pose"]))
        return state.replace(observed_walls=self.own.walls(state, dreamt=False))

    def _blank(self, evidence: Evidence) -> State:
        """A state that has seen nothing yet."""
        batch, (height, width) = evidence.batch, self.config.size
        plane = torch.zeros(batch, height, width, device=self.device)
        mask = plane.to(torch.uint8)
        tensors = {"rgb": mask[:, None].expand(-1, 3, -1, -1), "depth": plane + 1, "known": mask, "pose": evidence.pose}
        if self.config.moving:
            tensors |= {"things": plane, "instances": mask}
            tensors |= {f"earlier_{part}": tensors[part] for part in SEEN}
        return State({**tensors, **self.own.empty(batch)}, self.own.arenas)

    # -- a step -------------------------------------------------------------------------------------------------------

    def adopt(self, state: State) -> State:
        """The state with its keyframes in this scene's arena; ContractError where its memory is of another layout."""
        return self.own.adopted(state)

    def walls(self, state: State) -> tuple[State, Walls]:
        """The walls that recordings and evidence show. In episodes off known ground also those of dreamt frames, which are
        drawn for that; the frames of the others may wait. Beside a CPU none waits, for nothing asks how many are away."""
        cells, codes = self._cells, _cell_codes(state["pose"][:, :2])
        gone = cells[torch.searchsorted(cells, codes).clamp_max(len(cells) - 1)] != codes
        own = state["observed_walls"]
        if not kernels_do(own):
            return state, Walls(self._plan, torch.where(gone[:, None, None], self.own.walls(state), own))
        away = gone.nonzero()[:, 0]
        if len(away):
            drawn = state if len(away) == state.batch else state.narrowed(away)
            own = own.index_copy(0, away, self.own.walls(drawn))
            if drawn is not state and state.deferred is not None:
                state = state.put(away, drawn)
        return state, Walls(self._plan, own)

    def look(self, state: State, before: State) -> Conditioning:
        """What is known of the view from the state's pose; `before` has the last frame."""
        config, pose = self.config, state["pose"]
        last = _moving_frames(before) if config.moving else (before["rgb"], before["depth"], before["pose"])
        glimpse, carried = self.own.look_and_carry(state, pose, last, config.sources, config.slots, self.recorded)
        context, familiar = context_thumbnail(before["rgb"]), self._familiar(state)
        assert carried is not None
        if config.moving:
            carried = torch.cat([carried[:, 0], carried[:, 1, :4]], 1)  # as carry_frames gives them
            context = torch.cat([context, state["actions"].flatten(1)], 1)
        return Conditioning(glimpse, carried, context, familiar)

    def _familiar(self, state: State) -> torch.Tensor:
        """How well the place is known [B, 2]: distance to the nearest recorded keyframe, log(1 + metres), a radian counting as
        two metres; and the share of its own memory that is in use."""
        pose, kept = state["pose"], self.recorded.pose
        apart = torch.cdist(pose[:, :3], kept[:, :3], compute_mode=EXACTLY)
        apart = torch.add(apart, turn_between(pose, kept.expand(len(pose), -1, -1)), alpha=2)
        nearest = apart.amin(1).clamp_max(20) if len(kept) else pose.new_full((len(pose),), 20.0)
        own = self.own.count(state) / max(1, self.own.capacity)
        return torch.stack([nearest.log1p(), own], 1)

    def take(self, state: State, conditioning: Conditioning, frame: DrawnFrame) -> State:
        """With the frame; memory keeps it if it shows a new view of which little was known."""
        known, drawn = (
            conditioning.glimpse.known,
            {name: part for name, part in vars(frame).items() if part is not None},
        )
        state = state.replace(**drawn)
        if self.config.moving:
            known = known * (state["things"] < 0.5)
        kept = self.own.dreamt(state, state["rgb"], self._lasting(state), state["pose"], known)
        return state.replace(**kept, known=(known * 255).round().to(torch.uint8))

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        shown = {}
        if "rgb" in channels:
            shown["rgb"] = newest_frame(state).permute(0, 2, 3, 1).contiguous()
        if "known" in channels:
            shown["known"] = state["known"].float() / 255
        if "things" in channels:
            shown["things"] = state["things"] > 0.5
        if "places" in channels:
            shown["places"] = torch.cat([self._table.expand(state.batch, -1, -1), self.own.table(state)], 1)
        return shown

    def _lasting(self, state: State) -> torch.Tensor:
        """The frame's depth as a keyframe keeps it."""
        return static_depth(state["depth"], state["things"]) if self.config.moving else state["depth"]


def _moving_frames(before: State) -> MovingFrames:
    """The last frame of a state and the one before it, [B, 2, ...] each."""
    ages = [[before[f"{age}{part}"] for part in SEEN] for age in ("", "earlier_")]
    rgb, depth, things, pose, instances = (torch.stack(parts, 1) for parts in zip(*ages))
    covered = covered_pixels(instances.flatten(0, 1), things.flatten(0, 1)).view_as(things)
    return MovingFrames(rgb, depth, things, covered, pose)


def _cell_codes(places: torch.Tensor) -> torch.Tensor:
    """Codes int64 [N] of the map's cells in which places [N, 2] lie."""
    column, row = torch.div(places, CELL_M, rounding_mode="floor").clamp(-(2**30), 2**30).long().unbind(-1)
    return torch.add(row, column, alpha=2**31)


def own_memory(config: KeyframesConfig, device: str) -> Memory:
    """An episode's own memory; where its budget has no room for a keyframe, it holds the last frame alone."""
    rules = config.memory_mb, config.new_view, config.known_enough
    whole = Memory(config.camera, config.size, *rules, device=device)
    if whole.capacity:
        return whole
    frame_mb = Memory(config.camera, config.size).keyframe_bytes / 2**20
    return Memory(config.camera, config.size, frame_mb, (1e-6, 1e-6), 2.0, device=device)
