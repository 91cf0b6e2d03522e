"""One seed of `transfer`: trains every arm and tests it on the real robot. Results are saved at once, so that it continues."""

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
from ..learn.feeds import RandomBatches
from ..learn.objectives.regression import Regression, drawn_rows
from ..learn.recipes.policy import Practice, train_policy
from ..learn.trainer import Run, Trainer
from ..measure.transfer_scores import FLOORS, IDLE, RANDOM
from ..sim.corrected import Corrected, Residual, residual_targets
from ..sim.identification import identify
from ..sim.mujoco_world import MujocoWorld
from ..sim.randomised import Randomised, read
from ..sim.trials import Trials, collect, fitted_simulator
from .progress import Progress
from .transfer_camera import Encoders, camera_arms, with_encoder
from .transfer_experiment import DIAL, TransferExperiment

HIDDEN, LEARNING_RATE = 64, 3e-3
FINETUNING_RATE = 2e-3  # of a policy that is trained already
ENTROPY = 1e-2  # bonus that lets a policy which is sure of the simulator explore again
FITTED = 2000  # steps of a residual's regression
RANDOM_ACTIONS = 0.3  # share of random actions in the episodes that are learned from
IDENTIFIED_FROM = 10  # real episodes, where this many are gathered
GATHER = 50  # real episodes that are gathered at a time
STARTS = 1_000_003  # seed of the starts for tests, the same for all policies
GATHERED = 2_000_003  # seed of the episodes that are learned from


def run_seed(experiment: TransferExperiment, folder: Path, progress: Progress, seed: int) -> dict[str, Any]:
    """The results of a seed: place -> arm -> successes; kept in FOLDER/seed-N/found.json."""
    torch.set_num_threads(1)
    return _SeedRun(experiment, folder / f"seed-{seed}", progress, seed).run()


