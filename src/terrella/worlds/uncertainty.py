"""Uncertainty: the error that a world expects of the frame that it has just drawn, learned from its own dreams.

Two things make a frame differ from the truth. The picture is invented: from the conditioning and the frame a network predicts the
error that it would have at the true place. And the position has drifted: with the way since the last evidence the error grows from
there to a ceiling, what two random pictures of the world differ by.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import nn

from ..core.backend import constant, derived, plus
from ..core.state import State
from ..space.camera import turn_between
from .generator import Conditioning
from .parts import Absent, Channels

# Of an episode: steps since the last picture, way and turns since the last pose, whether it began with a picture of an
# unknown place, and how strange that was (0..1).
GONE = ("steps", "metres", "radians", "lone", "strange")
SITUATION = len(GONE) - 1 + 2  # without the last, and with Conditioning.familiar
INPUT_MAPS = 15  # maps that `input_maps` gives
LONGEST = 128  # steps, metres and radians of a situation at most
CELLS = 4  # side in pixels of a cell of those maps; errors are predicted in cells of twice that
KNOTS = 17  # of the calibration


@dataclass(frozen=True)
class UncertaintyConfig:
    """Of the network."""

    situation: int = SITUATION  # numbers of the situation in which a frame was drawn
    channels: tuple[int, int] = (24, 40)  # of its maps


class Expected(NamedTuple):
    """Expected mean absolute errors of rgb, 0..1, [B] each: in all, and its two parts."""

    uncertainty: torch.Tensor
    drifted: torch.Tensor  # since the position has drifted
    invented: torch.Tensor  # since the picture is invented


@final
class UncertaintyNetwork(nn.Module):
    """The network, a monotone calibration of its answer (isotonic regression on held-out dreams), and how a position drifts."""

    kind = "network"
    sure: torch.Tensor  # the usual error where memory knows the place
    invents: torch.Tensor  # and where it does not
    ceiling: torch.Tensor  # what two random pictures differ by
    drift: torch.Tensor  # rates a step, metre and radian, and a power: see `drifts`

    def __init__(self, config: UncertaintyConfig):
        super().__init__()
        self.config = config
        first, second = config.channels
        self.enter = nn.Conv2d(INPUT_MAPS, first, 3, 2, 1)
        self.situate = nn.Sequential(nn.Linear(config.situation, 32), nn.SiLU(), nn.Linear(32, 2 * second))
        self.wide = nn.Conv2d(first, second, 3, 1, 1)
        self.wider = nn.Conv2d(second, second, 3, 1, 2, 2)
        self.output = nn.Conv2d(second, 1, 1)
        self.output.bias = nn.Parameter(torch.tensor([-3.0]))
        self.register_buffer("found", torch.linspace(0, 1, KNOTS))  # names in the weights' file
        self.register_buffer("meant", torch.linspace(0, 1, KNOTS))
        self.register_buffer("sure", torch.tensor(0.02))
        self.register_buffer("invents", torch.tensor(0.08))
        self.register_buffer("ceiling", torch.tensor(1.0))
        self.register_buffer("drift", torch.tensor([0.0, 0.0, 0.15, 0.6]))  # as in a maze

    @property
    def answers(self) -> torch.Tensor:
        """Knots of the calibration: KNOTS answers of the network, ascending."""
        return self.get_buffer("found")

    @property
    def errors(self) -> torch.Tensor:
        """The mean error at each of the `answers`."""
        return self.get_buffer("meant")

    def channels(self) -> Channels:
        unit = "expected mean absolute error of the picture, intensity 0..1"
        units = {"uncertainty": unit, "drifted": f"{unit}, by a position that has drifted"}
        units["invented"] = f"{unit}, by a picture that is invented"
        return Channels({name: spaces.Box(0, 1, (), np.float32) for name in units}, units)

    def forward(self, maps: torch.Tensor, situation: torch.Tensor) -> torch.Tensor:
        """maps [B, INPUT_MAPS, h, w]; situation [B, S]. Returns the expected error of each cell, 0..1: [B, h/2, w/2]."""
        gain, shift = self.situate(situation)[:, :, None, None].chunk(2, 1)
        x = F.silu(torch.addcmul(shift, self.wide(F.silu(self.enter(maps))), 1 + gain))
        x = F.silu(x + self.wider(x))
        return F.softplus(self.output(x)[:, 0]) + 1e-4

    def expected(self, conditioning: Conditioning, clean: torch.Tensor, gone: torch.Tensor) -> Expected:
        """The error of frames `clean` [B, 4, H, W] drawn from `conditioning`, `gone` [B, len(GONE)] since evidence. In an episode
        that began with a picture unlike the recordings it is at least that of invention."""
        cells = self(input_maps(conditioning, clean), situation_of(placed(gone), conditioning))
        invented = torch.maximum(self.calibrated(cells.mean((1, 2))), self.invents * gone[:, 4])
        invented = torch.minimum(invented, self.ceiling)
        both = torch.lerp(self.ceiling, invented, self._stays(gone))
        return Expected(both, both - invented, invented)

    def drifts(self, gone: torch.Tensor) -> torch.Tensor:
        """How much of the way to the ceiling the error of a frame is [B], by its steps, metres and radians since evidence."""
        return 1 - self._stays(gone)

    def _stays(self, gone: torch.Tensor) -> torch.Tensor:
        return torch.exp(-((gone[:, :3] @ self.drift[:3]).clamp_min(1e-9) ** self.drift[3]))

    def calibrated(self, answer: torch.Tensor) -> torch.Tensor:
        """Linear between the knots; in proportion beyond them, up to the ceiling."""
        answers, errors = self.answers, self.errors
        steps, rises = derived(_steps, answers), derived(torch.diff, errors)
        shares = ((answer[..., None] - answers[:-1]) / steps).clamp(0, 1)  # how far it is from each knot to the next
        inside = shares @ rises + errors[0]
        within = answer.clamp(answers[0], answers[-1]).clamp_min(1e-6)
        return torch.minimum(inside * (answer / within), self.ceiling)


def _steps(knots: torch.Tensor) -> torch.Tensor:
    return knots.diff().clamp_min(1e-6)


@final
class NoUncertainty(Absent):
    """Of a world that expects no error."""

    def expected(self, conditioning, clean, gone) -> Expected:
        return Expected(*torch.zeros_like(gone[:, :3]).unbind(1))


@final
class UncertaintyProbe(Absent):
    """In the place of an uncertainty: passes on its inputs, from which one is learned, and expects no error."""

    def __init__(self, note: Callable[[Conditioning, torch.Tensor, torch.Tensor], None]):
        self.note = note

    def __bool__(self) -> bool:
        return True

    def expected(self, conditioning, clean, gone) -> Expected:
        self.note(conditioning, clean, gone)
        return NoUncertainty().expected(conditioning, clean, gone)


def drift(before: State, after: State, led: bool) -> torch.Tensor:
    """`gone` [B, len(GONE)] of `after`, one step further from evidence than `before`. led: whether its pose was observed."""
    gone = before["gone"]
    if led:
        return torch.cat([gone[:, :1] + 1, torch.zeros_like(gone[:, 1:3]), gone[:, 3:]], 1)
    if "pose" not in after:
        return gone + constant(torch.tensor, gone.device, (1.0, 0.0, 0.0, 0.0, 0.0))
    here, then = after["pose"], before["pose"]
    metres = torch.linalg.vector_norm(here[:, :2] - then[:, :2], dim=-1, keepdim=True)
    one, nothing = (constant(torch.tensor, gone.device, row).expand(len(gone), -1) for row in ((1.0,), (0.0, 0.0)))
    return gone + torch.cat([one, metres, turn_between(here, then[:, None]), nothing], 1)


def placed(gone: torch.Tensor) -> torch.Tensor:
    """`gone` [B, len(GONE)] of a frame whose pose is right: neither metres nor radians from evidence."""
    return gone * constant(torch.tensor, gone.device, (1.0, 0.0, 0.0, 1.0, 1.0))


def situation_of(gone: torch.Tensor, conditioning: Conditioning) -> torch.Tensor:
    """The situation [B, SITUATION] that the network sees."""
    assert conditioning.familiar is not None
    return torch.cat([gone[:, :4].clamp_max(LONGEST).log1p(), conditioning.familiar], 1)


def input_maps(conditioning: Conditioning, clean: torch.Tensor) -> torch.Tensor:
    """Maps [B, INPUT_MAPS, H / CELLS, W / CELLS] of a drawn frame and its sources."""
    glimpse, last = conditioning.glimpse, conditioning.last
    drawn, merged = clean[:, :3].clamp(-1, 1), plus(-1.0, glimpse.merged, 2)
    trust = glimpse.trust[:, :2] if glimpse.trust.shape[1] > 1 else glimpse.trust.repeat(1, 2, 1, 1)
    second = glimpse.rgb[:, min(1, glimpse.rgb.shape[1] - 1)]
    apart = _sizes(glimpse.rgb[:, 0] - second) * (trust[:, 1:] > 0)
    edges = F.pad(_sizes(drawn.diff(dim=3)), (0, 1))
    own = _sizes(drawn - merged) * glimpse.known[:, None]
    maps = [drawn, merged, own, glimpse.known[:, None], trust, last[:, 3:4], apart, clean[:, 3:4], edges]
    soft = F.avg_pool2d(torch.cat(maps, 1), CELLS)
    here = soft[:, :3] - F.avg_pool2d(F.pad(soft[:, :3], (1, 1, 1, 1), mode="replicate"), 3, 1)
    mean = constant(_mean_of_colours, soft.device)  # of the maps of `_sizes`, which are sums
    return torch.cat([soft, _sizes(here)], 1) * mean


def _sizes(colours: torch.Tensor) -> torch.Tensor:
    """The sum of the absolute values of colours [B, 3, H, W]: [B, 1, H, W]."""
    return torch.linalg.vector_norm(colours, 1, dim=1, keepdim=True)


def _mean_of_colours() -> torch.Tensor:
    return torch.tensor([1 / 3 if row in (6, 11, 13, 14) else 1.0 for row in range(INPUT_MAPS)])[:, None, None]
