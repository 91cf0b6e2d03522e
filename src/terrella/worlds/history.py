"""HistoryWorld: the generator of worlds/video.py on history alone, for recordings without depth or pose.

The last frames take the place of keyframes, unwarped, and the actions are told to the network, since no motion model
turns them into a view. It answers and stays in tune with its recordings; it does not remember what left the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from ..core.errors import ContractError, ObservationError
from ..core.spec import Spec
from ..core.state import State
from ..space.keyframes import Glimpse
from .video import Generator, VideoConfig, channels_last, generate, mood


class HistoryWorld:
    """`starts` are short pieces of recording, uint8 [S, slots, 3, H, W], the newest frame first; `reward` is the
    recording's usual one (without a pose nothing says where an episode ends)."""

    def __init__(self, spec: Spec, config: VideoConfig, generator: Generator, starts: torch.Tensor, reward: float):
        self.spec, self.config, self.starts, self.reward = spec, config, starts, reward
        self.generator = channels_last(generator.eval())

    def start(self, batch: int, rng: torch.Generator) -> State:
        """Begins with a piece of a recording, no button held."""
        if batch < 1:
            raise ContractError(f"start needs a batch of 1 or more; got {batch}.")
        frames = self.starts[torch.randint(len(self.starts), (batch,), generator=rng)]
        return State({"frames": frames, "actions": torch.zeros(batch, self.config.slots, self.config.actions)})

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        """A picture replaces the newest frame of the prior; without a prior it stands for the whole history."""
        height, width = self.config.size
        if "rgb" not in observation:
            raise ObservationError(f"{self.spec.name} observes rgb; got {list(observation)}.")
        rgb = torch.as_tensor(observation["rgb"])
        if rgb.ndim != 4 or rgb.shape[1:] != (height, width, 3):
            raise ObservationError(f"rgb is uint8 [B, {height}, {width}, 3]; got {tuple(rgb.shape)}.")
        frame = rgb.to(torch.uint8).permute(0, 3, 1, 2)[:, None]
        if prior is None:
            actions = torch.zeros(len(rgb), self.config.slots, self.config.actions)
            return State({"frames": frame.repeat(1, self.config.slots, 1, 1, 1), "actions": actions})
        return prior.replace(frames=torch.cat([frame, prior["frames"][:, 1:]], 1))

    @torch.inference_mode()
    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        action = self.spec.check_action(action, state.batch).float().view(state.batch, 1, -1)
        actions = torch.cat([action, state["actions"][:, :-1]], 1)
        noise = torch.randn(state.batch, 4, *self.config.size, generator=rng)
        there = next(self.generator.parameters()).device
        glimpse, nothing = past(state["frames"]).to(there), torch.zeros_like(noise, device=there)
        told = torch.cat([mood(state["frames"][:, 0]), actions.flatten(1)], 1).to(there)
        clean = generate(self.generator, noise.to(there), glimpse, nothing, told, self.config.steps).cpu()
        frame = ((clean[:, :3] + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)[:, None]
        return State({"frames": torch.cat([frame, state["frames"][:, :-1]], 1), "actions": actions})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        self.spec.check_channels(channels)
        show = {
            "rgb": lambda: state["frames"][:, 0].permute(0, 2, 3, 1).contiguous(),
            "reward": lambda: torch.full((state.batch,), self.reward),
            "done": lambda: torch.zeros(state.batch, dtype=torch.bool),
        }
        return {name: show[name]() for name in channels}


def past(frames: torch.Tensor) -> Glimpse:
    """The last frames (uint8 [B, slots, 3, H, W], the newest first) in the place of what a memory knows."""
    batch, slots, _, height, width = frames.shape
    trust = 0.5 ** torch.arange(slots, dtype=torch.float32)
    everywhere = torch.ones(batch, height, width)
    return Glimpse(
        frames.float() / 255, trust[None, :, None, None].expand(batch, -1, height, width), everywhere, everywhere
    )
