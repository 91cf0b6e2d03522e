"""Perceived: a World around a World, in which policies see a goal that an encoder estimates from a picture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from ..core.errors import TerrellaError
from ..core.state import State
from ..core.world import World
from .wrapper import WorldWrapper

GOAL, ESTIMATE = "goal", "perceived.goal"


class Perceived(WorldWrapper[World]):
    """`Perceived(world, encoder)`, for a world whose states have a `goal` [B, n] and which shows `camera`.

    encoder: one picture at the start of an episode, uint8 [B, H, W, 3] -> goals float32 [B, n], in the goal's units; channels:
    those rendered with the estimated goal; all others use the true one. TerrellaError where there is no such camera or no goal."""

    def __init__(
        self,
        world: World,
        encoder: Callable[[torch.Tensor], torch.Tensor],
        camera: str = "rgb",
        channels: Sequence[str] = ("observation",),
    ):
        if camera not in world.spec.channels:
            shown = ", ".join(world.spec.channels)
            raise TerrellaError(f"{world.spec.name} shows no '{camera}' to estimate a goal from; it shows {shown}.")
        world.spec.check_channels(channels)
        self.world, self.encoder, self.camera, self.channels = world, encoder, camera, tuple(channels)
        self.spec = replace(world.spec, differentiable=False)

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._estimated(self.world.start(batch, rng))

    def observe(self, observation: Mapping[str, torch.Tensor], prior: State | None, rng: torch.Generator) -> State:
        state = self.world.observe(observation, prior, rng)
        return self._estimated(state) if prior is None else state.replace(**{ESTIMATE: prior[ESTIMATE]})

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        return self.world.imagine(state, action, rng).replace(**{ESTIMATE: state[ESTIMATE]})

    def render(self, state: State, channels: Sequence[str]) -> dict[str, torch.Tensor]:
        estimated = [name for name in channels if name in self.channels]
        seen = dict(self.world.render(state, [name for name in channels if name not in estimated]))
        if estimated:
            seen |= self.world.render(state.replace(**{GOAL: state[ESTIMATE]}), estimated)
        return {name: seen[name] for name in channels}

    def _estimated(self, state: State) -> State:
        """The state with a goal estimated from its picture."""
        if GOAL not in state:
            raise TerrellaError(f"the states of {self.spec.name} have no '{GOAL}' to estimate from a picture.")
        goal = self.encoder(self.world.render(state, (self.camera,))[self.camera])
        return state.replace(**{ESTIMATE: goal.to(state[GOAL].dtype).reshape(state[GOAL].shape)})
