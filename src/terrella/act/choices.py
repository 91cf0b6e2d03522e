"""Choices: what decisions of a policy saw and drew, enough for their probability under other weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from ..core.world import Observation


@dataclass(frozen=True)
class Choices:
    """N decisions. inputs: what the network took, [N, ...] each; drawn [N, ...]: what was drawn from its output."""

    inputs: Mapping[str, torch.Tensor]
    drawn: torch.Tensor

    def at(self, rows: torch.Tensor) -> "Choices":
        """The decisions `rows` (int64 or bool)."""
        return Choices({name: value[rows] for name, value in self.inputs.items()}, self.drawn[rows])

    @staticmethod
    def join(parts: "list[Choices]") -> "Choices":
        """All decisions of the parts, one part after the other."""
        names = parts[0].inputs
        inputs = {name: torch.cat([part.inputs[name] for part in parts]) for name in names}
        return Choices(inputs, torch.cat([part.drawn for part in parts]))


class ExploringPolicy(Protocol):
    """A Policy that draws its actions, and gives the choices behind them."""

    @property
    def sees(self) -> tuple[str, ...]: ...
    def begin(self, batch: int, rng: torch.Generator) -> Any: ...
    def explore(
        self, observation: Observation, memory: Any, rng: torch.Generator
    ) -> tuple[torch.Tensor, Any, Choices | None]: ...
