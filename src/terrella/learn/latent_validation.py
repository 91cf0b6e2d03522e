"""What a latent world is worth on episodes that training did not see: open-loop errors beside two baselines, what its latents
hold, and how its uncertainty is calibrated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.state import State
from ..core.world import World, make_rng
from ..worlds.latent import LatentWorld
from ..worlds.latent_network import KNOTS, LatentNetwork
from .objectives.uncertainty import pooled, rank_correlation
from .recording import Recording

HORIZONS = (1, 8, 16)
CLIPS = 256  # of which each open-loop figure is the mean
PROBED = 4096  # rows from which a linear probe is learned
ARMS = ("true actions", "another's actions", "copy-last")


@dataclass(frozen=True)
class OpenLoop:
    """Errors of n clips, predicted without further evidence, in standard deviations: latent, by arm and step [n], and vectors, by
    name, arm and step [n, width]; spread [n] of the ensemble by step. steps: those that fit into the episodes."""

    steps: tuple[int, ...]
    latent: Mapping[tuple[str, int], torch.Tensor]
    vectors: Mapping[tuple[str, str, int], torch.Tensor]
    spread: Mapping[int, torch.Tensor]

    def table(self) -> dict[str, dict[str, dict[str, float]]]:
        """Root mean squares: channel -> arm -> step."""
        found: dict[str, dict[str, dict[str, float]]] = {}
        for (arm, step), error in self.latent.items():
            found.setdefault("latent", {}).setdefault(arm, {})[str(step)] = _rms(error)
        for (name, arm, step), error in self.vectors.items():
            found.setdefault(name, {}).setdefault(arm, {})[str(step)] = _rms(error)
        return found


def unseen(recording: Recording) -> Recording:
    """The episodes that training did not see; of a recording of one episode, that one."""
    if not recording.held_out:
        return recording
    usable = np.zeros(recording.cache.length, bool)
    for number in recording.held_out:
        usable[slice(*recording.cache.episodes[number])] = True
    return replace(recording, usable=usable)


@torch.inference_mode()
def encoded(world: LatentWorld, recording: Recording, rows: np.ndarray) -> torch.Tensor:
    """Latents [n, D] of rows of a recording."""
    parts = np.array_split(rows, max(1, -(-len(rows) // 512)))
    return torch.cat(
        [world.observe(evidence(world, recording, some), None, make_rng(0))["window"][:, -1] for some in parts]
    )


@torch.inference_mode()
def open_loop(world: LatentWorld, recording: Recording, horizons: Sequence[int], clips: int = CLIPS) -> OpenLoop:
    """Rollouts over held-out episodes, from as many rows of context as the world's history holds."""
    context, data = world.network.config.history - 1, unseen(recording)
    fitting = [step for step in sorted(horizons) if len(data.within(context, step, acted=True)) >= 8]
    if not fitting:
        raise DatasetError(
            f"the episodes of {recording.name} that training did not see have no {context + 1 + min(horizons)} rows in a row "
            "to be tried on; record longer episodes."
        )
    rows = data.within(context, fitting[-1], acted=True)
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(rows, min(len(rows), clips), replace=False))
    others = np.roll(rng.permutation(rows), 1)
    unit = encoded(world, recording, _some(recording, PROBED)).std(0, correction=0).clamp_min(1e-6)
    latent, vectors, spread = {}, {}, {}
    began = {name: _vector(recording, name, rows) for name, _ in world.network.config.vectors}
    first, paid = encoded(world, recording, rows), _rewards(recording)
    for arm, hands in ((ARMS[0], rows), (ARMS[1], others)):
        state = folded(world, recording, rows, context)
        for step in range(1, fitting[-1] + 1):
            state = world.imagine(state, recording.played(world.spec, hands + step - 1), make_rng(0))
            if step not in fitting:
                continue
            truth = encoded(world, recording, rows + step)
            latent[arm, step] = _per_clip((state["window"][:, -1] - truth) / unit)
            latent[ARMS[2], step] = _per_clip((first - truth) / unit)
            spread.setdefault(step, state["spread"])
            if paid is not None:
                reward, scale = paid
                for given, found in ((arm, state["reward"].cpu()), (ARMS[2], reward[rows - 1])):
                    vectors["reward", given, step] = ((found - reward[rows + step - 1]) / scale)[:, None]
            shown = world.render(state, tuple(began))
            for name in began:
                really, scale = _vector(recording, name, rows + step), _scale(world, name)
                vectors[name, arm, step] = (shown[name].cpu().reshape(really.shape) - really) / scale
                vectors[name, ARMS[2], step] = (began[name] - really) / scale
    return OpenLoop(tuple(fitting), latent, vectors, spread)


