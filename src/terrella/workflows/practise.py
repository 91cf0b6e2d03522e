"""`learn --practise`: collect, learn a latent world, practise in it, and again, each round with the policy of the last one.
Discrete actions are learned by PPO, which avoids states of high uncertainty; continuous ones along the world's own gradients.
A round's practice begins with the policy of the highest return so far; the better one of that and the last is the result.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from .. import library
from ..act.actor import Actor
from ..act.belief import BeliefPolicy, load_learned_policy
from ..act.policies_by_name import NoisyPolicy
from ..core.errors import DatasetError, TerrellaError, TrainingError
from ..core.files import write_json
from ..core.policy import Policy
from ..core.spec import AXES, shape_of
from ..core.world import World, make_rng
from ..data import Dataset, RecordOptions, record
from ..learn.recipes.latent import LatentTraining, train_latent
from ..learn.recipes.policy import Practice, default_channels, train_policy
from ..measure.statistics import mean_interval
from .collect import explore, storage_of
from .learn import check_budget
from .learn_schedule import folder_for, refuse_foreign_folder, refuse_other_settings
from .learn_trial import FEW_STEPS, HOPELESS_STEPS, TRIAL_FRAMES, slower
from .opening import Device, EnvironmentConfig, device_of
from .progress import Progress, Report, silent, stage, stopping_with
from .results import jsonable
from .train_policy import PolicyTrial, try_policy
from .trust import practice_within_trust

ROUNDS = 4
COLLECTING, LEARNING, PRACTISING = "collecting", "learning the world", "practising"
SHARES = {COLLECTING: 0.15, LEARNING: 0.5, PRACTISING: 0.35}  # of a round's time, at most
FEWEST_FRAMES = 1000  # of all rounds
LEAST_SHARE = 0.5  # of a round's frames are collected, however long that takes
SMALL_SIDE = 64  # pixels: the default side of pictures
ENDLESS = 10**9  # steps: stages end with their time
BATCH, SAVE_EVERY_S = 64, 20.0
RANDOM_SHARE = 0.1  # of a policy's actions while it collects: the world then learns the states beside its paths
TRUST = 0.1  # the uncertainty from which PPO assumes the worst return
TRIAL_EPISODES = 10
TRIAL_MIN = 0.2  # of a short round before the first
NOTES = "practise.json"


@dataclass(frozen=True)
class PractiseConfig:
    """Settings of `practise`."""

    minutes: float = 30.0
    """Time for all rounds, earlier runs included. More minutes train the last round of a finished run
    further."""
    out: Path | None = None
    """Folder for the recording, the worlds and the policies; default: learned/ and the environment's name."""
    frames: int = 20_000  # Frames to record at most, in all rounds.
    seed: int = 0  # The same seed gives the same result.
    environment: EnvironmentConfig = EnvironmentConfig()
    device: Device = "auto"


@dataclass(frozen=True)
class PractiseResult:
    """The best policy of all rounds, and its trial in the real environment."""

    trial: PolicyTrial
    rounds: tuple[Mapping[str, Any], ...]
    """Of each round: real frames so far, the mean return of the episodes that it collected, steps of practice, minutes."""
    policy: Path  # Folder of the policy.
    world: Path  # Folder of the world in which it practised.

    def to_json(self) -> dict[str, Any]:
        return jsonable({**self.trial.to_json(), "rounds": self.rounds, "policy": self.policy})

    def summary(self) -> str:
        verdict, *figures = self.trial.lines()
        where = f"the policy: {self.policy}; the world that it practised in: {self.world}"
        return "\n".join([verdict, *map(_round_line, self.rounds), *figures, where])


def practise(
    environment: str, config: PractiseConfig = PractiseConfig(), *, progress: Progress = silent
) -> PractiseResult:
    """Learns a policy of an environment in rounds: each collects with the last policy, learns a latent world and practises in it.

    The same call continues where an earlier one was stopped; with more minutes it trains a finished run on. TerrellaError for what
    cannot be practised.
    """
    check_budget(config.minutes, config.frames)
    if config.frames < FEWEST_FRAMES:
        raise TerrellaError(f"--practise needs --frames of {FEWEST_FRAMES:,} or more.")
    settings = {"environment": environment, "frames": config.frames, "seed": config.seed, **asdict(config.environment)}
    rounds = _Rounds(Path(config.out or folder_for(environment)), settings, config.minutes)
    if not (rounds.folder / NOTES).exists():
        refuse_foreign_folder(rounds.folder)
    real = _open(environment, config.environment)
    if "reward" not in real.spec.channels:
        raise TerrellaError(f"{environment} has no reward, which practice needs.")
    if not rounds.recording.exists():
        progress("A trial of some seconds: what does this machine manage?")
        progress(_forecast(environment, real, config))
    done = rounds.resume()
    for number in range(len(done), ROUNDS):
        progress(f"Round {number + 1} of {ROUNDS}, in {rounds.folder}.")
        with stopping_with("stopped; the same command continues."):
            done.append(_round(rounds, done, environment, real, config, progress))
        rounds.note(done)
        progress(_round_line(done[-1]))
    trials = {}
    for number in dict.fromkeys((ROUNDS - 1, best_round(done))):
        world = library.load(rounds.world(number))
        trials[number] = try_policy(rounds.policy(number), world, real, TRIAL_EPISODES, config.seed, progress)
    best = max(trials, key=lambda number: trials[number].figures["return"].value)
    return PractiseResult(trials[best], tuple(done), rounds.policy(best), rounds.world(best))


