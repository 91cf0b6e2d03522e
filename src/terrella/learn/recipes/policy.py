"""train policy: reinforcement learning in a world, learned or a simulator; see objectives/actor_critic.py and ppo.py."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from ...act.actor import RUN_SUBFOLDER, Actor
from ...act.actor_network import ActorConfig, ActorNetwork
from ...core.errors import ChannelError, TrainingError
from ...core.spec import BUTTONS, CHOICE, Spec
from ...core.world import World
from ...data import Dataset
from ..growth import Growth, Scaled
from ..imagination import ContinuedEpisodes, Imagination, RecordedStarts, check_practised, recorded_starts
from ..objectives.actor_critic import ActorCritic, Critic, ReturnConfig
from ..objectives.ppo import Ppo
from ..recording import Recording
from ..run_folder import load_run, resume_file
from ..trainer import Objective, Report, Run, Trainer

STAGE = "practice"
DEFAULT_MINUTES = 5.0
ENDLESS = 10**9  # steps: practice ends with its time
LONGEST = 64  # steps of an episode from a learned world's own starts
UNSEEN_SIDE = 64  # pixels of a recording whose pictures are not used


@dataclass(frozen=True)
class Practice:
    """Settings of a policy's training by reinforcement learning."""

    # Channels that the policy observes. Default: the vectors that the world observes, else its latent; of a simulator its
    # observation.
    sees: tuple[str, ...] = ()
    # Minutes of training, earlier runs included. Default: 5, unless --steps is given.
    minutes: float | None = None
    steps: int | None = None  # Training steps, each on one batch of rollouts.
    # "ppo" takes several epochs over each batch (objectives/ppo.py), "actor-critic" one gradient step, as in DreamerV3
    # (objectives/actor_critic.py), "imitation" learns from the actions of a recording alone. Default: ppo in a simulator that
    # steps many episodes together, as mujoco: does, else actor-critic.
    method: Literal["actor-critic", "ppo", "imitation"] | None = None
    # Episodes in parallel. Default: 256.
    batch: int | None = None
    # Horizon: steps of a rollout. Default: 16, for ppo 24.
    horizon: int | None = None
    discount: float = 0.99  # Discount factor, gamma.
    # Lambda of the lambda-returns (of GAE in ppo), from 0 (one-step bootstrapping) to 1 (the return of the whole rollout).
    td_lambda: float = 0.95
    # Coefficient of the entropy bonus, relative to the range of returns (for ppo to normalised advantages). Default: 3e-4, for
    # ppo 2e-3.
    entropy: float | None = None
    # --no-gradients: with continuous actions use REINFORCE, although the world is differentiable.
    gradients: bool = True
    # Expected error of what the world invents (of a latent world: its uncertainty) at which a rollout ends. Default: the world's
    # own threshold for invented content, if it declares one.
    trust: float | None = None
    # Where --trust ends a rollout, bootstrap from the lowest value in the batch instead of the critic's estimate.
    cautious: bool = False
    hidden: int = 128  # Width of the networks' layers.
    learning_rate: float = 1e-3  # Peak learning rate.
    save_every_s: float = 30.0  # Seconds between saves.
    seed: int = 0  # Random seed.


@dataclass(frozen=True)
class PracticeSettings(Practice):
    """The same, with the defaults of the method filled in."""

    batch: int = 256
    horizon: int = 16
    entropy: float = 3e-4

    @staticmethod
    def of(config: Practice, ppo: bool) -> PracticeSettings:
        given = {name: value for name, value in asdict(config).items() if value is not None}
        return PracticeSettings(**({"horizon": 24, "entropy": 2e-3} if ppo else {}) | given)


def settings_in(world: World, practice: Practice) -> tuple[PracticeSettings, bool]:
    """The settings with which a policy practises in this world, and whether it does by ppo."""
    ppo = (practice.method or ("ppo" if world.spec.card.get("together") else "actor-critic")) == "ppo"
    return PracticeSettings.of(practice, ppo), ppo


