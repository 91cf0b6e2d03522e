"""The network of an imitating policy: pictures, numbers and an instruction over some steps, to a chunk of actions (ACT, Zhao et al.
2023): logits for choices and buttons, flow matching for axes (Lipman et al. 2023; pi0, Black et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import ChannelError
from ..core.spec import BUTTONS, CHOICE, Spec, is_picture, shape_of
from .actor_network import AXES, MAX_SYMLOG, ActorConfig, mlp, symlog
from .embodiment import EMBODIMENT, Embodiment, index_of
from .sentences import WordEncoder

TEXT = "text"
CODES = 32  # values of a code
CELLS = 4  # side of the pooled feature map of a picture
QUERIES = 4  # places of a picture to which an instruction attends, for each of its waypoints
SHARPNESS = 20.0  # of attention: factor on the cosines of queries and places; plain products never learned to tell colours apart
COARSE = 40  # pixels of the longer side, at most, of pictures in which displacements are looked for
REACH = (3, 8)  # of these pixels, down and across, by which a part may have moved since the picture before
SHIFTS = tuple((down, across) for down in range(2 * REACH[0] + 1) for across in range(2 * REACH[1] + 1))
CONTRAST = 0.1  # of how well displacements fit, as a share of the mean error
FLOW_STEPS = 8  # Euler steps from noise to a chunk


@dataclass(frozen=True)
class ImitationConfig:
    """The inputs, the actions and the size of an imitating policy."""

    actor: ActorConfig  # channels, actions and width; the actions of the body that has most numbers
    size: tuple[int, int] = (64, 64)  # height and width to which pictures are resized
    vocabulary: tuple[str, ...] = ()  # words of the instructions; () for a policy without
    history: int = 2  # observations that it sees, the last ones
    own_actions: bool = False  # whether it sees its last actions as well
    chunk: int = 1  # actions that it predicts at once
    execute: int = 1  # of these, actions that it takes before it predicts anew
    outcome: float | None = None  # the standardised return that it asks for; None: not conditioned on outcomes
    waypoint: int = 0  # steps after an instruction began for which it predicts its numbers, and at its end; 0: not
    differences: bool = False  # whether it sees changes of numbers and pictures since the observation before, too
    remember: int = (
        0  # steps of the windows on which it learns to carry a memory (a GRU); 0: it sees the last `history` ones
    )
    bodies: tuple[Embodiment, ...] = ()  # that it drives, of which it sees which one; (): one, of any name

    @property
    def sees(self) -> tuple[str, ...]:
        return (*(name for name, _ in self.actor.sees), *((TEXT,) if self.vocabulary else ()))

    @property
    def window(self) -> int:
        """Observations from which it acts: with a memory one."""
        return 1 if self.remember else self.history

    @property
    def waypoints(self) -> int:
        """Waypoints that it predicts, where it sees pictures, numbers and an instruction: after some steps, and at the end."""
        return 2 if self.waypoint else 0

    @property
    def action_width(self) -> int:
        """Numbers of an action as networks see it."""
        return sum(self.actor.counts) if self.actor.mode == CHOICE else len(self.actor.low)

    def check(self, spec: Spec) -> None:
        """ActionError or ChannelError if `spec` has other actions, or lacks a channel in this form. Pictures may have any size."""
        replace(self.actor_of(spec), sees=()).check(spec)
        for name, shape in self.actor.sees:
            spec.check_channels((name,))
            other = shape_of(spec.channels[name])
            if not is_picture(shape) and np.prod(other) != np.prod(shape):
                raise ChannelError(f"the policy sees '{name}' of shape {shape}, and {spec.name} shows {other}.")
        if self.vocabulary and TEXT not in spec.channels:
            raise ChannelError(f"the policy follows instructions, and {spec.name} gives none (no channel '{TEXT}').")

    def actor_of(self, spec: Spec) -> ActorConfig:
        """The actor with the actions of the body that `spec` drives; ActionError where that is none of several bodies."""
        if not self.bodies:
            return self.actor
        body = self.bodies[index_of(self.bodies, spec)]
        return replace(self.actor, shape=body.shape, low=body.low, high=body.high)

    def width_of(self, spec: Spec) -> int:
        """Of the numbers of an action as networks see it, those of the body that `spec` drives."""
        return self.action_width if self.actor.mode == CHOICE else len(self.actor_of(spec).low)

    def decode(self, encoded: torch.Tensor, spec: Spec) -> torch.Tensor:
        """Encoded actions [N, action_width] (choices one-hot, buttons 0 or 1, axes from -1 to 1) in the space of `spec`:
        [N, *action.shape]."""
        if self.actor.mode != CHOICE:
            actor = self.actor_of(spec)
            encoded = encoded[:, : len(actor.low)]
            if self.actor.mode == BUTTONS:
                return actor.actions(encoded, spec)
            return actor.actions(torch.atanh(encoded.clamp(-1 + 1e-6, 1 - 1e-6)), spec)
        parts = encoded.split(list(self.actor.counts), 1)
        return self.actor.actions(torch.stack([part.argmax(1) for part in parts], 1).float(), spec)


class _Look(nn.Module):
    """A picture or a grid of codes [N, H, W, C] to features [N, width], modulated by the instruction (FiLM, Perez et al. 2018). Of
    a picture also where each map is largest, and in columns of their own [N, 2 * queries] where the instruction's queries attend
    to, by cosines: x of each, then y. steps: of this many pictures, one after another, each is seen with its change from the one
    before (of codes with those before), so that convolutions see what moves; 0: alone."""

    offset: torch.Tensor

    def __init__(
        self, shape: tuple[int, ...], size: tuple[int, int], width: int, words: WordEncoder | None, steps: int = 0
    ):
        super().__init__()
        self.picture, self.size, self.steps = is_picture(shape), size, steps
        channels = shape[2] * (2 if steps else 1)
        if self.picture:
            last, cells = 48, CELLS**2 + 2
            self.moves = nn.Linear(len(SHIFTS) * CELLS**2, width) if steps else None
            self.first = nn.Sequential(
                nn.Conv2d(channels, 24, 4, 2, 1), nn.ReLU(), nn.Conv2d(24, last, 4, 2, 1), nn.ReLU()
            )
        else:
            self.codes = nn.Embedding(channels * CODES, 32)
            self.register_buffer("offset", torch.arange(channels) * CODES, persistent=False)
            self.first = nn.Sequential(nn.Conv2d(32, 32, 3, 1, 1), nn.ReLU())
            last, cells = 32, shape[0] * shape[1]
        self.film = nn.Linear(words.sentence, 2 * last) if words else None
        self.second = nn.Conv2d(last, last, 3, 1, 1)
        attends = words is not None and words.pick is not None and self.picture
        self.keys = nn.Conv2d(last, last, 1) if attends else None
        self.queries = nn.Linear(words.sentence, last) if attends else None  # one for all: a colour is learned once
        self.out = nn.Linear(last * cells, width)

    def forward(self, seen: torch.Tensor, words: torch.Tensor | None) -> torch.Tensor:
        if self.picture:
            unit = seen.permute(0, 3, 1, 2).float() / (255 if seen.dtype == torch.uint8 else 1) - 0.5
            unit = unit if unit.shape[2:] == self.size else F.interpolate(unit, self.size, mode="area")
            before = self._before(unit) if self.steps else unit
            features = self.first(torch.cat([unit, unit - before], 1) if self.steps else unit)
        else:
            codes = seen.long().clamp(0, CODES - 1)
            codes = (torch.cat([codes, self._before(codes)], 3) if self.steps else codes) + self.offset
            features = self.first(self.codes(codes).sum(3).permute(0, 3, 1, 2))
        plain = features
        if self.film is not None and words is not None:
            scale, shift = self.film(words[:, : self.film.in_features])[..., None, None].chunk(2, 1)
            features = torch.relu((1 + scale) * features + shift)
        features = torch.relu(self.second(features))
        if not self.picture:
            return torch.relu(self.out(features.flatten(1)))
        pooled = torch.cat([F.adaptive_avg_pool2d(features, CELLS).flatten(1), spatial_softmax(features)], 1)
        out = self.out(pooled)
        parts = [torch.relu(out if self.moves is None else out + self.moves(displacements(unit, before).flatten(1)))]
        if self.keys is not None and self.queries is not None and words is not None:
            picks = words.unflatten(1, (-1, self.queries.in_features))[:, 1:]
            queries = SHARPNESS * F.normalize(self.queries(picks), dim=2)
            keys = F.normalize(self.keys(plain), dim=1)
            parts.append(spatial_softmax(torch.einsum("nqc,nchw->nqhw", queries, keys)))
        return torch.cat(parts, 1)

    def _before(self, seen: torch.Tensor) -> torch.Tensor:
        """What was seen a step before each of [N * steps, ...]; before the first the first itself."""
        steps = seen.unflatten(0, (-1, self.steps))
        return torch.cat([steps[:, :1], steps[:, :-1]], 1).flatten(0, 1)


def displacements(after: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Where each of CELLS x CELLS parts of pictures [N, C, H, W] came from in those before: a softmax of how well each of SHIFTS
    fits, [N, SHIFTS, CELLS, CELLS] (a correlation layer, as in FlowNet, Dosovitskiy et al. 2015)."""
    coarse = -(-max(after.shape[2:]) // COARSE)
    pool = [min(coarse, side) for side in after.shape[2:]]
    grey, earlier = (F.avg_pool2d(one.mean(1, keepdim=True), pool) for one in (after, before))
    (height, width), (down, across) = grey.shape[2:], REACH
    earlier = F.pad(earlier, (across, across, down, down), mode="replicate")
    # One at a time, so that the processor's caches hold it.
    displaced = (earlier[..., y : y + height, x : x + width] for y, x in SHIFTS)
    errors = torch.cat([F.adaptive_avg_pool2d((grey - one).abs_(), CELLS) for one in displaced], 1)
    best, usual = errors.amin(1, keepdim=True), errors.mean(1, keepdim=True)
    return torch.softmax((best - errors) / (CONTRAST * usual + 1e-3), 1)


def spatial_softmax(features: torch.Tensor) -> torch.Tensor:
    """Where each map of [N, C, H, W] is largest, softly: x and y from -1 to 1, [N, 2C] (Levine et al. 2016)."""
    weights = features.flatten(2).softmax(2).view_as(features)
    y, x = (torch.linspace(-1, 1, side, device=features.device) for side in features.shape[2:])
    return torch.cat([(weights.sum(2) * x).sum(2), (weights.sum(3) * y).sum(2)], 1)


def _deviation(numbers: torch.Tensor) -> torch.Tensor:
    """The standard deviation [D] of numbers [N, D]; 1 where they never vary."""
    spread = numbers.std(0, correction=0)
    return torch.where(spread <= 1e-6, 1.0, spread)


class _Waypoint(nn.Module):
    """Places [N, places] to which an instruction attends, and its features [N, words], to numbers [N, width]."""

    def __init__(self, places: int, words: int, hidden: int, width: int):
        super().__init__()
        self.of_places = nn.Sequential(nn.Linear(places, hidden), nn.ReLU(), nn.Linear(hidden, width))
        self.offset = nn.Linear(words, width)

    def forward(self, places: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
        return self.of_places(places) + self.offset(words)


class ImitationNetwork(nn.Module):
    """`features` of each step's observation, and from those of the last steps the chunk of actions."""

    mean: torch.Tensor
    scale: torch.Tensor
    change: torch.Tensor

    def __init__(self, config: ImitationConfig):
        super().__init__()
        self.config, actor = config, config.actor
        pictures = sum(is_picture(shape) for _, shape in actor.sees)
        picks = QUERIES * max(1, config.waypoints) if pictures else 0
        self.words = WordEncoder(config.vocabulary, picks=picks) if config.vocabulary else None
        words = self.words.sentence if self.words else 0
        self._vectors = [(name, int(np.prod(shape))) for name, shape in actor.sees if len(shape) < 2]
        self._arrays = [(name, shape) for name, shape in actor.sees if len(shape) == 3]
        width = sum(count for _, count in self._vectors)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))
        changes = 0
        if config.differences:
            self.register_buffer("change", torch.ones(width))
            changes = (config.window - 1) * width
        steps = config.window if config.differences else 0
        self.looks = nn.ModuleList(
            _Look(shape, config.size, actor.hidden, self.words, steps) for _, shape in self._arrays
        )
        self.attended = 2 * picks * pictures if words else 0
        self.width = width + len(config.bodies) + actor.hidden * len(self.looks) + self.attended
        foresees = config.waypoints if width and self.attended else 0
        self.waypoints = nn.ModuleList(
            _Waypoint(2 * QUERIES * pictures, words, actor.hidden, width) for _ in range(foresees)
        )
        self.memory = nn.GRU(self.width, actor.hidden, batch_first=True) if config.remember else None
        acted = config.window * config.action_width if config.own_actions else 0
        seen = config.window * self.width + (actor.hidden if self.memory else 0) + changes
        into = seen + acted + words + (config.outcome is not None) + foresees * width
        flow = actor.mode == AXES
        chunk = config.chunk * (config.action_width if flow else actor.outputs)
        self.trunk = mlp(into, actor.hidden, actor.layers, actor.hidden if flow else chunk, gain=1.0 if flow else 0.1)
        self.velocity = mlp(actor.hidden + chunk + 1, 2 * actor.hidden, 2, chunk, gain=0.1) if flow else None

    def features(self, seen: Mapping[str, torch.Tensor], words: torch.Tensor | None) -> torch.Tensor:
        """[N, width] of observations of N steps; words: the instruction as features [N, words]."""
        device, parts = self.mean.device, []
        if self._vectors:
            parts.append(self.numbers(seen))
        if self.config.bodies:
            parts.append(seen[EMBODIMENT].to(device))
        looks = [look(seen[name].to(device), words) for look, (name, _) in zip(self.looks, self._arrays)]
        hidden = self.config.actor.hidden
        return torch.cat([*parts, *(look[:, :hidden] for look in looks), *(look[:, hidden:] for look in looks)], 1)

    def foreseen(self, history: torch.Tensor, words: torch.Tensor | None) -> torch.Tensor | None:
        """The numbers [N, waypoints, D], normalised, that it expects `waypoint` steps after an instruction began and at its end,
        from features [N, window, width]; None where it predicts none. Of the pictures each knows nothing but the places to which
        its own queries attend, so these must be of what is named; the words alone only shift them."""
        if not self.waypoints or words is None:
            return None
        attended = history[:, -1, self.width - self.attended : self.width]
        # Of each picture x and y, of these each waypoint's own queries.
        places = attended.view(len(history), -1, len(self.waypoints), QUERIES)
        sentence = words[:, : self.words.sentence] if self.words is not None else words
        return torch.stack([one(places[:, :, at].flatten(1), sentence) for at, one in enumerate(self.waypoints)], 1)

    def numbers(self, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """The channels of numbers [N, ...], normalised: [N, D]."""
        device = self.mean.device
        flat = torch.cat([seen[name].to(device).float().reshape(-1, count) for name, count in self._vectors], 1)
        return symlog((flat - self.mean) / self.scale).clamp(-MAX_SYMLOG, MAX_SYMLOG)

    @property
    def recalled_width(self) -> int:
        """Features of an observation, and what is remembered beside them."""
        return self.width + (self.config.actor.hidden if self.memory else 0)

    def recall(self, features: torch.Tensor, memory: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Features [N, T, width] with what is remembered beside them [N, T, width + hidden], and the memory after them [N, hidden];
        the features alone for a policy without memory. memory: that before them; None at the start of an episode."""
        if self.memory is None:
            return features, features[:, -1, :0]
        recalled, last = self.memory(features, None if memory is None else memory[None])
        return torch.cat([features, recalled], 2), last[0]

    def fit_normalization(self, seen: Mapping[str, torch.Tensor]) -> None:
        """Takes mean and deviation from observations [N * history, ...]; those that never vary keep 1."""
        if self._vectors:
            flat = torch.cat([seen[name].double().reshape(-1, count) for name, count in self._vectors], 1)
            self.mean.copy_(flat.mean(0))
            self.scale.copy_(_deviation(flat))
            if self.config.differences:
                changes = self.numbers(seen).view(-1, self.config.window, len(self.mean)).diff(dim=1)
                self.change.copy_(_deviation(changes.flatten(0, 1)))

    def forward(
        self,
        history: torch.Tensor,
        acted: torch.Tensor,
        words: torch.Tensor | None,
        outcome: torch.Tensor | None,
        waypoints: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """From features [N, window, width], own actions [N, window, A], the instruction's features, the return that is asked for
        [N] and the waypoints [N, waypoints, D] that were expected where the instruction began: logits [N, chunk * outputs], or for
        axes the condition [N, hidden] of the flow."""
        parts = [history.flatten(1)]
        if self.config.differences:
            parts.append((history[..., : len(self.mean)].diff(dim=1) / self.change).flatten(1))
        parts += [acted.flatten(1)] if self.config.own_actions else []
        parts += [words[:, : self.words.sentence]] if words is not None and self.words is not None else []
        parts += [waypoints.flatten(1)] if self.waypoints and waypoints is not None else []
        parts += [outcome[:, None]] if self.config.outcome is not None and outcome is not None else []
        return self.trunk(torch.cat(parts, 1))

    def flow(self, noisy: torch.Tensor, time: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """The velocity [N, chunk * A] of chunks at flow times [N], 0 noise and 1 data."""
        assert self.velocity is not None
        return self.velocity(torch.cat([condition, noisy, time[:, None]], 1))

    def chunk(self, out: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The most likely chunk [N, chunk, A] of encoded actions from `forward`; of axes the one to which noise [N, chunk * A]
        flows."""
        if self.config.actor.mode == AXES:
            return self.chunk_of(self.draw(out, noise, None))
        return self._likeliest(out.view(len(out) * self.config.chunk, -1)).view(len(out), self.config.chunk, -1)

    def draw(self, out: torch.Tensor, noise: torch.Tensor, more: torch.Tensor | None) -> torch.Tensor:
        """A chunk drawn by normal noise [N, chunk * A]. Choices and buttons: encoded, [N, chunk, A]. Axes: all points
        [N, FLOW_STEPS + 1, chunk * A] of the flow from the noise, with normal noise `more` [N, FLOW_STEPS, chunk * A], if any,
        shared out over its steps (a stochastic differential equation, as in Flow-GRPO, Liu et al. 2025)."""
        config, count = self.config, len(out)
        if config.actor.mode == AXES:
            path = [noise]
            for step in range(FLOW_STEPS):
                time = torch.full((count,), step / FLOW_STEPS, device=out.device)
                after = path[-1] + self.flow(path[-1], time, out) / FLOW_STEPS
                path.append(after if more is None else after + more[:, step] / FLOW_STEPS**0.5)
            return torch.stack(path, 1)
        logits = out.view(count * config.chunk, -1)
        uniform = torch.special.ndtr(noise).clamp(1e-6, 1 - 1e-6).view_as(logits)
        if config.actor.mode == BUTTONS:
            return (uniform < logits.sigmoid()).float().view(count, config.chunk, -1)
        return self._likeliest(logits - (-uniform.log()).log()).view(count, config.chunk, -1)

    def chunk_of(self, drawn: torch.Tensor) -> torch.Tensor:
        """The encoded chunk [N, chunk, A] of what `draw` gives."""
        if self.config.actor.mode != AXES:
            return drawn
        return drawn[:, -1].view(len(drawn), self.config.chunk, -1).clamp(-1, 1)

    def _likeliest(self, logits: torch.Tensor) -> torch.Tensor:
        """The encoded choices or buttons [N, A] of the highest logits [N, A]."""
        if self.config.actor.mode == BUTTONS:
            return (logits > 0).float()
        parts = [F.one_hot(part.argmax(1), part.shape[1]) for part in logits.split(list(self.config.actor.counts), 1)]
        return torch.cat(parts, 1).float()