@dataclass(frozen=True)
class _Rounds:
    """The files in `folder`: the recording, and of each round a world and a policy."""

    folder: Path
    settings: Mapping[str, Any]
    minutes: float

    @property
    def recording(self) -> Path:
        return self.folder / "recording"

    def world(self, number: int) -> Path:
        return self.folder / f"world-{number}"

    def policy(self, number: int) -> Path:
        return self.folder / f"policy-{number}"

    def round_minutes(self, done: Sequence[Mapping[str, Any]]) -> float:
        """The minutes of the next round: its share of the time that the rounds before have left."""
        return max(self.minutes - sum(each["minutes"] for each in done), 0.1) / (ROUNDS - len(done))

    def resume(self) -> list[dict[str, Any]]:
        """The notes of the rounds that are over. Where a finished run has more minutes than before, its last round is not: it is
        trained on. TerrellaError for a folder of something else, or begun with other settings."""
        file = self.folder / NOTES
        if not file.exists():
            refuse_foreign_folder(self.folder)
            self.note([])
        try:
            notes = json.loads(file.read_text(encoding="utf-8"))
            settings, rounds = dict(notes["asked"]), list(notes["rounds"])
            minutes = float(settings.pop("minutes"))
        except (ValueError, KeyError, TypeError) as error:
            raise TerrellaError(f"{file} is damaged ({error}); give another --out.") from error
        refuse_other_settings(self.folder, settings, json.loads(json.dumps(self.settings)))
        rounds = [{"minutes": minutes / ROUNDS, **each} for each in rounds]  # older notes have no minutes
        if len(rounds) == ROUNDS and self.minutes > minutes:
            rounds.pop()
        return rounds

    def note(self, rounds: Sequence[Mapping[str, Any]]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        settings = {**self.settings, "minutes": self.minutes}
        write_json(self.folder / NOTES, {"asked": settings, "rounds": list(rounds)})


def _forecast(name: str, real: World, config: PractiseConfig) -> str:
    """One sentence of what the minutes will give, by a short round in a temporary folder; TerrellaError where nothing can be
    learned in them."""
    minutes = config.minutes / ROUNDS
    with TemporaryDirectory() as folder:
        rounds = _Rounds(Path(folder) / "trial", {}, TRIAL_MIN * ROUNDS)
        try:
            trial = _round(rounds, [], name, real, replace(config, frames=TRIAL_FRAMES * ROUNDS), silent)
        except (DatasetError, TrainingError) as error:
            return f"A trial of some seconds cannot say what {config.minutes:g} min will give: {error}"
    steps, practised = (int(trial[at] * minutes / TRIAL_MIN) for at in ("world_steps", "steps"))
    collected = trial["frames"] / trial["collected_s"] * 60 * minutes * SHARES[COLLECTING]
    frames = int(np.clip(collected, LEAST_SHARE * config.frames / ROUNDS, config.frames / ROUNDS))
    what = f"{ROUNDS} rounds of about {frames:,} frames, {steps:,} training steps of the world and {practised:,} of the policy"
    better = f"--minutes {math.ceil(config.minutes * FEW_STEPS / max(steps, 1))}"
    if steps < HOPELESS_STEPS:
        raise TerrellaError(f"{config.minutes:g} min are too few on this machine, by a trial: {what}. Give {better}.")
    little = f" That is little: {better} trains the world by {FEW_STEPS} steps." if steps < FEW_STEPS else ""
    return f"Expected in {config.minutes:g} min, by a trial on this machine: {what}.{little}"


def best_round(done: Sequence[Mapping[str, Any]]) -> int:
    """The round whose policy had the highest return when it collected, in the round after it; the first where none has yet."""
    return max(range(1, len(done)), key=lambda number: done[number]["return"], default=1) - 1


def _round(
    rounds: _Rounds,
    done: Sequence[Mapping[str, Any]],
    name: str,
    real: World,
    config: PractiseConfig,
    progress: Progress,
) -> dict[str, Any]:
    """One round: collects, learns the world, practises. Returns its notes."""
    number, seed, minutes = len(done), config.seed, rounds.round_minutes(done)
    seconds = {at: 60 * minutes * share for at, share in SHARES.items()}
    began = time.monotonic()
    if not rounds.world(number).exists():  # a world exists only after collection
        with stage(COLLECTING, progress) as report:
            _collect(rounds, number, real, config, seconds[COLLECTING], report)
    collected_s = time.monotonic() - began
    with stage(LEARNING, progress) as report:
        batch = None if "rgb" in real.spec.channels else BATCH
        latent = LatentTraining(
            rounds.folder.name,
            steps=ENDLESS,
            hours=seconds[LEARNING] / 3600,
            batch=batch,
            seed=seed,
            save_every_s=SAVE_EVERY_S,
            device=config.device,
        )
        paced = lambda steps: progress(line) if (line := slower(steps, config.minutes)) else None  # noqa: E731
        learned = train_latent(rounds.recording, rounds.world(number), latent, report, paced)
    world, before = (
        library.load(rounds.world(number), device=device_of(config.device)),
        done[-1]["frames"] if done else 0,
    )
    notes = {"frames": Dataset(rounds.recording).length, "return": mean_return(rounds.recording, before)}
    notes |= {"collected_s": collected_s, "world_steps": learned["step"]}
    with stage(PRACTISING, progress) as report:
        practice = Practice(minutes=seconds[PRACTISING] / 60, seed=seed, save_every_s=SAVE_EVERY_S)
        if world.spec.differentiable and world.spec.action_mode in AXES:
            practice = replace(practice, batch=BATCH)
        else:
            practice = replace(practice, method="ppo", cautious=True, trust=TRUST)
        practice = practice_within_trust(world, practice, progress)
        transferable = number and "latent" not in default_channels(world.spec)  # another world has other latents
        earlier = rounds.policy(best_round([*done, notes])) if transferable else None
        facts = train_policy(world, name, rounds.policy(number), practice, report, rounds.recording, earlier)
    return {**notes, "steps": facts["step"], "minutes": minutes}


def _collect(rounds: _Rounds, number: int, real: World, config: PractiseConfig, seconds: float, report: Report) -> None:
    """Records a round's frames: with the explorer in the first round, then with the last policy and some random actions."""
    began, rows, seed = time.monotonic(), 0, config.seed
    upto = config.frames * (number + 1) // ROUNDS
    least = upto - round((1 - LEAST_SHARE) * config.frames / ROUNDS)

    def counted(done: float, total: float) -> None:
        nonlocal rows
        rows = int(done)
        report(done, total)

    def enough() -> bool:
        return rows >= least and time.monotonic() - began > seconds

    options = RecordOptions(pictures=storage_of(real.spec))
    if number == 0:
        explore(real, rounds.recording, upto, seed, counted, options, enough=enough)
        return
    policy = load_learned_policy(rounds.policy(number - 1), real.spec, library.load(rounds.world(number - 1)))
    mixed = NoisyPolicy(sampling(policy), RANDOM_SHARE, real.spec)
    record(real, mixed, rounds.recording, upto, make_rng(seed), counted, enough, options)


def sampling(policy: Policy) -> Policy:
    """The same learned policy, which samples its actions."""
    if isinstance(policy, BeliefPolicy):
        return BeliefPolicy(policy.world, Actor(policy.actor.network, policy.actor.spec, greedy=False))
    return Actor(policy.network, policy.spec, greedy=False) if isinstance(policy, Actor) else policy


def _open(name: str, environment: EnvironmentConfig) -> World:
    """The environment. Where its observation is a vector it renders no pictures, and so needs no display."""
    if not name.startswith("gym:"):
        return environment.open(name)
    blind = environment.open(name, rgb=False)
    if "observation" in blind.spec.channels and len(shape_of(blind.spec.channels["observation"])) < 3:
        return blind
    return (environment if environment.size else replace(environment, size=(SMALL_SIDE, SMALL_SIDE))).open(name)


def mean_return(recording: Path, since: int) -> float:
    """The mean return of the episodes after row `since`."""
    dataset = Dataset(recording)
    ends = np.cumsum([episode.length for episode in dataset.episodes])
    new = [number for number, end in enumerate(ends) if end > since] or [len(ends) - 1]
    returns = [float(np.nansum(dataset.episode(number, ("reward",))["reward"])) for number in new]
    return mean_interval(torch.tensor(returns), make_rng(0)).value


def _round_line(notes: Mapping[str, Any]) -> str:
    return f"{notes['frames']:,} real frames so far: the collected episodes have a mean return of {notes['return']:.4g}"
