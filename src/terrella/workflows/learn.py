"""`learn`: from an environment's id to a playable world with a scorecard, within a number of minutes."""

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..act.policies_by_name import policy_of
from ..core.errors import DatasetError, TerrellaError
from ..core.world import World, make_rng
from ..data import Dataset, Layout, RecordOptions
from ..data.collect import Job
from ..learn.devices import describe_device, free_bytes, one_thread, yield_cores
from ..learn.presets import PRESETS, PresetName, TrainingPlan
from ..learn.recipes.student import student_settings, train_student
from ..learn.recipes.video import TrainConfig, train_video
from ..learn.recording import MOST
from ..measure import CLIPS, Exam, ExamConfig, most_clips_within, verdict
from ..worlds.checkpoint import read_about
from ..worlds.flow import FlowNetwork
from ..worlds.folder import load_world
from .collect import explore, open_player, storage_of
from .learn_environment import held_to_real_time, longest_episode, open_small
from .learn_schedule import DISTILLING, RECORDING, SCORING, STUDENTS_SHARE, TRAINING, LearnSchedule, folder_for
from .learn_trial import FEW_STEPS, HOPELESS_STEPS, forecast, slower, time_environment
from .opening import ControlsConfig, Device, EnvironmentConfig, device_of, load_named
from .progress import Progress, Report, duration, silent, stage, stopping_with
from .record_meanwhile import Recorded, recording_meanwhile, spare_workers
from .recording_facts import describe, recording_facts
from .results import changed_settings, command, jsonable
from .score import QUICK_HORIZONS, ExamRequest, arms_of, digest_of, exam_of, write_card

ENDLESS = 10**9  # steps: training ends with its time
CLIP_COUNTS, FEWEST_CLIPS = (50, 24, 12, 6, 3), 6  # scoring takes the most clips for which there is time
SAVE_EVERY_S = 30.0
SMALL = (
    64 * 96
)  # pixels of a picture at most, in fewer minutes than SHORT_MIN: more pixels learn too little in that time
SHORT_MIN = 60
FEW_FRAMES, FEWEST_FRAMES = 600, 100  # a slow game is recorded for up to a third of the time until it has 600 frames
STRIPS = 20  # pictures of truth and prediction in a training, at most
STUDENT = "student"  # a folder, and the arm of its score
FURTHER = "recording-further"  # a folder, recorded while training has begun
_DOES = {
    RECORDING: "records for up to",
    TRAINING: "trains for",
    DISTILLING: "trains a student for",
    SCORING: "scores for",
}
_DID = {RECORDING: "recorded for", TRAINING: "trained for", DISTILLING: "trained a student for", SCORING: "scored for"}


@dataclass(frozen=True)
class LearnConfig:
    """Settings of `learn`."""

    minutes: float = 30.0
    """Time for all of it, earlier runs included. More minutes train a finished world further."""
    out: Path | None = None
    """Folder for the recording, the run and the score; default: learned/ and the environment's name."""
    frames: int = 20_000  # Frames to record at most; recording ends sooner after an eighth of the time.
    policy: str | None = None
    """Who plays while it records, as for `record world`; default: a script that explores."""
    seed: int = 0  # The same seed gives the same result.
    device: Device = "auto"
    # Size of the network of a world without depth: small, medium, large or huge (see `train video`). Default: by device and
    # minutes.
    preset: PresetName = "auto"
    # Also distil the world into a student of the preset small, which CPUs play: 0.8 GFLOP a frame of 64 x 64 pixels, three
    # tenths of the time of training.
    student: bool = False
    batch: int | None = None  # Frames per training step. Default: 8 on a CPU, 64 on a GPU.
    compile: bool = True  # --no-compile: on a GPU, train the network as it is.
    half: bool = True  # --no-half: train in float32 where the device computes bfloat16.
    # Processes that go on recording up to --frames while a world without depth trains. Default: on 4 cores or more some that
    # training leaves free, otherwise 0.
    workers: int | None = None
    controls: ControlsConfig = ControlsConfig()
    environment: EnvironmentConfig = EnvironmentConfig()


