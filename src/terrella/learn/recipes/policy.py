"""train policy: practice in a world, learned or a simulator; see objectives/actor_critic.py."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from ...act.actor import RUN_SUBFOLDER, Actor
from ...act.actor_network import ActorConfig, ActorNetwork
from ...core.errors import ChannelError, TrainingError
from ...core.spec import BUTTONS, CHOICE, Spec
from ...core.world import World
from ...data import Dataset
from ..growth import Growth, Scaled
from ..imagination import Continued, Imagination, Recorded, check_practised, recorded_starts
from ..objectives.actor_critic import ActorCritic, Critic, Wanted
from ..objectives.ppo import Ppo
from ..recording import Recording
from ..run_folder import load_run, resume_file
from ..trainer import Objective, Report, Run, Trainer

STAGE = "practice"
UNLESS_SAID_MIN = 5.0
ENDLESS = 10**9  # steps: practice ends with its time
LONGEST = 64  # steps of a dream that begins at a learned world's own starts
UNSEEN_SIDE = 64  # pixels of a recording whose pictures nobody looks at


@dataclass(frozen=True)
class Practice:
    """Settings of a policy's practice.

    Args:
        sees: Channels that the policy sees. Default: the numbers that the world observes, else its latent; of a simulator its
            observation.
        minutes: Minutes of practice, earlier runs included. Default: 5, unless --steps are said.
        steps: Steps of training, each on a batch of dreams.
        method: "ppo" makes several passes over each batch (objectives/ppo.py), "actor-critic" one (objectives/actor_critic.py).
            Default: ppo in a simulator that steps worlds together, as mujoco: does, else actor-critic.
        batch: Dreams at a time. Default: 256.
        horizon: Steps of a dream. Default: 16, of ppo 24.
        discount: Of a reward a step later.
        td_lambda: Lambda, of the returns: 0 the critic's word after one step, 1 what came to the end of the dream.
        entropy: What a nat of chance in the actions is worth, in ranges of returns (of ppo, in their deviations). Default: 3e-4,
            of ppo 2e-3.
        gradients: Of axes, follow the world's own gradients where it has some. --no-gradients learns from what paid.
        trust: The world's uncertainty at which a dream ends. Default: as the world says that it invents, if it does.
        cautious: What lies beyond counts as the worst that the critic expects anywhere, in place of its word there.
        hidden: Width of the networks' layers.
        learning_rate: Highest learning rate.
        save_every_s: Seconds between saves.
        seed: Random seed.
    """

    sees: tuple[str, ...] = ()
    minutes: float | None = None
    steps: int | None = None
    method: Literal["actor-critic", "ppo"] | None = None
    batch: int | None = None
    horizon: int | None = None
    discount: float = 0.99
    td_lambda: float = 0.95
    entropy: float | None = None
    gradients: bool = True
    trust: float | None = None
    cautious: bool = False
    hidden: int = 128
    learning_rate: float = 1e-3
    save_every_s: float = 30.0
    seed: int = 0


@dataclass(frozen=True)
class Settled(Practice):
    """The same with what was not said: as actor-critic needs it, or PPO."""

    batch: int = 256
    horizon: int = 16
    entropy: float = 3e-4

    @staticmethod
    def of(config: Practice, ppo: bool) -> Settled:
        said = {name: value for name, value in asdict(config).items() if value is not None}
        return Settled(**({"horizon": 24, "entropy": 2e-3} if ppo else {}) | said)


def train_policy(
    world: World,
    name: str,
    out: str | Path,
    said: Practice,
    report: Report,
    recording: str | Path | None = None,
    before: Path | None = None,
    growing: Scaled | None = None,
) -> dict[str, Any]:
    """Practises in `world`, or goes on with it; the policy lies in `out`/policy from the first save on. Returns its facts.

    recording: where dreams begin; without one, at the world's own starts. before: the folder of an earlier run, whose networks a
    new one begins with. growing: whose ranges grow while the policy copes. ChannelError and TrainingError for what cannot be.
    """
    spec, out = world.spec, Path(out)
    ppo = (said.method or ("ppo" if spec.card.get("together") else "actor-critic")) == "ppo"
    config = Settled.of(said, ppo)
    _check(config)
    check_practised(spec)
    sees = config.sees or seen_unless_said(spec)
    torch.manual_seed(config.seed)
    shape = ActorConfig.of(spec, sees, config.hidden)
    actor, critic = ActorNetwork(shape), Critic(shape)
    _writable(out)
    facts: dict[str, Any] = {"practised_in": name, "begins_in": str(recording or "")}
    facts |= {} if growing is None else {"growing": True}
    run = Run.of(out, config, report, device_of(world), ("minutes",), **facts)
    run = replace(run, strip_every_s=config.save_every_s)  # when the policy is written
    begun = run.found(STAGE) is not None
    growth = None if growing is None else Growth(growing)
    if growth is not None:
        growth.set()  # the first episodes, too, begin with ranges of nothing
    starts = _starts(world, config, recording, report)
    trust = config.trust if config.trust is not None else _invents(spec)
    gradients = not ppo and config.gradients and spec.differentiable and spec.action_mode not in (BUTTONS, CHOICE)
    usual = starts.usual(sees)
    for network in (actor, critic):
        network.to(run.device).eyes.fit_normalization(usual)
    kept = {**starts.modules, **({} if growth is None else {"growth": growth})}
    wanted = Wanted(config.discount, config.td_lambda, config.entropy, config.cautious)
    objective: Objective = (
        Ppo(actor, critic, wanted, config.learning_rate, kept)
        if ppo
        else ActorCritic(actor, critic, wanted, config.learning_rate, gradients, kept)
    )
    if before is not None and not begun:
        networks = {name: one for name, one in objective.modules.items() if name in ("actor", "critic", "slow")}
        load_run(resume_file(before, STAGE), networks, {})
    feed = Imagination(world, actor, starts, config.horizon, gradients, trust, growth)
    trainer = Trainer(run, STAGE, feed, objective, config.steps or ENDLESS)
    minutes = config.minutes or (math.inf if config.steps else UNLESS_SAID_MIN)
    trainer.limit_s = 60 * minutes

    def save() -> None:
        Actor(actor, spec, card=_card(trainer, name, spec, config)).save(out / RUN_SUBFOLDER)

    try:
        trainer.train(save)
    finally:
        save()
    grown = {} if growth is None else {"ranges_grown_to": round(float(growth.scale), 2)}
    return {**trainer.summary, **_card(trainer, name, spec, config), **grown, "policy": str(out / RUN_SUBFOLDER)}


def seen_unless_said(spec: Spec) -> tuple[str, ...]:
    """The channels that a policy sees: numbers of which a learned world takes evidence, else its latent; of a simulator its
    observation, else its pictures."""
    evidence = (*spec.observes, *spec.may_observe)
    numbers = tuple(name for name in evidence if len(spec.channels[name].shape or ()) == 1)
    if numbers and "rgb" not in spec.observes:
        return numbers
    found = next((name for name in ("latent", "observation", "rgb") if name in spec.channels), None)
    if found is None:
        raise ChannelError(f"say what the policy sees with --sees; {spec.name} has {', '.join(spec.channels)}.")
    return (found,)


def device_of(world: World) -> torch.device:
    """Where a world computes; a simulator, on the CPU."""
    return getattr(world, "device", torch.device("cpu"))


def _starts(world: World, config: Settled, recording: str | Path | None, report: Report) -> Recorded | Continued:
    if recording is None:
        longest = LONGEST if world.spec.observes else world.spec.max_episode_steps or 1000
        return Continued(world, config.batch, max(longest, config.horizon), config.seed)
    dataset = Dataset(recording)
    drawn = world.spec.channels["rgb"].shape if "rgb" in world.spec.observes else None
    size = (drawn[0], drawn[1]) if drawn else (UNSEEN_SIDE, UNSEEN_SIDE)
    opened = Recording.open(dataset, size, report, needs=("action",), why="dreams begin between actions").enough()
    report(0, 1, "showing the world where dreams begin")
    return Recorded(world, recorded_starts(world, opened), config.batch)


def _invents(spec: Spec) -> float | None:
    """The uncertainty from which a world says that it invents; None where it says nothing."""
    told = spec.card.get("uncertainty")
    if "uncertainty" not in spec.channels or not isinstance(told, Mapping):
        return None
    level = told.get("invents")
    return float(level) if isinstance(level, int | float) else None


def _card(trainer: Trainer, name: str, spec: Spec, config: Settled) -> dict[str, Any]:
    steps = trainer.taken
    return {
        "what": f"A policy that practised in {spec.name}",
        "practised_in": name,
        "practised_steps": steps * config.batch * config.horizon,
        "minutes": round(trainer.facts["seconds"] / 60, 2),
    }


def _writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / ".probe").touch()
        (out / ".probe").unlink()
    except OSError as error:
        why = error.strerror or str(error)
        raise TrainingError(f"{out} cannot be written ({why}); give another --out.") from error


def _check(config: Settled) -> None:
    counts = (config.batch, config.horizon, config.hidden, 1 if config.steps is None else config.steps)
    if any(count < 1 for count in counts) or not (config.minutes is None or config.minutes > 0):
        raise TrainingError("--batch, --horizon, --hidden and --steps are 1 or more, and --minutes is above 0.")
    if not (0 < config.discount < 1 and 0 <= config.td_lambda <= 1 and config.entropy >= 0):
        raise TrainingError("--discount is between 0 and 1, --td-lambda from 0 to 1, and --entropy is 0 or more.")
