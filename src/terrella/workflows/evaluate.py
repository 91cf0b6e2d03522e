"""`evaluate`: evaluates policies in a world and, where there is one, in the real environment, and measures how far both agree."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from .. import library
from ..act.best_of import best_of
from ..act.paired_evaluation import CHUNK, Chunk, PairedEvaluation, check_finite
from ..act.planning import Cost, FullyObserved, SuccessCriterion, distance, distance_to
from ..act.policies_by_name import Within, policy_of
from ..core.errors import PlanningError, TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.spec import Spec
from ..core.world import World
from ..measure.policy_evaluation import (
    DREAM,
    RANDOM,
    REAL,
    RETURN,
    SUCCESS,
    PolicyEvaluation,
    as_dict,
    evaluate_policies,
    table,
    verdict,
)
from ..measure.policy_evaluation_page import policy_evaluation_page
from .evaluation_log import EvaluationLog, crc_of, fingerprint
from .goals import REWARD, read_goal
from .opening import Device, EnvironmentConfig, device_of, load_named
from .progress import Progress, silent, stage
from .real_environment import STEPS, check_alike, comparable_channels, open_copied, open_real, refuse_randomised
from .results import folder_name, jsonable, table_lines
from .trust import trusted_searches

BEST_OF = re.compile(r"^best:(\d+):")


@dataclass(frozen=True)
class EvaluateConfig:
    """Settings of `evaluate`."""

    real: str | None = None
    """The real environment, to compare the world with (gym:CartPole-v1); default: none, the world alone."""
    environment: EnvironmentConfig = EnvironmentConfig()
    episodes: int = 50  # Episodes of each policy, in the world and in the real environment.
    steps: int | None = None  # Steps per episode at most; default: the environment's limit, or 200.
    # What counts as success, and the goal of the policy `plan`: a picture file, the state as numbers, or CHANNEL=VALUE. With
    # `reward` nothing counts as success, and policies are ranked by their return.
    goal: str = REWARD
    within: float = 0.05
    """Distance at which the goal is reached: a share of the range of numbers, or of the full brightness of pictures."""
    success: str | None = None
    """Channel of both worlds that is above 0 when an episode has succeeded, instead of --within."""
    best_of: tuple[int, ...] = ()
    """Numbers of plans, as in 4 16: evaluate each policy of a folder also as the best of that many plans, by the world."""
    out: Path | None = None  # Folder for the page and evaluate.json; default: evaluations/ and the world's name.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class EvaluateResult:
    """The scores of policies in a world and in the real environment."""

    scores: PolicyEvaluation  # Figures of each policy, and how far world and reality agree.
    settings: Mapping[str, Any]  # World, goal and episodes.
    names: Mapping[str, str]  # The short label of a policy in `scores` -> its name.
    page: Path

    def to_json(self) -> dict[str, Any]:
        return jsonable({**as_dict(self.scores), **self.settings, "names": self.names, "page": self.page})

    def summary(self) -> str:
        lines = [*verdict(self.scores), "", *table_lines(*table(self.scores))]
        return "\n".join([*lines, "", f"the page: {self.page}"])


def evaluate(
    policies: Sequence[str], world: str | Path, config: EvaluateConfig | None = None, *, progress: Progress = silent
) -> EvaluateResult:
    """Evaluates policies in a world and in the real environment from the same starts: does the world rank them as reality does?

    policies: names as in `load_policy`: random, plan:samples=16, a folder, ...; acting at random is evaluated as well. The page
    and evaluate.json are left in a folder; stopped at any time, the same call continues.
    """
    config, inside = config or EvaluateConfig(), str(world)
    if config.episodes < 1 or (config.steps is not None and config.steps < 1) or not config.within > 0:
        raise TerrellaError("--episodes and --steps are whole numbers from 1 up, and --within is above 0.")
    if not policies:
        raise TerrellaError("name one policy or more: random, idle, plan, constant:VALUE, a folder, or FILE.py:NAME.")
    names = tuple(dict.fromkeys((*policies, *_best_of(policies, config.best_of))))
    study = open_evaluation(inside, config, progress)
    every = names if RANDOM in names else (*names, RANDOM)
    for name in every:  # a policy that does not fit is refused before anything is played
        study.spec.check_channels(observed_channels(study.load(name), study.spec))
    folder = Path(config.out or f"evaluations/{folder_name(inside)}")
    marks = {name: fingerprint(BEST_OF.sub("", name)) for name in every}
    log = EvaluationLog(folder, settings_of(inside, config, study), marks)
    play_policies(study, log, every, config.episodes, progress)
    return _result(log, names, config, folder)


@dataclass(frozen=True)
class Evaluation:
    """The worlds of `evaluate`, opened and checked."""

    pair: PairedEvaluation
    spec: Spec  # Of the channels that both worlds render, which policies may see.
    cost: Cost | None
    within: Within  # Shortens the plans of the policy `plan`.

    def load(self, name: str) -> Policy:
        """The policy of a name; "best:4:FOLDER" is the best of 4 plans."""
        if best := BEST_OF.match(name):
            return best_of(name[best.end() :], int(best[1]), self.pair.dream, self.pair.criterion)
        return policy_of(name, self.spec, self.pair.dream, self.cost, self.within)


def _best_of(policies: Sequence[str], counts: Sequence[int]) -> list[str]:
    """The names of the best of some plans of each policy of a folder. TerrellaError where there is none, or a count is below 1."""
    folders = [name for name in policies if Path(name).is_dir()]
    if counts and (not folders or min(counts) < 1):
        raise TerrellaError(
            "--best-of takes counts from 1 up, and the folder of a policy by `train policy` that draws plans."
        )
    return [f"best:{count}:{name}" for name in folders for count in counts]


def settings_of(world: str, config: EvaluateConfig, study: Evaluation) -> dict[str, Any]:
    """What must not change for an evaluation to continue."""
    trained = None if library.is_truth(world) else fingerprint(library.folder_of(world))
    settings = {"in": world, "world": trained, "real": config.real, "goal": config.goal, "within": config.within}
    settings |= {"success": config.success, "steps": study.pair.steps, "seed": config.seed}
    adapter = config.environment.adapter or ""
    files = {"goal": config.goal, "adapter": adapter.rpartition(":")[0] or config.environment.adapter}
    return settings | asdict(config.environment) | {f"{what}'s file": crc_of(file) for what, file in files.items()}


def play_policies(
    study: Evaluation, log: EvaluationLog, names: tuple[str, ...], episodes: int, progress: Progress
) -> None:
    """Plays all policies chunk by chunk, so that all have the same number of episodes whenever it is stopped."""
    chunks = [(number, min(CHUNK, episodes - number * CHUNK)) for number in range(-(-episodes // CHUNK))]
    try:
        with stage("evaluating", progress) as report:
            for number, count in chunks:
                for place, name in enumerate(names):
                    report(number * CHUNK * len(names) + count * place, episodes * len(names), name)
                    if not log.has(name, number * CHUNK + count):
                        log.add(name, number * CHUNK, _played(study, name, number, count))
            report(1, 1)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_stopped(log, names, episodes)) from None
    finally:
        log.save()


def _stopped(log: EvaluationLog, names: tuple[str, ...], episodes: int) -> str:
    """What is safe, and the mean of each policy so far."""
    safe, means = min(log.count(name) for name in names), []
    for name in filter(log.count, names):
        arms = log.scores(name, episodes)
        measures = arms.get(REAL) or arms[DREAM]
        what = SUCCESS if SUCCESS in measures else RETURN
        means.append(f"{name} {what} {float(measures[what].mean()):.3g} of {log.count(name)}")
    far = f" So far: {', '.join(means)}." if means else ""
    return f"stopped: {safe} of {episodes} episodes of each policy are safe in {log.file}; the same command continues.{far}"


def _played(study: Evaluation, name: str, number: int, count: int) -> Chunk:
    try:
        chunk = study.pair.play(partial(study.load, name), study.spec, number, count)
    except TerrellaError as error:
        raise type(error)(f"{name}: {error}") from error
    arms = {"reality": chunk.real, "the dream": chunk.dream, "the dream's control": chunk.control}
    for place, episodes in arms.items():
        check_finite(name, place, episodes)
    return chunk


def _result(log: EvaluationLog, names: tuple[str, ...], config: EvaluateConfig, folder: Path) -> EvaluateResult:
    """Writes the figures and the page."""
    labels = labels_of((*names, RANDOM))
    scores = {labels[name]: log.scores(name, config.episodes) for name in dict.fromkeys((*names, RANDOM))}
    errors = {labels[name]: log.open_loop_errors(name) for name in names if log.open_loop_errors(name)}
    compared_scores = evaluate_policies(scores, errors, [labels[name] for name in names], config.seed)
    settings = {**log.settings, "episodes": config.episodes, "policies": ", ".join(names)}
    settings["solved_starts_left_out"] = log.skipped(names)
    title = f"{settings['in']}: {len(names)} polic{'y' if len(names) == 1 else 'ies'} evaluated"
    page = folder / "evaluate.html"
    page.write_text(policy_evaluation_page(title, compared_scores, settings), encoding="utf-8")
    result = EvaluateResult(compared_scores, settings, {labels[name]: name for name in names}, page)
    log.save(result.to_json())
    return result


def labels_of(names: tuple[str, ...]) -> dict[str, str]:
    """Names without the folders that they begin with, as long as all stay different."""
    short = {
        name: re.sub(r"^.*\.py:", "", name) if ".py:" in name else name.rstrip("/").rpartition("/")[2] for name in names
    }
    short |= {name: best[0] + short[name].rpartition(":")[2] for name in names if (best := BEST_OF.match(name))}
    return {name: one if list(short.values()).count(one) == 1 else name for name, one in short.items()}


def open_evaluation(
    name: str, config: EvaluateConfig, progress: Progress, rule: Callable[[Spec], SuccessCriterion] | None = None
) -> Evaluation:
    """The worlds by their names, held to each other. TerrellaError for what does not fit. rule: what success is in a world with a
    spec, in place of that of the settings; real episodes are then replayed in the world."""
    refuse_randomised(name, config.environment)
    if library.is_truth(name):
        dream = _simulator(name, config.environment)
    else:
        dream = load_named(name, device_of(config.device), progress=progress)
    real = (
        None
        if config.real is None
        else open_real(config.real, config.environment, dream.spec, "rgb" in dream.spec.channels)
    )
    if real is not None:
        check_alike(dream.spec, real.spec)
    goal = read_goal(config.goal, dream.spec)
    criterion = rule(dream.spec) if rule else _criterion(config, goal, dream.spec, real)
    _check_shown(criterion, config, real)
    measured = (real or dream).spec  # one unit of --within: the bounds of a learned world's numbers are not known
    criterion = replace(criterion, distance_to_goal=lambda _, goal, seen: distance(measured, goal, seen))
    specs = {dream.spec.name: dream.spec} if real is None else {name: dream.spec, str(config.real): real.spec}
    silent_ones = [each for each, spec in specs.items() if "reward" not in spec.channels]
    if silent_ones and not criterion.defined:
        raise PlanningError(
            f"{' and '.join(silent_ones)} {'has' if len(silent_ones) == 1 else 'have'} no reward, and so no return to rank by: "
            "say what success is with --goal or --success."
        )
    channels = dream.spec.channels if real is None else _shared(dream.spec, real.spec)
    limit = config.steps or (real or dream).spec.max_episode_steps or dream.spec.max_episode_steps or STEPS
    both = comparable_channels(dream.spec, real.spec) if real else ()
    both = tuple(one for one in both if len(channels[one].shape or ()) == 1 or one in dream.spec.observes)
    pair = PairedEvaluation(dream, real, criterion, limit, config.seed, both, real is not None and rule is not None)
    cost = distance_to(dream, goal) if goal else None
    return Evaluation(pair, replace(dream.spec, channels=channels), cost, trusted_searches(progress))


def _criterion(config: EvaluateConfig, goal: Mapping[str, Any], dream: Spec, real: World | None) -> SuccessCriterion:
    if config.success:
        if config.within != EvaluateConfig.within:
            raise TerrellaError(f"--success {config.success} says when an episode has succeeded; leave --within out.")
        for spec in (dream, *([real.spec] if real else [])):
            if config.success not in spec.channels:
                known = ", ".join(spec.channels)
                raise PlanningError(f"{spec.name} has no channel '{config.success}'; it has {known}.")
        return SuccessCriterion({}, config.within, config.success)
    return SuccessCriterion({name: value[None] for name, value in goal.items()}, config.within, "")


def _check_shown(criterion: SuccessCriterion, config: EvaluateConfig, real: World | None) -> None:
    """PlanningError where the real environment does not show what success is seen by."""
    hidden = [name for name in criterion.channels if real is not None and name not in real.spec.channels]
    if hidden:
        raise PlanningError(
            f"{config.real} does not show {', '.join(hidden)}, so nobody can tell whether the goal is reached: name a channel that "
            "can with --success."
        )


def _simulator(name: str, environment: EnvironmentConfig) -> World:
    """A simulator in place of the learned world. It is put where the real one is, if its states can be copied."""
    try:
        return FullyObserved(open_copied(name, environment))
    except TerrellaError:
        return environment.open(name)


def _shared(dream: Spec, real: Spec) -> Mapping[str, Any]:
    """The channels that both render in the same shape."""
    both = {name: space for name, space in dream.channels.items() if name in real.channels}
    return {name: space for name, space in both.items() if real.channels[name].shape == space.shape}
