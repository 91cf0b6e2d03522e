"""`transfer` with a recording as reality: open-loop errors of the simulator, and the agreement of actions."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import library
from ..core.errors import DatasetError
from ..core.files import write_json
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..data import Dataset
from ..data.channels import facts_of
from ..data.game import check_game
from ..measure.statistics import Figure, mean_interval
from ..sim.identification import identify
from ..sim.mujoco_world import MujocoWorld
from ..sim.randomised import Randomised, read
from ..sim.trials import PAST, Trials, fitted_simulator, idle_actions, with_joints
from .real_environment import meaning_difference
from .results import jsonable, table_lines
from .transfer_arms import fit_residual

HORIZONS = (1, 10, 50)
NEEDED = ("action", "qpos", "qvel")
STILL, RANDOM, IDLE = "stands still", "random", "idle"
CANDIDATES, MOMENTS = 256, 32  # actions that are tried at each of some moments of the recording


@dataclass(frozen=True)
class RecordedTransferResult:
    """How well a simulator predicts a recording, as it is, as identified, and with a learned residual."""

    settings: Mapping[str, Any]  # sim, real, and the numbers of episodes that were learned from and held out.
    open_loop: Mapping[str, Mapping[int, Figure]]
    """world -> horizon in steps -> error of qpos (rad, m) in held-out episodes."""
    action_error: Mapping[str, Figure]
    """world -> error of the action that best explains a recorded step, in shares of the range."""
    file: Path  # transfer.json.

    def to_json(self) -> dict[str, Any]:
        open_loop = {
            name: {str(step): _plain(one) for step, one in row.items()} for name, row in self.open_loop.items()
        }
        action_error = {name: _plain(one) for name, one in self.action_error.items()}
        return jsonable({**self.settings, "open_loop": open_loop, "action_error": action_error})

    def summary(self) -> str:
        steps = sorted({step for row in self.open_loop.values() for step in row})
        cells = {name: [str(row[step]) for step in steps] for name, row in self.open_loop.items()}
        rows = [[name, *errors, str(self.action_error.get(name, ""))] for name, errors in cells.items()]
        rows += [[name, *("" for _ in steps), str(self.action_error[name])] for name in (RANDOM, IDLE)]
        heads = ["open-loop error of qpos (rad, m)", *(f"{step} steps" for step in steps)]
        lines = table_lines([*heads, "error of actions, shares of range"], rows)
        return "\n".join([*lines, "", f"the figures: {self.file}"])


def transfer_to_recording(
    sim: str, recording: Path, randomise: Path | None, count: int, *, out: Path | None, seed: int
) -> RecordedTransferResult:
    """Open-loop errors of a simulator in the held-out half of a recording: as it is, as identified, and with a residual, both
    fitted to up to `count` other episodes; and whether the action that it needs for a recorded step is the recorded one."""
    dataset, opened = Dataset(recording), library.load(sim, cameras=(), threads=1)
    check_recording(dataset, opened.spec)
    world = fitted_simulator(opened)
    learned, held = _halves(read_trials(dataset, world), count)
    folder = Path(out or f"transfers/{recording.name}")
    worlds: dict[str, World] = {"simulator": world}
    if randomise is not None:
        rough = Randomised(world, read(randomise))
        best = identify(rough, learned, seed)
        worlds["identified"] = Randomised(world, best.around(rough.distributions), 1.0)
    mark = _mark(world, learned)
    worlds[f"model {len(learned.actions)}"] = fit_residual(world, learned, folder / "residual", seed, mark)
    errors = {name: open_loop(one, held, seed) for name, one in worlds.items()} | {STILL: open_loop(None, held, seed)}
    agree = {name: agreement(one, held, seed) for name, one in worlds.items()} | _baselines(world, held, seed)
    settings = {"sim": sim, "real": str(recording), "learned_from": len(learned.actions), "held_out": len(held.actions)}
    result = RecordedTransferResult(settings, errors, agree, folder / "transfer.json")
    folder.mkdir(parents=True, exist_ok=True)
    write_json(result.file, result.to_json())
    return result


def _mark(world: MujocoWorld, learned: Trials) -> str:
    """sha256 of a simulator and of the episodes that a residual is fitted to."""
    digest = hashlib.sha256(world.fingerprint().encode())
    for value in vars(learned).values():
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()


def check_recording(dataset: Dataset, spec: Spec) -> None:
    """DatasetError where its actions have other semantics than the world's, or where joints are missing."""
    check_game(dataset, spec)
    theirs = {"action_names": dataset.action_names, **dataset.world}
    if why := meaning_difference(theirs, facts_of(spec)):
        raise DatasetError(f"the actions of {dataset.root} and of {spec.name} have other semantics: {why}.")
    if not math.isclose(dataset.fps * spec.dt_s, 1, rel_tol=0.02):
        raise DatasetError(
            f"{dataset.root} has {dataset.fps:g} rows a second, and {spec.name} {1 / spec.dt_s:.4g} steps: they differ."
        )
    lacks = [name for name in NEEDED if not dataset.has(name)]
    if lacks:
        raise DatasetError(
            f"{dataset.root} holds no {', '.join(lacks)}, so no simulator can be put where it was; record them."
        )


