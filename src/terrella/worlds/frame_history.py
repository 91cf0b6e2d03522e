"""FrameHistory: the scene of a frames-only world, for recordings without depth or pose.

The last frames take the place of keyframes, unwarped, and the actions are part of the context, since no motion model turns
them into a view. Where pictures scroll, a mosaic remembers what left the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces

from ..core import chance
from ..core.errors import ObservationError
from ..core.state import State
from ..space.keyframes import Glimpse, Keyframes
from ..space.matching import scrolled
from ..space.mosaic import PICTURES, blank, held_in, remembered
from .config import HistoryConfig
from .generator import Conditioning, context_thumbnail, pixels
from .parts import STARTS, Channels, Evidence, Walls, check_prior, picture_of

TRUST = 0.03  # in a frame, against the one after it: what is merged from all of them is nearly the newest alone


@dataclass(frozen=True)
class StartClips:
    """Where episodes begin, S pieces of recording, the newest first: frames uint8 [S, slots, 3, H, W]; the actions that led to
    them as networks take them [S, slots, A]; vitals [S, V]; what a mosaic knew of the frame before the newest, uint8 [S, 4, H,
    W] (colour and votes)."""

    frames: torch.Tensor
    actions: torch.Tensor
    vitals: torch.Tensor
    known: torch.Tensor

    @staticmethod
    def of(frames: torch.Tensor, actions: int) -> StartClips:
        """No button held, and no vitals."""
        known = torch.zeros(len(frames), 4, *frames.shape[3:], dtype=torch.uint8)
        return StartClips(frames, torch.zeros(*frames.shape[:2], actions), torch.zeros(len(frames), 0), known)


@final
class FrameHistory:
    """`starts`: where episodes begin; `over` bool [H, W]: the pixels that stay while the picture scrolls, such as a status line or
    the walker in the middle, which are no part of the mosaic. Default: none."""

    kind, posed, camera = "history", False, None

    def __init__(self, config: HistoryConfig, starts: StartClips, over: torch.Tensor | None = None):
        self.config, self.starts = config, starts
        self.over = torch.zeros(config.size, dtype=torch.bool, device=self.device) if over is None else over
        self.moves = torch.tensor(config.moves, dtype=torch.int64, device=starts.frames.device).view(-1, 2)
        self.drawn_names = ("frames", "mosaic", "scroll") if config.moves else ("frames",)
        nothing = torch.zeros(0, 3, *config.size, dtype=torch.uint8), torch.zeros(0, *config.size), torch.zeros(0, 7)
        self.recorded = Keyframes.of(*nothing, (1.0, 1.0, 0.5, 0.5))

    def to(self, device) -> FrameHistory:
        starts = StartClips(*(part.to(device) for part in vars(self.starts).values()))
        return FrameHistory(self.config, starts, self.over.to(device))

    def with_memory(self, *given) -> FrameHistory:
        """It has no use for keyframes."""
        return self

    with_memory_of = with_memory

    @property
    def device(self) -> torch.device:
        return self.starts.frames.device

    @property
    def history(self) -> int:
        """Actions that its conditioning needs."""
        return self.config.slots

    def channels(self) -> Channels:
        shows: dict[str, spaces.Space] = {"rgb": spaces.Box(0, 255, (*self.config.size, 3), np.uint8)}
        if len(set(self.config.moves)) > 1:  # else nothing ever scrolls, and what was seen is what is seen
            height, width = (times * length for times, length in zip(PICTURES, self.config.size))
            shows["mosaic"] = spaces.Box(0, 255, (height, width, 4), np.uint8)
        return Channels(shows, observes=("rgb",))

    def begin(self, seeds: torch.Tensor) -> tuple[Evidence, torch.Tensor]:
        """Pieces of recordings, by chance; which of the starts they are [B]."""
        pick = (chance.uniform(seeds, (), stream=STARTS) * len(self.starts.frames)).long()
        found = StartClips(*(part[pick] for part in vars(self.starts).values()))
        seen = {"frames": found.frames, "actions": found.actions.flip(1), "vitals": found.vitals}
        if self.config.moves:
            seen["mosaic"] = held_in(blank(len(pick), self.config.size, self.device), found.known)
        return Evidence(len(pick), self.device, None, seen), pick

    def evidence(self, observation: Mapping[str, torch.Tensor], prior: State | None, estimator: Any) -> Evidence:
        """A picture replaces the newest frame of the prior; without a prior it stands for the whole history."""
        if "rgb" not in observation:
            raise ObservationError(f"it observes rgb; got {list(observation)}.")
        frame = picture_of(observation, self.config.size, self.device)[:, None]
        if prior is None:
            return Evidence(len(frame), self.device, None, {"frames": frame.repeat(1, self.config.slots, 1, 1, 1)})
        check_prior(prior.batch, len(frame))
        return Evidence(len(frame), self.device, None, {"frames": torch.cat([frame, prior["frames"][:, 1:]], 1)})

    def adopted(self, state: State, *given) -> State:
        """`state`, which points at nothing; nothing in it waits for a body, is kept beside it or grows old."""
        return state

    settled = kept = aged = adopted

    def blank(self, evidence: Evidence) -> State:
        """A state in which nothing was seen yet."""
        flat = {}
        if self.config.moves:
            flat = {"mosaic": blank(evidence.batch, self.config.size, self.device)}
            flat["scroll"] = torch.zeros(evidence.batch, dtype=torch.int64, device=self.device)
        return State({"frames": evidence.seen["frames"], **flat})

    def pictured(self, state: State, evidence: Evidence) -> State:
        """`state` with the frames of the evidence, the actions that led to them, the mosaic as of the frame before, and how the
        newest scrolled."""
        names = ("frames", "actions", "mosaic")
        found = {name: evidence.seen[name] for name in names if name in evidence.seen}
        if self.config.moves:
            found["scroll"] = scrolled(found["frames"][:, 1], found["frames"][:, 0], self.moves)
        return state.replace(**found)

    def frame(self, state: State) -> torch.Tensor:
        """The newest frame, uint8 [B, 3, H, W]."""
        return state["frames"][:, 0]

    def walls(self, state: State) -> Walls:
        nothing = torch.zeros(state.batch, 0, 4, device=self.device)
        return Walls(nothing[0], nothing)

    def familiar(self, state: State) -> torch.Tensor:
        """Nothing of it lies anywhere: [B, 2] of zeros (see KeyframeScene)."""
        return torch.zeros(state.batch, 2, device=self.device)

    def conditioning(self, state: State, before: State) -> Conditioning:
        """What the generator gets to draw the frame that follows `state`'s newest action."""
        frames, actions = state["frames"], state["actions"].flip(1)
        context = torch.cat([context_thumbnail(frames[:, 0]), actions.flatten(1)], 1)
        last = torch.zeros(len(frames), 4, *self.config.size, device=frames.device)
        if not self.config.moves:
            return Conditioning(past(frames), last, context)
        return Conditioning(past(frames), last, context, self._joined(state), self.over.expand(len(frames), -1, -1))

    def drawn(
        self, state: State, conditioning: Conditioning, clean: torch.Tensor, paint: Callable[[State], State]
    ) -> State:
        """`state` with the frame `clean` [B, 4, H, W] as its newest, how it was made to scroll, and the last in its mosaic."""
        mosaic, scroll = conditioning.mosaic, conditioning.scroll
        flat = {} if mosaic is None or scroll is None else {"mosaic": mosaic, "scroll": scroll}
        return state.replace(frames=torch.cat([pixels(clean)[:, None], state["frames"][:, :-1]], 1), **flat)

    def _joined(self, state: State) -> torch.Tensor:
        """The mosaic with the newest frame in its middle. That of a state lags by a frame, so that evidence may yet replace it.
        It goes on as the frame was made to: new ground, of which little is known, is too plain to tell how it scrolled."""
        return remembered(state["mosaic"], state["frames"][:, 0], self.moves[state["scroll"]], self.over)

    def _whole(self, state: State) -> torch.Tensor:
        """The mosaic, and what lies over it where it knows nothing."""
        frame, move = state["frames"][:, 0], self.moves[state["scroll"]]
        joined, none = self._joined(state), torch.zeros_like(self.over)
        return torch.where(joined[:, 3:] > 0, joined, remembered(state["mosaic"], frame, move, none))

    def show(self, state: State) -> dict[str, Callable[[], torch.Tensor]]:
        return {
            "rgb": lambda: state["frames"][:, 0].permute(0, 2, 3, 1).contiguous(),
            "mosaic": lambda: _shown(self._whole(state)),
        }


def _shown(mosaic: torch.Tensor) -> torch.Tensor:
    """The channel `mosaic` (core/world.py) of mosaics uint8 [B, 4, H', W'], colour and votes."""
    seen = (mosaic[:, 3:] > 0).to(torch.uint8) * 255
    return torch.cat([mosaic[:, :3], seen], 1).permute(0, 2, 3, 1).contiguous()


def past(frames: torch.Tensor) -> Glimpse:
    """The last frames (uint8 [B, slots, 3, H, W], the newest first) in the place of what a memory knows."""
    batch, slots, _, height, width = frames.shape
    trust = TRUST ** torch.arange(slots, dtype=torch.float32, device=frames.device)
    everywhere = torch.ones(batch, height, width, device=frames.device)
    trust = trust[None, :, None, None].expand(batch, -1, height, width)
    return Glimpse(frames.float() / 255, trust, everywhere, everywhere)
