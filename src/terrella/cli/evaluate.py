"""The command `terrella evaluate`: judges policies in a dream and, where there is one, in reality, and says how far both agree."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from .. import library, progress
from ..act.paired_evaluation import CHUNK, Chunk, PairedEvaluation, check_finite
from ..act.planning import Cost, FullyObserved, SuccessCriterion, distance_to
from ..act.policies_by_name import policy_of
from ..core.errors import PlanningError, TerrellaError
from ..core.policy import Policy, observed_channels
from ..core.spec import Spec
from ..core.world import World
from ..measure.policy_evaluation import RANDOM, as_dict, evaluate_policies, table, verdict
from ..measure.policy_evaluation_page import policy_evaluation_page
from .beside import STEPS, check_alike, compared, open_copied, open_real, sound
from .goals import REWARD, read_goal
from .judged_log import JudgedLog, crc_of, fingerprint
from .named import Device, Environment, device_of, load_named
from .say import Json, Seed, result

Inside = Annotated[str, arg(name="in", help="The world to judge them in: what `terrella list` shows, or its path.")]


@dataclass(frozen=True)
class _Case:
    """What is asked, with the worlds open. spec: of the channels that both show, which policies may be shown."""

    bench: PairedEvaluation
    spec: Spec
    cost: Cost | None

    def load(self, name: str) -> Policy:
        return policy_of(name, self.spec, self.bench.dream, self.cost)


def evaluate(
    policies: Positional[tuple[str, ...]],
    inside: Inside,
    environment: Environment,
    real: str | None = None,
    episodes: int = 50,
    steps: int | None = None,
    goal: str = REWARD,
    within: float = 0.05,
    success: str | None = None,
    out: Path | None = None,
    device: Device = "auto",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Judge policies in a world and in the real environment, from the same starts: does the dream rank them as reality does?

    Leaves a page of plots and all figures in a folder. Stop it with Ctrl-C at any time; the same command continues.

    Args:
        policies: random, idle, explorer, constant:VALUE, plan, plan:samples=16,horizon=12, the folder of a learned policy,
            MODULE:NAME or FILE.py:NAME of your own; with @0.3 behind it each action is random with probability 0.3.
        real: The environment that the world is held against (gym:CartPole-v1); without one, policies are judged in the world alone.
        episodes: Of each policy, in the world and in reality.
        steps: Of an episode at most; default: the environment's own limit, or 200.
        goal: What success is, and what `plan` plans for: a picture's file, numbers of the state, CHANNEL=VALUE, or reward.
        within: The distance at which a goal is reached: numbers count in shares of their range, pictures of full brightness.
        success: A channel that is above 0 where an episode has succeeded, in place of --within; the world must show it, too.
        out: Folder for the page and evaluate.json; default: evaluations/ and the world's name.
    """
    if episodes < 1 or (steps is not None and steps < 1) or not within > 0:
        raise TerrellaError("--episodes and --steps are whole numbers from 1 up, and --within is above 0.")
    if not policies:
        raise TerrellaError("name one policy or more: random, idle, plan, constant:VALUE, a folder, or FILE.py:NAME.")
    names = tuple(dict.fromkeys(policies))
    case = _opened(inside, environment, real, steps, goal, within, success, device, seed)
    every = names if RANDOM in names else (*names, RANDOM)
    for name in every:  # what does not fit is said before anything is played
        case.spec.check_channels(observed_channels(case.load(name), case.spec))
    asked = {"in": inside, "world": None if library.is_truth(inside) else fingerprint(library.folder_of(inside))}
    asked |= {"real": real, "goal": goal, "within": within, "success": success, "steps": case.bench.steps, "seed": seed}
    files = {"goal": goal, "adapter": (environment.adapter or "").rpartition(":")[0] or environment.adapter}
    asked |= asdict(environment) | {f"{what}'s file": crc_of(file) for what, file in files.items()}
    folder = out or Path("evaluations") / (re.sub(r"[^\w.-]+", "-", inside.strip("/:")) or "world")
    log = JudgedLog(folder, asked, {name: fingerprint(name) for name in every})
    _play(case, log, every, episodes)
    _report(log, names, episodes, folder, seed, json)


