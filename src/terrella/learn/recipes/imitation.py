"""train policy --method imitation: a policy from a recording's demonstrations; see objectives/imitation.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...act.actor import RUN_SUBFOLDER
from ...act.actor_network import ActorConfig
from ...act.embodiment import Embodiment
from ...act.imitation import ImitationActor
from ...act.imitation_network import AXES, ImitationConfig, ImitationNetwork
from ...act.sentences import vocabulary_of
from ...core.errors import DatasetError, TrainingError
from ...core.similar import did_you_mean
from ...core.spec import CHOICE, Spec, is_picture, kind_of
from ...data import Dataset
from ...data.channels import ESTIMATES, PRIVILEGED, usually_seen
from ...data.training.cache import array_for
from ..copycat import copycat
from ..demonstrations import DemonstrationRows, JointDemonstrations
from ..devices import device_named
from ..feeds import RandomBatches
from ..merged import by_body
from ..objectives.imitation import BehaviourCloning
from ..recording import Recording
from ..sized_feed import SizedFeed
from ..trainer import Report, Run, Trainer
from .policy import DEFAULT_MINUTES, ENDLESS, Practice

STAGE = "imitation"
NOT_SEEN = {
    "action",
    "reward",
    "done",
    "truncated",
    "depth",
    "pose",
    "latent",
    *PRIVILEGED,
    *ESTIMATES,
}
NAMED_ONLY = {"pose", "latent", *PRIVILEGED}  # of these, seen by a policy that names them
DISCRETE_CHUNK, AXES_CHUNK = 1, 8  # default chunk of actions
TESTED = 2048  # moments of the final test
UNINSTRUCTED = "explore "  # with which the text of a recording without a task begins


@dataclass(frozen=True)
class Imitation:
    """Settings of imitation beside those of every policy."""

    picture_size: tuple[int, int] = (64, 64)  # Height and width to which pictures are resized.
    history: int = 2  # Observations that the policy sees, the last ones.
    own_actions: bool = False
    """Let the policy see its own last actions as well. Half of the time they are hidden in training."""
    chunk: int | None = None  # Actions that it predicts at once. Default: 8, for buttons and choices 1.
    execute: int | None = None  # Of these, actions that it takes before it predicts anew. Default: half of the chunk.
    remember: int = 0
    """Carry a memory through the episode (a GRU) instead of seeing the last observations; it learns on windows of this many steps.
    Default: 0, none."""
    waypoint: int = 8
    """A policy of cameras, numbers and instructions predicts what its numbers (the place of its hand) will be this many steps
    after an instruction began and at the instruction's end, only from the places to which the instruction attends. 0: not."""
    outcome: bool = False
    """Condition the policy on the return of the episode and ask for the best: failures teach what not to do."""


def train_imitation(
    recording: str | Path | Sequence[str | Path],
    out: str | Path,
    practice: Practice,
    imitation: Imitation,
    report: Report,
    device: str = "auto",
    relabel: Callable[[DemonstrationRows], DemonstrationRows] = lambda rows: rows.advised,
    spec: Spec | None = None,
) -> dict[str, Any]:
    """Trains, or resumes, a policy in `out`/policy that acts as the recording's player did. Returns the facts of the run, with the
    verdict on held-out episodes. relabel: which rows are learned from, with what actions; default: a recorded teacher's (channel
    `expert`), else those that were taken. spec: where it is to act. recording: or several, of one body or of several, which the
    policy tells apart by their embodiments. DatasetError or TrainingError for what cannot be imitated, ActionError or ChannelError
    if it could not act there."""
    out, batch, place = Path(out), practice.batch or 256, device_named(device)
    _check(practice, imitation)
    names = [recording] if isinstance(recording, str | Path) else recording
    if len({str(name) for name in names}) < len(names):
        raise DatasetError("a recording is named twice; name each once.")
    opened = [open_demonstrations(name, practice.sees, imitation.picture_size, report) for name in names]
    several = [(part, sees) for one, sees in opened for part in by_body(one)]
    sees, config = several[0][1], joint_config(several, practice.hidden, imitation)
    recording = ", ".join(map(str, names))
    if spec is not None:
        config.check(spec)
    settings = {**asdict(imitation), "recording": recording}
    run = Run.of(out, practice, report, place, ("minutes",), **settings)
    run.saved_facts(STAGE)
    torch.manual_seed(practice.seed)
    network = ImitationNetwork(config).to(run.device)
    parts = tuple(relabel(DemonstrationRows.of(opened, config, run.device)) for opened, _ in several)
    rows = JointDemonstrations(parts)
    network.fit_normalization(rows.sample(4096, np.random.default_rng(0)).seen)
    objective = BehaviourCloning(network, practice.learning_rate)
    feed = SizedFeed(lambda size: RandomBatches(lambda now: rows.sample(size, now.rng)), batch)
    trainer = Trainer(run, STAGE, feed, objective, practice.steps or ENDLESS)
    trainer.limit_s = 60 * (practice.minutes or (math.inf if practice.steps else DEFAULT_MINUTES))
    taught = all(part.taken is not None for part in parts)
    whom = f"the teacher (channel 'expert') in {recording}" if taught else recording
    card = {"what": f"A policy that imitates {whom}", "learned_from": recording, "sees": list(sees)}
    card |= {"bodies": [body.name for body in config.bodies]} if config.bodies else {}

    def save() -> None:
        ImitationActor.write(network, out / RUN_SUBFOLDER, card)

    try:
        trainer.train(save)
    finally:
        save()
    tested = [copycat(network.eval(), part.held_out, TESTED) for part in parts]
    if len(parts) > 1:
        names = [f"{part.recording.name} ({part.recording.embodiment})" for part in parts]
        verdicts = [f"{name}: {test['held_out_verdict']}" for name, test in zip(names, tested)]
        shares = {name: test.get("held_out") for name, test in zip(names, tested)}
        tested = [{"held_out": shares, "held_out_verdict": "\n".join(verdicts)}]
    return {**trainer.summary, **card, **tested[0], "policy": str(out / RUN_SUBFOLDER)}


