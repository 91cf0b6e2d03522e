"""The one Policy: whatever turns observations into actions, be it a person, a planner, a network or chance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch

from .errors import ContractError
from .spec import Spec, neutral_action, shape_of
from .state import State
from .world import Observation


@runtime_checkable
class Policy(Protocol):
    """Acts in any World. What it remembers of a batch of episodes is handed back to it at each step, so that a policy itself
    never changes and one policy can play many episodes at once. It may name the channels that it is to be shown, as `sees`;
    one that does not is shown all that a recording would hold."""

    def begin(self, batch: int, rng: torch.Generator) -> Any:
        """The memory in which `batch` episodes begin: None, or a State, tensor or list that leads with the batch."""
        ...

    def act(self, observation: Observation, memory: Any, rng: torch.Generator) -> tuple[torch.Tensor, Any]:
        """The actions [B, *spec.action.shape] of this step, and the memory for the next."""
        ...


def act(
    policy: Policy, observation: Observation, memory: Any, batch: int, spec: Spec, rng: torch.Generator
) -> tuple[torch.Tensor, Any]:
    """`policy.act`, held to its contract: ContractError for a memory or an action of another batch."""
    held = _batch_of(memory)
    if held is not None and held != batch:
        raise ContractError(f"the policy's memory is of {held} episodes, and {batch} are played: begin it again.")
    action, memory = policy.act(observation, memory, rng)
    action = torch.as_tensor(action)
    if tuple(action.shape) != (batch, *shape_of(spec.action)):
        raise ContractError(
            f"the policy gave an action of shape {tuple(action.shape)} where {spec.name} takes "
            f"{(batch, *shape_of(spec.action))}."
        )
    return action, memory


def observed_channels(policy: Policy, spec: Spec) -> tuple[str, ...]:
    """The channels of a world that a policy is shown: its own `sees`, or all that a recording would hold. Channels that the world
    lacks are left out where it lists them in `may_observe`."""
    named = tuple(getattr(policy, "sees", spec.recorded))
    return tuple(name for name in named if name in spec.channels or name not in spec.may_observe)


def _batch_of(memory: Any) -> int | None:
    if isinstance(memory, State):
        return memory.batch
    if isinstance(memory, torch.Tensor):
        return len(memory) if memory.ndim else None
    return len(memory) if isinstance(memory, list) else None


class Reactive:
    """A policy without memory: `function(observation, rng)` gives the actions."""

    def __init__(self, function: Callable[[Observation, torch.Generator], torch.Tensor]):
        self.function = function

    def begin(self, batch: int, rng: torch.Generator) -> None:
        return None

    def act(self, observation: Observation, memory: None, rng: torch.Generator) -> tuple[torch.Tensor, None]:
        return self.function(observation, rng), None


class Replay:
    """Plays given actions [T, B, *action.shape]; ContractError after the last. Its memory is the step."""

    sees = ()

    def __init__(self, actions: torch.Tensor):
        self.actions = torch.as_tensor(actions)

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        return torch.zeros(batch, dtype=torch.int64)

    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        step = int(memory[0]) if len(memory) else 0
        if step >= len(self.actions):
            raise ContractError(f"the {len(self.actions)} actions to replay are used up.")
        return self.actions[step], memory + 1


class Constant:
    """Does one action always."""

    sees = ()

    def __init__(self, action: torch.Tensor):
        self.action = action

    def begin(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        return self.action.expand(batch, *self.action.shape)

    def act(
        self, observation: Observation, memory: torch.Tensor, rng: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return memory.clone(), memory


class Idle(Constant):
    """Does as little as the world's actions allow: the baseline "do nothing"."""

    def __init__(self, spec: Spec):
        super().__init__(torch.from_numpy(neutral_action(spec)))


class Held(NamedTuple):
    """A random action and the steps for which it is still held."""

    action: torch.Tensor
    steps: int


class Random:
    """Uniformly random actions, each held for `hold` steps, between the least and the most, both counted."""

    sees = ()

    def __init__(self, spec: Spec, hold: tuple[int, int] = (1, 1)):
        self.spec, self.hold = spec, hold

    def begin(self, batch: int, rng: torch.Generator) -> list[Held]:
        return [self._draw(rng) for _ in range(batch)]

    def act(
        self, observation: Observation, memory: list[Held], rng: torch.Generator
    ) -> tuple[torch.Tensor, list[Held]]:
        held = [one if one.steps else self._draw(rng) for one in memory]
        return torch.cat([one.action for one in held]), [Held(one.action, one.steps - 1) for one in held]

    def _draw(self, rng: torch.Generator) -> Held:
        least, most = self.hold
        return Held(self.spec.sample_action(1, rng), int(torch.randint(least, most + 1, (1,), generator=rng)))