def _play(case: _Case, log: JudgedLog, names: tuple[str, ...], episodes: int) -> None:
    """Judges all policies chunk by chunk, so that whenever it is stopped all have had as many episodes."""
    chunks = [(number, min(CHUNK, episodes - number * CHUNK)) for number in range(-(-episodes // CHUNK))]
    try:
        with progress.shown("judging") as report:
            for number, count in chunks:
                for place, name in enumerate(names):
                    report(number * CHUNK * len(names) + count * place, episodes * len(names), name)
                    if not log.has(name, number * CHUNK + count):
                        chunk = _judged(name, case, partial(case.load, name), number, count)
                        log.add(name, number * CHUNK, chunk)
            report(1, 1)
    except KeyboardInterrupt:
        safe = min(log.count(name) for name in names)
        raise KeyboardInterrupt(
            f"stopped: {safe} of {episodes} episodes of each policy are safe in {log.file}; the same command goes on."
        ) from None
    finally:
        log.save()


def _judged(name: str, case: _Case, load: Callable[[], Policy], number: int, count: int) -> Chunk:
    try:
        chunk = case.bench.play(load, case.spec, number, count)
    except TerrellaError as error:
        raise type(error)(f"{name}: {error}") from error
    for place, found in (("reality", chunk.real), ("the dream", chunk.dream), ("the dream's control", chunk.control)):
        check_finite(name, place, found)
    return chunk


def _report(log: JudgedLog, names: tuple[str, ...], episodes: int, folder: Path, seed: int, json: bool) -> None:
    """Writes the figures and the page, and says what came of it."""
    labels = labels_of((*names, RANDOM))
    scores = {labels[name]: log.scores(name, episodes) for name in dict.fromkeys((*names, RANDOM))}
    followed = {labels[name]: log.followed(name) for name in names if log.followed(name)}
    found = evaluate_policies(scores, followed, [labels[name] for name in names], seed)
    facts = {
        **log.asked,
        "episodes": episodes,
        "policies": ", ".join(names),
        "solved_starts_left_out": log.skipped(names),
    }
    title = f"{facts['in']}: {len(names)} polic{'y' if len(names) == 1 else 'ies'} judged"
    page = folder / "evaluate.html"
    page.write_text(policy_evaluation_page(title, found, facts), encoding="utf-8")
    whole = sound({**as_dict(found), **facts, "names": {labels[name]: name for name in names}, "page": str(page)})
    log.save(whole)
    result(whole, json, "\n".join([*verdict(found), "", *table_lines(*table(found)), "", f"the page: {page}"]))


def table_lines(heads: list[str], lines: list[list[str]]) -> list[str]:
    widths = [max(len(line[at]) for line in [heads, *lines]) for at in range(len(heads))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip() for line in [heads, *lines]]


def labels_of(names: tuple[str, ...]) -> dict[str, str]:
    """Names without the folders that they begin with, as long as all stay different."""
    short = {
        name: re.sub(r"^.*\.py:", "", name) if ".py:" in name else name.rstrip("/").rpartition("/")[2] for name in names
    }
    return {name: one if list(short.values()).count(one) == 1 else name for name, one in short.items()}


def _opened(inside, environment, real, steps, goal, within, success, device, seed) -> _Case:
    """The worlds by their names, held to each other; a sentence for what does not fit."""
    if library.is_truth(inside):
        dream = _truth(inside, environment)
    else:
        dream = load_named(inside, device_of(device))
    acted = None if real is None else open_real(real, environment, dream.spec)
    if acted is not None:
        check_alike(dream.spec, acted.spec)
    specs = {dream.spec.name: dream.spec} if acted is None else {inside: dream.spec, str(real): acted.spec}
    for name, spec in specs.items():
        if success and success not in spec.channels:
            raise PlanningError(f"{name} has no channel '{success}'; it has {', '.join(spec.channels)}.")
    wanted = read_goal(goal, dream.spec)
    unseen = [at for at in wanted if acted is not None and at not in acted.spec.channels]
    if unseen and not success:
        raise PlanningError(
            f"{real} does not show {', '.join(unseen)}, so nobody can tell whether the goal is reached: name a channel that "
            "can with --success."
        )
    judged = SuccessCriterion(
        {} if success else {at: value[None] for at, value in wanted.items()}, within, success or ""
    )
    unpaid = [name for name, spec in specs.items() if "reward" not in spec.channels]
    if unpaid and not judged.defined:
        raise PlanningError(
            f"{' and '.join(unpaid)} tell{'s' if len(unpaid) == 1 else ''} no reward, so there is no return to judge by: say what "
            "success is with --goal or --success."
        )
    both = dream.spec.channels if acted is None else _shared(dream.spec, acted.spec)
    spec = replace(dream.spec, channels=both)
    limit = steps or (acted.spec if acted else dream.spec).max_episode_steps or dream.spec.max_episode_steps or STEPS
    known = compared(dream.spec, acted.spec) if acted else ()
    known = tuple(name for name in known if len(both[name].shape or ()) == 1 or name in dream.spec.observes)
    cost = distance_to(dream, wanted) if wanted else None
    return _Case(PairedEvaluation(dream, acted, judged, limit, seed, known), spec, cost)


def _truth(name: str, environment: Environment) -> World:
    """A simulator in place of a dream: one that can be put where the real one stands, if it can be copied."""
    try:
        return FullyObserved(open_copied(name, environment))
    except TerrellaError:
        return environment.open(name)


def _shared(dream: Spec, real: Spec) -> Mapping[str, Any]:
    """The channels that both show alike."""
    return {
        name: space
        for name, space in dream.channels.items()
        if name in real.channels and real.channels[name].shape == space.shape
    }
