"""Controls: the kind of a world's actions (buttons, choices, axes), and their encoding for networks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from gymnasium import spaces

from ..core.backend import constant
from ..core.errors import ContractError
from ..core.spec import BUTTONS, CHOICE, Spec, shape_of

AXES = "axes"


@dataclass(frozen=True)
class Controls:
    """What an action is."""

    kind: str  # "buttons", each 0 or 1; "choice", one or several whole numbers; "axes", numbers between limits
    low: tuple[float, ...]  # limits, one for each number of an action
    high: tuple[float, ...]
    mode: str = ""  # what axes mean: mode, units and frame as in Spec
    units: tuple[str, ...] = ()
    frame: str = ""

    @staticmethod
    def buttons(count: int) -> Controls:
        return Controls(BUTTONS, (0.0,) * count, (1.0,) * count)

    @staticmethod
    def of(spec: Spec) -> Controls:
        """The controls of a spec; ContractError for axes without limits and for actions of more than one dimension."""
        low, high = (np.asarray(limit, np.float64).ravel() for limit in spec.action_limits)
        if len(shape_of(spec.action)) > 1 or not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ContractError(
                f"{spec.name} has actions in {spec.action}; buttons, one choice or limited axes can be learned."
            )
        kind = spec.action_mode if spec.action_mode in (BUTTONS, CHOICE) else AXES
        meaning = spec.action_mode if kind == AXES else "", tuple(spec.action_units), spec.action_frame
        return Controls(kind, tuple(low.tolist()), tuple(high.tolist()), *meaning)

    @property
    def numbers(self) -> int:
        """Numbers of an encoded action."""
        return sum(self.counts) if self.kind == CHOICE else len(self.low)

    @property
    def counts(self) -> list[int]:
        """The number of options of each choice."""
        return [int(high - low) + 1 for low, high in zip(self.low, self.high)]

    def space(self) -> spaces.Space:
        """The space of one action."""
        if self.kind == BUTTONS:
            return spaces.MultiBinary(len(self.low))
        if self.kind == CHOICE:
            starts = [int(low) for low in self.low]
            if len(starts) == 1:
                return spaces.Discrete(self.numbers, start=starts[0])
            return spaces.MultiDiscrete(self.counts, start=starts)
        return spaces.Box(np.array(self.low, np.float32), np.array(self.high, np.float32))

    def encode(self, action: torch.Tensor) -> torch.Tensor:
        """Actions [B, ...] of `space` as float32 [B, numbers]: buttons as they are, choices one-hot, axes scaled to -1..1."""
        given = action.reshape(len(action), -1).float()
        if self.kind == CHOICE:
            low, high = (constant(torch.tensor, action.device, limit) for limit in (self.low, self.high))
            picked = torch.clamp(given.round(), low, high)
            which, options = (
                constant(make, action.device, self.low, tuple(self.counts)) for make in (_which, _options)
            )
            return ((picked if len(self.counts) == 1 else picked[:, which]) == options).float()
        if self.kind == AXES:
            low, high = (constant(torch.tensor, action.device, limit) for limit in (self.low, self.high))
            return (2 * (given - low) / (high - low).clamp_min(1e-6) - 1).clamp(-1, 1)
        return given


def _which(low: tuple[float, ...], counts: tuple[int, ...]) -> torch.Tensor:
    """int64 [numbers]: the choice that each number of an encoded action is of."""
    return torch.arange(len(low)).repeat_interleave(torch.tensor(counts))


def _options(low: tuple[float, ...], counts: tuple[int, ...]) -> torch.Tensor:
    """float32 [numbers]: the options of the choices, one after another."""
    return torch.cat([first + torch.arange(count) for first, count in zip(low, counts)]).float()
