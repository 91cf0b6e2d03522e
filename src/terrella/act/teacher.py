"""Teacher: does what a world's scripted expert advises, with some noise."""

import torch

from ..core.errors import TerrellaError
from ..core.spec import AXES, Spec, shape_of, torch_dtype_of
from ..core.world import Observation

EXPERT = "expert"


class Teacher:
    """Takes the action in the channel `expert`. noise: standard deviation of noise that is added to axes, as a share of half their
    range, so that a recording holds recoveries. TerrellaError for a world without an expert."""

    sees = (EXPERT,)

    def __init__(self, spec: Spec, noise: float = 0.0):
        if EXPERT not in spec.channels:
            raise TerrellaError(f"{spec.name} has no teacher (no channel '{EXPERT}'); mujoco:table has one.")
        if noise and spec.action_mode not in AXES:
            raise TerrellaError(
                f"the actions of {spec.name} are no axes: give teacher@0.1 in place of teacher:{noise:g}."
            )
        self.spec, self.noise = spec, noise

    def begin(self, batch: int, rng: torch.Generator) -> None:
        return None

    def act(self, observation: Observation, memory: None, rng: torch.Generator) -> tuple[torch.Tensor, None]:
        action = observation[EXPERT].cpu()
        action = action.reshape(len(action), *shape_of(self.spec.action)).to(torch_dtype_of(self.spec.action))
        if self.noise:
            low, high = map(torch.from_numpy, self.spec.action_limits)
            drawn = torch.randn(action.shape, generator=rng, dtype=action.dtype)
            action = (action + self.noise * (high - low) / 2 * drawn).maximum(low).minimum(high)
        return action, None


def teacher_of(text: str, spec: Spec) -> Teacher:
    """By "NOISE"; "" is 0."""
    try:
        noise = float(text or 0)
    except ValueError:
        noise = -1.0
    if not 0 <= noise <= 1:
        raise TerrellaError(f"'teacher:{text}': give the noise of its actions, 0 to 1, as in teacher:0.1.")
    return Teacher(spec, noise)
