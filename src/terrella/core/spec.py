"""What a world is, as data: its actions, its channels, its clock and its units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from gymnasium import spaces

from .errors import ActionError, ChannelError

# The spaces of the channels `reward` and `done`, alike in all worlds.
REWARD = spaces.Box(-np.inf, np.inf, (), np.float32)
DONE = spaces.Box(0, 1, (), np.bool_)  # pyright: ignore[reportCallIssue, reportArgumentType]


def shape_of(space: spaces.Space) -> tuple[int, ...]:
    """The shape of one value; ActionError for spaces whose values are not one array (Dict, Tuple)."""
    if space.shape is None:
        raise ActionError(f"the values of {space} are not one array")
    return space.shape


def dtype_of(space: spaces.Space) -> np.dtype:
    """The dtype of the values."""
    return np.dtype(space.dtype)


@dataclass(frozen=True)
class Spec:
    """The declaration that every tool reads instead of asking `hasattr`.

    action:       space of one action (no batch axis).
    channels:     what `render` can show, name -> space of one observation (no batch axis).
    observes:     the channels that `observe` needs as evidence.
    may_observe:        the channels that it takes beside them where they are at hand (what moves, how the player is).
    dt_s:         seconds of world time that one `imagine` advances.
    units:        channel -> unit, for the channels that have one ("m", "reward").
    action_names: one name per button (MultiBinary), choice (Discrete) or axis (Box).
    keys:         browser key (`KeyboardEvent.code`) -> the action that it stands for while held, as a
                  flat list of floats; keys held together are combined by element-wise maximum.
    camera:       pinhole intrinsics in units of the image size: fx/W, fy/H, cx/W, cy/H; None without a camera.
    forkable:     False where a state cannot be kept and returned to (an external game process).
    max_batch:    the largest batch that `start` accepts; None for no limit.
    card:         free facts for people: training data, hardware, scores.
    """

    name: str
    action: spaces.Space
    channels: Mapping[str, spaces.Space]
    observes: tuple[str, ...]
    dt_s: float
    units: Mapping[str, str] = field(default_factory=dict)
    action_names: tuple[str, ...] = ()
    keys: Mapping[str, list[float]] = field(default_factory=dict)
    camera: tuple[float, float, float, float] | None = None
    forkable: bool = True
    max_batch: int | None = None
    card: Mapping[str, object] = field(default_factory=dict)
    may_observe: tuple[str, ...] = ()

    def check_channels(self, channels) -> None:
        """Raises ChannelError naming the channels that exist."""
        for name in channels:
            if name not in self.channels:
                raise ChannelError(f"{self.name} cannot render '{name}'; it has {', '.join(self.channels)}.")

    def check_action(self, action: torch.Tensor, batch: int) -> torch.Tensor:
        """The action as a tensor [batch, *action.shape] of the space's dtype; ActionError where it does not fit."""
        low, high = self.action_limits
        shape = (batch, *shape_of(self.action))
        try:
            tensor = torch.as_tensor(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ActionError(f"{self.name} takes an action of numbers of shape {shape}; got {action!r}.") from error
        if tuple(tensor.shape) != shape:
            raise ActionError(f"{self.name} takes an action of shape {shape} (batch first); got {tuple(tensor.shape)}.")
        if tensor.is_complex() or not torch.isfinite(tensor).all():
            raise ActionError(f"{self.name} was given an action that is not a finite number.")
        plain = tensor.float() if tensor.dtype == torch.bfloat16 else tensor  # which numpy does not have
        given = plain.detach().cpu().numpy()
        array = given.astype(dtype_of(self.action))
        whole = array.dtype.kind == "f" or (array == given).all()
        if not (whole and (array >= low).all() and (array <= high).all()):
            raise ActionError(f"{self.name} takes actions in {self.action}; got {given.tolist()}.")
        return torch.from_numpy(array).to(tensor.device)

    def sample_action(self, batch: int, rng: torch.Generator) -> torch.Tensor:
        """Uniform random actions [batch, *action.shape], from `rng` alone; axes without a limit stay within 1000."""
        low, high = self.action_limits
        numpy_rng = np.random.default_rng(int(torch.randint(2**31 - 1, (1,), generator=rng, device=rng.device).item()))
        shape, dtype = (batch, *shape_of(self.action)), dtype_of(self.action)
        if dtype.kind == "f":
            array = numpy_rng.uniform(np.clip(low, -1e3, 1e3), np.clip(high, -1e3, 1e3), shape).astype(dtype)
        else:
            array = numpy_rng.integers(low, high, shape, endpoint=True).astype(dtype)
        return torch.from_numpy(array)

    @cached_property
    def action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest action, in the space's dtype."""
        space = self.action
        if isinstance(space, spaces.Box):
            return space.low, space.high
        if isinstance(space, spaces.MultiBinary):
            return np.zeros(space.shape, space.dtype), np.ones(space.shape, space.dtype)
        if isinstance(space, spaces.Discrete):
            return np.asarray(space.start), np.asarray(space.start + space.n - 1)
        if isinstance(space, spaces.MultiDiscrete):
            return space.start, space.start + space.nvec - 1
        raise ActionError(
            f"{self.name} has the action space {space}; only Box, Discrete, MultiBinary and MultiDiscrete are known."
        )