@dataclass(frozen=True)
class LearnResult:
    """A world that was learned, and its score."""

    verdict: tuple[str, ...]  # Sentences: is it better than copying the last frame, and how far can it be trusted?
    world: Path  # Folder of the run: `load` and `terrella play` open it.
    card: Path | None  # The page of the scorecard; None where too little was recorded to score.
    spent_s: Mapping[str, float]  # Seconds of each stage: recording, training, scoring.

    again: str  # The command that trains it further.
    steps: int  # Training steps so far.
    student: Path | None = None  # Folder of the student, if one was distilled.

    @property
    def play(self) -> str:
        return command("terrella", "play", self.world)

    @property
    def page(self) -> str:
        """The command that writes it as one page for others; "" where a browser cannot run it."""
        parts = read_about(self.world / "world")["parts"]
        if parts["generator"]["kind"] != FlowNetwork.kind or parts["generator"]["config"].get("views"):
            return ""
        return command("terrella", "export", "world", self.student or self.world, out=f"{self.world.parent.name}.html")

    def to_json(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"verdict": self.verdict} | ({"card": self.card} if self.card else {})
        minutes = {f"{name}_minutes": round(seconds / 60, 2) for name, seconds in self.spent_s.items()}
        following = {"play": self.play, "train_further": self.again}
        facts |= {STUDENT: self.student} if self.student else {}
        return jsonable({**facts, "world": self.world, "steps": self.steps, **following, **minutes})

    def summary(self) -> str:
        stages = ", ".join(
            f"{text} {duration(self.spent_s[name])}" for name, text in _DID.items() if self.spent_s[name]
        )
        lines = [*self.verdict, f"It took {duration(sum(self.spent_s.values()))}: {stages}."]
        lines += [f"the card: {self.card}"] if self.card else []
        few = f"{self.steps} training steps are too few to play it yet." if self.steps < HOPELESS_STEPS else ""
        lines.append(few or f"play it: {self.play}")
        lines += [f"play its student: {command('terrella', 'play', self.student)}"] if self.student else []
        lines += [f"as one page for others: {self.page}"] if not few and self.page else []
        return "\n".join([*lines, f"train it further: {self.again}"])


def learn(environment: str, config: LearnConfig = LearnConfig(), *, progress: Progress = silent) -> LearnResult:
    """Learns a world of an environment: a script explores and records it, a world is trained on that recording and scored.

    environment: gym:CarRacing-v3, gym:ALE/Breakout-v5, gym:PACKAGE:ID, or a game (doom:my_way_home).
    The same call continues where an earlier one was stopped. TerrellaError for what cannot be learned.
    """
    check_budget(config.minutes, config.frames)
    device_of(config.device)
    settings = {"environment": environment, "frames": config.frames, "seed": config.seed}
    settings |= asdict(config.environment) | asdict(config.controls)
    settings |= {"policy": config.policy} if config.policy else {}
    schedule = LearnSchedule(Path(config.out or folder_for(environment)), settings, config.minutes, config.student)
    if SCORING in schedule.facts:
        progress(f"{schedule.folder} is finished; --minutes with more than {schedule.minutes:g} trains it further.")
        if config.student and DISTILLING not in schedule.facts:
            run, data, out = (schedule.folder / part for part in ("run", RECORDING, STUDENT))
            progress(
                f"It has no student; this distils one: {command('terrella', 'train', 'distil', run, data=data, out=out)}"
            )
    else:
        _Learning(environment, config, schedule, progress).run()
    score = schedule.facts[SCORING]
    card = Path(score["card"]) if "card" in score else None
    steps = int(schedule.facts[TRAINING].get("steps", 0))
    lacking = max(0, FEW_STEPS - steps) * schedule.spent[TRAINING] / max(steps, 1) / 60
    longer = {**changed_settings(config), "minutes": math.ceil(max(2 * schedule.minutes, schedule.minutes + lacking))}
    again = command("terrella", "learn", environment, **longer)
    student = schedule.folder / STUDENT if DISTILLING in schedule.facts else None
    return LearnResult(
        tuple(score["verdict"]), schedule.folder / "run", card, dict(schedule.spent), again, steps, student
    )


