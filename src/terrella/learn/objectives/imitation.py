"""Behaviour cloning of chunks of actions (ACT, Zhao et al. 2023): cross-entropy for choices and buttons, flow matching for axes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ...act.imitation_network import AXES, ImitationNetwork
from ...core.spec import BUTTONS
from ..learners import adamw, warmup_cosine
from ..train_step import TrainStep
from ..trainer import Loss

FORGOTTEN = (
    0.5  # probability that the own actions are hidden, so that the policy is no copy of them (de Haan et al. 2019)
)
FULL = nullcontext()
DRAWS = 8  # of noise and flow time for each moment: a look at pictures costs far more than the flow
SHIFT = 1  # pixels by which pictures are moved at most, as in DrQ (Kostrikov et al. 2020)


@dataclass(frozen=True)
class Demonstrations:
    """N moments of demonstrations; for a policy that remembers all moments of N windows, one window after the other."""

    seen: Mapping[str, torch.Tensor]  # channel -> [N * history, ...], the oldest step of each moment first
    acted: torch.Tensor  # [N, history, A], the encoded actions before the moment
    chunk: torch.Tensor  # [N, chunk, A], the encoded actions from the moment on
    weight: torch.Tensor  # float32 [N, chunk] of each action in the loss, 0 beyond the episode
    words: torch.Tensor | None = None  # [N, WORDS], the instruction
    outcome: torch.Tensor | None = None  # [N], the standardised return of the episode
    windows: torch.Tensor | None = None  # int64 [windows, T]: the row of `seen` of each moment; `words` are of windows
    requested: torch.Tensor | None = None  # int64 [windows]: the moments that were asked for; None: all
    waypoints: tuple[Mapping[str, torch.Tensor], ...] = ()
    """Numbers [N, ...] some steps after the instruction of the moment began, and at its end."""
    begins: torch.Tensor | None = None  # float32 [N]: 1 where an instruction begins at the moment

    @staticmethod
    def joined(parts: Sequence[Demonstrations]) -> Demonstrations:
        """The moments of several, one after another; not for windows or outcomes."""

        def cat(name: str) -> torch.Tensor | None:
            values = [getattr(part, name) for part in parts]
            return None if values[0] is None else torch.cat(values)

        def seen(each: Sequence[Mapping[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
            return {name: torch.cat([one[name] for one in each]) for name in each[0]}

        alike = {name: cat(name) for name in ("acted", "chunk", "weight", "words", "begins")}
        waypoints = tuple(seen(each) for each in zip(*(part.waypoints for part in parts)))
        return Demonstrations(seen=seen([part.seen for part in parts]), waypoints=waypoints, **alike)  # pyright: ignore[reportArgumentType]


class BehaviourCloning:
    """The chunk that the teacher took, from what it saw."""

    def __init__(self, network: ImitationNetwork, learning_rate: float, name: str = "imitation"):
        self.network, self.name = network, name
        self.modules = {"network": network}
        self.learners = {name: adamw((network,), warmup_cosine(learning_rate, 100, 0.02), decay=1e-3)}

    def losses(self, batch: Demonstrations, now: TrainStep) -> Iterator[Loss]:
        network, config, count = self.network, self.network.config, len(batch.chunk)
        hidden = torch.from_numpy(now.rng.random(count) < FORGOTTEN).to(batch.acted.device)
        half = now.half() if any(look.picture for look in network.looks) else FULL
        history, words = moments(network, batch, _shift(now), half)
        foreseen, missed, waypoints = network.foreseen(history, words), (), None
        if foreseen is not None:
            truth = torch.stack([network.numbers(numbers) for numbers in batch.waypoints], 1)
            missed, waypoints = waypoint_errors(foreseen - truth, truth, batch, now)
        acted = torch.where(hidden[:, None, None], 0.0, batch.acted)
        out = network(history, acted, words, batch.outcome, waypoints)
        if config.actor.mode == AXES:
            data, out = batch.chunk.flatten(1).repeat(DRAWS, 1), out.repeat(DRAWS, 1)
            time, noise = now.rand(len(data)), now.randn(*data.shape)
            noisy = torch.lerp(noise, data, time[:, None])
            errors = (network.flow(noisy, time, out) - (data - noise)).square()
            error = errors.view(DRAWS, *batch.chunk.shape).mean((0, 3))
        else:
            error = chunk_errors(network, out, batch.chunk)
        loss = (error * batch.weight).sum() / batch.weight.sum().clamp_min(1e-6)
        facts = {self.name: loss, **dict(zip(("waypoint", "end"), missed))}
        yield Loss(self.name, sum(facts.values(), loss * 0), facts)


def waypoint_errors(
    difference: torch.Tensor, truth: torch.Tensor, batch: Demonstrations, now: TrainStep
) -> tuple[torch.Tensor, torch.Tensor]:
    """The squared error [waypoints] of waypoints at moments at which an instruction begins, from their differences to the true ones
    [N, waypoints, D], normalised; later the place of the hand alone tells where it goes. And the waypoints [N, waypoints, D] that
    the actions are given: true ones with errors drawn from these, for acting keeps those of the beginning."""
    assert batch.begins is not None
    squares = difference.square().mean(2) * batch.begins[:, None]
    made = batch.begins.nonzero()[:, 0]
    drawn = made[torch.from_numpy(now.rng.integers(0, len(made), len(truth)))] if len(made) else None
    waypoints = truth if drawn is None else truth + difference[drawn].detach()
    return squares.sum(0) / max(1, len(made)), waypoints


def condition(
    network: ImitationNetwork, batch: Demonstrations, acted: torch.Tensor, beginnings: Demonstrations | None = None
) -> torch.Tensor:
    """What the network makes of moments: logits, or the condition of the flow. beginnings: the moments at which their instructions
    began, for a network with waypoints."""
    history, words = moments(network, batch)
    waypoints = None if beginnings is None else network.foreseen(*moments(network, beginnings))
    return network(history, acted, words, batch.outcome, waypoints)


def moments(
    network: ImitationNetwork,
    batch: Demonstrations,
    shift: tuple[int, int] = (0, 0),
    half: AbstractContextManager[object] = FULL,
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The features [N, window, width] of moments, with what is remembered, and those of their instructions [N, words]. half: in
    which it looks at pictures."""
    count, history = len(batch.chunk), network.config.history
    words = None if network.words is None or batch.words is None else network.words(batch.words)
    seen = {name: _moved(value, shift) for name, value in batch.seen.items()} if any(shift) else batch.seen
    if batch.windows is None:
        with half:
            features = network.features(seen, None if words is None else words.repeat_interleave(history, 0)).float()
        return features.view(count, history, -1), words
    with half:
        features = window_features(network, seen, words, batch.windows).float()
    recalled = network.recall(features, None)[0].flatten(0, 1)[:, None]
    every = None if words is None else words.repeat_interleave(batch.windows.shape[1], 0)
    return recalled, every


