"""`terrella transfer --real RECORDING`: a recording stands for reality, so open-loop errors and agreement of actions are told."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
import torch

from .. import library
from ..core.errors import DatasetError
from ..core.files import write_json
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..data import Dataset
from ..data.channels import check_game, facts_of
from ..measure.statistics import Figure, mean_interval
from ..sim.identification import identify
from ..sim.mujoco_world import MujocoWorld
from ..sim.randomised import Randomised, read
from ..sim.trials import PAST, Trials, idle, inner, placed
from .beside import misunderstood, sound
from .evaluate import table_lines
from .say import result
from .transfer_arms import fitted

HORIZONS = (1, 10, 50)
NEEDED = ("action", "qpos", "qvel")
STILL, RANDOM, IDLE = "stands still", "random", "idle"


def transfer_recorded(
    sim: str, recording: Path, randomise: Path | None, count: int, out: Path | None, seed: int, json: bool
) -> None:
    """Open-loop errors in held-out episodes of the simulator, as identified, and with a model of up to `count` of the others; and
    how well the actions that brought the model from each moment to the next agree with the recorded ones."""
    dataset, opened = Dataset(recording), library.load(sim, cameras=(), threads=1)
    check_recording(dataset, opened.spec)
    world = inner(opened)
    learned, held = _halves(read_trials(dataset, world), count)
    folder = out or Path("transfers") / recording.name
    worlds: dict[str, World] = {"simulator": world}
    if randomise is not None:
        rough = Randomised(world, read(randomise))
        found = identify(rough, learned, seed)
        worlds["identified"] = Randomised(world, found.around(rough.distributions), 1.0)
    worlds[f"model {len(learned.actions)}"] = fitted(world, learned, folder / "residual", seed, _mark(world, learned))
    rows: dict[str, dict[int, Figure]] = {name: open_loop(one, held, seed) for name, one in worlds.items()}
    rows[STILL] = open_loop(None, held, seed)
    steps = sorted({step for row in rows.values() for step in row})
    agree = {name: agreement(one, held, seed) for name, one in worlds.items()} | _floors(world, held, seed)
    lines = [[name, *(str(row[step]) for step in steps), str(agree.get(name, ""))] for name, row in rows.items()]
    lines += [[name, *("" for _ in steps), str(agree[name])] for name in (RANDOM, IDLE)]
    heads = [
        "open-loop error of qpos (rad, m)",
        *(f"{step} steps" for step in steps),
        "error of actions, shares of range",
    ]
    facts = {"sim": sim, "real": str(recording), "learned_from": len(learned.actions), "held_out": len(held.actions)}
    facts |= {"open_loop": {name: {str(step): one for step, one in row.items()} for name, row in rows.items()}}
    whole = sound({**facts, "action_error": agree})
    folder.mkdir(parents=True, exist_ok=True)
    plain = _plain(whole)
    write_json(folder / "transfer.json", plain)
    result(plain, json, "\n".join([*table_lines(heads, lines), "", f"the figures: {folder / 'transfer.json'}"]))


def _mark(world: MujocoWorld, learned: Trials) -> str:
    """sha256 of a simulator and of what a model of it learns from."""
    found = hashlib.sha256(world.fingerprint().encode())
    for value in vars(learned).values():
        found.update(value.contiguous().numpy().tobytes())
    return found.hexdigest()


def check_recording(dataset: Dataset, spec: Spec) -> None:
    """DatasetError where its actions mean something else than a world's, or where joints are missing."""
    check_game(dataset, spec)
    theirs = {"action_names": dataset.action_names, **dataset.world}
    if why := misunderstood(theirs, facts_of(spec)):
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
    found = [dataset.episode(number, NEEDED) for number in range(len(dataset.episodes))]
    found = [one for one in found if len(one["action"]) > PAST + 1]
    if len(found) < 2:
        raise DatasetError(
            f"{recording} has fewer than two episodes of {PAST + 2} rows: one to learn from, one to judge by."
        )
    if found[0]["qpos"].shape[1] != world.file.nq:
        raise DatasetError(
            f"{recording} has {found[0]['qpos'].shape[1]} joints, and {spec.name} {world.file.nq}: they differ."
        )
    rows = max(len(one["action"]) for one in found)

    def padded(name: str, length: int) -> torch.Tensor:
        parts = [np.pad(one[name][:length], ((0, max(0, length - len(one[name]))), (0, 0)), "edge") for one in found]
        return torch.from_numpy(np.stack(parts).astype(np.float32))

    known = torch.tensor([[step < len(one["action"]) - 1 for step in range(rows - 1)] for one in found])
    low, high = (torch.as_tensor(limit) for limit in spec.action_limits)
    actions = padded("action", rows - 1).clamp(low, high)
    return Trials(padded("qpos", rows), padded("qvel", rows), actions, known, idle(spec, len(found)))


