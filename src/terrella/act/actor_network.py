"""The networks of a learned policy: numbers and pictures to features, features to a distribution over actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from ..core.errors import ActionError, ChannelError, TerrellaError
from ..core.spec import BUTTONS, CHOICE, Spec, dtype_of, shape_of
from .distributions import ActionDistribution, Bernoulli, Categorical, SquashedGaussian

AXES = "axes"
CELLS = 4  # side of the pooled feature map of a picture
MAX_SYMLOG = 20.0  # numbers are clamped to this after symlog


@dataclass(frozen=True)
class ActorConfig:
    """The inputs, the actions and the size of a policy network."""

    sees: tuple[tuple[str, tuple[int, ...]], ...]  # (channel, shape): numbers [n] or [], pictures [H, W, C]
    mode: str  # buttons, choice or axes
    shape: tuple[int, ...]  # of one action
    low: tuple[float, ...]  # of each number of an action
    high: tuple[float, ...]  # of each number of an action
    hidden: int = 128  # width of the MLP
    layers: int = 2  # of the MLP

    @staticmethod
    def of(spec: Spec, sees: tuple[str, ...], hidden: int = 128, layers: int = 2) -> ActorConfig:
        """For a world's actions, and these of its channels. ChannelError for a channel of neither numbers nor pictures,
        ActionError for continuous actions without limits."""
        spec.check_channels(sees)
        if not sees:
            raise ChannelError(f"a policy needs at least one channel; {spec.name} has {', '.join(spec.channels)}.")
        shapes = tuple((name, shape_of(spec.channels[name])) for name in sees)
        wrong = [name for name, shape in shapes if len(shape) not in (0, 1, 3)]
        if wrong:
            raise ChannelError(f"a policy takes numbers and pictures, and {', '.join(wrong)} is neither.")
        return ActorConfig(shapes, *_actions(spec), hidden, layers)

    @property
    def numbers(self) -> tuple[tuple[str, int], ...]:
        """(channel, width) of the inputs that are numbers."""
        return tuple((name, int(np.prod(shape))) for name, shape in self.sees if len(shape) < 2)

    @property
    def pictures(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        return tuple((name, shape) for name, shape in self.sees if len(shape) == 3)

    @property
    def width(self) -> int:
        return sum(width for _, width in self.numbers)

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of options of each choice."""
        return tuple(int(high - low) + 1 for low, high in zip(self.low, self.high))

    @property
    def outputs(self) -> int:
        """Parameters of the distribution over actions."""
        return {CHOICE: sum(self.counts), BUTTONS: len(self.low), AXES: 2 * len(self.low)}[self.mode]

    def distribution(self, params: torch.Tensor) -> ActionDistribution:
        """The distribution with parameters [N, outputs]."""
        if self.mode == CHOICE:
            return Categorical(self.counts, params)
        return Bernoulli(params) if self.mode == BUTTONS else SquashedGaussian(params)

    def actions(self, samples: torch.Tensor, spec: Spec) -> torch.Tensor:
        """Samples [N, D] of the distribution as actions of `spec`; gradients pass through continuous actions."""
        low, high = (torch.tensor(limit, dtype=torch.float32, device=samples.device) for limit in (self.low, self.high))
        if self.mode == AXES:
            values = ((low + high) / 2 + (high - low) / 2 * torch.tanh(samples)).clamp(low, high)
        else:
            values = samples + low
        kind = torch.from_numpy(np.zeros(0, dtype_of(spec.action))).dtype
        return values.to(kind).reshape(-1, *self.shape)

    def check(self, spec: Spec) -> None:
        """ActionError or ChannelError if `spec` has other actions or channels."""
        if _actions(spec) != (self.mode, self.shape, self.low, self.high):
            raise ActionError(
                f"the policy gives actions of {self._action_text()}, and {spec.name} takes {spec.action}: it is for other actions."
            )
        for name, shape in self.sees:
            if name not in spec.channels:
                raise ChannelError(
                    f"the policy sees '{name}', which {spec.name} lacks; it has {', '.join(spec.channels)}."
                )
            if shape_of(spec.channels[name]) != shape:
                raise ChannelError(
                    f"the policy sees '{name}' of shape {shape}, and {spec.name} shows {shape_of(spec.channels[name])}."
                )

    def _action_text(self) -> str:
        if self.mode == CHOICE:
            return " and ".join(f"one of {count}" for count in self.counts)
        limits = f" from {list(self.low)} to {list(self.high)}" if self.mode == AXES else ""
        return f"{len(self.low)} {self.mode}{limits}"