def check_budget(minutes: float, frames: int) -> None:
    """TerrellaError for a time or a number of frames with which nothing can be learned."""
    if not 0 < minutes < math.inf or frames < 100:
        raise TerrellaError("--minutes is a time above 0, and --frames are 100 or more.")


@dataclass(frozen=True)
class _Learning:
    """The stages of `learn`."""

    name: str
    config: LearnConfig
    schedule: LearnSchedule
    progress: Progress

    def run(self) -> None:
        """All stages that are not over."""
        schedule, progress = self.schedule, self.progress
        spent = ", ".join(f"{text} {duration(schedule.spent[at])}" for at, text in _DID.items() if schedule.spent[at])
        if spent:
            progress(f"Continues in {schedule.folder}: {spent} so far.")
        yield_cores()
        if RECORDING in schedule.facts:
            self._announce()
        with stage(f"learning {schedule.folder.name}", progress) as shown:
            self._check_student()
            works = {RECORDING: self._record, TRAINING: self._train, DISTILLING: self._distil, SCORING: self._score}
            for name, work in works.items():
                if name not in schedule.facts and (name != DISTILLING or schedule.student):
                    self._do(name, work, shown)
                if name == RECORDING:
                    self._check_student()

    def _check_student(self) -> None:
        """Says so where the world will be no larger than a student, so that none is distilled."""
        schedule, device = self.schedule, torch.device(device_of(self.config.device))
        if not schedule.student or DISTILLING in schedule.facts:
            return
        plan = TrainingPlan.of(self.config.preset, device, schedule.share_s[TRAINING] / 60, free_bytes(device))
        dataset = Dataset(schedule.folder / RECORDING) if RECORDING in schedule.facts else None
        if plan.preset is PRESETS[0]:
            why = "the world itself is of the preset small (--preset medium or larger has one)"
        elif dataset is not None and dataset.has("depth") and dataset.has("pose"):
            why = "worlds with depth and poses are small themselves"
        else:
            return
        schedule.student = False
        self.progress(f"No student is distilled: {why}.")

    def _do(self, name: str, work: Callable[[Report], dict[str, object]], shown: Report) -> None:
        """One stage. All share one bar, that of the minutes."""
        schedule = self.schedule
        try:
            stopped = f"stopped while {name}; the same command continues."
            with stopping_with(stopped), schedule.stage(name, shown) as report:
                facts = work(report)
        except Exception:
            schedule.forget()
            raise
        schedule.note(name, facts)
        if name != SCORING:
            self.progress(f"{_DID[name].capitalize()} {duration(schedule.spent[name])}: {_in_words(facts)}")

    def _announce(self) -> None:
        """One line about the stages to come, with their times."""
        schedule = self.schedule
        stages = [at for at in _DOES if at not in schedule.facts and (at != DISTILLING or schedule.student)]
        parts = [f"{_DOES[at]} {duration(schedule.left_s(at))}" for at in stages]
        device = describe_device(device_of(self.config.device))
        self.progress(
            f"Of {duration(schedule.seconds)} on {device} it {', '.join(parts)}; all files are in {schedule.folder}."
        )
        self.progress(
            f"From {duration(self._strip_s)} after training begins, `{command('terrella', 'play', schedule.folder)}` plays the "
            f"newest state of the world (start it again for a newer one), and {schedule.live_page()} shows truth and prediction."
        )

    @property
    def _strip_s(self) -> float:
        """Seconds between pictures of truth and prediction, and between states of the world that can be played."""
        return min(120.0, max(15.0, self.schedule.share_s[TRAINING] / STRIPS))

    def _foresee(self, world: World) -> None:
        """Says what the minutes will give, by a trial of seconds. TerrellaError where that is nothing."""
        schedule = self.schedule
        self.progress("A trial of some seconds: what does this machine manage?")
        pace = time_environment(world, self.config.seed, self._training)
        if pace is None:
            return
        recorded_s = max(schedule.left_s(RECORDING), FEW_FRAMES / pace.frames_per_s)
        frames = min(self.config.frames, int(recorded_s * pace.frames_per_s))
        recorded_s = frames / pace.frames_per_s
        training_s = schedule.seconds - schedule.spent[RECORDING] - recorded_s - schedule.share_s[SCORING]
        training_s *= 1 - STUDENTS_SHARE * schedule.student
        self.progress(forecast(pace, schedule.minutes, frames, training_s))

    def _record(self, report: Report) -> dict[str, object]:
        schedule, name, environment = self.schedule, self.name, self.config.environment
        first = name if schedule.has_recording else held_to_real_time(name, environment)
        opened = schedule.facts.setdefault("opened", first)
        most = SMALL if schedule.seconds < 60 * SHORT_MIN else MOST
        world = self.config.controls.of(open_small(opened, environment, most))
        if not schedule.has_recording:
            self._foresee(world)
            schedule.facts["trial_s"] = schedule.elapsed_s
        self._announce()  # after it was opened: nothing is announced of an environment that does not open
        if opened != name:
            held = opened.rpartition("@")[2]
            self.progress(
                f"Each action is held for {held} steps, for the game has more steps per second than are played in real time; "
                f"{name}@1 records every step."
            )
        for line in describe(world.spec):
            self.progress(line)
        out, frames = schedule.folder / RECORDING, self.config.frames
        schedule.facts.setdefault("longest", longest_episode(world, frames, schedule.share_s[RECORDING]))
        schedule.save()
        rows = 0

        def overtime_s() -> float:
            """Seconds beyond the stage's time that a slow game needs for a few frames, at this pace."""
            spent = schedule.spent[RECORDING]
            return min(schedule.seconds / 3 - spent, (FEW_FRAMES / max(rows, 1) - 1) * spent)

        def counted(done: float, total: float, text: str = "") -> None:
            nonlocal rows
            rows = done
            late = schedule.left_s(RECORDING) <= 0 < overtime_s()
            report(done, total, f"a slow game: until it has {FEW_FRAMES} frames" if late else text)

        def enough() -> bool:
            return schedule.left_s(RECORDING) <= 0 and overtime_s() <= 0

        options = RecordOptions(max_episode_steps=schedule.facts["longest"], pictures=storage_of(world.spec))
        policy = policy_of(self.config.policy, world.spec, world) if self.config.policy else None
        with one_thread():
            explore(world, out, frames, self.config.seed, counted, options, policy, enough=enough)
        dataset = Dataset(out)
        if dataset.length < min(FEWEST_FRAMES, frames):
            raise DatasetError(
                f"{name} gave {dataset.length} frames in {duration(schedule.spent[RECORDING])}, too few to learn from; the same "
                "command with more --minutes goes on recording."
            )
        return recording_facts(dataset, world.spec.name, self.progress)

    def _train(self, report: Report) -> dict[str, object]:
        folder = self.schedule.folder
        further = folder / FURTHER
        with self._recording_on(further) as recorded:

            def shown(*what: Any) -> None:
                if recorded is not None and (line := recorded.trouble()):
                    self.progress(line)
                report(*what)

            training = self._training
            facts = train_video(
                folder / RECORDING, folder / "run", training, shown, self._paced, self.progress, meanwhile=further
            )
        return {"world": facts["world"], "steps": facts["step"]}

    def _recording_on(self, out: Path) -> AbstractContextManager[Recorded | None]:
        """Records on in other processes while a world of frames alone trains, where there are cores and frames are lacking."""
        config, dataset, facts = self.config, Dataset(self.schedule.folder / RECORDING), self.schedule.facts
        cuda = device_of(config.device) != "cpu"
        workers = spare_workers(cuda) if config.workers is None else config.workers
        lacking = config.frames - dataset.length
        if workers < 1 or lacking < 2 or (dataset.has("depth") and dataset.has("pose")):
            return nullcontext()
        policy = config.policy or "explorer"
        environment, size = config.environment, dataset.sensors[dataset.rgb_key].shape[:2] if dataset.rgb_key else None
        if facts["opened"].startswith("gym:"):
            environment = replace(environment, size=size)
        make = partial(open_player, facts["opened"], config.controls, environment, True, policy)
        spec = make()[0].spec
        layout = replace(Layout.of(spec), pictures=storage_of(spec))
        job = replace(Job.of(make, spec, make_rng(config.seed + 1), layout), steps=facts["longest"])
        self.progress(f"While it trains, up to {lacking:,} frames more are recorded; processes: {workers} (--workers).")
        return recording_meanwhile(job, out, workers, lacking)

    @property
    def _training(self) -> TrainConfig:
        config, hours = self.config, self.schedule.share_s[TRAINING] / 3600
        chosen = {name: getattr(config, name) for name in ("seed", "device", "preset", "batch", "compile", "half")}
        times = {"hours": hours, "save_every_s": SAVE_EVERY_S, "strip_every_s": self._strip_s}
        return TrainConfig(self.schedule.folder.name, steps=ENDLESS, **times, **chosen)

    def _distil(self, report: Report) -> dict[str, object]:
        schedule, training = self.schedule, self._training
        teacher = load_world(library.folder_of(schedule.folder / "run"), device=str(device_of(self.config.device)))
        same = ("steps", "seed", "device", "batch", "compile", "half", "save_every_s", "strip_every_s")
        settings = replace(student_settings(teacher), **{name: getattr(training, name) for name in same})
        settings = replace(settings, hours=schedule.share_s[DISTILLING] / 3600)
        data, out = schedule.folder / RECORDING, schedule.folder / STUDENT
        facts = train_student(teacher, data, out, settings, report, say=self.progress)
        return {"world": facts["world"], "steps": facts["step"], "gflop_per_frame": facts["gflop_per_frame"]}

    def _paced(self, steps: int) -> None:
        if line := slower(steps, self.schedule.minutes):
            self.progress(line)

    def _score(self, report: Report) -> dict[str, object]:
        schedule = self.schedule
        run, data = str(schedule.folder / "run"), schedule.folder / RECORDING
        arms, closing = arms_of(run, self.config.device, fast=False, quick=True, progress=self.progress)
        student = str(schedule.folder / STUDENT) if DISTILLING in schedule.facts else ""
        if student:
            arms |= {STUDENT: load_named(student, self.config.device, progress=self.progress)}
        try:
            exam, identity = _longest_exam(
                ExamRequest(arms, closing, data, clips=max(CLIP_COUNTS), drift=0, seed=self.config.seed), report
            )
        except DatasetError as error:
            return {"verdict": [f"{schedule.folder.name} is not scored: {error}"]}
        report(0, 1, "measuring how fast the world is")
        if "clips" not in schedule.facts:
            schedule.note("clips", most_clips_within(exam, schedule.left_s(SCORING), CLIP_COUNTS))
        if not schedule.facts["clips"]:
            later = command("terrella", "score", run, data=data, quick=True)
            return {"verdict": [f"{schedule.folder.name} is not scored: too little time was left. Score it: {later}"]}
        exam = exam.of(schedule.facts["clips"])
        identity += digest_of(student) if student else ""
        card, files = write_card(run, exam, identity, schedule.folder / "score", report)
        lines = verdict(card)
        if student:
            lines += verdict(replace(card, worlds={STUDENT: card.worlds[STUDENT]}))[:2]
        return {"verdict": lines, "card": str(files[1])}


def _longest_exam(request: ExamRequest, report: Report) -> tuple[Exam, str]:
    """The exam over the longest horizon of which enough clips fit into the episodes that training did not see."""
    exams: list[tuple[Exam, str]] = []
    first_error: DatasetError | None = None
    for horizons in (QUICK_HORIZONS, (1, 8, 16), (1, 8), (1, 4)):
        try:
            exams.append(exam_of(request, ExamConfig.quick(horizons), report=report))
        except DatasetError as error:
            first_error = first_error or error
            continue
        if _clip_count(exams[-1][0]) >= FEWEST_CLIPS:
            return exams[-1]
    if not exams:
        assert first_error is not None
        raise first_error
    return max(exams, key=lambda each: _clip_count(each[0]))


def _clip_count(exam: Exam) -> int:
    return min(len(clips) for clips in exam.sets[CLIPS].values())


def _in_words(facts: Mapping[str, object]) -> str:
    names = (
        "frames",
        "episodes",
        "frames_that_change",
        "places",
        "actions_with_a_clear_effect",
        "look",
        "steps",
        "world",
    )
    return "; ".join(f"{name.replace('_', ' ')} {facts[name]}" for name in names if name in facts)
