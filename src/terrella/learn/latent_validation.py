"""Validation of a latent world on held-out episodes: open-loop errors beside two baselines, linear probes of its latents, and the
calibration of its uncertainty."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ..core.errors import DatasetError
from ..core.state import State
from ..core.world import World, make_rng, without_end
from ..worlds.latent import FORGOTTEN, LatentWorld
from ..worlds.latent_network import KNOTS
from .calibration import isotonic
from .objectives.uncertainty import rank_correlation
from .recording import Recording

HORIZONS = (1, 8, 16)
LONGEST = 512  # steps of the rollouts by which uncertainty is calibrated
CLIPS = 256  # over which open-loop errors are averaged
CLEARLY = 0.9  # share of another error below which an error is clearly less
HELD = 0.5  # R² of a linear probe from which latents hold a vector
PROBED = 4096  # rows to which linear probes are fitted
CONSTANT = 1e-3  # the deviation below which a number of the latent is constant: its error says nothing
ARMS = ("true actions", "another's actions", "copy-last")


@dataclass(frozen=True)
class OpenLoop:
    """Errors of n open-loop rollouts, in standard deviations: latent, by arm and step [n], and vectors, by name, arm and step
    [n, width]; spread [n] of the ensemble by step. steps: the horizons that fit into the episodes."""

    steps: tuple[int, ...]
    latent: Mapping[tuple[str, int], torch.Tensor]
    vectors: Mapping[tuple[str, str, int], torch.Tensor]
    spread: Mapping[int, torch.Tensor]

    def table(self) -> dict[str, dict[str, dict[str, float]]]:
        """Root mean squared errors: channel -> arm -> step."""
        table: dict[str, dict[str, dict[str, float]]] = {}
        for (arm, step), error in self.latent.items():
            table.setdefault("latent", {}).setdefault(arm, {})[str(step)] = _rms(error)
        for (name, arm, step), error in self.vectors.items():
            table.setdefault(name, {}).setdefault(arm, {})[str(step)] = _rms(error)
        return table


def held_out_rows(recording: Recording) -> Recording:
    """The recording with its held-out episodes as usable rows; all of it if it has none."""
    if not recording.held_out:
        return recording
    usable = np.zeros(recording.cache.length, bool)
    for number in recording.held_out:
        usable[slice(*recording.cache.episodes[number])] = True
    return replace(recording, usable=usable)


@torch.inference_mode()
def encode_rows(world: LatentWorld, recording: Recording, rows: np.ndarray) -> torch.Tensor:
    """Latents [n, D] of rows of a recording, and of what is before them in their episodes."""
    parts, latents = np.array_split(rows, max(1, -(-len(rows) // 512))), []
    for some in parts:
        seen, prior = observation_at(world, recording, some), _prior(world, recording, some)
        latents.append(world.observe(seen, prior, make_rng(0))["window"][:, -1])
    return torch.cat(latents)


def _prior(world: LatentWorld, recording: Recording, rows: np.ndarray) -> State | None:
    """A state that has seen the pictures before rows, where latents are made of several."""
    network, config = world.network, world.network.config
    if not config.pictured or config.frames == 1:
        return None
    back = np.arange(1, config.frames)
    at = rows[:, None] - back
    known = torch.from_numpy(at >= recording.start[rows][:, None]).to(world.device)
    looks = network.look(recording.rgb(np.maximum(at, 0).ravel()).to(world.device))
    ages = torch.where(known, torch.from_numpy(back).to(world.device), FORGOTTEN)
    return world.start(len(rows), make_rng(0)).replace(glances=network.glance(looks).unflatten(0, at.shape), ages=ages)


def fitting_horizons(recording: Recording, context: int, horizons: Sequence[int] = HORIZONS) -> list[int]:
    """The horizons for which held-out episodes are long enough, after `context` rows. DatasetError where there are none."""
    data = held_out_rows(recording)
    fitting = [step for step in sorted(horizons) if len(data.rows_within(context, step, acted=True)) >= 8]
    if not fitting:
        raise DatasetError(
            f"the episodes of {recording.name} that training does not see have too few stretches of {context + 1 + min(horizons)} "
            "rows for validation; record longer episodes, or more."
        )
    return fitting


@torch.inference_mode()
def open_loop(world: LatentWorld, recording: Recording, horizons: Sequence[int], clips: int = CLIPS) -> OpenLoop:
    """Rollouts over held-out episodes, after as many rows of context as the world's history has."""
    context, data = world.network.config.history - 1, held_out_rows(recording)
    fitting = fitting_horizons(recording, context, horizons)
    rows = data.rows_within(context, fitting[-1], acted=True)
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(rows, min(len(rows), clips), replace=False))
    others = np.roll(rng.permutation(rows), 1)
    deviation = encode_rows(world, recording, _some(recording, PROBED)).std(0, correction=0)
    varies = (deviation > CONSTANT) | (deviation <= CONSTANT).all()
    unit = deviation[varies].clamp_min(CONSTANT)
    latent, vectors, spread = {}, {}, {}
    began = {name: _vector(recording, name, rows) for name, _ in world.network.config.vectors}
    first, rewards = encode_rows(world, recording, rows), _rewards(recording)
    for arm, actors in ((ARMS[0], rows), (ARMS[1], others)):
        state = state_at(world, recording, rows, context)
        for step in range(1, fitting[-1] + 1):
            state = world.imagine(
                without_end(state), recording.recorded_actions(world.spec, actors + step - 1), make_rng(0)
            )
            if step not in fitting:
                continue
            truth = encode_rows(world, recording, rows + step)
            latent[arm, step] = _per_clip((state["window"][:, -1] - truth)[:, varies] / unit)
            latent[ARMS[2], step] = _per_clip((first - truth)[:, varies] / unit)
            spread.setdefault(step, state["spread"])
            if rewards is not None:
                reward, scale = rewards
                for name, predicted in ((arm, state["reward"].cpu()), (ARMS[2], reward[rows - 1])):
                    vectors["reward", name, step] = ((predicted - reward[rows + step - 1]) / scale)[:, None]
            shown = world.render(state, tuple(began))
            for name in began:
                truth, scale = _vector(recording, name, rows + step), _scale(world, name)
                vectors[name, arm, step] = (shown[name].cpu().reshape(truth.shape) - truth) / scale
                vectors[name, ARMS[2], step] = (began[name] - truth) / scale
    return OpenLoop(tuple(fitting), latent, vectors, spread)