class _SeedRun:
    """The worlds of an experiment, and the folder of one seed."""

    def __init__(self, experiment: TransferExperiment, folder: Path, progress: Progress, seed: int):
        self.experiment, self.folder, self.progress, self.seed = experiment, folder, progress, seed
        self.file = folder / "found.json"
        self.sim: World = library.load(experiment.sim, cameras=(), threads=1)
        self.real: World = experiment.open_real()
        self._models: dict[int, tuple[World, Path]] = {}
        self.criterion = SuccessCriterion(channel=experiment.success)
        self.steps = self.real.spec.max_episode_steps or 200
        places = ("real", "the simulator", "the model", *(f"dial {gap}" for gap in DIAL))
        self.results: dict[str, Any] = {"practised": [], **{place: {} for place in places}}
        if self.file.is_file():
            self.results |= json.loads(self.file.read_text(encoding="utf-8"))

    def run(self) -> dict[str, Any]:
        experiment, counts = self.experiment, self.experiment.real_episodes
        self._train("first", self.sim, None)
        few = IDENTIFIED_FROM if IDENTIFIED_FROM in counts else max(counts)
        models = {f"model {count}": count for count in counts} if "model" in experiment.arms else {}
        first = self.folder / "first"
        # arm -> the world to train in, and the policy to begin with
        worlds: dict[str, Callable[[], tuple[World, Path]]] = {"nominal": lambda: (self.sim, first)}
        if models:
            worlds[f"model {few}"] = lambda: self.model(few)
        if "oracle" in experiment.arms:
            worlds["oracle"] = lambda: (self.real, first)
        if "randomised" in experiment.arms:
            worlds["randomised"] = lambda: (Randomised(self.sim, read(experiment.randomise)), first)
        if "identified" in experiment.arms:
            worlds[f"identified {few}"] = lambda: (self.identified(few), first)
        for arm, count in models.items():
            worlds.setdefault(arm, lambda count=count: self.model(count))
        for arm, world in worlds.items():
            if arm not in self.results["real"]:
                self._train(arm, *world())
                self._test(arm)
        for arm in [one for one in FLOORS if one not in self.results["real"]]:
            self._test(arm)
        if models:
            self._test_in_model(self.results.setdefault("judged in the model of", few))
        if experiment.look:
            self._test_with_camera([*worlds], f"model {few}")
        return self.results

    def _policy(self, arm: str) -> Policy:
        spec = self.sim.spec
        return {RANDOM: Random, IDLE: Idle}[arm](spec) if arm in FLOORS else Actor.load(self.folder / arm, spec)

    def _train(self, arm: str, world: World, before: Path | None) -> None:
        if arm in self.results["practised"]:
            return
        config = Practice(
            method="ppo",
            steps=self.experiment.practice,
            hidden=HIDDEN,
            learning_rate=LEARNING_RATE if before is None else FINETUNING_RATE,
            entropy=ENTROPY,
            seed=self.seed,
            save_every_s=60,
        )
        train_policy(world, arm, self.folder / arm, config, lambda *_: None, before=before)
        self.results["practised"].append(arm)
        write_json(self.file, self.results)
        self.progress(f"seed {self.seed}: {arm} is trained")

    def _test(self, arm: str) -> None:
        """Plays on the real robot, in the simulator, and along the dial."""
        experiment, results, policy = self.experiment, self.results, self._policy(arm)
        results["real"][arm] = self._successes(self.real, policy)
        results["the simulator"][arm] = self._successes(self.sim, policy)
        if arm in ("nominal", "randomised") and experiment.gap:
            for gap in DIAL:
                results[f"dial {gap}"][arm] = self._successes(experiment.open_real(gap), policy)
        write_json(self.file, results)

    def _test_in_model(self, count: int) -> None:
        """Plays all tested arms in one model, that of `count` real episodes, also those of earlier runs."""
        for arm in self.results["real"]:
            if arm not in self.results["the model"]:
                self.results["the model"][arm] = self._successes(self.model(count)[0], self._policy(arm))
                write_json(self.file, self.results)

    def _test_with_camera(self, arms: list[str], best: str) -> None:
        """Tests policies that read their goal off a camera picture, on the real robot with its look."""
        experiment = self.experiment
        kept = self.results.setdefault("camera", {}).setdefault(experiment.look_hash, {})
        pairs = {name: pair for name, pair in camera_arms(arms, best).items() if name not in kept.get("arms", {})}
        real = experiment.open_real(look=experiment.look)
        folder = self.folder / experiment.look_hash[:8]
        encoders = Encoders(experiment.sim, real, experiment.looks, folder, self.seed, self.progress)
        for name in dict.fromkeys(encoder for _, encoder in pairs.values()):
            encoder = encoders[name]
            error = encoders.error(encoder)
            for arm, (policy, its_encoder) in pairs.items():
                if its_encoder == name:
                    kept.setdefault("errors", {})[arm] = error
                    actor = Actor.load(self.folder / policy, self.sim.spec)
                    kept.setdefault("arms", {})[arm] = self._successes(with_encoder(real, encoder), actor)
            write_json(self.file, self.results)

    def _successes(self, world: World, policy: Policy) -> list[int]:
        played = play(world, policy, self.experiment.episodes, PlaySettings(self.steps, self.criterion), STARTS)
        return [int(bool(episode.success)) for episode in played.episodes]

    def _gathered(self, policy: Path, count: int, number: int = 0) -> Trials:
        """Real episodes to learn from, of a policy with some random actions, in round `number`. Fewer are a part of more."""
        actor = Actor.load(policy, self.sim.spec, greedy=False)
        noisy, seed = NoisyPolicy(actor, RANDOM_ACTIONS, self.sim.spec), GATHERED + self.seed + 1000 * number
        blocks = (collect(self.real, noisy, GATHER, seed + 1_000_000 * at) for at in range(-(-count // GATHER)))
        return reduce(Trials.joined_with, blocks)[:count]

    def model(self, count: int) -> tuple[World, Path]:
        """The model of `count` real episodes, and the policy that gathered the last of them. They are gathered in rounds, because
        the first policy does not visit where a better one goes."""
        if count in self._models:
            return self._models[count]
        rounds = min(self.experiment.rounds, count)
        shares = [count // rounds + (number < count % rounds) for number in range(rounds)]
        policy = self.folder / "first"
        trials = self._gathered(policy, shares[0])
        for number, share in enumerate(shares):
            name = f"{count}, round {number + 1}"
            if number:
                trials = trials.joined_with(self._gathered(policy, share, number))
            residual = self.folder / f"residual {name}"
            model = fit_residual(fitted_simulator(self.sim), trials, residual, self.seed)
            if number + 1 < len(shares):
                self._train(f"model {name}", model, policy)
                policy = self.folder / f"model {name}"
        self._models[count] = model, policy
        return self._models[count]

    def identified(self, count: int) -> World:
        world = Randomised(self.sim, read(self.experiment.randomise))
        best = identify(world, self._gathered(self.folder / "first", count), self.seed)
        self.results["identified"] = {**best.values, "error": best.error, "nominal error": best.nominal}
        return Randomised(self.sim, best.around(world.distributions))


def fit_residual(sim: MujocoWorld, trials: Trials, folder: Path, seed: int, mark: str = "") -> Corrected:
    """The simulator with a residual that is fitted to the trials; it continues where it was stopped. TrainingError where the
    folder holds a residual of another mark."""
    inputs, targets = residual_targets(sim, trials)
    torch.manual_seed(seed)
    network = Residual(sim.file.nq, sim.file.nu)
    network.fit_scales(inputs, targets)
    facts: Mapping[str, Any] = {
        "episodes": len(trials.actions),
        "rows": len(inputs),
        **({"mark": mark} if mark else {}),
    }
    run = Run(folder, facts, lambda *_: None, seed)
    feed = RandomBatches(lambda now: drawn_rows(inputs, targets, now))
    Trainer(run, "residual", feed, Regression(network, network.unit, network.scale, LEARNING_RATE), FITTED).train()
    return Corrected(sim, network)