def _actions(spec: Spec) -> tuple[str, tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
    low, high = (np.asarray(limit, np.float64) for limit in spec.action_limits)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ActionError(
            f"{spec.name} has continuous actions without limits, {spec.action}; a learned policy needs limits."
        )
    mode = spec.action_mode if spec.action_mode in (BUTTONS, CHOICE) else AXES
    return mode, shape_of(spec.action), tuple(low.ravel().tolist()), tuple(high.ravel().tolist())


class ObservationEncoder(nn.Module):
    """Observations to features [N, width]: symlog of normalised numbers, strided convolutions of pictures."""

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, config: ActorConfig):
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(config.width))
        self.register_buffer("scale", torch.ones(config.width))
        self.looks = nn.ModuleList(_convolutions(shape[2], config.hidden) for _, shape in config.pictures)
        self.width = config.width + config.hidden * len(self.looks)

    def forward(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        parts = []
        if self.config.numbers:
            normalised = (self.numbers(seen) - self.mean) / self.scale
            parts.append(symlog(normalised).clamp(-MAX_SYMLOG, MAX_SYMLOG))
        for look, (name, _) in zip(self.looks, self.config.pictures):
            picture = seen[name].to(self.mean.device)
            unit = picture.float() / 255 if picture.dtype == torch.uint8 else picture.float()
            parts.append(look((unit - 0.5).permute(0, 3, 1, 2).contiguous()))
        return torch.cat(parts, 1)

    def numbers(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """All numbers [N, width]."""
        parts = [seen[name].to(self.mean.device).float().reshape(-1, width) for name, width in self.config.numbers]
        return torch.cat(parts, 1)

    def fit_normalization(self, seen: Mapping[str, torch.Tensor]) -> None:
        """Takes mean and standard deviation from observations; numbers that never vary keep a deviation of 1."""
        if self.config.numbers:
            flat = self.numbers(seen).double()
            spread, mean = flat.std(0, correction=0), flat.mean(0)
            constant = spread <= 1e-6 * mean.abs().clamp_min(1e-6)
            self.mean.copy_(mean)
            self.scale.copy_(torch.where(constant, 1.0, spread))


class ActorNetwork(nn.Module):
    """Encoder and MLP, to the parameters of a distribution over actions."""

    def __init__(self, config: ActorConfig):
        super().__init__()
        self.config, self.eyes = config, ObservationEncoder(config)
        self.think = mlp(self.eyes.width, config.hidden, config.layers, config.outputs, gain=0.01)

    def forward(self, seen: Mapping[str, torch.Tensor]) -> ActionDistribution:
        return self.config.distribution(self.think(self.eyes(seen)))


def mlp(into: int, hidden: int, layers: int, out: int, gain: float) -> nn.Sequential:
    """An MLP with LayerNorm and SiLU; the weights of its last layer are scaled by `gain`."""
    parts: list[nn.Module] = []
    for layer in range(layers):
        parts += [nn.Linear(hidden if layer else into, hidden), nn.LayerNorm(hidden), nn.SiLU()]
    last = nn.Linear(hidden, out)
    with torch.no_grad():
        last.weight.mul_(gain)
        last.bias.zero_()
    return nn.Sequential(*parts, last)


def symlog(x: torch.Tensor) -> torch.Tensor:
    """sign(x) log(1 + |x|), about x near 0 (Webber 2012; DreamerV3)."""
    return x.sign() * x.abs().log1p()


def symexp(x: torch.Tensor) -> torch.Tensor:
    """The inverse of symlog."""
    return x.sign() * x.abs().expm1()


def _convolutions(channels: int, hidden: int) -> nn.Sequential:
    widths = (channels, 16, 32, 48)
    layers = [part for a, b in zip(widths, widths[1:]) for part in (nn.Conv2d(a, b, 4, 2, 1), nn.SiLU())]
    cells = (nn.AdaptiveAvgPool2d(CELLS), nn.Flatten(), nn.Linear(widths[-1] * CELLS**2, hidden), nn.SiLU())
    return nn.Sequential(*layers, *cells)


def check_seen(config: ActorConfig, seen: Mapping[str, torch.Tensor]) -> int:
    """The batch size of an observation; TerrellaError if it does not fit the policy."""
    missing = [name for name, _ in config.sees if name not in seen]
    if missing:
        raise ChannelError(f"the policy sees {', '.join(missing)}, which the observation lacks.")
    for name, shape in config.sees:
        if tuple(seen[name].shape[1:]) != shape:
            raise ChannelError(f"the policy sees '{name}' of shape {shape}; got {tuple(seen[name].shape[1:])}.")
    batches = {len(seen[name]) for name, _ in config.sees}
    if len(batches) != 1:
        raise TerrellaError(f"the channels of an observation must have one batch size; got {sorted(batches)}.")
    return batches.pop()