def train_policy(
    world: World,
    name: str,
    out: str | Path,
    practice: Practice,
    report: Report,
    recording: str | Path | None = None,
    before: Path | None = None,
    growing: Scaled | None = None,
) -> dict[str, Any]:
    """Trains, or resumes, a policy in `world`; it is in `out`/policy from the first save on. Returns the facts of the run.

    recording: where rollouts begin; without one, at the world's own starts. before: the folder of an earlier run, whose networks
    initialise those of a new one. growing: a world whose randomisation ranges widen with the policy's success. ChannelError and
    TrainingError for what cannot be trained.
    """
    spec, out = world.spec, Path(out)
    config, ppo = settings_in(world, practice)
    _check(config)
    check_practised(spec)
    sees = config.sees or default_channels(spec)
    torch.manual_seed(config.seed)
    shape = ActorConfig.of(spec, sees, config.hidden)
    actor, critic = ActorNetwork(shape), Critic(shape)
    _check_writable(out)
    facts: dict[str, Any] = {"practised_in": name, "begins_in": str(recording or "")}
    facts |= {} if growing is None else {"growing": True}
    run = Run.of(out, config, report, device_of(world), ("minutes",), **facts)
    run = replace(run, strip_every_s=config.save_every_s)  # when the policy is written
    is_new = run.saved_facts(STAGE) is None
    growth = None if growing is None else Growth(growing)
    if growth is not None:
        growth.set()  # the first episodes, too, begin with empty ranges
    starts = _starts(world, config, recording, report)
    trust = config.trust if config.trust is not None else _inventing_level(spec)
    gradients = not ppo and config.gradients and spec.differentiable and spec.action_mode not in (BUTTONS, CHOICE)
    observations = starts.sample(sees)
    for network in (actor, critic):
        network.to(run.device).eyes.fit_normalization(observations)
    kept = {**starts.modules, **({} if growth is None else {"growth": growth})}
    objective = _objective(actor, critic, config, ppo, gradients, kept)
    if before is not None and is_new:
        networks = {part: one for part, one in objective.modules.items() if part in ("actor", "critic", "slow")}
        load_run(resume_file(before, STAGE), networks, {})
    feed = Imagination(world, actor, starts, config.horizon, gradients, trust, growth)
    trainer = Trainer(run, STAGE, feed, objective, config.steps or ENDLESS)
    trainer.limit_s = 60 * (config.minutes or (math.inf if config.steps else DEFAULT_MINUTES))

    def save() -> None:
        Actor(actor, spec, card=_card(trainer, name, spec, config)).save(out / RUN_SUBFOLDER)

    try:
        trainer.train(save)
    finally:
        save()
    grown = {} if growth is None else {"ranges_grown_to": round(float(growth.scale), 2)}
    return {**trainer.summary, **_card(trainer, name, spec, config), **grown, "policy": str(out / RUN_SUBFOLDER)}


def _objective(
    actor: ActorNetwork,
    critic: Critic,
    config: PracticeSettings,
    ppo: bool,
    gradients: bool,
    more: dict[str, nn.Module],
) -> Objective:
    returns = ReturnConfig(config.discount, config.td_lambda, config.entropy, config.cautious)
    if ppo:
        return Ppo(actor, critic, returns, config.learning_rate, more)
    return ActorCritic(actor, critic, returns, config.learning_rate, gradients, more)


def default_channels(spec: Spec) -> tuple[str, ...]:
    """The channels that a policy observes: the vectors that a learned world observes, else its latent; of a simulator its
    observation, else its pictures."""
    observed = (*spec.observes, *spec.may_observe)
    vectors = tuple(name for name in observed if len(spec.channels[name].shape or ()) == 1)
    if vectors and "rgb" not in spec.observes:
        return vectors
    default = next((name for name in ("latent", "observation", "rgb") if name in spec.channels), None)
    if default is None:
        raise ChannelError(f"say what the policy sees with --sees; {spec.name} has {', '.join(spec.channels)}.")
    return (default,)


def device_of(world: World) -> torch.device:
    """Where a world computes; a simulator, on the CPU."""
    return getattr(world, "device", torch.device("cpu"))


def _starts(
    world: World, config: PracticeSettings, recording: str | Path | None, report: Report
) -> RecordedStarts | ContinuedEpisodes:
    if recording is None:
        longest = LONGEST if world.spec.observes else world.spec.max_episode_steps or 1000
        return ContinuedEpisodes(world, config.batch, max(longest, config.horizon), config.seed)
    dataset = Dataset(recording)
    drawn = world.spec.channels["rgb"].shape if "rgb" in world.spec.observes else None
    size = (drawn[0], drawn[1]) if drawn else (UNSEEN_SIDE, UNSEEN_SIDE)
    opened = Recording.open(
        dataset, size, report, needs=("action",), why="rollouts begin between actions"
    ).require_rows()
    report(0, 1, "encoding the states in which rollouts begin")
    return RecordedStarts(world, recorded_starts(world, opened), config.batch)


def _inventing_level(spec: Spec) -> float | None:
    """The uncertainty above which the content of a frame is invented, by the world's card; None if the card has no such level."""
    levels = spec.card.get("uncertainty")
    if "uncertainty" not in spec.channels or not isinstance(levels, Mapping):
        return None
    level = levels.get("invents")
    return float(level) if isinstance(level, int | float) else None


def _card(trainer: Trainer, name: str, spec: Spec, config: PracticeSettings) -> dict[str, Any]:
    steps = trainer.steps_done
    return {
        "what": f"A policy that practised in {spec.name}",
        "practised_in": name,
        "practised_steps": steps * min(config.batch, trainer.facts.get("batch", config.batch)) * config.horizon,
        "minutes": round(trainer.facts["seconds"] / 60, 2),
    }


def _check_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / ".probe").touch()
        (out / ".probe").unlink()
    except OSError as error:
        why = error.strerror or str(error)
        raise TrainingError(f"{out} cannot be written ({why}); give another --out.") from error


def _check(config: PracticeSettings) -> None:
    counts = (config.batch, config.horizon, config.hidden, 1 if config.steps is None else config.steps)
    if any(count < 1 for count in counts) or not (config.minutes is None or config.minutes > 0):
        raise TrainingError("--batch, --horizon, --hidden and --steps are 1 or more, and --minutes is above 0.")
    if not (0 < config.discount < 1 and 0 <= config.td_lambda <= 1 and config.entropy >= 0):
        raise TrainingError("--discount is between 0 and 1, --td-lambda from 0 to 1, and --entropy is 0 or more.")
