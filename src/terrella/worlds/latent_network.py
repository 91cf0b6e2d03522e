"""The networks of a latent world: encoder, predictor, heads and, for people, a decoder (LeWorldModel, Maes et al. 2026)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import nn

from ..core.spec import kind_of

KNOTS = 17  # of the map from the spread of the ensemble to the error to expect
FARTHEST = 8.0  # standard deviations to which latents and inputs are clamped
COARSE = 16  # side in pixels of a cell of the encoder's last map
NEVER = -30.0  # the logit of an end


@dataclass(frozen=True)
class LatentConfig:
    """Of the networks of a latent world."""

    actions: int  # numbers of an encoded action
    rewards: tuple[float, ...] = (0.0, 1.0)  # values of the two-hot code of rewards, ascending
    vectors: tuple[tuple[str, int], ...] = ()  # name and width of the channels of numbers, which are all predicted
    size: tuple[int, int] | None = None  # height and width of pictures, multiples of 16; None without pictures
    sees_pictures: bool = True  # whether pictures are evidence
    sees_vectors: bool = True  # whether vectors are evidence
    latent: int = 32  # width of the latent
    history: int = 3  # last latents and actions that the predictor sees
    hidden: int = 192  # width of its layers
    members: int = 3  # predictors of the ensemble
    leap: int = 0  # steps of a leap, 0 without
    identity: bool = False  # the latent is the scaled vectors, all of which are evidence; there is no encoder
    frames: int = 1  # last pictures that a latent is made of
    glance: int = 64  # width of what is kept of a picture for the latents after it
    ends: bool = True  # whether an episode that it learned from ended; if none did, none ends in a rollout

    @property
    def width(self) -> int:
        """Numbers of all vectors together."""
        return sum(width for _, width in self.vectors)

    @property
    def seen(self) -> tuple[str, ...]:
        """The vectors that are evidence: all but poses, which robots seldom measure."""
        return tuple(name for name, _ in self.vectors if kind_of(name) != "pose") if self.sees_vectors else ()

    @property
    def columns(self) -> list[int]:
        """Columns of the vectors that are evidence."""
        names = [name for name, width in self.vectors for _ in range(width)]
        return [column for column, name in enumerate(names) if name in self.seen]

    @property
    def pictured(self) -> bool:
        """Whether pictures are evidence."""
        return self.size is not None and self.sees_pictures


class Outcomes(NamedTuple):
    """Logits [B, len(rewards)] of the reward and [B] of the end."""

    reward: torch.Tensor
    done: torch.Tensor


class Looks(NamedTuple):
    """Features of the last pictures at N moments."""

    newest: torch.Tensor  # [N, hidden]
    past: torch.Tensor  # [N, frames - 1, glance], of those before it, the newest first
    known: torch.Tensor  # [N, frames - 1], 0 where there is none


class LatentEncoder(nn.Module):
    """The last pictures and numbers to a latent; its projector ends in BatchNorm and one linear layer, as SIGReg asks for. Of the
    pictures before the newest it sees by how much they differ from it, each number by its own deviation: velocities are there."""

    def __init__(self, config: LatentConfig):
        super().__init__()
        hidden, width = config.hidden, 0
        if config.pictured:
            assert config.size is not None
            cells = (config.size[0] // COARSE) * (config.size[1] // COARSE)
            widths = (3, 16, 32, 64, 96)
            layers = [part for a, b in zip(widths, widths[1:]) for part in (nn.Conv2d(a, b, 4, 2, 1), nn.SiLU())]
            self.look = nn.Sequential(*layers, nn.Flatten(), nn.Linear(widths[-1] * cells, hidden), nn.SiLU())
            width += hidden
            if config.frames > 1:
                past = (config.frames - 1) * config.glance
                self.glance, self.change = nn.Linear(hidden, config.glance), nn.BatchNorm1d(past, affine=False)
                width += past + config.frames - 1
        if config.columns:
            first = nn.Linear(len(config.columns) + 1, hidden)
            self.sense = nn.Sequential(first, nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU())
            width += hidden
        layers = nn.Linear(width, hidden), nn.BatchNorm1d(hidden), nn.SiLU(), nn.Linear(hidden, config.latent)
        self.project = nn.Sequential(*layers)

    def forward(self, looks: Looks | None, numbers: torch.Tensor | None, known: torch.Tensor | None):
        """looks of N moments; numbers [N, S], scaled; known [N]: 0 where the numbers are not. Returns [N, D]."""
        parts = []
        if looks is not None:
            parts.append(looks.newest)
            if looks.past.shape[1]:
                change = self.change((self.glance(looks.newest)[:, None] - looks.past).flatten(1))
                parts += [(change.view_as(looks.past) * looks.known[..., None]).flatten(1), looks.known]
        if numbers is not None:
            known = numbers.new_ones(len(numbers)) if known is None else known.float()
            parts.append(self.sense(torch.cat([numbers * known[:, None], known[:, None]], 1)))
        return self.project(torch.cat(parts, 1))


class Ensemble(nn.Module):
    """Residual perceptrons with one input, computed at once; `slowly` computes the same one by one."""

    def __init__(self, members: int, into: int, hidden: int, out: int):
        super().__init__()

        def uniform(*shape: int, fan: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(*shape).uniform_(-1, 1) * fan**-0.5)

        self.enter, self.entered = uniform(members, into, hidden, fan=into), uniform(members, 1, hidden, fan=into)
        self.inner, self.bias = uniform(members, hidden, hidden, fan=hidden), uniform(members, 1, hidden, fan=hidden)
        self.leave = nn.Parameter(0.1 * uniform(members, hidden, out, fan=hidden).data)  # begins near copy-last
        self.left = nn.Parameter(torch.zeros(members, 1, out))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """x [B, into]. Returns [members, B, out]."""
        members, into, hidden = self.enter.shape
        flat = x @ self.enter.transpose(0, 1).reshape(into, members * hidden)
        first = F.silu(_normed(flat.view(-1, members, hidden).transpose(0, 1) + self.entered))
        second = first + F.silu(_normed(torch.baddbmm(self.bias, first, self.inner)))
        return torch.baddbmm(self.left, second, self.leave)

    def slowly(self, x: torch.Tensor) -> torch.Tensor:
        """The same, one member after the other."""
        outputs = []
        for one in range(len(self.enter)):
            first = F.silu(_normed(x @ self.enter[one] + self.entered[one]))
            second = first + F.silu(_normed(first @ self.inner[one] + self.bias[one]))
            outputs.append(second @ self.leave[one] + self.left[one])
        return torch.stack(outputs)


def _normed(x: torch.Tensor) -> torch.Tensor:
    return F.layer_norm(x, x.shape[-1:])


class Decoder(nn.Module):
    """A latent as a picture: for people, and in training so that latents of pictures hold what one sees. Most of its layers are at
    low resolution (sub-pixel convolution, Shi et al. 2016)."""

    def __init__(self, latent: int, size: tuple[int, int]):
        super().__init__()
        self.cells, widths = (size[0] // COARSE, size[1] // COARSE), (64, 32, 24, 12)
        self.enter = nn.Linear(latent, widths[0] * self.cells[0] * self.cells[1])
        self.layers = nn.ModuleList(nn.Conv2d(a, 4 * b, 3, 1, 1) for a, b in zip(widths, widths[1:]))
        self.output = nn.Conv2d(widths[-1], 12, 3, 1, 1)

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """latent [N, D]. Returns [N, 3, H, W], about 0 to 1."""
        x = F.silu(self.enter(latent)).view(len(latent), -1, *self.cells)
        for layer in self.layers:
            x = F.silu(F.pixel_shuffle(layer(x), 2))
        return 0.5 + F.pixel_shuffle(self.output(x), 2)


class LatentNetwork(nn.Module):
    """All networks of a latent world. A window [B, K, D] holds the last latents, the newest last."""

    mean: torch.Tensor  # [width] of the vectors
    scale: torch.Tensor  # [width], their standard deviation
    rewards: torch.Tensor
    spread: torch.Tensor  # KNOTS summed variances of the ensemble, ascending from 0
    error: torch.Tensor  # the usual error at each
    unit: torch.Tensor  # [latent], the usual change in a step, where the latent is the vectors; else 1

    kind = "joint-embedding"

    def __init__(self, config: LatentConfig):
        super().__init__()
        self.config = config
        latent, hidden, window = config.latent, config.hidden, config.history * config.latent
        self.encoder: Any = nn.Identity() if config.identity else LatentEncoder(config)
        self.predictor = Ensemble(config.members, window + config.history * config.actions, hidden, latent)
        self.heads = nn.ModuleDict(
            {
                "numbers": _perceptron(window, hidden, config.width)
                if config.width and not config.identity
                else nn.Identity(),
                "outcome": _perceptron(window + config.actions + latent, hidden // 2, len(config.rewards) + 1),
                "inverse": _perceptron(window + latent, hidden // 2, config.actions),
            }
        )
        self.decoder = Decoder(latent, config.size) if config.size else nn.Identity()
        acted = (config.history - 1 + config.leap) * config.actions
        self.leaper = Ensemble(1, window + acted, hidden, window) if config.leap else nn.Identity()
        self.register_buffer("mean", torch.zeros(config.width))
        self.register_buffer("scale", torch.ones(config.width))
        self.register_buffer("rewards", torch.tensor(config.rewards), persistent=False)
        self.register_buffer("spread", torch.linspace(0, 1, KNOTS))
        self.register_buffer("error", torch.linspace(0, 1, KNOTS))
        self.register_buffer("unit", torch.ones(latent), persistent=config.identity)

    def scaled(self, numbers: torch.Tensor) -> torch.Tensor:
        """Numbers [..., width] in standard deviations from their mean."""
        return ((numbers - self.mean) / self.scale).clamp(-FARTHEST, FARTHEST)

    def look(self, rgb: torch.Tensor) -> torch.Tensor:
        """Features [N, hidden] of pictures, uint8 [N, 3, H, W]."""
        return self.encoder.look((rgb.float() / 127.5 - 1).contiguous(memory_format=torch.channels_last))

    def glance(self, look: torch.Tensor) -> torch.Tensor:
        """What is kept [N, glance] of a picture's features for the latents after it."""
        return self.encoder.glance(look) if self.config.frames > 1 else look[:, :0]

    def encode(
        self, looks: Looks | None, numbers: torch.Tensor | None, known: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Evidence to latents [N, D]: looks, where pictures are evidence; numbers [N, width] as recorded, of all vectors; known
        [N]: whether they are known, which beside a picture they need not be."""
        seen = None
        if self.config.columns:
            if numbers is None:
                assert looks is not None
                numbers, known = self.mean.expand(len(looks.newest), -1), looks.newest.new_zeros(len(looks.newest))
            seen = self.scaled(numbers)[:, self.config.columns]
            if self.config.identity:
                return seen
        return self.encoder(looks, seen, known)

    def predict(self, window: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """The next latent of each member [members, B, D], after actions [B, K, A], the newest last."""
        latents = window[:, -1] + self.unit * self.predictor(torch.cat([window.flatten(1), actions.flatten(1)], 1))
        return latents.clamp(-FARTHEST, FARTHEST)

    def leap(self, window: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """The window [B, K, D] after `config.leap` steps, under actions [B, K - 1 + leap, A], the newest last."""
        change = self.leaper(torch.cat([window.flatten(1), actions.flatten(1)], 1))[0].view_as(window)
        return (window[:, -1:] + self.unit * change).clamp(-FARTHEST, FARTHEST)

    def numbers(self, window: torch.Tensor) -> torch.Tensor:
        """The scaled vectors [B, width] of a window."""
        return window[:, -1] if self.config.identity else self.heads["numbers"](window.flatten(1))

    def outcome(self, window: torch.Tensor, action: torch.Tensor, after: torch.Tensor) -> Outcomes:
        """Of a step from `window` by `action` [B, A] to the latent `after` [B, D]."""
        logits = self.heads["outcome"](torch.cat([window.flatten(1), action, after], 1))
        done = logits[:, -1] if self.config.ends else torch.full_like(logits[:, -1], NEVER)
        return Outcomes(logits[:, :-1], done)

    def expected_reward(self, logits: torch.Tensor) -> torch.Tensor:
        """The reward expected [B]."""
        return (logits.softmax(1) * self.rewards).sum(1)

    def inverse(self, window: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """The action [B, A] that led from `window` to the latent `after` [B, D]: logits, or axes from -1 to 1."""
        return self.heads["inverse"](torch.cat([window.flatten(1), after], 1))

    def decode(self, latent: torch.Tensor) -> torch.Tensor:
        """Pictures uint8 [B, H, W, 3] of latents [B, D]."""
        return (self.decoder(latent) * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)

    def expected(self, spread: torch.Tensor) -> torch.Tensor:
        """The usual error [B] at this spread [B] of the ensemble: linear between the knots, beyond the last in proportion to it, at
        most 1."""
        at = torch.searchsorted(self.spread, spread.contiguous()).clamp(1, KNOTS - 1)
        low, high = self.spread[at - 1], self.spread[at]
        share = ((spread - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
        beyond = (spread / self.spread[-1].clamp_min(1e-12)).clamp_min(1)
        return (torch.lerp(self.error[at - 1], self.error[at], share) * beyond).clamp_max(1)


def _perceptron(into: int, hidden: int, out: int) -> nn.Sequential:
    first, second = (nn.Linear(into, hidden), nn.SiLU()), (nn.Linear(hidden, hidden), nn.SiLU())
    return nn.Sequential(*first, *second, nn.Linear(hidden, out))
