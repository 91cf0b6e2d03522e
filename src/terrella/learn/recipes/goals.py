"""train goals: a goal-conditioned policy in the latents of a world, from the recording that the world was learned of; see
objectives/goals.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...act.actor import RUN_SUBFOLDER
from ...act.distributions import SquashedGaussian
from ...act.goal_network import GoalActor, GoalConfig, GoalNetwork
from ...core.errors import TrainingError
from ...core.world import World, make_rng
from ...data import Dataset
from ..feeds import Drawn
from ..latent_validation import evidence
from ..objectives.goals import GoalReaching, Trajectories, action_error
from ..recording import Recording
from ..trainer import Report, Run, Trainer
from .policy import device_of

STAGE = "goals"
AT_ONCE, TRIED = 256, 2048
HELD_AHEAD = (1, 5, 25)  # steps to goals of held-out episodes


@dataclass(frozen=True)
class GoalTraining:
    """Settings of a goal-conditioned policy.

    Args:
        farthest: Steps to a goal at most.
        hidden: Width of the networks' layers.
        steps: Training steps.
        batch: Moves per step.
        learning_rate: Highest learning rate.
        save_every_s: Seconds between saves.
        seed: Random seed.
    """

    farthest: int = 50
    hidden: int = 256
    steps: int = 4000
    batch: int = 512
    learning_rate: float = 1e-3
    save_every_s: float = 60.0
    seed: int = 0


def train_goals(
    world: World, name: str, recording: str | Path, out: str | Path, config: GoalTraining, report: Report
) -> dict[str, Any]:
    """Trains, or goes on with, the policy in `out`/policy. Returns its facts."""
    if min(config.farthest - 1, config.hidden, config.steps, config.batch) < 1:
        raise TrainingError("--farthest is 2 or more; --hidden, --steps and --batch are 1 or more.")
    run = Run.of(out, config, report, device_of(world), practised_in=name, recording=str(recording))
    run.found(STAGE)
    torch.manual_seed(config.seed)
    network = GoalNetwork(GoalConfig.of(world.spec, config.farthest, config.hidden)).to(run.device)
    opened = _opened(world, recording, report)
    latents = _latents(world, opened, report)
    seen, held = (_trajectories(opened, latents, which, config.farthest) for which in (opened.seen, opened.held_out))
    feed = Drawn(lambda now: seen.drawn(config.batch, now.rng))
    trainer = Trainer(run, STAGE, feed, GoalReaching(network, config.learning_rate), config.steps)
    card = {"what": f"A goal-conditioned policy in the latents of {world.spec.name}", "learned_in": name}

    def save() -> None:
        GoalActor(network, world.spec, card=card).save(Path(out) / RUN_SUBFOLDER)

    try:
        trainer.train(save)
    finally:
        save()
    explained = _explained(network, held if len(held.rows) else seen)
    return {**trainer.summary, **card, "action_explained": explained, "policy": str(Path(out) / RUN_SUBFOLDER)}


def _opened(world: World, recording: str | Path, report: Report) -> Recording:
    dataset, shape = Dataset(recording), world.spec.channels["rgb"].shape if "rgb" in world.spec.channels else None
    size = (shape[0], shape[1]) if shape else (64, 64)
    return Recording.open(dataset, size, report, needs=("action",), why="hindsight needs what was done").enough()


@torch.inference_mode()
def _latents(world: World, recording: Recording, report: Report) -> torch.Tensor:
    """Of all rows, each seen alone, as goals are: [R, D]."""
    length, found = recording.cache.length, []
    for first in range(0, length, AT_ONCE):
        rows = np.arange(first, min(first + AT_ONCE, length))
        state = world.observe(evidence(world, recording, rows), None, make_rng(0))
        found.append(world.render(state, ("latent",))["latent"])
        report(rows[-1] + 1, length, "showing the world what was recorded")
    return torch.cat(found).clone()


def _trajectories(recording: Recording, latents: torch.Tensor, episodes, farthest: int) -> Trajectories:
    cache = recording.cache
    ends, rows = np.zeros(cache.length, np.int64), np.zeros(cache.length, bool)
    for first, last in cache.episodes:
        ends[first:last] = last - 1
    for number in episodes:
        rows[slice(*cache.episodes[number])] = True
    rows &= np.asarray(cache.action_valid).reshape(-1)
    actions = recording.action(np.arange(cache.length)).to(latents.device)
    return Trajectories(latents, actions, ends, np.flatnonzero(rows), farthest)


@torch.no_grad()
def _explained(network: GoalNetwork, held: Trajectories) -> dict[str, float]:
    """By steps to the goal, the share of held-out actions' variance (of choices: of their nats) that the policy explains."""
    found = {}
    for steps in HELD_AHEAD:
        if (held.ends[held.rows] - held.rows < steps).all() or steps > network.config.farthest:
            continue
        batch = held.drawn(TRIED, np.random.default_rng(0), steps)
        told = network(batch.latent, batch.goal, batch.steps)
        error = float(action_error(told, batch.action, network.config.actor.counts))
        usual = batch.action.mean(0)
        if isinstance(told, SquashedGaussian):
            blind = float((batch.action - usual).square().mean())
        else:
            blind = float(torch.special.entr(usual).sum())
        found[str(steps)] = round(1 - error / max(blind, 1e-9), 4)
    return found