def _halves(trials: Trials, count: int) -> tuple[Trials, Trials]:
    """Episodes to learn from, at most `count` and half of all, and those after the first half, which are held out."""
    half = len(trials.actions) // 2
    return trials[: min(count, half)], trials[half:]


@torch.no_grad()
def open_loop(world: World | None, held: Trials, seed: int) -> dict[int, Figure]:
    """The mean distance of the joints after so many steps under the recorded actions; None stands still."""
    batch, state = len(held.actions), None
    if world is not None:
        state = placed(
            world, world.start(batch, make_rng(seed)), held.actions[:, :PAST], held.qpos[:, PAST], held.qvel[:, PAST]
        )
    found = {}
    for step in range(min(max(HORIZONS), held.actions.shape[1] - PAST)):
        at = PAST + step
        if state is not None and world is not None:
            state = world.imagine(state, held.actions[:, at], make_rng(seed))
        known = held.known[:, : at + 1].all(1)
        if step + 1 in HORIZONS and known.any():
            mine = held.qpos[:, PAST] if world is None or state is None else world.render(state, ("qpos",))["qpos"]
            away = (mine - held.qpos[:, at + 1]).square().mean(1).sqrt()[known]
            found[step + 1] = mean_interval(away, make_rng(seed))
    return found


TRIED = 256  # actions that are tried at each moment


@torch.no_grad()
def agreement(world: World, held: Trials, seed: int) -> Figure:
    """How far the action that leads a world from one recorded moment nearest to the next is from the recorded one, in shares of
    the range; of some moments."""
    rng, rows = make_rng(seed), held.known[:, PAST:].nonzero()
    episode, at = rows[torch.randint(len(rows), (32,), generator=rng)].T
    at, past = at + PAST, held.past()
    each = torch.arange(len(at)).repeat_interleave(TRIED)
    state = placed(
        world,
        world.start(len(each), rng),
        past[episode, at][each],
        held.qpos[episode, at][each],
        held.qvel[episode, at][each],
    )
    tried = world.spec.sample_action(len(each), rng)
    after = world.render(world.imagine(state, tried, rng), ("qpos", "qvel"))
    unit = {name: getattr(held, name)[:, :-1][held.known].std(0).clamp_min(1e-6) for name in ("qpos", "qvel")}
    away = sum(
        ((after[name] - getattr(held, name)[episode, at + 1][each]) / unit[name]).square().mean(1) for name in unit
    )
    best = torch.as_tensor(away).view(-1, TRIED).argmin(1) + TRIED * torch.arange(len(at))
    return _apart(world, tried[best], held.actions[episode, at], seed)


def _floors(world: World, held: Trials, seed: int) -> dict[str, Figure]:
    actions = held.actions[held.known]
    return {
        RANDOM: _apart(world, world.spec.sample_action(len(actions), make_rng(seed)), actions, seed),
        IDLE: _apart(world, idle(world.spec, len(actions)), actions, seed),
    }


def _apart(world: World, one: torch.Tensor, other: torch.Tensor, seed: int) -> Figure:
    low, high = (torch.as_tensor(limit) for limit in world.spec.action_limits)
    return mean_interval(((one - other).abs() / (high - low)).flatten(1).mean(1), make_rng(seed))


def _plain(value):
    """Figures as JSON."""
    if isinstance(value, Figure):
        return sound({"value": value.value, "low": value.low, "high": value.high, "count": value.count})
    return {name: _plain(one) for name, one in value.items()} if isinstance(value, dict) else value
