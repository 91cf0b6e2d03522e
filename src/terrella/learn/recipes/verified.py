"""practise: fine-tunes a learned policy in a world by rewards that a rule computes; see verified_rollouts.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...act import imitation
from ...act.actor import KIND as ACTOR
from ...act.actor import RUN_SUBFOLDER, Actor
from ...act.imitation import ImitationActor
from ...act.lerobot_policy import kind_of_policy
from ...act.planning import SuccessCriterion
from ...core.errors import PlanningError, TrainingError
from ...core.world import World, make_rng
from ...data import Dataset
from ..objectives.group_relative import GroupRelative
from ..paired import fingerprint
from ..recording import Recording
from ..train_step import TrainStep
from ..trainer import Report, Run, Trainer
from ..verified_rollouts import ReferenceStarts, VerifiedRollouts, WorldStarts
from .policy import DEFAULT_MINUTES, ENDLESS, UNSEEN_SIDE, device_of

STAGE = "verified practice"
PROBED = 4  # batches that are imagined before training, to see whether there is anything to learn


@dataclass(frozen=True)
class VerifiedPractice:
    """Settings of practice by verified rewards."""

    minutes: float | None = None  # Minutes of training, earlier runs included. Default: 5, unless --updates is given.
    updates: int | None = None  # Training steps, each on one batch of groups.
    groups: int = 32  # Starts in a batch.
    group_size: int = 8  # Rollouts from each start, whose mean reward is the baseline.
    noise: float = 0.15  # Standard deviation of the noise on continuous actions while it practises, in half ranges.
    learning_rate: float = 2e-3  # Peak learning rate.
    save_every_s: float = 30.0  # Seconds between saves.
    seed: int = 0  # Random seed.


@dataclass(frozen=True)
class RewardRule:
    """What is rewarded within `steps` steps: that the criterion is met; without one the return; with a reference, a recording, that
    the rollouts stay near to its episodes."""

    criterion: SuccessCriterion
    steps: int
    reference: str | Path | None = None


Practised = ImitationActor | Actor


def load_practised(folder: str | Path, world: World, std: float) -> Practised:
    """The policy of a folder, which draws its actions. TrainingError for a kind that cannot be fine-tuned; ActionError or
    ChannelError if it does not fit the world."""
    kind = kind_of_policy(folder)
    if kind == imitation.KIND:
        loaded = ImitationActor.load(folder, world.spec)
        return ImitationActor(loaded.network, world.spec, loaded.card, std)
    if kind == ACTOR:
        return Actor.load(folder, world.spec, greedy=False)
    raise TrainingError(
        f"{folder} is a policy of kind '{kind}'; practice fine-tunes policies by `train policy`, imitating or not."
    )


def practise_verified(
    world: World,
    policy: str | Path,
    out: str | Path,
    config: VerifiedPractice,
    rule: RewardRule,
    report: Report,
    blind: bool = False,
) -> dict[str, Any]:
    """Fine-tunes, or continues to fine-tune, the policy of a folder; it is in `out`/policy from the first save on. Returns the
    facts of the run.

    blind: the policy sees nothing of the world. TrainingError, PlanningError, ActionError, ChannelError or DatasetError for what
    cannot be practised.
    """
    _check(config)
    criterion, steps = rule.criterion, rule.steps
    out, actor = Path(out), load_practised(policy, world, config.noise)
    torch.manual_seed(config.seed)
    network = actor.network.requires_grad_(True)
    facts = {"policy": str(policy), "steps of a rollout": steps, "reference": str(rule.reference or ""), "blind": blind}
    goal = {name: str(value.tolist()) for name, value in criterion.goal.items()}  # as text, for NaN is not NaN
    facts |= {"goal": goal, "within": criterion.within, "weights of the policy": fingerprint(network)}
    run = Run.of(out, config, report, device_of(world), ("minutes", "updates"), success=criterion.channel, **facts)
    starts = WorldStarts(world) if rule.reference is None else _references(world, rule.reference, steps, report)
    feed = VerifiedRollouts(world, actor, starts, criterion, steps, (config.groups, config.group_size), blind)
    if not blind and run.saved_facts(STAGE) is None:  # a blind arm may well learn nothing
        check_rewards(feed, criterion, report)
    network.to(run.device)
    trainer = Trainer(
        run, STAGE, feed, GroupRelative(network, config.learning_rate, config.noise), config.updates or ENDLESS
    )
    trainer.limit_s = 60 * (config.minutes or (math.inf if config.updates else DEFAULT_MINUTES))
    card = {
        **actor.card,
        "what": f"A policy that practised in {world.spec.name} by verified rewards",
        "began as": str(policy),
    }

    def save() -> None:
        if isinstance(actor, ImitationActor):
            ImitationActor.write(actor.network, out / RUN_SUBFOLDER, card)
        else:
            Actor(actor.network, actor.spec, card=card).save(out / RUN_SUBFOLDER)

    try:
        trainer.train(save)
    finally:
        save()
    return {**trainer.summary, **card, "policy": str(out / RUN_SUBFOLDER)}


def check_rewards(feed: VerifiedRollouts, criterion: SuccessCriterion, report: Report) -> None:
    """PlanningError where the rewards of imagined rollouts never differ, so that practice could learn nothing."""
    rewards = []
    for number in range(PROBED):
        report(number, PROBED, "imagining before practice")
        now = TrainStep(number, 0.0, torch.device("cpu"), np.random.default_rng(number), make_rng(number))
        rewards.append(feed.batch(now).reward)
    reward = torch.cat(rewards)
    if (reward.std(1, correction=0) > 0).any():
        return
    what, name = f"of {reward.numel()} imagined rollouts of the policy", feed.world.spec.name
    if criterion.defined and not reward.any():
        raise PlanningError(
            f"none {what} in {name} succeeds, so there is nothing to reward: is success beyond what the world knows? Give "
            f"{'a larger --within, ' * bool(criterion.goal)}more --steps, or a policy that sometimes succeeds."
        )
    raise PlanningError(
        f"the rewards {what} in {name} are all the same within a group: there is nothing to improve there."
    )


def _references(world: World, recording: str | Path, steps: int, report: Report) -> ReferenceStarts:
    opened = Recording.open(
        Dataset(recording), (UNSEEN_SIDE, UNSEEN_SIDE), report, needs=("action",), why="it is a reference"
    )
    spec = world.spec
    channels = tuple(name for name in (*spec.observes, *spec.may_observe) if len(spec.channels[name].shape or ()) == 1)
    if not channels:
        raise TrainingError(f"{spec.name} observes no numbers in which a distance to {recording} is computed.")
    return ReferenceStarts(world, opened, channels, steps)


def _check(config: VerifiedPractice) -> None:
    counts = config.groups, config.group_size - 1, 1 if config.updates is None else config.updates
    if min(counts) < 1 or not (config.minutes is None or config.minutes > 0):
        raise TrainingError("--groups and --updates are 1 or more, --group-size 2 or more, and --minutes is above 0.")
    if not config.noise > 0:
        raise TrainingError("--noise is above 0: rollouts of a group differ by it.")
