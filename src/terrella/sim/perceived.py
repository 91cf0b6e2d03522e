"""Perceived: a World around a World, in which policies see the goal that an encoder read off a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from ..core.errors import TerrellaError
from ..core.state import State
from ..core.world import World
from .wrapper import WorldWrapper

GOAL, SEEN = "goal", "perceived.goal"


class Perceived(WorldWrapper[World]):
    """`Perceived(world, encoder)`: of a world whose states keep a `goal` [B, n] and which shows `camera`.

    encoder: pictures uint8 [B, H, W, 3] -> goals [B, n], float32, in the goal's units. One picture is taken when an episode
    begins. The channels of `told` are made with that goal; whatever else, as reward and success, with the true one.
    TerrellaError where there is no camera or no goal.
    """

    def __init__(
        self,
        world: World,
        encoder: Callable[[torch.Tensor], torch.Tensor],
        camera: str = "rgb",
        told: Sequence[str] = ("observation",),
    ):
        if camera not in world.spec.channels:
            shown = ", ".join(world.spec.channels)
            raise TerrellaError(
                f"{world.spec.name} shows no '{camera}', so that no goal can be read off it; it shows {shown}."
            )
        world.spec.check_channels(told)
        self.world, self.encoder, self.camera, self.told = world, encoder, camera, tuple(told)
        self.spec = replace(world.spec, differentiable=False)

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._looked(self.world.start(batch, rng))

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        found = self.world.observe(observation, prior, rng)
        return self._looked(found) if prior is None else found.replace(**{SEEN: prior[SEEN]})

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        return self.world.imagine(state, action, rng).replace(**{SEEN: state[SEEN]})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        told = [name for name in channels if name in self.told]
        seen = dict(self.world.render(state, [name for name in channels if name not in told]))
        if told:
            seen |= self.world.render(state.replace(**{GOAL: state[SEEN]}), told)
        return {name: seen[name] for name in channels}

    def _looked(self, state: State) -> State:
        if GOAL not in state:
            raise TerrellaError(f"the states of {self.spec.name} keep no '{GOAL}' that could be read off a picture.")
        found = self.encoder(self.world.render(state, (self.camera,))[self.camera])
        return state.replace(**{SEEN: found.to(state[GOAL].dtype).reshape(state[GOAL].shape)})
