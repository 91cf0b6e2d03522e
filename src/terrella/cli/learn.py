"""The command `terrella learn`: from an environment's id to a playable world with a scorecard, within a number of minutes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from .. import progress
from ..core.errors import DatasetError, TerrellaError
from ..core.world import World, make_rng
from ..data import Dataset
from ..data.recording import LONGEST
from ..learn.recipes.video import TrainConfig, train_video
from ..learn.recording import MOST, learned_size
from ..measure import CLIPS, Exam, ExamConfig, most_clips_within, verdict
from .named import Controls, Environment
from .plan import RECORDING, SCORING, TRAINING, Plan, folder_for
from .practising import practise as rounds_of_practice
from .record import described, explore, looked_at, stored_as
from .say import Json, Seed, result, say
from .score import QUICK_HORIZONS, arms_of, carded, exam_of

Report = Callable[..., None]
ENDLESS = 10**9  # steps: training ends with its time
EPISODES = 12  # or more are recorded, if need be shorter ones: some are kept out of training, to score it
SIZES, FEWEST = (50, 24, 12, 6, 3), 6  # numbers of clips, the most for which there is time; fewer are too few
SAVE_EVERY_S = 30.0
SMALL = 64 * 96  # pixels of a picture at most, if there are fewer minutes than SOON_MIN: of more it learns too little
SOON_MIN = 60
FEW_FRAMES, FEWEST_FRAMES = 600, 100  # so many are recorded if half of the time allows it; fewer teach nothing
PLAYED, STEADY = 32, 25  # steps a second that a learned world plays on two cores; to which faster ones are brought
FEW_STEPS = 600  # after which a world has learned next to nothing


def learn(
    name: Positional[str],
    controls: Controls,
    environment: Environment,
    minutes: float = 30.0,
    out: Path | None = None,
    frames: int = 20_000,
    practise: bool = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Learn a world of an environment, in one go: a script explores and records it, a world is trained on that, and scored.

    Stop it with Ctrl-C, or in any other way: the same command goes on where it was stopped.

    Args:
        name: The environment (gym:CarRacing-v3, gym:ALE/Breakout-v5, gym:PACKAGE:ID) or game (doom:my_way_home).
        minutes: Time for all of it, earlier runs included. With more than a finished world had, it is trained on.
        out: Folder for the recording, the run and the score; default: learned/ and the environment's name.
        frames: Frames to record at most; an eighth of the time is recorded if there are not so many sooner.
        practise: Learn a policy, too: collect with it, learn a latent world, practise in that, and again (see docs/practice.md).
    """
    if not 0 < minutes < math.inf or frames < 100:
        raise TerrellaError("--minutes is a time above 0, and --frames are 100 or more.")
    if practise:
        if any(asdict(controls).values()):
            raise TerrellaError("--keys, --action-names and --idle are for a person who plays; --practise takes none.")
        return rounds_of_practice(name, environment, minutes, out or folder_for(name), frames, seed, json)
    asked = {"environment": name, "frames": frames, "seed": seed, **asdict(environment), **asdict(controls)}
    plan = Plan(out or folder_for(name), asked, minutes)
    if SCORING in plan.facts:
        say(f"{plan.folder} is finished; --minutes with more than {minutes:g} trains it on.")
    else:
        _go(plan, name, controls, environment)
    _tell(plan, json)


def _go(plan: Plan, name: str, controls: Controls, environment: Environment) -> None:
    """All stages that are not over."""
    took = ", ".join(f"{words} {_minutes(plan.spent[stage])}" for stage, words in _DID.items() if plan.spent[stage])
    if took:
        say(f"Goes on in {plan.folder}: {took} so far.")
    if RECORDING in plan.facts:
        _promise(plan)
    for stage, work in ((RECORDING, _record), (TRAINING, _train), (SCORING, _score)):
        if stage in plan.facts:
            continue
        try:
            with progress.shown(stage) as report, plan.stage(stage, report) as told:
                facts = work(plan, name, controls, environment, told)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(
                str(stop) or f"stopped while {stage}; the same command goes on from there."
            ) from stop
        except Exception:
            plan.forget()
            raise
        plan.note(stage, facts)
        if stage != SCORING:
            say(f"{_DID[stage].capitalize()} {_minutes(plan.spent[stage])}: {_summary(facts)}")


