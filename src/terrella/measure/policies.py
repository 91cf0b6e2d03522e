"""Policies of recorded and constant actions, until core/policy.py has them."""

from __future__ import annotations

from typing import Any, Protocol

import torch


class Policy(Protocol):
    def begin(self, batch: int, rng: torch.Generator) -> Any: ...

    def act(self, observation, memory: Any, rng: torch.Generator) -> tuple[torch.Tensor, Any]: ...


class Replay:
    def __init__(self, actions: torch.Tensor):
        self.actions = actions

    def begin(self, batch: int, rng: torch.Generator) -> int:
        return 0

    def act(self, observation, memory, rng):
        return self.actions[memory], memory + 1


class Constant:
    def __init__(self, action: torch.Tensor):
        self.action = action

    def begin(self, batch: int, rng: torch.Generator) -> int:
        return batch

    def act(self, observation, memory, rng):
        return self.action.expand(memory, *self.action.shape), memory