def validate(world: LatentWorld, recording: Recording, horizons: Sequence[int] = HORIZONS) -> dict[str, Any]:
    """JSON facts. errors: see OpenLoop.table; probe: R² of a linear probe of each vector, on the latent and on the window of them;
    effective_rank of the latents, of how many; uncertainty: its rank correlation with the error found."""
    rolled = open_loop(world, recording, horizons)
    rows = _some(recording, PROBED)
    held = np.flatnonzero(unseen(recording).usable)
    held = held[:: max(1, len(held) // 1024)]
    known, asked = encoded(world, recording, rows), encoded(world, recording, held)
    probe = {
        name: linear_probe(known, _vector(recording, name, rows), asked, _vector(recording, name, held))
        for name, _ in world.network.config.vectors
    }
    error = torch.cat([rolled.latent[ARMS[0], step] for step in rolled.steps])
    expected = world.network.expected(torch.cat([rolled.spread[step] for step in rolled.steps]))
    return {
        "errors": _rounded(rolled.table()),
        "probe_r2": _rounded(probe),
        "effective_rank": round(effective_rank(known), 2),
        "latent": known.shape[1],
        "uncertainty_rank_correlation": round(rank_correlation(expected, error), 3),
    }


def calibrate(world: LatentWorld, recording: Recording, horizons: Sequence[int] = (1, 2, 4, 8, 16, 32)) -> None:
    """Fits the map from the spread of the ensemble to the latent's error (isotonic regression on half of the held-out clips), in
    the world's own network."""
    network, rolled = world.network, open_loop(world, recording, horizons)
    spread = torch.cat([rolled.spread[step][::2] for step in rolled.steps]).cpu()
    error = torch.cat([rolled.latent[ARMS[0], step][::2] for step in rolled.steps]).cpu()
    _fit(network, spread, error)


def _fit(network: LatentNetwork, spread: torch.Tensor, error: torch.Tensor) -> None:
    bins = [part for part in np.array_split(spread.argsort().numpy(), KNOTS - 1) if len(part)]
    found = [0.0, *(float(spread[part].mean()) for part in bins)]
    meant = [0.0, *pooled([float(error[part].clamp(0, 1).mean()) for part in bins], [len(part) for part in bins])]
    while len(found) < KNOTS:
        found, meant = [*found, found[-1]], [*meant, meant[-1]]
    network.spread.copy_(torch.tensor(found))
    network.error.copy_(torch.tensor(meant))


@torch.inference_mode()
def foreseen(world: LatentWorld, recording: Recording, steps: int = 64) -> list[torch.Tensor]:
    """Pictures uint8 [9, 3, H, W] of a held-out episode, every eighth of `steps` or of as many as it has, and those decoded of a
    rollout from the first of them; none of a world that draws none."""
    context, data = world.network.config.history - 1, unseen(recording)
    if world.network.config.size is None:
        return []
    fits = [count for count in range(8, steps + 1, 8) if len(data.within(context, count, acted=True))]
    if not fits:
        return []
    rows, every = data.within(context, fits[-1], acted=True)[:1], fits[-1] // 8
    state = folded(world, recording, rows, context)
    frames = [world.render(state, ("rgb",))["rgb"]]
    for step in range(fits[-1]):
        state = world.imagine(state, recording.played(world.spec, rows + step), make_rng(0))
        if (step + 1) % every == 0:
            frames.append(world.render(state, ("rgb",))["rgb"])
    return [recording.rgb(rows[0] + every * np.arange(9)), torch.cat(frames).permute(0, 3, 1, 2).cpu()]


def linear_probe(known: torch.Tensor, values: torch.Tensor, asked: torch.Tensor, truth: torch.Tensor) -> float:
    """R² on (asked, truth) of ridge regression from latents [n, D] to values [n, V], mean over the numbers that vary."""
    mean, unit = values.double().mean(0), values.double().std(0, correction=0)
    varies = unit > 1e-6 * values.double().abs().amax(0).clamp_min(1e-6)
    if not varies.any() or len(truth) < 2:
        return float("nan")
    into, out = (torch.cat([part.double().cpu(), torch.ones(len(part), 1)], 1) for part in (known, asked))
    target = ((values.double() - mean) / unit)[:, varies]
    ridge = 1e-3 * len(into) * torch.eye(into.shape[1], dtype=torch.float64)
    weights = torch.linalg.solve(into.T @ into + ridge, into.T @ target)
    real = ((truth.double() - mean) / unit)[:, varies]
    left = (out @ weights - real).square().mean(0)
    around = (real - real.mean(0)).square().mean(0).clamp_min(1e-9)
    return float((1 - left / around).mean())


def effective_rank(latents: torch.Tensor) -> float:
    """exp of the entropy of the shares of variance along the principal axes of latents [n, D] (Roy & Vetterli 2007)."""
    shares = torch.linalg.eigvalsh(torch.cov(latents.double().cpu().T)).clamp_min(0)
    shares = shares / shares.sum().clamp_min(1e-12)
    return float(torch.special.entr(shares).sum().exp())


def folded(world: World, recording: Recording, rows: np.ndarray, context: int) -> State:
    """The state at `rows`, each row before it being evidence upon what was imagined from the one before."""
    rng = make_rng(0)
    state = world.observe(evidence(world, recording, rows - context), None, rng)
    for back in range(context, 0, -1):
        state = world.imagine(state, recording.played(world.spec, rows - back), rng)
        state = world.observe(evidence(world, recording, rows - back + 1), state, rng)
    return state


def evidence(world: World, recording: Recording, rows: np.ndarray) -> dict[str, torch.Tensor]:
    seen = {}
    for name in (*world.spec.observes, *world.spec.may_observe):
        if name == "rgb":
            seen[name] = recording.rgb(rows).permute(0, 2, 3, 1)
        elif recording.cache.keys.get(name, name) in recording.cache.arrays:
            seen[name] = _vector(recording, name, rows)
    return seen


def _vector(recording: Recording, name: str, rows: np.ndarray) -> torch.Tensor:
    """A channel of numbers of the recording: float32 [n, width]."""
    cache = recording.cache
    array = cache.arrays[cache.keys.get(name, name)]
    return torch.from_numpy(np.array(array[rows], np.float32)).reshape(len(rows), -1).nan_to_num(0.0, 0.0, 0.0)


def _rewards(recording: Recording) -> tuple[torch.Tensor, torch.Tensor] | None:
    """The reward [N] that followed each row, and its standard deviation; None where it is always the same."""
    if recording.cache.reward is None:
        return None
    reward = torch.from_numpy(np.array(recording.cache.reward, np.float32)).reshape(-1)
    unit = reward[torch.from_numpy(np.flatnonzero(recording.usable))].std(correction=0)
    return (reward, unit) if unit > 1e-6 else None


def _scale(world: LatentWorld, name: str) -> torch.Tensor:
    widths = [width for _, width in world.network.config.vectors]
    at = [known for known, _ in world.network.config.vectors].index(name)
    return world.network.scale.cpu().split(widths)[at]


def _some(recording: Recording, count: int) -> np.ndarray:
    rows = np.flatnonzero(recording.usable)
    return rows[:: max(1, len(rows) // count)]


def _per_clip(error: torch.Tensor) -> torch.Tensor:
    return error.square().mean(1).sqrt().cpu()


def _rms(error: torch.Tensor) -> float:
    return float(error.double().square().mean().sqrt())


def _rounded(found: Any) -> Any:
    if isinstance(found, dict):
        return {name: _rounded(value) for name, value in found.items()}
    return round(found, 4) if np.isfinite(found) else None
