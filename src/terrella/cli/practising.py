"""`terrella learn --practise`: collect, learn the world, practise in it, and again, each time by the policy that came of it.
Choices and buttons are learned by PPO, which keeps to where the world knows what comes; axes along the world's own gradients.

Every stage goes on where it was stopped, and what is over is noted in a file, so the same command goes on from anywhere.
A round's practice begins with the policy that has earned most so far; of that and the last, the better one is the result.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import library, progress
from ..act.actor import Actor
from ..act.belief import BeliefPolicy, load_learned_policy
from ..act.policies_by_name import NoisyPolicy
from ..core.errors import TerrellaError
from ..core.files import write_json
from ..core.policy import Policy
from ..core.spec import AXES, shape_of
from ..core.world import World, make_rng
from ..data import Dataset, record
from ..learn.recipes.latent import LatentTraining, train_latent
from ..learn.recipes.policy import Practice, seen_unless_said, train_policy
from ..measure.statistics import mean_interval
from .named import Environment
from .practice import told, tried_out, verdict
from .record import explore, stored_as
from .say import result, say

ROUNDS = 4
SHARES = {"collecting": 0.15, "learning the world": 0.5, "practising": 0.35}  # of a round's time, at most
FEWEST = 1000  # frames of all rounds
LEAST = 0.5  # of a round's frames are collected, whatever time that takes
SMALL = 64  # pixels a side of pictures, unless it is said
ENDLESS = 10**9  # steps: stages end with their time
BATCH, SAVE_EVERY_S = 64, 20.0
SLIPS = 0.1  # of a policy's actions are random ones while it collects: the world then knows what lies beside its paths
TRUST = 0.1  # the uncertainty from which PPO takes the worst for granted
TRIED = 10  # episodes in which the last policy is tried
NOTES = "practise.json"


@dataclass(frozen=True)
class Rounds:
    """What is made in `folder`: the recording, and of each round a world and a policy."""

    folder: Path
    asked: Mapping[str, Any]
    minutes: float

    @property
    def recording(self) -> Path:
        return self.folder / "recording"

    def world(self, number: int) -> Path:
        return self.folder / f"world-{number}"

    def policy(self, number: int) -> Path:
        return self.folder / f"policy-{number}"

    def seconds(self, stage: str) -> float:
        return 60 * self.minutes / ROUNDS * SHARES[stage]

    def notes(self) -> list[dict[str, Any]]:
        """What is known of the rounds that are over. TerrellaError for a folder of something else, or begun otherwise."""
        file = self.folder / NOTES
        if not file.exists():
            if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
                raise TerrellaError(f"{self.folder} holds something else than practice; give another --out.")
            self.note([])
        try:
            told = json.loads(file.read_text(encoding="utf-8"))
            asked, rounds = dict(told["asked"]), list(told["rounds"])
        except (ValueError, KeyError, TypeError) as error:
            raise TerrellaError(f"{file} is damaged ({error}); give another --out.") from error
        if asked != json.loads(json.dumps(self.asked)):
            raise TerrellaError(f"{self.folder} was begun with other settings, {asked}; repeat them, or another --out.")
        return rounds

    def note(self, rounds: list[dict[str, Any]]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / NOTES, {"asked": self.asked, "rounds": rounds})


def practise(
    name: str, environment: Environment, minutes: float, out: Path, frames: int, seed: int, json: bool
) -> None:
    """All rounds that are not over, and what the last policy earned in the environment."""
    asked = {"environment": name, "frames": frames, "seed": seed, "minutes": minutes, **asdict(environment)}
    if frames < FEWEST:
        raise TerrellaError(f"--practise needs --frames of {FEWEST:,} or more.")
    rounds = Rounds(out, asked, minutes)
    done = rounds.notes()
    real = _opened(name, environment)
    if "reward" not in real.spec.channels:
        raise TerrellaError(f"{name} tells no reward, and practice is for one.")
    for number in range(len(done), ROUNDS):
        say(f"Round {number + 1} of {ROUNDS}, in {out}.")
        try:
            done.append(_round(rounds, done, name, real, frames, seed))
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(str(stop) or "stopped; the same command goes on from there.") from stop
        rounds.note(done)
        say(_line(done[-1]))
    tried = {}
    for number in dict.fromkeys((ROUNDS - 1, _best(done))):
        world = library.load(rounds.world(number))
        tried[number] = world, tried_out(rounds.policy(number), world, real, TRIED, seed)
    number = max(tried, key=lambda number: tried[number][1]["return"].value)
    (world, figures), policy = tried[number], rounds.policy(number)
    facts = {"verdict": verdict(figures, real), **{at: asdict(figure) for at, figure in figures.items()}}
    where = f"the policy: {policy}; the world that it practised in: {rounds.world(number)}"
    lines = [facts["verdict"], *map(_line, done), *told(figures, world), where]
    result({**facts, "rounds": done, "policy": str(policy)}, json, "\n".join(lines))


def _best(done: Sequence[Mapping[str, Any]]) -> int:
    """The round whose policy earned most when it collected, which is in the round after it; the first where none has yet."""
    return max(range(1, len(done)), key=lambda number: done[number]["return"], default=1) - 1


def _round(
    rounds: Rounds, done: Sequence[Mapping[str, Any]], name: str, real: World, frames: int, seed: int
) -> dict[str, Any]:
    number = len(done)
    if not rounds.world(
        number
    ).exists():  # else enough was collected: the world that is being learned is of those frames
        with progress.shown("collecting") as report:
            _collect(rounds, number, real, frames * (number + 1) // ROUNDS, seed, report)
    with progress.shown("learning the world") as report:
        hours = rounds.seconds("learning the world") / 3600
        batch = None if "rgb" in real.spec.channels else BATCH
        config = LatentTraining(
            rounds.folder.name, steps=ENDLESS, hours=hours, batch=batch, seed=seed, save_every_s=SAVE_EVERY_S
        )
        train_latent(rounds.recording, rounds.world(number), config, report)
    world, before = library.load(rounds.world(number)), done[-1]["frames"] if done else 0
    found = {"frames": Dataset(rounds.recording).length, "return": _earned(rounds.recording, before)}
    with progress.shown("practising") as report:
        config = Practice(minutes=rounds.seconds("practising") / 60, seed=seed, save_every_s=SAVE_EVERY_S)
        if world.spec.differentiable and world.spec.action_mode in AXES:
            config = replace(config, batch=BATCH)
        else:
            config = replace(config, method="ppo", cautious=True, trust=TRUST)
        alike = number and "latent" not in seen_unless_said(world.spec)  # another world's latents mean something else
        earlier = rounds.policy(_best([*done, found])) if alike else None
        facts = train_policy(world, name, rounds.policy(number), config, report, rounds.recording, earlier)
    return {**found, "steps": facts["step"]}


def _collect(rounds: Rounds, number: int, real: World, upto: int, seed: int, report: Callable[..., None]) -> None:
    """Records up to so many frames: by the explorer at first, then by the last policy, which draws its actions and slips."""
    began, most, rows = time.monotonic(), rounds.seconds("collecting"), 0
    least = upto - round((1 - LEAST) * rounds.asked["frames"] / ROUNDS)

    def told(done: float, total: float) -> None:
        nonlocal rows
        rows = int(done)
        report(done, total)

    enough = lambda: rows >= least and time.monotonic() - began > most  # noqa: E731
    if number == 0:
        explore(real, rounds.recording, upto, seed, told, stored_as(real.spec), enough=enough)
        return
    policy = load_learned_policy(rounds.policy(number - 1), real.spec, library.load(rounds.world(number - 1)))
    record(
        real, NoisyPolicy(drawing(policy), SLIPS, real.spec), rounds.recording, upto, make_rng(seed), told,
        pictures=stored_as(real.spec), enough=enough,
    )  # fmt: skip


def drawing(policy: Policy) -> Policy:
    """The same learned policy, drawing its actions."""
    if isinstance(policy, BeliefPolicy):
        return BeliefPolicy(policy.world, Actor(policy.actor.network, policy.actor.spec, greedy=False))
    return Actor(policy.network, policy.spec, greedy=False) if isinstance(policy, Actor) else policy


def _opened(name: str, environment: Environment) -> World:
    """The environment; one that shows numbers is asked for no pictures, and so needs no display."""
    if not name.startswith("gym:"):
        return environment.open(name)
    blind = environment.open(name, rgb=False)
    if "observation" in blind.spec.channels and len(shape_of(blind.spec.channels["observation"])) < 3:
        return blind
    return (environment if environment.size else replace(environment, size=(SMALL, SMALL))).open(name)


def _earned(recording: Path, since: int) -> float:
    """The mean return of the episodes from row `since` on."""
    dataset = Dataset(recording)
    ends = np.cumsum([episode.length for episode in dataset.episodes])
    new = [number for number, end in enumerate(ends) if end > since] or [len(ends) - 1]
    returns = [float(np.nansum(dataset.episode(number, ("reward",))["reward"])) for number in new]
    return mean_interval(torch.tensor(returns), make_rng(0)).value


def _line(done: Mapping[str, Any]) -> str:
    return f"{done['frames']:,} real frames so far: those who collected earned {done['return']:.4g} an episode"
