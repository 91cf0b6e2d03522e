"""Policy: turns observations into actions. People, scripts, planners, networks and replays all have this interface."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch

from .errors import ContractError
from .spec import Spec, neutral_action, shape_of
from .state import State
from .world import Observation


@runtime_checkable
class Policy(Protocol):
    """Acts in any World.

        memory = policy.begin(batch, rng)
        action, memory = policy.act(observation, memory, rng)

    The memory of its episodes is passed in and returned, so a policy itself never changes, and one policy can act in many
    episodes at once. A policy may have an attribute `sees`: the channels that it is shown. Without it, it is shown every
    channel that a recording holds (`Spec.recorded`).
    """

    def begin(self, batch: int, rng: torch.Generator) -> Any:
        """The memory at the start of `batch` episodes: None, or a State, tensor or list that leads with the batch axis."""
        ...

    def act(self, observation: Observation, memory: Any, rng: torch.Generator) -> tuple[torch.Tensor, Any]:
        """The actions [B, *spec.action.shape] of this step, and the memory for the next step."""
        ...


def act(
    policy: Policy, observation: Observation, memory: Any, batch: int, spec: Spec, rng: torch.Generator
) -> tuple[torch.Tensor, Any]:
    """`policy.act` with its contract checked: ContractError for a memory or an action of another batch."""
    held = _batch_of(memory)
    if held is not None and held != batch:
        raise ContractError(f"the policy's memory holds {held} episodes, not {batch}; call begin({batch}, rng) first.")
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
    """Plays given actions [T, B, *action.shape]; ContractError after the last. Its memory is the step number."""

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
            raise ContractError(f"the {len(self.actions)} actions to replay are used up; give more, or step less.")
        return self.actions[step], memory + 1


class Constant:
    """Always takes the same action."""

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
    """Takes the neutral action of the world: the baseline that does nothing."""

    def __init__(self, spec: Spec):
        super().__init__(torch.from_numpy(neutral_action(spec)))


class Held(NamedTuple):
    """A random action, and the steps for which it will be repeated."""

    action: torch.Tensor
    steps: int


class Random:
    """Uniformly random actions, each repeated for a random number of steps in `hold` = (least, most), both inclusive."""

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