def _promise(plan: Plan) -> None:
    parts = [f"{words} {_minutes(plan.left_s(stage))}" for stage, words in _DOES.items() if stage not in plan.facts]
    say(f"Of {_minutes(plan.seconds)} it {', '.join(parts)}; all of it lies in {plan.folder}.")


_DOES = {RECORDING: "records for up to", TRAINING: "trains for", SCORING: "scores for"}
_DID = {RECORDING: "recorded for", TRAINING: "trained for", SCORING: "scored for"}


def _record(plan: Plan, name: str, controls: Controls, environment: Environment, report: Report) -> dict[str, object]:
    opened = plan.facts.setdefault("opened", name if plan.recorded else _slowed(name, environment))
    world = controls.of(_open(opened, environment, SMALL if plan.seconds < 60 * SOON_MIN else MOST))
    _promise(plan)  # nothing is promised of what does not open
    if opened != name:
        held = opened.rpartition("@")[2]
        say(
            f"Each action is held for {held} steps of the game, which has more than are played in real time; {name}@1 takes all."
        )
    for line in described(world.spec):
        say(line)
    out, frames = plan.folder / RECORDING, plan.asked["frames"]
    plan.facts.setdefault("longest", _longest(world, frames, plan.share_s[RECORDING]))
    plan.save()
    rows = 0

    def few_s() -> float:
        """Seconds for which it goes on beyond its time, at this pace, for there are few frames."""
        spent = plan.spent[RECORDING]
        return min(plan.seconds / 2 - spent, (FEW_FRAMES / max(rows, 1) - 1) * spent)

    def told(done: float, total: float, words: str = "", left_s: float | None = None) -> None:
        nonlocal rows
        rows = done
        late = plan.left_s(RECORDING) <= 0 < few_s()
        report(done, total, *((f"a slow game: until it has {FEW_FRAMES} frames", few_s()) if late else (words, left_s)))

    def enough() -> bool:
        return plan.left_s(RECORDING) <= 0 and few_s() <= 0

    more: dict[str, Any] = {"max_episode_steps": plan.facts["longest"], "enough": enough}
    explore(world, out, frames, plan.asked["seed"], told, stored_as(world.spec), **more)
    dataset = Dataset(out)
    if dataset.length < min(FEWEST_FRAMES, frames):
        raise DatasetError(
            f"{name} gave {dataset.length} frames in {_minutes(plan.spent[RECORDING])}, too few to learn from; the same command "
            "with more --minutes goes on recording."
        )
    return looked_at(dataset, world.spec.name)


def _slowed(name: str, environment: Environment) -> str:
    """The environment, each action held for so many of its steps (gym:ID@N) that there are some 25 a second, where there are
    more than can be played in real time."""
    if not name.startswith("gym:") or "@" in name or environment.fps:
        return name
    world = environment.open(name)
    rate = 1 / world.spec.dt_s
    if callable(close := getattr(world, "close", None)):
        close()
    return name if rate <= PLAYED else f"{name}@{max(2, round(rate / STEADY))}"


def _open(name: str, environment: Environment, most: int) -> World:
    """The environment, with pictures of the size at which they are learned, of `most` pixels, if that is smaller."""
    world = environment.open(name)
    drawn = world.spec.channels.get("rgb")
    if drawn is None:
        raise TerrellaError(
            f"{name} shows no pictures, and a world is learned from them; an environment draws itself as rgb_array, "
            "or its observation is a picture."
        )
    height, width = (drawn.shape or (0, 0))[:2]
    if environment.size or not name.startswith("gym:") or height * width <= most:
        return world
    if callable(close := getattr(world, "close", None)):
        close()
    return replace(environment, size=learned_size(height, width, most)).open(name)


