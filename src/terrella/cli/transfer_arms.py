"""One seed of `terrella transfer`: every arm practises, and plays in the real one; what is over is noted, so that it goes on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..act.actor import Actor
from ..act.planning import PlaySettings, SuccessCriterion, play
from ..act.policies_by_name import NoisyPolicy
from ..core.files import write_json
from ..core.policy import Idle, Policy, Random
from ..core.world import World
from ..learn.feeds import Drawn
from ..learn.objectives.regression import Regression, drawn_rows
from ..learn.recipes.policy import Practice, train_policy
from ..learn.trainer import Run, Trainer
from ..measure.transfer_scores import FLOORS, IDLE, RANDOM
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
FITTED = 2000  # steps of a residual's regression
SLIPS = 0.3  # of the actions in the episodes that are learned from are random
IDENTIFIED_FROM, GATHER = 10, 50  # real episodes: of identification, and so many are gathered at a time
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
        self.sim: World = library.load(asked.sim, cameras=(), threads=1)
        self.real: World = opened_real(asked.real, asked.gap, asked.dial)
        self._models: dict[int, tuple[World, Path]] = {}
        self.judge = SuccessCriterion(channel=asked.success)
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
        first = self.folder / "first"
        # Of each arm the world to practise in, and the policy that it begins with.
        worlds: dict[str, Callable[[], tuple[World, Path]]] = {"nominal": lambda: (self.sim, first)}
        if models:
            worlds[f"model {few}"] = lambda: self.model(few)
        if "oracle" in asked.arms:
            worlds["oracle"] = lambda: (self.real, first)
        if "randomised" in asked.arms:
            worlds["randomised"] = lambda: (Randomised(self.sim, read(asked.randomise)), first)
        if "identified" in asked.arms:
            worlds[f"identified {few}"] = lambda: (self.identified(few), first)
        for arm, count in models.items():
            worlds.setdefault(arm, lambda count=count: self.model(count))
        for arm, world in worlds.items():
            if arm not in self.found["real"]:
                self._practised(arm, *world())
                self._judge(arm, self._policy(arm))
        for arm in FLOORS:
            if arm not in self.found["real"]:
                self._judge(arm, self._policy(arm))
        if models:
            self._judge_in_the_model(self.found.setdefault("judged in the model of", few))
        if asked.look:
            self._look([*worlds], f"model {few}")
        return self.found

    def _policy(self, arm: str) -> Policy:
        spec = self.sim.spec
        return {RANDOM: Random, IDLE: Idle}[arm](spec) if arm in FLOORS else Actor.load(self.folder / arm, spec)

    def _look(self, arms: list[str], best: str) -> None:
        """Judges policies that are told their goal by a camera, in the real one as it looks."""
        asked, kept = self.asked, self.found.setdefault("camera", {}).setdefault(self.asked.look_hash, {})
        pairs = {name: pair for name, pair in arms_of(arms, best).items() if name not in kept.get("arms", {})}
        real = opened_real(asked.real, asked.gap, asked.dial, asked.look)
        encoders = Encoders(asked.sim, real, asked.looks, self.folder / asked.look_hash[:8], self.seed)
        for name in dict.fromkeys(encoder for _, encoder in pairs.values()):
            encoder = encoders[name]
            error = encoders.error(encoder)
            for arm, (policy, _) in pairs.items():
                if pairs[arm][1] == name:
                    kept.setdefault("errors", {})[arm] = error
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

    def _judge(self, arm: str, policy: Policy) -> None:
        """Plays in the real one, in the simulator, and along the dial."""
        asked, found = self.asked, self.found
        found["real"][arm] = self._successes(self.real, policy)
        found["the simulator"][arm] = self._successes(self.sim, policy)
        if arm in ("nominal", "randomised") and asked.gap:
            for gap in DIAL:
                found[f"dial {gap}"][arm] = self._successes(opened_real(asked.real, asked.gap, gap), policy)
        write_json(self.file, found)

    def _judge_in_the_model(self, count: int) -> None:
        """Plays all that were judged, whenever they were asked for, in one model: of `count` real episodes."""
        for arm in self.found["real"]:
            if arm not in self.found["the model"]:
                self.found["the model"][arm] = self._successes(self.model(count)[0], self._policy(arm))
                write_json(self.file, self.found)

    def _successes(self, world: World, policy: Policy) -> list[int]:
        settings = PlaySettings(self.steps, self.judge, tuple(getattr(policy, "sees", ())))
        played = play(world, policy, self.asked.episodes, settings, STARTS)
        return [int(bool(episode.success)) for episode in played.episodes]

    def _gathered(self, policy: Path, count: int, number: int = 0) -> Trials:
        """Real episodes to learn from, of a policy of which some actions slip, in round `number`. Those of fewer are among those of
        more."""
        actor = Actor.load(policy, self.sim.spec, greedy=False)
        slipping, seed = NoisyPolicy(actor, SLIPS, self.sim.spec), GATHERED + self.seed + 1000 * number
        blocks = (collect(self.real, slipping, GATHER, seed + 1_000_000 * at) for at in range(-(-count // GATHER)))
        return reduce(Trials.and_then, blocks)[:count]

    def model(self, count: int) -> tuple[World, Path]:
        """The world model of `count` real episodes, and the policy that gathered the last of them. They are gathered in rounds: the
        first policy's say nothing of where a better one goes."""
        if count in self._models:
            return self._models[count]
        rounds = min(self.asked.rounds, count)
        shares = [count // rounds + (number < count % rounds) for number in range(rounds)]
        policy = self.folder / "first"
        trials = self._gathered(policy, shares[0])
        for number, share in enumerate(shares):
            name = f"{count}, round {number + 1}"
            if number:
                trials = trials.and_then(self._gathered(policy, share, number))
            model = fitted(inner(self.sim), trials, self.folder / f"residual {name}", self.seed)
            if number + 1 < len(shares):
                self._practised(f"model {name}", model, policy)
                policy = self.folder / f"model {name}"
        self._models[count] = model, policy
        return self._models[count]

    def identified(self, count: int) -> World:
        world = Randomised(self.sim, read(self.asked.randomise))
        found = identify(world, self._gathered(self.folder / "first", count), self.seed)
        self.found["identified"] = {**found.values, "error": found.error, "nominal error": found.nominal}
        return Randomised(self.sim, found.around(world.distributions))


def fitted(sim: MujocoWorld, trials: Trials, folder: Path, seed: int, mark: str = "") -> Corrected:
    """The simulator with a residual that is fitted to the trials; it goes on where it was stopped. TrainingError where the folder
    holds one of another mark."""
    inputs, targets = residuals(sim, trials)
    torch.manual_seed(seed)
    network = Residual(sim.file.nq, sim.file.nu)
    network.settle(inputs, targets)
    facts: Mapping[str, Any] = {
        "episodes": len(trials.actions),
        "rows": len(inputs),
        **({"mark": mark} if mark else {}),
    }
    run = Run(folder, facts, lambda *_: None, seed)
    feed = Drawn(lambda now: drawn_rows(inputs, targets, now))
    Trainer(run, "residual", feed, Regression(network, network.unit, network.scale, LEARNING_RATE), FITTED).train()
    return Corrected(sim, network)
