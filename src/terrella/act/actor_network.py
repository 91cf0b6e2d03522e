"""The networks of a learned policy: numbers and pictures to features, features to a distribution of actions."""

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
CELLS = 4  # a side: of what is left of a picture
FARTHEST = 20.0  # of numbers, after symlog


@dataclass(frozen=True)
class ActorConfig:
    """sees: (channel, shape) of what it is shown, numbers [n] or [] and pictures [H, W, C]; mode: buttons, choice or axes; shape,
    low, high: of one action, limits for each number of it; hidden, layers: of the perceptron."""

    sees: tuple[tuple[str, tuple[int, ...]], ...]
    mode: str
    shape: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    hidden: int = 128
    layers: int = 2

    @staticmethod
    def of(spec: Spec, sees: tuple[str, ...], hidden: int = 128, layers: int = 2) -> ActorConfig:
        """For the actions of a world, seeing these channels of it. ChannelError for channels that are neither numbers nor
        pictures, ActionError for axes without limits."""
        spec.check_channels(sees)
        if not sees:
            raise ChannelError(f"a policy sees at least one channel; {spec.name} has {', '.join(spec.channels)}.")
        shapes = tuple((name, shape_of(spec.channels[name])) for name in sees)
        wrong = [name for name, shape in shapes if len(shape) not in (0, 1, 3)]
        if wrong:
            raise ChannelError(f"a policy sees numbers and pictures, and {', '.join(wrong)} is neither.")
        return ActorConfig(shapes, *_actions(spec), hidden, layers)

    @property
    def numbers(self) -> tuple[tuple[str, int], ...]:
        """(channel, width) of what comes as numbers."""
        return tuple((name, int(np.prod(shape))) for name, shape in self.sees if len(shape) < 2)

    @property
    def pictures(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        return tuple((name, shape) for name, shape in self.sees if len(shape) == 3)

    @property
    def width(self) -> int:
        return sum(width for _, width in self.numbers)

    @property
    def counts(self) -> tuple[int, ...]:
        """Of how many each choice is one."""
        return tuple(int(high - low) + 1 for low, high in zip(self.low, self.high))

    @property
    def outputs(self) -> int:
        """Numbers of which a distribution of actions is made."""
        return {CHOICE: sum(self.counts), BUTTONS: len(self.low), AXES: 2 * len(self.low)}[self.mode]

    def distribution(self, found: torch.Tensor) -> ActionDistribution:
        """The distribution that [N, outputs] stand for."""
        if self.mode == CHOICE:
            return Categorical(self.counts, found)
        return Bernoulli(found) if self.mode == BUTTONS else SquashedGaussian(found)

    def actions(self, drawn: torch.Tensor, spec: Spec) -> torch.Tensor:
        """Draws [N, D] as the world of `spec` takes them; of axes with gradients."""
        low, high = (torch.tensor(limit, dtype=torch.float32, device=drawn.device) for limit in (self.low, self.high))
        if self.mode == AXES:
            values = ((low + high) / 2 + (high - low) / 2 * torch.tanh(drawn)).clamp(low, high)
        else:
            values = drawn + low
        kind = torch.from_numpy(np.zeros(0, dtype_of(spec.action))).dtype
        return values.to(kind).reshape(-1, *self.shape)

    def check(self, spec: Spec) -> None:
        """ActionError or ChannelError where this is a policy for other actions, or one that sees what is not there."""
        if _actions(spec) != (self.mode, self.shape, self.low, self.high):
            raise ActionError(
                f"the policy gives actions of {self._told()}, and {spec.name} takes {spec.action}: it is one for other actions."
            )
        for name, shape in self.sees:
            if name not in spec.channels:
                raise ChannelError(
                    f"the policy sees '{name}', which {spec.name} does not show; it shows {', '.join(spec.channels)}."
                )
            if shape_of(spec.channels[name]) != shape:
                raise ChannelError(
                    f"the policy sees '{name}' of shape {shape}, and {spec.name} shows {shape_of(spec.channels[name])}."
                )

    def _told(self) -> str:
        if self.mode == CHOICE:
            return " and ".join(f"one of {count}" for count in self.counts)
        return f"{len(self.low)} {self.mode}" + (
            f" from {list(self.low)} to {list(self.high)}" if self.mode == AXES else ""
        )


def _actions(spec: Spec) -> tuple[str, tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
    low, high = (np.asarray(limit, np.float64) for limit in spec.action_limits)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ActionError(f"{spec.name} has axes without limits, {spec.action}; a learned policy needs limits.")
    mode = spec.action_mode if spec.action_mode in (BUTTONS, CHOICE) else AXES
    return mode, shape_of(spec.action), tuple(low.ravel().tolist()), tuple(high.ravel().tolist())


class ObservationEncoder(nn.Module):
    """Observations to features [N, width]: numbers in symlogs of deviations from their mean, pictures by strided
    convolutions. settle: tells it the mean and the deviation of the numbers."""

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
            away = (self.flat(seen) - self.mean) / self.scale
            parts.append(symlog(away).clamp(-FARTHEST, FARTHEST))
        for look, (name, _) in zip(self.looks, self.config.pictures):
            picture = seen[name].to(self.mean.device)
            unit = picture.float() / 255 if picture.dtype == torch.uint8 else picture.float()
            parts.append(look((unit - 0.5).permute(0, 3, 1, 2).contiguous()))
        return torch.cat(parts, 1)

    def flat(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """All numbers [N, width]."""
        found = [seen[name].to(self.mean.device).float().reshape(-1, width) for name, width in self.config.numbers]
        return torch.cat(found, 1)

    def fit_normalization(self, seen: Mapping[str, torch.Tensor]) -> None:
        """Mean and deviation of what was seen; of what never varies, the deviation is 1."""
        if self.config.numbers:
            flat = self.flat(seen).double()
            spread, mean = flat.std(0, correction=0), flat.mean(0)
            still = spread <= 1e-6 * mean.abs().clamp_min(1e-6)
            self.mean.copy_(mean)
            self.scale.copy_(torch.where(still, 1.0, spread))


class ActorNetwork(nn.Module):
    """Eyes, a perceptron, and what a distribution of actions is made of."""

    def __init__(self, config: ActorConfig):
        super().__init__()
        self.config, self.eyes = config, ObservationEncoder(config)
        self.think = mlp(self.eyes.width, config.hidden, config.layers, config.outputs, gain=0.01)

    def forward(self, seen: Mapping[str, torch.Tensor]) -> ActionDistribution:
        return self.config.distribution(self.think(self.eyes(seen)))


def mlp(into: int, hidden: int, layers: int, out: int, gain: float) -> nn.Sequential:
    """Layers with LayerNorm and SiLU; the last one's weights are small by `gain`."""
    parts: list[nn.Module] = []
    for layer in range(layers):
        parts += [nn.Linear(hidden if layer else into, hidden), nn.LayerNorm(hidden), nn.SiLU()]
    last = nn.Linear(hidden, out)
    with torch.no_grad():
        last.weight.mul_(gain)
        last.bias.zero_()
    return nn.Sequential(*parts, last)


def symlog(x: torch.Tensor) -> torch.Tensor:
    """Sign and logarithm: as it is where it is small (Webber 2012; DreamerV3)."""
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
    """The batch of an observation; TerrellaError where it is not what the policy sees."""
    lacks = [name for name, _ in config.sees if name not in seen]
    if lacks:
        raise ChannelError(f"the policy sees {', '.join(lacks)}, which the observation lacks.")
    for name, shape in config.sees:
        if tuple(seen[name].shape[1:]) != shape:
            raise ChannelError(f"the policy sees '{name}' of shape {shape}; got {tuple(seen[name].shape[1:])}.")
    batches = {len(seen[name]) for name, _ in config.sees}
    if len(batches) != 1:
        raise TerrellaError(f"the channels of an observation are of one batch; got batches of {sorted(batches)}.")
    return batches.pop()