def open_demonstrations(
    recording: str | Path,
    sees: Sequence[str],
    size: tuple[int, int],
    report: Report,
    needs: tuple[str, ...] = ("action",),
) -> tuple[Recording, tuple[str, ...]]:
    """The recording, and the channels that a policy sees of it: these, or by default all cameras, codes and numbers."""
    dataset = Dataset(recording)
    cameras = [name for name in (sees or dataset.channels) if dataset.feature(name) in dataset.cameras]
    why = "a policy imitates the actions of a recording"
    opened = Recording.open(dataset, size, report, needs=needs, why=why, cameras=cameras).require_rows()
    cache = opened.cache
    if not sees:
        known = [name for name in cache.keys if not {name, kind_of(name)} & NOT_SEEN and usually_seen(name)]
        shapes = {name: shape for name in known if (shape := _shape(opened, name)) is not None}
        sees = tuple(name for name, shape in shapes.items() if len(shape) in (0, 1, 3))
    for name in sees:
        if name in NOT_SEEN - NAMED_ONLY or _shape(opened, name) is None:
            known = [name for name in cache.keys if not {name, kind_of(name)} & NOT_SEEN]
            hint = did_you_mean(name, known) or "."
            raise DatasetError(
                f"a policy cannot see '{name}' of {opened.name}{hint} It has {', '.join(known) or 'nothing to see'}."
            )
    if not sees:
        raise DatasetError(f"{opened.name} has neither pictures nor numbers that a policy could see.")
    return opened.having(name for name in sees), tuple(sees)


def joint_config(
    several: Sequence[tuple[Recording, tuple[str, ...]]], hidden: int, imitation: Imitation
) -> ImitationConfig:
    """The network's shape by several recordings and what is seen of each. DatasetError where these differ, where actions of one
    body do, or where bodies have actions of different kinds; TrainingError for settings that take one recording."""
    first, sees = several[0]
    if len(several) > 1 and (imitation.remember or imitation.outcome):
        raise TrainingError("--remember and --outcome take one recording of one body; leave them out.")
    texts = {task for opened, _ in several for task in opened.cache.tasks if not task.startswith(UNINSTRUCTED)}
    instructed = len(texts) > 1 or any(len(set(opened.cache.tasks)) > 1 for opened, _ in several)
    tasks = [task for opened, _ in several for task in opened.cache.tasks] if instructed else []
    configs = [config_of(opened, sees, hidden, imitation, tasks) for opened, sees in several]
    if len(several) == 1:
        return configs[0]
    bodies: dict[str, Embodiment] = {}
    for (opened, _), config in zip(several, configs):
        body, actor = embodiment_of(opened), config.actor
        unlike = {name for name, _ in {*actor.sees} ^ {*configs[0].actor.sees}}
        if unlike:
            alike = [name for name, shape in actor.sees if (name, shape) in configs[0].actor.sees]
            raise DatasetError(
                f"{first.name} and {opened.name} differ in {', '.join(sorted(unlike))}: "
                + (f"name what they have alike, --sees {' '.join(alike)}." if alike else "one policy cannot see both.")
            )
        if unlike := bodies.setdefault(body.name, body).differs(body):
            raise DatasetError(f"{opened.name} has other actions of {body.name} than the others: {unlike}.")
        if actor.mode != configs[0].actor.mode or (actor.mode == CHOICE and actor.counts != configs[0].actor.counts):
            raise DatasetError(
                f"the actions of {first.name} and {opened.name} are of different kinds: train a policy for each."
            )
    widest = max(configs, key=lambda config: config.action_width)
    return replace(widest, bodies=tuple(bodies.values()) if len(bodies) > 1 else ())


