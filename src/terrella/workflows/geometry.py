"""`bench geometry`: the geometry of a latent world, and the trust horizon that follows from it, beside the measured one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..core.errors import DatasetError, TerrellaError
from ..core.numbers import check_seed
from ..core.spec import chance_error, measured_trust
from ..core.state import State
from ..core.world import World, make_rng, without_end
from ..data import split
from ..measure.clips import Clip, clips_from_cache, evidence
from ..measure.geometry import (
    Step,
    distance_to_data,
    effective_rank,
    intrinsic_dimension,
    jacobians,
    lyapunov_exponents,
    parting,
)
from ..measure.rollouts import actions_at, fold_context
from ..measure.statistics import Figure, mean_interval
from ..measure.trust import errors_of, trust_figures
from ..worlds.latent import LatentWorld
from .opening import Device, load_named
from .progress import Progress, silent
from .results import jsonable, table_lines
from .score import open_cache

CONTEXT, KNOWN, ROWS = 4, 200, 8  # rows that are observed first; clips of the data, and rows of each
EXPONENTS, PLACES = 4, 8  # of Lyapunov; steps of a rollout at which derivatives are taken
LEAST, FEWEST = 20, 4  # clips of the data and rollouts, at least


@dataclass(frozen=True)
class GeometryConfig:
    """Settings of `bench geometry`."""

    data: Path  # A recording of the domain. Rollouts begin in the episodes held out of training.
    rollouts: int = 24  # Rollouts of the world.
    steps: int = 64  # Steps of a rollout. The horizon can be found within them alone.
    fresh: bool = False  # Use every episode for rollouts: for a recording that training never used.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class Geometry:
    """The geometry of a latent world."""

    world: str
    steps: int
    width: int  # numbers of a latent
    dimension: Figure  # intrinsic, of recorded latents
    dreamt_dimension: Figure  # of those that the world predicts
    exponents: tuple[Figure, ...]  # local Lyapunov exponents, the largest first, 1/s
    rank: Figure  # effective rank of the derivatives of a step
    turning: Figure  # how much they change from step to step, as a share of their size
    distance: dict[int, Figure]  # step -> distance of predicted latents to the data, in that of neighbours
    horizons: dict[str, tuple[Figure, str]]  # steps of trust: how -> (figure, note)

    def to_json(self) -> dict[str, Any]:
        return jsonable(asdict(self))

    def summary(self) -> str:
        last = max(self.distance)
        verdict = f"{self.world}: data fill {_short(self.dimension)} of {self.width} dimensions"
        fastest = self.exponents[0].value
        parts = "nearby rollouts stay together" if fastest <= 0 else f"they part e-fold in {1 / fastest:.3g} s"
        away = f"after {last} steps predictions are {self.distance[last].value:.2g} times as far from the data as its neighbours"
        rows = [
            ["intrinsic dimension of predicted latents", _short(self.dreamt_dimension)],
            ["Lyapunov exponents, 1/s", ", ".join(_short(one) for one in self.exponents)],
            ["effective rank of a step's derivatives", _short(self.rank)],
            ["their change from step to step", _short(self.turning)],
            *[
                [f"distance to the data after {step} steps", _short(figure)]
                for step, figure in self.distance.items()
            ],
            *[
                [f"trust horizon, {how}, steps", f"{_short(figure)} ({note})"]
                for how, (figure, note) in self.horizons.items()
            ],
        ]  # fmt: skip
        return "\n".join([f"{verdict}; {parts}; {away}.", "", *table_lines(["", "value [95% interval]"], rows)])


def _short(figure: Figure) -> str:
    return f"{figure.value:.3g} [{figure.low:.3g}, {figure.high:.3g}]"


def measure_geometry(world: str, config: GeometryConfig, *, progress: Progress = silent) -> Geometry:
    """Measures the geometry of a latent world on a recording. TerrellaError for another kind of world, DatasetError where the
    recording is too short."""
    if min(config.rollouts, config.steps) < 2:
        raise TerrellaError("--rollouts and --steps are 2 or more.")
    check_seed(config.seed)
    opened = load_named(world, config.device, progress=progress)
    if not isinstance(opened, LatentWorld):
        raise TerrellaError(
            f"{world} has no latents, whose geometry is measured; give a run of `terrella train latent`."
        )
    cache, rng = open_cache(config.data, opened, progress), make_rng(config.seed)
    every = range(len(cache.episodes))
    train, held_out = (every, every) if config.fresh else split(len(every))
    advice = "take fewer --steps, or record longer episodes"
    clips = clips_from_cache(cache, held_out, CONTEXT, config.steps, config.rollouts, rng, advice=advice)
    known = clips_from_cache(cache, train, CONTEXT, ROWS, KNOWN, rng, advice=advice)
    if len(known) < LEAST or len(clips) < FEWEST:
        raise DatasetError(
            f"{config.data} has {len(clips)} stretches of {config.steps} steps held out of training and {len(known)} others; "
            f"{FEWEST} and {LEAST} are needed. Record more, take fewer --steps, or --fresh where training never saw the recording."
        )
    return geometry_of(opened, clips, known, config.seed)


@torch.inference_mode()
def geometry_of(world: LatentWorld, clips: Sequence[Clip], known: Sequence[Clip], seed: int = 0) -> Geometry:
    """The geometry of rollouts from `clips`, beside latents of the clips `known`."""
    rng, steps = make_rng(seed), clips[0].horizon
    data, true = encoded(world, known, ROWS, rng), encoded(world, clips, steps, rng)
    states, expected = _dreamt(world, clips, steps, rng)
    dreamt = torch.stack([state["window"][:, -1] for state in states[1:]], 1).cpu()
    step, start = _stepper(world, clips, states, rng), states[0]["window"].flatten(1).cpu()
    exponents = lyapunov_exponents(step, start, steps, EXPONENTS, rng) / world.spec.dt_s
    latent = slice(start.shape[1] - data.shape[2], None)
    picks = sorted({*torch.linspace(0, steps - 2, min(PLACES, steps - 1)).long().tolist()})
    windows = [state["window"].flatten(1).cpu() for state in states]
    now = torch.stack([jacobians(step, at, windows[at], latent) for at in picks], 1)
    then = torch.stack([jacobians(step, at + 1, windows[at + 1], latent) for at in picks], 1)
    turning = (then - now).norm(dim=(2, 3)) / now.norm(dim=(2, 3)).clamp_min(1e-12)
    away = distance_to_data(dreamt, data)
    shown = sorted({1, min(8, steps), min(32, steps), steps})
    return Geometry(
        world.spec.name, steps, data.shape[2], intrinsic_dimension(data, rng), intrinsic_dimension(dreamt, rng),
        tuple(mean_interval(one.double(), rng) for one in exponents.T),
        mean_interval(effective_rank(now).mean(1).double(), rng), mean_interval(turning.mean(1).double(), rng),
        {at: mean_interval(away[:, at - 1], rng) for at in shown},
        _horizons(world, step, start, data.flatten(0, 1), true, dreamt, expected, rng),
    )  # fmt: skip


def _horizons(
    world: LatentWorld, step: Step, start: Tensor, data: Tensor, true: Tensor, dreamt: Tensor, expected: Tensor, rng
) -> dict[str, tuple[Figure, str]]:
    """Steps of trust by the geometry, by the world's own uncertainty, and measured."""
    unit, first = data.std(0, correction=0).clamp_min(1e-6), float(expected[:, 0].mean())

    def draw() -> Tensor:
        """An error as large as the world expects of its first step, in the directions in which data differ."""
        one, other = data[torch.randint(len(data), (2, len(start)), generator=rng)]
        return first * (one - other) / 2**0.5

    chance, error = chance_error(world.spec), errors_of({"latent": dreamt, "true latent": true})
    by_parting = parting(step, start, dreamt.shape[1], unit, draw)
    figures = trust_figures(by_parting, error, chance)
    named = {"by geometry": figures["forecast"]}
    own = trust_figures(expected, error, chance, measured_trust(world.spec))
    return named | {"by its uncertainty": own["forecast"], "measured": own["measured"]}


