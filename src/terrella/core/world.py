"""The contract: whatever has these four verbs is a World, and every tool takes any World."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch

from .spec import Spec
from .state import State

# name -> tensor that leads with the batch axis. A name is a kind, or a kind and which one of it ("rgb.wrist"). rgb: uint8
# [B, H, W, 3]; depth: float32 [B, h, w], metres along the optical axis; pose: float32 [B, 7] = x, y, z in metres and
# quaternion w, x, y, z of T_world_cam, world z up, camera x forward, y left, z up; reward: float32 [B]; done: bool [B];
# known: float32 [B, H, W] in 0..1, the share of memory in each pixel of rgb, the rest being invented; places: float32
# [B, N, 4] = x, y in metres, heading in radians, kind (0 empty, a keyframe that was 1 recorded, 2 observed, 3 imagined, or 4
# a place where one can stand); mosaic: uint8 [B, H', W', 4] = red, green, blue and 255 (0 where nothing was seen), the
# pictures joined by how they scrolled, rgb in the middle; instruction: float32 [B, D], the embedding of a task's text. A goal
# is a mapping of channels, too.
Observation = Mapping[str, torch.Tensor]


@runtime_checkable
class World(Protocol):
    """Folds observations into a state, moves the state under an action, shows what can be seen from it.

    Gradients and inference mode are the caller's choice: no verb forces either. Chance comes from `rng` alone, so that a
    batch of B steps as B single episodes would that are stepped one after the other.
    """

    spec: Spec

    def start(self, batch: int, rng: torch.Generator) -> State:
        """`batch` states in which an episode may begin."""
        ...

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        """Evidence into state: all that `spec.observes` names, and of what `spec.may_observe` names whatever is at hand.
        Filtering is `observe(obs, imagine(state, action, rng), rng)`."""
        ...

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """The state one step (`spec.dt_s`) later under `action` [B, *spec.action.shape]."""
        ...

    def render(self, state: State, channels: Sequence[str]) -> Observation:
        """The asked channels, and no work for the others."""
        ...


@runtime_checkable
class Leaping(World, Protocol):
    """A world whose `spec.leap` is above 0."""

    def leap(self, state: State, actions: torch.Tensor, rng: torch.Generator) -> State:
        """The state `spec.leap` steps later, at once, under actions [B, leap, *action.shape]. Only the channel `latent` of it
        counts: what was paid on the way is not told."""
        ...


def make_rng(seed: int, device: str = "cpu") -> torch.Generator:
    """A generator to hand to the verbs."""
    return torch.Generator(device=device).manual_seed(seed)