def validate(world: LatentWorld, recording: Recording, horizons: Sequence[int] = HORIZONS) -> dict[str, Any]:
    """JSON facts, the verdict first. errors: see OpenLoop.table; probe_r2: R² of a linear probe of each vector; effective_rank of
    the latents, and their dimensions; uncertainty_rank_correlation: of the expected with the actual error."""
    rolled = open_loop(world, recording, horizons)
    rows = _some(recording, PROBED)
    held = np.flatnonzero(held_out_rows(recording).usable)
    held = held[:: max(1, len(held) // 1024)]
    fitted, tested = encode_rows(world, recording, rows), encode_rows(world, recording, held)
    probe = {
        name: linear_probe(fitted, _vector(recording, name, rows), tested, _vector(recording, name, held))
        for name, _ in world.network.config.vectors
    }
    error = torch.cat([rolled.latent[ARMS[0], step] for step in rolled.steps])
    expected = world.network.expected(torch.cat([rolled.spread[step] for step in rolled.steps])).cpu()
    table = _rounded(rolled.table())
    return {
        "verdict": verdict(table["latent"], probe, world.controls.low != world.controls.high),
        "errors": table,
        "probe_r2": _rounded(probe),
        "effective_rank": round(effective_rank(fitted), 2),
        "latent": fitted.shape[1],
        "uncertainty_rank_correlation": round(rank_correlation(expected, error), 3),
    }


def verdict(errors: Mapping[str, Mapping[str, float]], probe: Mapping[str, float], acts: bool = True) -> str:
    """A sentence or two: how far ahead it can be planned in, by the latent's errors of each arm and step, and what latents lack, by
    the R² of each vector's linear probe. acts: whether there is more than one action."""
    true, other, still = (errors[arm] for arm in ARMS)
    predicts = [step for step in true if true[step] < CLEARLY * still[step]]
    obeys = [step for step in predicts if true[step] < CLEARLY * other[step]]
    if not predicts:
        words = "It predicts no better than copy-last: do not plan in it. Train longer (--steps), or record more."
    elif not acts:
        last = f"{predicts[-1]} step{'s'[: int(predicts[-1]) > 1]}"
        words = f"Better than copy-last after {last}; it has one action, so there is nothing to plan."
    elif not obeys:
        words = "It predicts better than copy-last, but hardly depends on the actions: plans in it cannot be expected to work."
    else:
        last = f"{predicts[-1]} step{'s'[: int(predicts[-1]) > 1]}"
        words = f"Better than copy-last after {last}; what it predicts depends on the actions after {obeys[-1]}."
    if lost := [name for name, share in probe.items() if share < HELD]:
        words += f" Its latents do not hold {', '.join(lost)}."
    return words


def calibrate(world: LatentWorld, recording: Recording, longest: int = LONGEST) -> None:
    """Fits the map from the spread of the ensemble to the error of the latent, by isotonic regression on half of the held-out
    clips, in the world's own network. Horizons are 1, 2, 4, ... up to `longest` steps, as far as a fifth of the held-out rows
    reach; the error at larger spreads is extrapolated."""
    network, data = world.network, held_out_rows(recording)
    context = network.config.history - 1
    reach = [len(data.rows_within(context, 2**power, acted=True)) for power in range(longest.bit_length())]
    rolled = open_loop(world, recording, [2**power for power, rows in enumerate(reach) if rows >= 0.2 * reach[0]])
    spread = torch.cat([rolled.spread[step][::2] for step in rolled.steps]).cpu()
    error = torch.cat([rolled.latent[ARMS[0], step][::2] for step in rolled.steps]).cpu()
    knots, errors = isotonic(spread, error, KNOTS - 1)
    network.spread.copy_(F.pad(knots, (1, 0)))
    network.error.copy_(F.pad(errors, (1, 0)))


@torch.inference_mode()
def rollout_frames(world: LatentWorld, recording: Recording, steps: int = 64) -> list[torch.Tensor]:
    """Nine pictures uint8 [9, 3, H, W] of a held-out episode, evenly over at most `steps` steps, and those decoded from a rollout
    that begins at the first; none for a world without pictures."""
    context, data = world.network.config.history - 1, held_out_rows(recording)
    if world.network.config.size is None:
        return []
    fits = [count for count in range(8, steps + 1, 8) if len(data.rows_within(context, count, acted=True))]
    if not fits:
        return []
    rows, every = data.rows_within(context, fits[-1], acted=True)[:1], fits[-1] // 8
    state = state_at(world, recording, rows, context)
    frames = [world.render(state, ("rgb",))["rgb"]]
    for step in range(fits[-1]):
        state = world.imagine(without_end(state), recording.recorded_actions(world.spec, rows + step), make_rng(0))
        if (step + 1) % every == 0:
            frames.append(world.render(state, ("rgb",))["rgb"])
    return [recording.rgb(rows[0] + every * np.arange(9)), torch.cat(frames).permute(0, 3, 1, 2).cpu()]


def linear_probe(
    latents: torch.Tensor, values: torch.Tensor, test_latents: torch.Tensor, test_values: torch.Tensor
) -> float:
    """R² on the test set of ridge regression from latents [n, D] to values [n, V], the mean over the numbers that vary."""
    mean, unit = values.double().mean(0), values.double().std(0, correction=0)
    varies = unit > 1e-6 * values.double().abs().amax(0).clamp_min(1e-6)
    if not varies.any() or len(test_values) < 2:
        return float("nan")
    into, out = (torch.cat([part.double().cpu(), torch.ones(len(part), 1)], 1) for part in (latents, test_latents))
    target = ((values.double() - mean) / unit)[:, varies]
    ridge = 1e-3 * len(into) * torch.eye(into.shape[1], dtype=torch.float64)
    weights = torch.linalg.solve(into.T @ into + ridge, into.T @ target)
    truth = ((test_values.double() - mean) / unit)[:, varies]
    residual = (out @ weights - truth).square().mean(0)
    variance = (truth - truth.mean(0)).square().mean(0).clamp_min(1e-9)
    return float((1 - residual / variance).mean())


def effective_rank(latents: torch.Tensor) -> float:
    """Effective rank of latents [n, D]: exp of the entropy of their normalised covariance spectrum (Roy & Vetterli 2007)."""
    shares = torch.linalg.eigvalsh(torch.atleast_2d(torch.cov(latents.double().cpu().T))).clamp_min(0)
    shares = shares / shares.sum().clamp_min(1e-12)
    return float(torch.special.entr(shares).sum().exp())


def state_at(world: World, recording: Recording, rows: np.ndarray, context: int) -> State:
    """The states at `rows` after `context` rows before them, each imagined from the one before and corrected by its observation."""
    rng = make_rng(0)
    state = world.observe(observation_at(world, recording, rows - context), None, rng)
    for back in range(context, 0, -1):
        state = world.imagine(state, recording.recorded_actions(world.spec, rows - back), rng)
        state = world.observe(observation_at(world, recording, rows - back + 1), state, rng)
    return state


def observation_at(world: World, recording: Recording, rows: np.ndarray) -> dict[str, torch.Tensor]:
    """The recorded channels of `rows` that the world observes."""
    seen = {}
    for name in (*world.spec.observes, *world.spec.may_observe):
        if name == "rgb":
            seen[name] = recording.rgb(rows).permute(0, 2, 3, 1)
        elif recording.cache.keys.get(name, name) in recording.cache.arrays:
            seen[name] = _vector(recording, name, rows)
    return seen


def _vector(recording: Recording, name: str, rows: np.ndarray) -> torch.Tensor:
    """A vector of the recording: float32 [n, width]."""
    cache = recording.cache
    array = cache.arrays[cache.keys.get(name, name)]
    return torch.from_numpy(np.array(array[rows], np.float32)).reshape(len(rows), -1).nan_to_num(0.0, 0.0, 0.0)


def _rewards(recording: Recording) -> tuple[torch.Tensor, torch.Tensor] | None:
    """The reward [N] after each row, and its standard deviation; None if it is constant."""
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


def _rounded(figures: Any) -> Any:
    if isinstance(figures, dict):
        return {name: _rounded(value) for name, value in figures.items()}
    return round(figures, 4) if np.isfinite(figures) else None
