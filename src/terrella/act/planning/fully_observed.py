"""A simulator whose whole state is observed, so that a planner starts from the state of the real episode."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from gymnasium import spaces

from ...core.errors import ObservationError, PlanningError
from ...core.spec import Spec
from ...core.state import State
from ...core.world import Observation, World, make_rng

_KIND = "snapshot"


class FullyObserved:
    """A World around a World whose states are values: each tensor of the state is a channel `snapshot.NAME`, and observing those
    sets the state. So a Planner over a simulator is a Policy like any other: it sees what it needs to copy the state.

    PlanningError for a world that cannot be copied (an external game), or whose state holds rows of an arena, unless `here`:
    channels are observed in the process that rendered them, while the rows are fresh.
    """

    def __init__(self, world: World, here: bool = False):
        spec = world.spec
        if not spec.forkable:
            raise PlanningError(
                f"{spec.name} cannot be planned in: it cannot return to a state (forkable=False). Learn a world of it first."
            )
        state = world.start(1, make_rng(0))
        if state.arenas and not here:
            raise PlanningError(
                f"the state of {spec.name} lies in an arena, which no channel can show; plan in the world itself."
            )
        self._world, self._arenas = world, state.arenas
        self._names = {f"{_KIND}.{name}": name for name in state}
        shown = {channel: _space_of(state[name][0]) for channel, name in self._names.items()}
        self.spec: Spec = replace(
            spec, channels={**spec.channels, **shown}, observes=tuple(self._names), may_observe=()
        )

    def start(self, batch: int, rng: torch.Generator) -> State:
        return self._world.start(batch, rng)

    def observe(self, observation: Observation, prior: State | None, rng: torch.Generator) -> State:
        """The state that is shown; the prior is not used."""
        missing = [channel for channel in self._names if channel not in observation]
        if missing:
            raise ObservationError(f"{self.spec.name} observes its whole state, and {', '.join(missing)} is missing.")
        for channel, name in self._names.items():
            if tuple(observation[channel].shape[1:]) != self.spec.channels[channel].shape:
                raise ObservationError(
                    f"'{name}' of the state is {tuple(observation[channel].shape[1:])}, where {self.spec.name} has "
                    f"{self.spec.channels[channel].shape}: this is another environment."
                )
        return State({name: observation[channel] for channel, name in self._names.items()}, self._arenas)

    def imagine(self, state: State, action: torch.Tensor, rng: torch.Generator) -> State:
        return self._world.imagine(state, action, rng)

    def render(self, state: State, channels: Sequence[str]) -> Mapping[str, torch.Tensor]:
        self.spec.check_channels(channels)
        seen = self._world.render(state, [name for name in channels if name not in self._names])
        return {**seen, **{name: state[self._names[name]] for name in channels if name in self._names}}

    def close(self) -> None:
        close = getattr(self._world, "close", None)
        if callable(close):
            close()


def _space_of(tensor: torch.Tensor) -> spaces.Space:
    array = tensor.cpu().numpy()
    if array.dtype == np.bool_:
        return spaces.Box(0, 1, array.shape, np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if array.dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, array.shape, array.dtype.type)
    limit = np.iinfo(array.dtype.type)
    return spaces.Box(limit.min, limit.max, array.shape, array.dtype.type)
