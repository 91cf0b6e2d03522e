"""`practise`: fine-tunes a policy in a world by rewards that a rule computes, and measures what that gained inside and outside."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from ..act.actor import RUN_SUBFOLDER, policy_folder
from ..act.paired_evaluation import CHUNK
from ..act.planning import SuccessCriterion
from ..act.planning.costs import checked_goal
from ..core.errors import PlanningError, TerrellaError
from ..core.files import write_json
from ..core.spec import Spec
from ..learn.recipes.verified import RewardRule, VerifiedPractice, load_practised, practise_verified
from ..measure.practice_gains import AFTER, BEFORE, BLIND, PracticeGains, practice_gains
from ..measure.trust import forecast_trust
from .evaluate import EvaluateConfig, Evaluation, open_evaluation, play_policies, settings_of
from .evaluation_log import EvaluationLog, fingerprint
from .goals import read_goal
from .opening import EnvironmentConfig
from .progress import Progress, silent, stage, stopping_with
from .results import folder_name, jsonable, table_lines

CLEARLY = 0.9  # share of the error of copy-last below which a world predicts a channel
NOTES = "practise.json"


@dataclass(frozen=True)
class VerifiedPracticeConfig:
    """Settings of `practise`."""

    # verified: 1 where the goal is reached within --steps, by --goal, --success or both, or the nearness to --reference. predicted:
    # the return that the world's channel `reward` predicts, which practice may exploit.
    reward: Literal["verified", "predicted"] = "verified"
    goal: tuple[str, ...] = ()
    """The goal, one CHANNEL=VALUE or more: observation=_,0 (_ matches any)."""
    within: float = 0.05  # Distance at which the goal is reached: a share of the range of numbers, where they have one.
    success: str | None = None
    """Channel that is above 0 in success. Beside --goal both must hold: a learned predictor, checked by a rule."""
    reference: str | None = None
    """A recording: rollouts begin with its episodes, and are rewarded for staying near to them."""
    real: str | None = None
    """The real environment, in which the gain outside is measured; default: none, and the verdict says so."""
    environment: EnvironmentConfig = EnvironmentConfig()
    steps: int | None = None  # Steps per episode at most; default: the environment's limit, or 200.
    episodes: int = 300  # Episodes of each policy, inside and outside.
    blind: bool = True
    """--no-blind: leave out the arm that practises without seeing the world."""
    practice: VerifiedPractice = VerifiedPractice()
    out: Path | None = None  # Folder of the run; default: practised/ and the policy's name.


@dataclass(frozen=True)
class VerifiedPracticeResult:
    """What practice gained, and the policy."""

    gains: PracticeGains
    policy: Path  # Folder of the policy.
    settings: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return jsonable({**self.gains.to_json(), **self.settings, "policy": self.policy})

    def summary(self) -> str:
        lines = [*self.gains.verdict(), "", *table_lines(*self.gains.table()), *self.gains.replay_lines()]
        return "\n".join([*lines, f"the policy: {self.policy}"])


def practise_by_rule(
    policy: str | Path, world: str | Path, config: VerifiedPracticeConfig, *, progress: Progress = silent
) -> VerifiedPracticeResult:
    """Fine-tunes the policy of a folder in a world by computed rewards, and measures the gain inside and in the real environment
    from the same starts, beside a blind arm.

    policy: a folder of `train policy`. world: as in `train policy`. The same call continues where an earlier one was stopped.
    TerrellaError for what cannot be practised.
    """
    inside, folder = str(world), Path(config.out or f"practised/{folder_name(str(policy))}")
    _check(policy, folder, config)
    evaluated = EvaluateConfig(
        config.real, config.environment, config.episodes, config.steps, within=config.within, device="cpu",
        seed=config.practice.seed,
    )  # fmt: skip
    study = open_evaluation(inside, evaluated, progress, lambda spec: _rule(config, spec))
    dream, steps = study.pair.dream, study.pair.steps
    load_practised(policy, dream, config.practice.noise)  # refuses what does not fit
    study.load(str(policy))
    _check_study(study, config, progress)
    criterion = study.pair.criterion if config.reward == "verified" else SuccessCriterion()
    rule, arms = RewardRule(criterion, steps, config.reference), {BEFORE: str(policy)}
    practice = config.practice
    for arm in (AFTER, BLIND) if config.blind else (AFTER,):
        with (
            stage(f"practising{', blind' * (arm == BLIND)}", progress) as report,
            stopping_with("stopped; the same command continues."),
        ):
            run = folder / BLIND if arm == BLIND else folder
            facts = practise_verified(dream, policy, run, practice, rule, report, blind=arm == BLIND)
        arms[arm] = str(run)
        practice = replace(practice, updates=facts["step"], minutes=None)  # the blind arm practises as much
    log = EvaluationLog(
        folder / "evaluation", settings_of(inside, evaluated, study) | _what_succeeds(config),
        {name: fingerprint(Path(name) / "policy" if arm != BEFORE else name) for arm, name in arms.items()},
    )  # fmt: skip
    play_policies(study, log, tuple(arms.values()), config.episodes, progress)
    gains = practice_gains({arm: log.scores(name, config.episodes) for arm, name in arms.items()}, config.practice.seed)
    result = VerifiedPracticeResult(gains, folder / "policy", {**log.settings, "updates": facts["step"]})
    write_json(folder / NOTES, result.to_json())
    return result


def _what_succeeds(config: VerifiedPracticeConfig) -> dict[str, Any]:
    return {"goal": list(config.goal), "success": config.success, "reward": config.reward}


def _check(policy: str | Path, out: Path, config: VerifiedPracticeConfig) -> None:
    if not Path(policy).is_dir():
        raise TerrellaError(f"there is no folder {policy}: give the folder of a policy by `terrella train policy`.")
    if (out / RUN_SUBFOLDER).resolve() == policy_folder(policy).resolve():
        raise TerrellaError(f"{out} holds the policy itself, which the gain is measured against; give another --out.")
    if config.episodes < 1 or (config.steps is not None and config.steps < 1) or not config.within > 0:
        raise TerrellaError("--episodes and --steps are whole numbers from 1 up, and --within is above 0.")
    if not config.goal and not config.success:
        raise TerrellaError(
            "say what success is, so that it can be verified: --goal CHANNEL=VALUE, --success CHANNEL, or both."
        )
    if config.reference and config.reward != "verified":
        raise TerrellaError("--reference is a verified reward; leave --reward predicted out.")


def _rule(config: VerifiedPracticeConfig, spec: Spec) -> SuccessCriterion:
    """When an episode succeeds, in a world with this spec."""
    goal: dict[str, torch.Tensor] = {}
    for text in config.goal:
        if "=" not in text:
            raise TerrellaError(f"--goal {text}: give CHANNEL=VALUE, as in observation=_,0.")
        goal |= read_goal(text, spec)
    if config.success:
        spec.check_channels((config.success,))
    return SuccessCriterion(checked_goal(spec, goal) if goal else {}, config.within, config.success or "")


def _check_study(study: Evaluation, config: VerifiedPracticeConfig, progress: Progress) -> None:
    """PlanningError for a goal that the world cannot predict, that lies beyond its range or where every start is; says where trust
    ends."""
    pair, spec = study.pair, study.pair.dream.spec
    if pair.real is not None and pair.criterion.goal:
        checked_goal(pair.real.spec, {name: value[0] for name, value in pair.criterion.goal.items()})
    if config.reward == "predicted" and "reward" not in spec.channels:
        raise PlanningError(f"{spec.name} has no channel 'reward' that --reward predicted could take.")
    validation = spec.card.get("validation")
    errors = validation.get("errors", {}) if isinstance(validation, Mapping) else {}
    for name in pair.criterion.channels:
        arms = errors.get(name, {})
        true, still = (arms.get(arm) or {} for arm in ("true actions", "copy-last"))
        if true and not any(true[step] < CLEARLY * still[step] for step in true if step in still):
            raise PlanningError(
                f"{spec.name} does not predict '{name}' better than copying its last value, so success in it says nothing: train "
                "it longer, record more, or name another channel."
            )
    pair.starts(0, min(CHUNK, config.episodes))  # refuses a goal that every start has reached
    forecast = forecast_trust(pair.dream, pair.steps)
    if forecast is not None and forecast.ends:
        progress(
            f"{spec.name} is not trusted beyond {max(1, forecast.steps)} of {pair.steps} steps: watch the gain outside."
        )
