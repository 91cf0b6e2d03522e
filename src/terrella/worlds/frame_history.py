"""FrameHistory: the scene of a frames-only world, for recordings without depth or pose.

The last frames and actions take the place of keyframes. Where pictures scroll, a mosaic remembers what left the picture, and the
ground of the recordings is known where a picture is recognised on it. Where they change as a whole, earlier frames are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.backend import constant
from ..core.errors import ObservationError
from ..core.state import State
from ..space.camera import Intrinsics
from ..space.ground import ALIKE, NOWHERE, locate, window
from ..space.keyframes import Glimpse, Keyframes
from ..space.matching import scroll_index
from ..space.mosaic import PICTURES, empty_mosaic, middle, update_mosaic, write_mosaic
from ..space.recall import keep, nothing_kept
from .config import HistoryConfig
from .generator import Conditioning, DrawnFrame, context_thumbnail
from .parts import STARTS, Channels, Evidence, Tensors, Walls, check_prior, newest_frame, picture_of

TRUST = 0.03  # of a frame relative to the next one: merged, they are nearly the newest alone


@dataclass(frozen=True)
class StartClips:
    """S clips of recordings with which episodes begin, the newest frame first."""

    frames: torch.Tensor  # uint8 [S, slots, 3, H, W]
    actions: torch.Tensor  # [S, slots, A], encoded: those that led to the frames
    vitals: torch.Tensor  # [S, V]
    known: torch.Tensor  # uint8 [S, 4, H, W]: colour and votes of a mosaic at the frame before the newest

    @staticmethod
    def of(frames: torch.Tensor, actions: int) -> StartClips:
        """Clips of frames alone: no button held, no vitals, an empty mosaic."""
        known = torch.zeros(len(frames), 4, *frames.shape[3:], dtype=torch.uint8)
        return StartClips(frames, torch.zeros(*frames.shape[:2], actions), torch.zeros(len(frames), 0), known)


@final
class FrameHistory:
    """`starts`: where episodes begin. `over` bool [H, W], default none: pixels that stay while the picture scrolls, such as a
    status line or the player in the middle; they are no part of the mosaic. `ground` uint8 [4, H', W'] (space/ground.py), default
    none: what the recordings scrolled over."""

    kind = "history"
    camera: Intrinsics | None = None
    earlier_names: tuple[str, ...] = ()

    def __init__(
        self,
        config: HistoryConfig,
        starts: StartClips,
        over: torch.Tensor | None = None,
        ground: torch.Tensor | None = None,
    ):
        self.config, self.starts = config, starts
        self.device, self.history = starts.frames.device, config.slots
        self.cameras = tuple(config.cameras) or ("rgb",)
        self.over = torch.zeros(config.size, dtype=torch.bool, device=self.device) if over is None else over
        self.moves = torch.tensor(config.moves, dtype=torch.int64, device=self.device).view(-1, 2)
        self.ground = torch.zeros(4, 1, 1, dtype=torch.uint8, device=self.device) if ground is None else ground
        self.grounded = bool(config.moves) and self.ground[0].numel() > 1
        flat = ("mosaic", "scroll") * bool(config.moves) + ("kept", "kept_keys") * config.recalls
        self.drawn_names: tuple[str, ...] = ("frames", *flat, *("place",) * self.grounded)
        nothing = torch.zeros(0, 3, *config.size, dtype=torch.uint8), torch.zeros(0, *config.size), torch.zeros(0, 7)
        self.recorded = Keyframes.of(*nothing, (1.0, 1.0, 0.5, 0.5))

    def to(self, device) -> FrameHistory:
        starts = StartClips(*(part.to(device) for part in vars(self.starts).values()))
        return FrameHistory(self.config, starts, self.over.to(device), self.ground.to(device))

    def with_memory(self, recorded: Keyframes | None = None, budget_mb: float | None = None) -> FrameHistory:
        """The same: it has no keyframes."""
        return self

    def channels(self) -> Channels:
        one = spaces.Box(0, 255, (*self._picture_size, 3), np.uint8)
        shows: dict[str, spaces.Space] = dict.fromkeys(self.cameras, one)
        if self.config.moves:
            height, width = (times * length for times, length in zip(PICTURES, self.config.size))
            shows["mosaic"] = spaces.Box(0, 255, (height, width, 4), np.uint8)
        return Channels(shows, observes=self.cameras)

    @property
    def _picture_size(self) -> tuple[int, int]:
        """Height and width of a camera's pictures."""
        return self.config.size[0], self.config.size[1] // len(self.cameras)

    # -- evidence -----------------------------------------------------------------------------------------------------

    def start(self, seeds: torch.Tensor) -> tuple[Evidence, torch.Tensor]:
        """Clips of recordings, drawn by chance; which of the starts they are [B]."""
        pick = (chance.uniform(seeds, (), stream=STARTS) * len(self.starts.frames)).long()
        clips = StartClips(*(part[pick] for part in vars(self.starts).values()))
        seen = {"frames": clips.frames, "actions": clips.actions.flip(1), "vitals": clips.vitals}
        if self.config.moves:
            seen["mosaic"] = write_mosaic(empty_mosaic(len(pick), self.config.size, self.device), clips.known)
        return Evidence(len(pick), self.device, None, seen), pick

    def evidence(self, observation: Mapping[str, torch.Tensor], prior: State | None, estimator: Any) -> Evidence:
        """A picture replaces the newest frame of the prior; without a prior it stands for the whole history."""
        if not all(name in observation for name in self.cameras):
            raise ObservationError(f"it observes {' and '.join(self.cameras)}; got {list(observation)}.")
        pictures = [picture_of(observation, self._picture_size, self.device, name) for name in self.cameras]
        frame = torch.cat(pictures, 3)[:, None]
        if prior is None:
            return Evidence(len(frame), self.device, None, {"frames": frame.repeat(1, self.config.slots, 1, 1, 1)})
        check_prior(prior.batch, len(frame))
        return Evidence(len(frame), self.device, None, {"frames": torch.cat([frame, prior["frames"][:, 1:]], 1)})

    def observe(self, prior: State | None, evidence: Evidence) -> State:
        """With the frames of the evidence, the mosaic as of the frame before, and how the newest scrolled."""
        frames = evidence.seen["frames"]
        seen = {"frames": frames}
        if self.config.recalls and prior is None:
            seen["kept"], seen["kept_keys"] = nothing_kept(evidence.batch, self.config.size, self.device)
        if self.config.moves:
            if "mosaic" in evidence.seen:
                seen["mosaic"] = evidence.seen["mosaic"]
            elif prior is None:
                seen["mosaic"] = empty_mosaic(evidence.batch, self.config.size, self.device)
            seen["scroll"] = scroll_index(frames[:, 1], frames[:, 0], self.moves)
        if self.grounded:
            shown = ~self.over.expand(len(frames), -1, -1)
            place, share = locate(frames[:, 0], shown, self.ground)
            seen["place"] = torch.where(share[:, None] >= ALIKE, place, self._followed(prior, seen["scroll"]))
        return State(seen) if prior is None else prior.replace(**seen)

    def _followed(self, prior: State | None, scroll: torch.Tensor) -> torch.Tensor:
        """Where the newest picture lies on the ground, if it scrolled so, int64 [B, 2]; NOWHERE without a prior."""
        if prior is None:
            return torch.full((len(scroll), 2), NOWHERE, device=self.device)
        return prior["place"] + self.moves[prior["scroll"]] - self.moves[scroll]

    # -- a step -------------------------------------------------------------------------------------------------------

    def adopt(self, state: State) -> State:
        """The same: its states point at nothing."""
        return state

    def walls(self, state: State) -> tuple[State, Walls]:
        """No walls, and the same state."""
        nothing = constant(torch.zeros, self.device, 1, 0, 4)
        return state, Walls(nothing[0], nothing.expand(state.batch, -1, -1))

    def look(self, state: State, before: State) -> Conditioning:
        """The last frames in the place of keyframes; `familiar` is 0, since they lie in no place."""
        frames, actions = state["frames"], state["actions"].flip(1)
        context = torch.cat([context_thumbnail(frames[:, 0]), actions.flatten(1)], 1)
        last = constant(torch.zeros, frames.device, 1, 4, *self.config.size).expand(len(frames), -1, -1, -1)
        familiar = constant(torch.zeros, self.device, 1, 2).expand(state.batch, -1)
        mosaic = self._joined(state) if self.config.moves else None
        kept = (state["kept"], state["kept_keys"]) if self.config.recalls else (None, None)
        return Conditioning(glimpse_of_frames(frames), last, context, familiar, mosaic, None, *kept)

    def take(self, state: State, conditioning: Conditioning, frame: DrawnFrame) -> State:
        """With the frame as its newest, the move by which it scrolled, and the last frame in its mosaic; the oldest is kept."""
        mosaic, scroll = conditioning.mosaic, conditioning.scroll
        flat = {} if mosaic is None or scroll is None else {"mosaic": mosaic, "scroll": scroll}
        if self.grounded and scroll is not None:
            flat["place"] = state["place"] - self.moves[scroll]
        if conditioning.kept is not None and conditioning.kept_keys is not None:
            flat["kept"], flat["kept_keys"] = keep(conditioning.kept, conditioning.kept_keys, state["frames"][:, -1])
        return state.replace(frames=torch.cat([frame.rgb[:, None], state["frames"][:, :-1]], 1), **flat)

    def _joined(self, state: State) -> torch.Tensor:
        """The mosaic with the newest frame in its middle. A state's mosaic lags by a frame, which evidence may still replace. It
        scrolls by the move that was drawn: new ground is often too plain to estimate the move from. The ground of the recordings
        comes first."""
        frame, move = state["frames"][:, 0], self.moves[state["scroll"]]
        whole = update_mosaic(state["mosaic"], frame, move, self.over)
        if not self.grounded:
            return whole
        at = state["place"] - constant(torch.tensor, self.device, middle(whole, self.config.size)[::-1])
        ground = window(self.ground, at, (whole.shape[2], whole.shape[3]))
        return torch.where(ground[:, 3:] > 0, ground, whole)

    def _whole(self, state: State) -> torch.Tensor:
        """The mosaic; where it is empty, what lies over it."""
        frame, move = state["frames"][:, 0], self.moves[state["scroll"]]
        joined, none = self._joined(state), torch.zeros_like(self.over)
        return torch.where(joined[:, 3:] > 0, joined, update_mosaic(state["mosaic"], frame, move, none))

    def render(self, state: State, channels: Sequence[str]) -> Tensors:
        shown = {}
        if set(self.cameras) & set(channels):
            shown |= split_pictures(newest_frame(state).permute(0, 2, 3, 1), self.cameras)
        if "mosaic" in channels:
            shown["mosaic"] = _shown(self._whole(state))
        return shown