def _longest(world: World, frames: int, seconds: float) -> int:
    """Steps of an episode, at most, of which some are recorded in the time, by a trial of a few."""
    rng = make_rng(0)
    state = world.start(1, rng)
    began, done = time.monotonic(), 0
    while done < 20 or (done < 200 and time.monotonic() - began < 1):
        state = world.imagine(state, world.spec.sample_action(1, rng), rng)
        seen = world.render(state, list(world.spec.channels))
        done += 1
        if "done" in seen and bool(seen["done"][0]):
            state = world.start(1, rng)
    pace_s = (time.monotonic() - began) / done
    expected = min(frames, seconds / pace_s)
    return min(world.spec.max_episode_steps or LONGEST, LONGEST, max(100, int(expected / EPISODES)))


def _train(plan: Plan, name: str, controls: Controls, environment: Environment, report: Report) -> dict[str, object]:
    hours = plan.share_s[TRAINING] / 3600
    config = TrainConfig(
        plan.folder.name, steps=ENDLESS, hours=hours, seed=plan.asked["seed"], save_every_s=SAVE_EVERY_S
    )
    facts = train_video(plan.folder / RECORDING, plan.folder / "run", config, report)
    if facts["step"] < FEW_STEPS:
        say(
            f"Warning: there was time for {facts['step']} training steps alone; the same command with more --minutes trains it on."
        )
    return {"world": facts["world"], "steps": facts["step"]}


def _score(plan: Plan, name: str, controls: Controls, environment: Environment, report: Report) -> dict[str, object]:
    run, data, seed = str(plan.folder / "run"), plan.folder / RECORDING, plan.asked["seed"]
    arms, closing = arms_of(run, "auto", False, True)
    try:
        exam, identity = _exam(arms, closing, data, seed, report)
    except DatasetError as error:
        return {"verdict": [f"{plan.folder.name} is not scored: {error}"]}
    report(0, 1, "measuring how fast the world is")
    if "clips" not in plan.facts:
        plan.note("clips", most_clips_within(exam, plan.left_s(SCORING), SIZES))
    card, files = carded(run, exam.of(plan.facts["clips"]), identity, plan.folder / "score", report)
    return {"verdict": verdict(card), "card": str(files[1])}


def _exam(
    arms: Mapping[str, World], closing: Mapping[str, World], data: Path, seed: int, report: Report
) -> tuple[Exam, str]:
    """Over the longest steps of which enough clips fit into the episodes that training did not see."""
    found: list[tuple[Exam, str]] = []
    why: DatasetError | None = None
    for horizons in (QUICK_HORIZONS, (1, 8, 16), (1, 8), (1, 4)):
        try:
            config = ExamConfig.quick(horizons)
            found.append(exam_of(arms, closing, data, None, False, max(SIZES), 0, config, seed, report))
        except DatasetError as error:
            why = why or error
            continue
        if _clips(found[-1][0]) >= FEWEST:
            return found[-1]
    if not found:
        assert why is not None
        raise why
    return max(found, key=lambda each: _clips(each[0]))


def _clips(exam: Exam) -> int:
    return min(len(clips) for clips in exam.sets[CLIPS].values())


def _tell(plan: Plan, json: bool) -> None:
    """The verdict, how to play, and where the card lies."""
    score = plan.facts[SCORING]
    play = f"terrella play {plan.folder / 'run'}"
    spent = {f"{stage}_minutes": round(seconds / 60, 2) for stage, seconds in plan.spent.items()}
    facts = {**score, "world": str(plan.folder / "run"), "play": play, **spent}
    lines = [*score["verdict"], f"play it: {play}"]
    lines += [f"the card: {score['card']}"] if "card" in score else []
    took = ", ".join(f"{words} {_minutes(plan.spent[stage])}" for stage, words in _DID.items())
    result(facts, json, "\n".join([*lines, f"It took {_minutes(sum(plan.spent.values()))}: {took}."]))


def _summary(facts: Mapping[str, object]) -> str:
    told = (
        "frames",
        "episodes",
        "frames_that_change",
        "places",
        "actions_with_a_clear_effect",
        "look",
        "steps",
        "world",
    )
    return "; ".join(f"{name.replace('_', ' ')} {facts[name]}" for name in told if name in facts)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{max(seconds, 0.0):.0f} s"