def window_features(
    network: ImitationNetwork, seen: Mapping[str, torch.Tensor], words: torch.Tensor | None, windows: torch.Tensor
) -> torch.Tensor:
    """The features [N, T, width] of windows [N, T] of the rows of `seen`, each of which belongs to windows of one instruction
    [N, words]."""
    of_row = torch.zeros(int(windows.max()) + 1, dtype=torch.int64, device=windows.device)
    of_row[windows] = torch.arange(len(windows), device=windows.device)[:, None].expand_as(windows)
    return network.features(seen, None if words is None else words[of_row])[windows]


def chunk_errors(network: ImitationNetwork, logits: torch.Tensor, chunk: torch.Tensor) -> torch.Tensor:
    """The negative log-likelihood [N, chunk] of encoded chunks of choices or buttons."""
    actor, shape = network.config.actor, chunk.shape
    flat, truth = logits.view(shape[0] * shape[1], -1), chunk.flatten(0, 1)
    if actor.mode == BUTTONS:
        return F.binary_cross_entropy_with_logits(flat, truth, reduction="none").sum(1).view(shape[:2])
    parts = zip(flat.split(list(actor.counts), 1), truth.split(list(actor.counts), 1))
    return sum((F.cross_entropy(a, b.argmax(1), reduction="none") for a, b in parts), flat[:, 0] * 0).view(shape[:2])


def _shift(now: TrainStep) -> tuple[int, int]:
    down, across = now.rng.integers(-SHIFT, SHIFT + 1, 2).tolist()
    return down, across


def _moved(value: torch.Tensor, shift: tuple[int, int]) -> torch.Tensor:
    """Pictures [N, H, W, C] moved by pixels, with their edges repeated; other values as they are."""
    if value.ndim != 4 or min(value.shape[1:3]) < 8 * SHIFT:
        return value
    rows, columns = (
        (torch.arange(side, device=value.device) + by).clamp(0, side - 1) for side, by in zip(value.shape[1:3], shift)
    )
    return value[:, rows][:, :, columns]