def embodiment_of(opened: Recording) -> Embodiment:
    """The body whose actions a recording holds. DatasetError where it does not say which."""
    controls = opened.controls
    world = opened.cache.world
    assert controls is not None
    if not opened.embodiment:
        raise DatasetError(
            f"{opened.name} does not say of which body its actions are (embodiment in meta/terrella.json)."
        )
    shape = tuple(world.get("action_shape") or (len(controls.low),))
    names, units = (tuple(world.get(f"action_{key}") or ()) for key in ("names", "units"))
    mode, frame = (str(world.get(f"action_{key}") or "") for key in ("mode", "frame"))
    return Embodiment(opened.embodiment, shape, controls.low, controls.high, names, units, mode, frame)


def config_of(
    opened: Recording,
    sees: tuple[str, ...],
    hidden: int,
    imitation: Imitation,
    tasks: Sequence[str] | None = None,
) -> ImitationConfig:
    """The network's shape, by the recording's channels, actions and instructions, or these `tasks`."""
    controls = opened.controls
    assert controls is not None
    mode, action_shape = controls.kind, opened.cache.world.get("action_shape")
    shape = tuple(action_shape) if action_shape is not None else (len(controls.low),)
    seen = tuple((name, _shape(opened, name) or ()) for name in sees)
    actor = ActorConfig(seen, mode, shape, controls.low, controls.high, hidden)
    chunk = imitation.chunk or (AXES_CHUNK if mode == AXES else DISCRETE_CHUNK)
    execute = imitation.execute or max(1, chunk // 2)
    if execute > chunk:
        raise TrainingError(f"--execute {execute}: at most the {chunk} actions of --chunk can be taken.")
    tasks = opened.cache.tasks if tasks is None else tasks
    tasks = tasks if len(set(tasks)) > 1 else ()
    pictures, numbers = (any(kind(shape) for _, shape in seen) for kind in (is_picture, lambda shape: len(shape) < 2))
    foresees = pictures and numbers and tasks and not imitation.remember
    return ImitationConfig(
        actor, imitation.picture_size, vocabulary_of(tasks), imitation.history, imitation.own_actions, chunk, execute,
        best_outcome(opened) if imitation.outcome else None, imitation.waypoint if foresees else 0,
        remember=imitation.remember,
    )  # fmt: skip


def best_outcome(opened: Recording) -> float:
    """The standardised return that a policy asks for, that of the best tenth. DatasetError where all returns are the same."""
    returns = opened.episode_returns()
    if returns is None or np.ptp(returns) < 1e-6:
        what = "has no rewards" if returns is None else f"ends every episode with the return {returns[0]:.3g}"
        raise DatasetError(f"{opened.name} {what}: there are no outcomes to condition on; leave --outcome out.")
    return float((np.quantile(returns, 0.9) - returns.mean()) / returns.std())


def _shape(opened: Recording, name: str) -> tuple[int, ...] | None:
    """The shape of a row of a channel; None where the recording has none of this name."""
    cache = opened.cache
    array = array_for(name, cache.arrays, cache.keys)
    return None if array is None else tuple(cache.arrays[array].shape[1:])


def _check(practice: Practice, imitation: Imitation) -> None:
    optional = (imitation.chunk, imitation.execute, practice.batch, practice.steps)
    counts = [imitation.history, practice.hidden, *(one for one in optional if one is not None)]
    lasts = practice.minutes is None or practice.minutes > 0
    if min(*counts, imitation.remember + 1, imitation.waypoint + 1) < 1 or not lasts:
        raise TrainingError(
            "--history, --chunk, --execute, --hidden, --batch and --steps are 1 or more, --remember and --waypoint are 0 or more, "
            "and --minutes is above 0."
        )