def encoded(world: World, clips: Sequence[Clip], rows: int, rng: torch.Generator) -> Tensor:
    """The latents [n, rows, D] of the observations after the context of clips."""
    state, latents = fold_context(world, clips, rng), []
    for row in range(clips[0].context, clips[0].context + rows):
        state = world.imagine(state, actions_at(world, clips, row - 1), rng)
        state = world.observe(evidence(clips, world.spec, row), state, rng)
        latents.append(world.render(state, ("latent",))["latent"].cpu())
    return torch.stack(latents, 1)


def _dreamt(world: World, clips: Sequence[Clip], steps: int, rng: torch.Generator) -> tuple[list[State], Tensor]:
    """States of rollouts under recorded actions, the start first, and the errors that the world expects [n, steps]."""
    states, expected = [fold_context(world, clips, rng)], []
    for number in range(steps):
        states.append(
            world.imagine(without_end(states[-1]), actions_at(world, clips, clips[0].context - 1 + number), rng)
        )
        expected.append(world.render(states[-1], ("uncertainty",))["uncertainty"].cpu())
    return states, torch.stack(expected, 1)


def _stepper(world: LatentWorld, clips: Sequence[Clip], states: Sequence[State], rng: torch.Generator) -> Step:
    """A step of windows [B, M, K * D] at the number of a step, under the recorded action."""

    def step(number: int, windows: Tensor) -> Tensor:
        batch, many, size = windows.shape
        state = states[number].fork(many)
        shape = state["window"].shape
        state = without_end(state.replace(window=windows.reshape(shape).to(world.device)))
        action = actions_at(world, clips, clips[0].context - 1 + number).repeat_interleave(many, 0)
        return world.imagine(state, action, rng)["window"].reshape(batch, many, size).cpu()

    return step