def read_trials(dataset: Dataset, world: MujocoWorld) -> Trials:
    """The episodes of a recording; DatasetError where they are too few, or of another robot."""
    recording, spec = dataset.root, world.spec
    episodes = [dataset.episode(number, NEEDED) for number in range(len(dataset.episodes))]
    episodes = [one for one in episodes if len(one["action"]) > PAST + 1]
    if len(episodes) < 2:
        raise DatasetError(
            f"{recording} has fewer than two episodes of {PAST + 2} rows: one to learn from, one to judge by."
        )
    if episodes[0]["qpos"].shape[1] != world.file.nq:
        raise DatasetError(
            f"{recording} has {episodes[0]['qpos'].shape[1]} joints, and {spec.name} {world.file.nq}: they differ."
        )
    rows = max(len(one["action"]) for one in episodes)

    def padded(name: str, length: int) -> torch.Tensor:
        parts = [np.pad(one[name][:length], ((0, max(0, length - len(one[name]))), (0, 0)), "edge") for one in episodes]
        return torch.from_numpy(np.stack(parts).astype(np.float32))

    known = torch.tensor([[step < len(one["action"]) - 1 for step in range(rows - 1)] for one in episodes])
    low, high = (torch.as_tensor(limit) for limit in spec.action_limits)
    actions = padded("action", rows - 1).clamp(low, high)
    return Trials(padded("qpos", rows), padded("qvel", rows), actions, known, idle_actions(spec, len(episodes)))


def _halves(trials: Trials, count: int) -> tuple[Trials, Trials]:
    """Episodes to learn from, at most `count` and half of all, and those after the first half, which are held out."""
    half = len(trials.actions) // 2
    return trials[: min(count, half)], trials[half:]


@torch.no_grad()
def open_loop(world: World | None, held: Trials, seed: int) -> dict[int, Figure]:
    """horizon -> RMS error of the joints under the recorded actions; without a world, of standing still."""
    batch, state = len(held.actions), None
    if world is not None:
        state = with_joints(
            world, world.start(batch, make_rng(seed)), held.actions[:, :PAST], held.qpos[:, PAST], held.qvel[:, PAST]
        )
    errors = {}
    for step in range(min(max(HORIZONS), held.actions.shape[1] - PAST)):
        at = PAST + step
        if state is not None and world is not None:
            state = world.imagine(state, held.actions[:, at], make_rng(seed))
        known = held.valid[:, : at + 1].all(1)
        if step + 1 in HORIZONS and known.any():
            mine = held.qpos[:, PAST] if world is None or state is None else world.render(state, ("qpos",))["qpos"]
            away = (mine - held.qpos[:, at + 1]).square().mean(1).sqrt()[known]
            errors[step + 1] = mean_interval(away, make_rng(seed))
    return errors


@torch.no_grad()
def agreement(world: World, held: Trials, seed: int) -> Figure:
    """Distance between the recorded action and the one that brings the world nearest to the next recorded moment, in shares of the
    range, over some moments."""
    rng, rows = make_rng(seed), held.valid[:, PAST:].nonzero()
    episode, at = rows[torch.randint(len(rows), (MOMENTS,), generator=rng)].T
    at, past = at + PAST, held.past()
    each = torch.arange(len(at)).repeat_interleave(CANDIDATES)
    state = with_joints(
        world,
        world.start(len(each), rng),
        past[episode, at][each],
        held.qpos[episode, at][each],
        held.qvel[episode, at][each],
    )
    tried = world.spec.sample_action(len(each), rng)
    after = world.render(world.imagine(state, tried, rng), ("qpos", "qvel"))
    unit = {name: getattr(held, name)[:, :-1][held.valid].std(0).clamp_min(1e-6) for name in ("qpos", "qvel")}
    true = {name: getattr(held, name)[episode, at + 1][each] for name in unit}
    away = sum(((after[name] - true[name]) / unit[name]).square().mean(1) for name in unit)
    best = torch.as_tensor(away).view(-1, CANDIDATES).argmin(1) + CANDIDATES * torch.arange(len(at))
    return _apart(world, tried[best], held.actions[episode, at], seed)


def _baselines(world: World, held: Trials, seed: int) -> dict[str, Figure]:
    actions = held.actions[held.valid]
    return {
        RANDOM: _apart(world, world.spec.sample_action(len(actions), make_rng(seed)), actions, seed),
        IDLE: _apart(world, idle_actions(world.spec, len(actions)), actions, seed),
    }


def _apart(world: World, one: torch.Tensor, other: torch.Tensor, seed: int) -> Figure:
    low, high = (torch.as_tensor(limit) for limit in world.spec.action_limits)
    return mean_interval(((one - other).abs() / (high - low)).flatten(1).mean(1), make_rng(seed))


def _plain(figure: Figure) -> dict[str, float]:
    return {"value": figure.value, "low": figure.low, "high": figure.high, "count": figure.count}
