"""The contract: a World is whatever has these four verbs, and every tool takes any World."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch

from .spec import Spec
from .state import State

# Channel name -> tensor that leads with the batch axis B. A name is a kind, or a kind and a suffix ("rgb.wrist").
#   rgb          uint8 [B, H, W, 3]
#   depth        float32 [B, h, w], metres along the optical axis
#   pose         float32 [B, 7], x, y, z in metres and quaternion w, x, y, z of T_world_cam; world z up; camera x forward, y
#                left, z up
#   reward       float32 [B], of the last step
#   done         bool [B], whether the episode has ended
#   known        float32 [B, H, W] in 0..1, the share of each pixel of rgb that comes from memory; the rest is invented
#   places       float32 [B, N, 4], x, y in metres, heading in radians, and kind: 0 empty; a keyframe that was 1 recorded, 2
#                observed, 3 imagined; 4 a place where one can stand
#   mosaic       uint8 [B, H', W', 4], red, green, blue and 255 (0 where nothing was seen): the pictures so far, stitched by
#                their scrolling, with rgb in the middle
#   text         uint8 [B, 1024], the text of the task in UTF-8, padded with zeros (core/instruction.py)
#   instruction  float32 [B, D], the embedding of that text
# A goal is such a mapping, too.
Observation = Mapping[str, torch.Tensor]


@runtime_checkable
class World(Protocol):
    """Folds observations into a state, moves the state forward under an action, renders what can be seen from it.

        state = world.start(1, rng)
        state = world.imagine(state, action, rng)
        picture = world.render(state, ("rgb",))["rgb"]

    States are values: no verb changes its arguments. The caller decides on gradients and inference mode; no verb forces
    either. Randomness comes from `rng` alone, and a batch of B gives the same as B single episodes stepped in turn,
    up to rounding (of learned pictures in batches of more than 16: half precision, where a CPU has it).
    """

    spec: Spec

    def start(self, batch: int, rng: torch.Generator) -> State:
        """The initial states of `batch` episodes."""
        ...

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        """The posterior state after an observation.

        The observation holds every channel in `spec.observes`, and may hold those in `spec.may_observe`. `prior` is the
        predicted state, or None at the start of an episode. Filtering is `observe(obs, imagine(state, action, rng), rng)`.
        """
        ...

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        """The state one step (`spec.dt_s` seconds) later, under `action` [B, *spec.action.shape]."""
        ...

    def render(self, state: State, channels: Sequence[str]) -> Observation:
        """The named channels of the state. Channels that are not named cost nothing."""
        ...


@runtime_checkable
class Leaping(World, Protocol):
    """A World that can predict `spec.leap` steps at once; its `spec.leap` is above 0."""

    def leap(self, state: State, actions: torch.Tensor, rng: torch.Generator) -> State:
        """The state `spec.leap` steps later, under actions [B, leap, *action.shape]: its channel `latent` alone is defined, for the
        rewards of the steps in between are not predicted."""
        ...


def without_end(state: State) -> State:
    """The state of an episode that goes on, whatever the world predicts: for rollouts that are compared with a recording that goes
    on, and for pictures over more steps than an episode has. After a predicted end a world stands still."""
    return state.replace(done=torch.zeros_like(state["done"])) if "done" in state else state


def make_rng(seed: int, device: str = "cpu") -> torch.Generator:
    """A seeded generator for the verbs."""
    return torch.Generator(device=device).manual_seed(seed)