def split_pictures(frames: torch.Tensor, cameras: Sequence[str]) -> Tensors:
    """The pictures [B, H, W / n, 3] of n cameras, which lie side by side in frames [B, H, W, 3]."""
    return {name: part.contiguous() for name, part in zip(cameras, frames.chunk(len(cameras), 2))}


def _shown(mosaic: torch.Tensor) -> torch.Tensor:
    """The channel `mosaic` (core/world.py) of mosaics uint8 [B, 4, H', W'] of colour and votes."""
    seen = (mosaic[:, 3:] > 0).to(torch.uint8) * 255
    return torch.cat([mosaic[:, :3], seen], 1).permute(0, 2, 3, 1).contiguous()


def _trust(slots: int) -> torch.Tensor:
    return TRUST ** torch.arange(slots, dtype=torch.float32)


def glimpse_of_frames(frames: torch.Tensor) -> Glimpse:
    """The last frames (uint8 [B, slots, 3, H, W], the newest first) as a Glimpse."""
    batch, slots, _, height, width = frames.shape
    everywhere = constant(torch.ones, frames.device, 1, height, width).expand(batch, -1, -1)
    trust = constant(_trust, frames.device, slots)[None, :, None, None].expand(batch, -1, height, width)
    return Glimpse(frames / 255, trust, everywhere, everywhere)
