"""`train policy`: a policy practises in a world only, and is then tried in the real environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import torch
from tyro.conf import arg

from .. import library
from ..act.actor import Actor
from ..act.belief import load_learned_policy
from ..act.planning import PlaySettings, play
from ..core.errors import TerrellaError
from ..core.policy import Policy, Random, observed_channels
from ..core.world import World, make_rng
from ..learn.growth import Scaled
from ..learn.recipes import imitation
from ..learn.recipes import policy as recipe
from ..learn.recipes.imitation import Imitation
from ..learn.recipes.policy import Practice
from ..measure.statistics import Figure, mean_interval
from .opening import Device, EnvironmentConfig, load_named
from .progress import Progress, silent, stage
from .real_environment import STEPS, check_alike, open_copied, open_real, refuse_randomised
from .results import changed_settings, jsonable
from .trust import practice_within_trust

IMITATED_WITH = ("sees", "minutes", "steps", "batch", "hidden", "learning_rate", "save_every_s", "seed")


@dataclass(frozen=True)
class TrainPolicyConfig:
    """Settings of `train policy`."""

    out: Path  # Folder of the run: the policy, its checkpoint and a log.
    practice: Practice = Practice()
    imitation: Imitation = Imitation()
    recording: Annotated[tuple[str, ...], arg(name="from")] = ()
    """A recording in whose states practice begins (default: where the world's own episodes begin), or that is imitated; several
    are imitated by one policy, which drives each of their bodies."""
    grow: bool = False
    """Start with --randomise ranges of width zero and widen them to those of the file as the policy's return
    holds up."""
    real: str | None = None
    """The environment in which the policy is tried afterwards (gym:Pendulum-v1), beside random actions from the same starts."""
    episodes: int = 20  # Episodes of that trial.
    device: Device = "auto"
    environment: EnvironmentConfig = EnvironmentConfig()

    def __post_init__(self):
        if isinstance(self.recording, str):
            object.__setattr__(self, "recording", (self.recording,))


@dataclass(frozen=True)
class TrainPolicyResult:
    """A policy that practised, and its trial in the real environment."""

    world: str | None  # The world in which it practised; None if it imitates a recording.
    facts: Mapping[str, Any]  # Of the training run: policy (its folder), practised_steps, minutes, losses.
    trial: PolicyTrial | None  # None without a real environment.

    @property
    def folder(self) -> Path:
        """The folder of the policy."""
        return Path(self.facts["policy"])

    def to_json(self) -> dict[str, Any]:
        if self.trial is None:
            return jsonable(self.facts)
        return jsonable({**self.trial.to_json(), **self.facts})

    def summary(self) -> str:
        test = str(self.facts.get("held_out_verdict", ""))
        if self.trial is None:
            facts = (f"{name}: {value}" for name, value in self.to_json().items() if name != "held_out_verdict")
            return "\n".join(filter(None, [test, *facts]))
        if test:
            learned = f"{test}\n{self.facts['step']:,} steps of training"
        else:
            learned = f"{self.facts['practised_steps']:,} steps of practice in {self.facts['minutes']:.1f} minutes"
        return "\n".join([*self.trial.lines(), learned, f"the policy: {self.facts['policy']}"])


@dataclass(frozen=True)
class PolicyTrial:
    """A policy's episodes in the real environment, beside random actions from the same starts."""

    real: str
    inside: str | None  # The world that it practised in, if any.
    figures: Mapping[str, Figure]
    """Returns: "return" of the policy, "at random", "better by" (start by start), "promised" by the learned world."""

    @property
    def verdict(self) -> str:
        better = self.figures["better by"]
        if better.low > 0:
            return f"It acts better than chance in {self.real}, by {better}."
        if better.high < 0:
            why = ": the world that it practised in misleads it." if self.inside else "."
            return f"It acts worse than chance in {self.real}, by {better}{why}"
        return f"It is not seen to act better than chance in {self.real}: by {better}."

    def lines(self) -> list[str]:
        figures = self.figures
        lines = [self.verdict, f"return {figures['return']}; at random from the same starts {figures['at random']}"]
        if "promised" in figures:
            lines.append(f"in {self.inside} itself, where it practised: {figures['promised']}")
        return lines

    def to_json(self) -> dict[str, Any]:
        return {"verdict": self.verdict, **{name: asdict(figure) for name, figure in self.figures.items()}}


def train_policy(
    world: str | Path | None, config: TrainPolicyConfig, *, progress: Progress = silent
) -> TrainPolicyResult:
    """Trains a policy on imagined rollouts of a world, hundreds at once, or on the actions of a recording (method imitation), and
    tries it in the real environment.

    world: a name that `terrella.worlds()` lists, the path of a checkpoint or a run, or a simulator (gym:ID); None for imitation.
    The same call continues where an earlier one was stopped. TerrellaError for what cannot be practised.
    """
    if config.episodes < 1:
        raise TerrellaError("--episodes is a whole number from 1 up.")
    if config.practice.method == "imitation":
        return _imitate(world, config, progress)
    if given := changed_settings(config.imitation):
        raise TerrellaError(f"{_flags(given)}: only --method imitation has a use for that.")
    if world is None:
        raise TerrellaError(
            "say in which world the policy practises, --in WORLD, or --method imitation --from RECORDING."
        )
    if len(config.recording) > 1:
        raise TerrellaError("--from: practice begins in the states of one recording; only imitation takes several.")
    environment, world, out = config.environment, str(world), Path(config.out)
    if config.grow and environment.randomise is None:
        raise TerrellaError("--grow widens the ranges of a file: name it with --randomise FILE.")
    refuse_randomised(world, environment)
    truth = library.is_truth(world)
    inside = open_copied(world, environment) if truth else load_named(world, config.device, progress=progress)
    outside = None if config.real is None else open_real(config.real, environment, inside.spec)
    if outside is not None:
        check_alike(inside.spec, outside.spec)
    growing = cast(Scaled, inside) if config.grow else None
    practice = practice_within_trust(inside, config.practice, progress)
    with stage("practising", progress) as report:
        began = next(iter(config.recording), None)
        facts = recipe.train_policy(inside, world, out, practice, report, began, growing=growing)
    if outside is None:
        return TrainPolicyResult(world, facts, None)
    trial = try_policy(out, inside, outside, config.episodes, config.practice.seed, progress)
    return TrainPolicyResult(world, facts, trial)


def _imitate(world: str | Path | None, config: TrainPolicyConfig, progress: Progress) -> TrainPolicyResult:
    """A policy of a recording's actions. TerrellaError where settings have no use."""
    given = changed_settings(replace(config.practice, method=None))
    useless = {name: value for name, value in given.items() if name.removeprefix("no_") not in IMITATED_WITH}
    useless |= {"in": world} if world is not None else {}
    if useless or config.grow:
        raise TerrellaError(
            f"{_flags(useless) or '--grow'}: imitation learns from a recording and has no use for that."
        )
    if not config.recording:
        raise TerrellaError("say which recording is imitated: --from RECORDING.")
    outside = None
    if config.real is not None:
        outside = config.environment.open(config.real)
    with stage("imitating", progress) as report:
        facts = imitation.train_imitation(
            config.recording, config.out, config.practice, config.imitation, report, config.device,
            spec=None if outside is None else outside.spec,
        )  # fmt: skip
    if outside is None:
        return TrainPolicyResult(None, facts, None)
    trial = try_policy(config.out, None, outside, config.episodes, config.practice.seed, progress)
    return TrainPolicyResult(None, facts, trial)


def _flags(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in settings)


def try_policy(
    folder: Path, inside: World | None, outside: World, episodes: int, seed: int, progress: Progress
) -> PolicyTrial:
    """Plays the policy in `folder` in the environment, random actions from the same starts, and, where the world that it practised
    in is learned, the policy in that world."""
    steps = outside.spec.max_episode_steps or STEPS

    def returns(world: World, policy: Policy, what: str, sees: Sequence[str] = ()) -> torch.Tensor:
        with stage(what, progress) as report:
            played = play(world, policy, episodes, PlaySettings(steps, sees=sees), seed, report)
        return torch.tensor([episode.reward for episode in played.episodes])

    actor = load_learned_policy(folder, outside.spec, inside)
    sees = [name for name in observed_channels(actor, outside.spec) if name in outside.spec.channels]
    mine = returns(outside, actor, "acting", sees)
    floor = returns(outside, Random(outside.spec), "acting at random")
    values = {"return": mine, "at random": floor, "better by": mine - floor}
    if inside is not None and inside.spec.observes:
        dreamer = Actor.load(folder, inside.spec)
        values["promised"] = returns(inside, dreamer, "acting in the learned world", dreamer.sees)
    figures = {name: mean_interval(each, make_rng(seed)) for name, each in values.items()}
    return PolicyTrial(outside.spec.name, inside.spec.name if inside else None, figures)
