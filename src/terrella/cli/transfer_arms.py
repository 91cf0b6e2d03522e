"""One seed of `terrella transfer`: every arm practises, and plays in the real one; what is over is noted, so that it goes on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..act.actor import Actor
from ..act.named import Slipping
from ..act.planning.episodes import Judge, play
from ..core.policy import Idle, Policy, Random
from ..core.world import World
from ..data.storage.durable import write_json
from ..learn.feeds import Drawn
from ..learn.objectives.regression import Regression, drawn_rows
from ..learn.recipes.policy import Practice, train_policy
from ..learn.trainer import Run, Trainer
from ..sim.corrected import Corrected, Residual, residuals
from ..sim.identification import identify
from ..sim.mujoco_world import MujocoWorld
from ..sim.randomised import Randomised, read
from ..sim.trials import Trials, collect, inner
from .say import say
from .transfer import DIAL, Experiment, opened_real
from .transfer_look import Encoders, arms_of, told_by

HIDDEN, LEARNING_RATE = 64, 3e-3
GENTLY = 2e-3  # of a policy that has practised already
ENTROPY = 1e-2  # a policy that is sure of what it learned in the simulator must try other things again
FITTED = 500  # steps of a residual's regression
SLIPS = 0.3  # of the actions in the episodes that are learned from are random
IDENTIFIED_FROM, GATHER = 10, 50  # real episodes: of identification, and so many or more are gathered
STARTS, GATHERED = (
    1_000_003,
    2_000_003,
)  # seeds of the judged starts, the same for all; of the episodes that are learned from


def one_seed(asked: Experiment, folder: Path, seed: int) -> dict[str, Any]:
    """What came of a seed: place -> arm -> successes; kept in FOLDER/seed-N/found.json."""
    torch.set_num_threads(1)
    return _Seed(asked, folder / f"seed-{seed}", seed).run()


class _Seed:
    """The worlds of an experiment, and the folder of one seed."""

    def __init__(self, asked: Experiment, folder: Path, seed: int):
        self.asked, self.folder, self.seed, self.file = asked, folder, seed, folder / "found.json"
        self.sim: MujocoWorld = inner(library.load(asked.sim, cameras=(), threads=1))
        self.real: World = opened_real(asked.real, asked.gap, asked.dial)
        self._models: dict[int, World] = {}
        self.judge = Judge(channel=asked.success)
        self.steps = self.real.spec.max_episode_steps or 200
        places = ("real", "the simulator", "the model", *(f"dial {gap}" for gap in map(str, DIAL)))
        self.found: dict[str, Any] = {"practised": [], **{place: {} for place in places}}
        if self.file.is_file():
            self.found |= json.loads(self.file.read_text(encoding="utf-8"))

    def run(self) -> dict[str, Any]:
        asked = self.asked
        self._practised("first", self.sim, None)
        few = IDENTIFIED_FROM if IDENTIFIED_FROM in asked.real_episodes else max(asked.real_episodes)
        models = {f"model {count}": count for count in asked.real_episodes} if "model" in asked.arms else {}
        worlds: dict[str, Callable[[], World]] = {"nominal": lambda: self.sim}
        if models:
            worlds[f"model {few}"] = lambda: self.model(few)
        if "oracle" in asked.arms:
            worlds["oracle"] = lambda: self.real
        if "randomised" in asked.arms:
            worlds["randomised"] = lambda: Randomised(self.sim, read(asked.randomise))
        if "identified" in asked.arms:
            worlds[f"identified {few}"] = lambda: self.identified(few)
        for arm, count in models.items():
            worlds.setdefault(arm, lambda count=count: self.model(count))
        for arm, world in worlds.items():
            if arm not in self.found["real"]:
                self._practised(arm, world(), self.folder / "first")
                self._judge(arm, Actor.load(self.folder / arm, self.sim.spec), few if models else None)
        for arm, policy in {"random": Random(self.sim.spec), "idle": Idle(self.sim.spec)}.items():
            if arm not in self.found["real"]:
                self._judge(arm, policy, few if models else None)
        if asked.look:
            self._look([*worlds], f"model {few}")
        return self.found

    def _look(self, arms: list[str], best: str) -> None:
        """Judges policies that are told their goal by a camera, in the real one as it looks."""
        asked, kept = self.asked, self.found.setdefault("camera", {}).setdefault(self.asked.look_hash, {})
        pairs = {name: pair for name, pair in arms_of(arms, best).items() if name not in kept.get("arms", {})}
        real = opened_real(asked.real, asked.gap, asked.dial, asked.look)
        encoders = Encoders(asked.sim, real, asked.looks, self.folder / asked.look_hash[:8], self.seed)
        for name in dict.fromkeys(encoder for _, encoder in pairs.values()):
            encoder = encoders[name]
            kept.setdefault("errors", {})[name] = encoders.error(encoder)
            for arm, (policy, _) in pairs.items():
                if pairs[arm][1] == name:
                    actor = Actor.load(self.folder / policy, self.sim.spec)
                    kept.setdefault("arms", {})[arm] = self._successes(told_by(encoder, real), actor)
            write_json(self.file, self.found)

    def _practised(self, arm: str, world: World, before: Path | None) -> None:
        if arm in self.found["practised"]:
            return
        rate = LEARNING_RATE if before is None else GENTLY
        config = Practice(
            method="ppo",
            steps=self.asked.practice,
            hidden=HIDDEN,
            learning_rate=rate,
            entropy=ENTROPY,
            seed=self.seed,
            save_every_s=60,
        )
        train_policy(world, arm, self.folder / arm, config, lambda *_: None, before=before)
        self.found["practised"].append(arm)
        write_json(self.file, self.found)
        say(f"seed {self.seed}: {arm} has practised")

    def _judge(self, arm: str, policy: Policy, count: int | None) -> None:
        """Plays in the real one, in the simulator, in the model of `count` episodes, and along the dial."""
        asked, found = self.asked, self.found
        found["real"][arm] = self._successes(self.real, policy)
        found["the simulator"][arm] = self._successes(self.sim, policy)
        if count is not None:
            found["the model"][arm] = self._successes(self.model(count), policy)
        if arm in ("nominal", "randomised") and asked.gap:
            for gap in DIAL:
                found[f"dial {gap}"][arm] = self._successes(opened_real(asked.real, asked.gap, gap), policy)
        write_json(self.file, found)

    def _successes(self, world: World, policy: Policy) -> list[int]:
        sees = tuple(getattr(policy, "sees", ()))
        played = play(world, policy, self.asked.episodes, self.steps, STARTS, self.judge, sees=sees)
        return [int(bool(episode.success)) for episode in played.episodes]

    @cached_property
    def trials(self) -> Trials:
        """Real episodes to learn from: the first policy's, of which some actions slip."""
        policy = Slipping(Actor.load(self.folder / "first", self.sim.spec, greedy=False), SLIPS, self.sim.spec)
        return collect(self.real, policy, max(GATHER, *self.asked.real_episodes), GATHERED + self.seed)

    def model(self, count: int) -> World:
        """The world model of `count` real episodes."""
        if count not in self._models:
            folder = self.folder / f"residual {count}"
            self._models[count] = fitted(self.sim, self.trials.first(count), folder, self.seed)
        return self._models[count]

    def identified(self, count: int) -> World:
        world = Randomised(self.sim, read(self.asked.randomise))
        found = identify(world, self.trials.first(count), self.seed)
        self.found["identified"] = {**found.values, "error": found.error, "nominal error": found.nominal}
        return Randomised(self.sim, found.around(world.distributions))


def fitted(sim: MujocoWorld, trials: Trials, folder: Path, seed: int) -> Corrected:
    """The simulator with a residual that is fitted to the trials; it goes on where it was stopped."""
    inputs, targets = residuals(sim, trials)
    torch.manual_seed(seed)
    network = Residual(sim.file.nq, sim.file.nu)
    network.settle(inputs, targets)
    facts: Mapping[str, Any] = {"episodes": len(trials.actions), "rows": len(inputs)}
    run = Run(folder, facts, lambda *_: None, seed)
    feed = Drawn(lambda now: drawn_rows(inputs, targets, now))
    Trainer(run, "residual", feed, Regression(network, network.unit, network.scale, LEARNING_RATE), FITTED).train()
    return Corrected(sim, network)
