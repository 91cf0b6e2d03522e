"""train goals: a goal-conditioned policy in the latents of a world, from the recording of the world; see objectives/goals.py."""

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
from ..feeds import RandomBatches
from ..latent_validation import observation_at
from ..objectives.goals import GoalReaching, Trajectories, action_error
from ..recording import Recording
from ..sized_feed import SizedFeed
from ..trainer import Report, Run, Trainer
from .policy import device_of

STAGE = "goals"
BATCH, TESTED = 256, 2048  # rows that are encoded at once, and samples of a test
TEST_STEPS = (1, 5, 25)  # to goals in held-out episodes


@dataclass(frozen=True)
class GoalTraining:
    """Settings of a goal-conditioned policy."""

    farthest: int = 50  # Largest number of steps from a state to its goal.
    hidden: int = 256  # Width of the networks' layers.
    steps: int = 4000  # Training steps.
    batch: int = 512  # Samples per step.
    learning_rate: float = 1e-3  # Peak learning rate.
    save_every_s: float = 60.0  # Seconds between saves.
    seed: int = 0  # Random seed.


def train_goals(
    world: World, name: str, recording: str | Path, out: str | Path, config: GoalTraining, report: Report
) -> dict[str, Any]:
    """Trains, or resumes, the policy in `out`/policy. Returns the facts of the run."""
    if min(config.farthest - 1, config.hidden) < 1:
        raise TrainingError("--farthest is 2 or more, and --hidden 1 or more.")
    run = Run.of(out, config, report, device_of(world), practised_in=name, recording=str(recording))
    run.saved_facts(STAGE)
    torch.manual_seed(config.seed)
    network = GoalNetwork(GoalConfig.of(world.spec, config.farthest, config.hidden)).to(run.device)
    opened = _opened(world, recording, report)
    latents = _latents(world, opened, report)
    seen, held = (_trajectories(opened, latents, which, config.farthest) for which in (opened.seen, opened.held_out))
    feed = SizedFeed(lambda size: RandomBatches(lambda now: seen.sample(size, now.rng)), config.batch)
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
    return Recording.open(
        dataset, size, report, needs=("action",), why="a policy is learned from the actions that reached goals"
    ).require_rows()


@torch.inference_mode()
def _latents(world: World, recording: Recording, report: Report) -> torch.Tensor:
    """The latents of all rows [R, D], each encoded alone, as goals are."""
    length, parts = recording.cache.length, []
    for first in range(0, length, BATCH):
        rows = np.arange(first, min(first + BATCH, length))
        state = world.observe(observation_at(world, recording, rows), None, make_rng(0))
        parts.append(world.render(state, ("latent",))["latent"])
        report(rows[-1] + 1, length, "encoding the recording")
    return torch.cat(parts).clone()


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
    """By steps to the goal, the share of the variance of held-out actions (of the entropy of choices) that the policy explains."""
    explained = {}
    for steps in TEST_STEPS:
        if (held.ends[held.rows] - held.rows < steps).all() or steps > network.config.farthest:
            continue
        batch = held.sample(TESTED, np.random.default_rng(0), steps)
        distribution = network(batch.latent, batch.goal, batch.steps)
        error = float(action_error(distribution, batch.action, network.config.actor.counts))
        mean = batch.action.mean(0)
        if isinstance(distribution, SquashedGaussian):
            baseline = float((batch.action - mean).square().mean())
        else:
            baseline = float(torch.special.entr(mean).sum())
        explained[str(steps)] = round(1 - error / max(baseline, 1e-9), 4)
    return explained
