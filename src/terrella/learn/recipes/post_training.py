"""train distil and train dreams: further training of a finished world, by a teacher or on its own rollouts."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ...core.errors import TrainingError
from ...worlds.folder import save_world
from ...worlds.learned import LearnedWorld
from ..feeds import RandomBatches
from ..learners import hold_then_decay
from ..objectives.distillation import Student
from ..objectives.dreams import DreamRollouts, DreamsObjective, dream_starts
from ..paired import Paired, fingerprint, open_paired
from ..presets import PresetName
from ..recording import Box
from ..sized_feed import SizedFeed
from ..strips import draw_strip
from ..trainer import Report, Run, Trainer
from .student import student_settings, train_student


@dataclass(frozen=True)
class PostTraining:
    """Settings that both trainings share."""

    # Batch size: frames (distil) or rollouts (dreams) per step. Default: 16, and of a world without depth as in `train video`.
    batch: int | None = None
    # Peak learning rate of the generator. Default: 3e-4, and without depth 6e-3.
    learning_rate: float | None = None
    teacher_weight: float = 1.0  # Weight of the teacher's distribution, if there is a teacher (worlds with depth).
    # A box x0 y0 x1 y1 of the map in metres that training never sees. Default: the one that was kept out of the world's training.
    keep_out: Box | None = None
    save_every_s: float = 60.0  # Seconds between saves.
    strip_every_s: float = 300.0  # Seconds between pictures of truth and prediction.
    seed: int = 0  # Random seed.


@dataclass(frozen=True)
class DistilConfig(PostTraining):
    """Settings of a distillation."""

    # Flow steps in which the student draws a frame. Default: 1, and without depth the teacher's.
    flow_steps: int | None = None
    # Training steps. Default: 2000, and without depth as in `train video`.
    steps: int | None = None
    hours: float | None = None  # Hours of training, earlier runs included.
    preset: PresetName = "small"  # Size of the student of a world without depth.
    # Weight of the recorded frames. Trained on these alone, the student averages over uncertain content and blurs.
    truth_weight: float = 0.25
    critic_weight: float = 0.2  # Weight of a patch critic (worlds with depth).


@dataclass(frozen=True)
class DreamsConfig(PostTraining):
    """Settings of a training on rollouts of the world itself."""

    steps: int = 150  # Training steps, each on one batch of rollouts.
    horizon: int = 12  # Horizon: frames of a rollout, each of which is one update.
    # Weight of the recorded frames. A larger weight follows the recording more closely, but blurs.
    truth_weight: float = 0.05
    critic_weight: float = 1.0  # Weight of a patch critic.


def distil(teacher: LearnedWorld, data: str | Path, out: str | Path, config: DistilConfig, report: Report) -> dict:
    """Trains, or resumes, the student in the folder `out`; its world is in `out`/world. Returns the facts of the run."""
    if not teacher.config.geometry:
        return _distil_frames(teacher, data, out, config, report)
    name, steps, flow_steps = teacher.spec.name, teacher.config.steps, config.flow_steps or 1
    updates = 2000 if config.steps is None else config.steps
    if steps == 1:
        raise TrainingError(
            f"{name} draws a frame in one step already; a teacher comes from `terrella train video --flow-steps 8`."
        )
    if not 1 <= flow_steps < steps:
        raise TrainingError(f"--flow-steps is 1 to {steps - 1}: {name} takes {steps}.")
    if updates < 1 or _batch(config) < 1:
        raise TrainingError("--steps and --batch are 1 or more.")
    pair = open_paired(teacher, data, config.keep_out, report)
    torch.manual_seed(config.seed)
    weights, rate = (
        (config.truth_weight, config.teacher_weight, config.critic_weight),
        hold_then_decay(_rate(config), 50),
    )
    student = Student("student", teacher.generator, flow_steps, rate, 0.0, weights, teacher.generator)
    whole = replace(
        config, flow_steps=flow_steps, steps=updates, hours=math.inf if config.hours is None else config.hours
    )
    run = _run(pair, out, whole, report)
    feed = SizedFeed(lambda size: pair.feed(size, student.dream), _batch(config))
    trainer = Trainer(run, "distil", feed, student, updates)
    about = f"{steps} to {flow_steps} steps a frame, {{}} updates"
    return _trained(pair, run, trainer, student, lambda step: {"distilled": about.format(step)})


def _distil_frames(
    teacher: LearnedWorld, data: str | Path, out: str | Path, config: DistilConfig, report: Report
) -> dict:
    """Of a world of frames alone, a student of a smaller preset."""
    names = ("steps", "hours", "batch", "learning_rate", "keep_out", "save_every_s", "strip_every_s", "seed")
    settings = replace(student_settings(teacher, config.preset), **{name: getattr(config, name) for name in names})
    settings = replace(settings, device=str(teacher.device), flow_steps=config.flow_steps or settings.flow_steps)
    return train_student(teacher, data, out, settings, report)


def train_dreams(
    world: LearnedWorld,
    data: str | Path,
    out: str | Path,
    config: DreamsConfig,
    report: Report,
    teacher: LearnedWorld | None = None,
) -> dict:
    """Trains, or resumes, the run in the folder `out`; the world is in `out`/world. Returns the facts of the run.

    teacher: a world of the same kind that draws a frame in many flow steps (see `distil`).
    """
    batch = _batch(config)
    if min(config.steps, config.horizon, batch) < 1:
        raise TrainingError("--steps, --horizon and --batch are 1 or more.")
    pair = open_paired(check_posed(world), data, config.keep_out, report)
    dream_starts(pair.recording, config.horizon)
    more = {} if teacher is None else {"teacher": fingerprint(check_teacher(world, check_posed(teacher)).generator)}
    torch.manual_seed(config.seed)
    weights, rate = (
        (config.truth_weight, config.teacher_weight, config.critic_weight),
        hold_then_decay(_rate(config), 10),
    )
    likely = None if teacher is None else teacher.generator
    student = Student("generator", world.generator, world.config.steps, rate, 0.9, weights, likely)
    dreams = DreamsObjective(student, config.horizon, pair.feed(batch).batch)
    run = _run(pair, out, config, report, **more)
    batches = lambda size: RandomBatches(lambda now: DreamRollouts(world, pair.recording, config.horizon, size, now))  # noqa: E731
    trainer = Trainer(run, "dreams", SizedFeed(batches, batch), dreams, config.steps)
    about = lambda step: {"dreams": f"{step * batch:,} of {config.horizon} frames"}  # noqa: E731
    return _trained(pair, run, trainer, student, about)


def check_posed(world: LearnedWorld) -> LearnedWorld:
    """The world; TrainingError for a flat one, which has learned from its own rollouts and samples its frames."""
    if not world.config.geometry:
        raise TrainingError(
            f"{world.spec.name} has no depth and poses, and further training is for worlds that have; `terrella train video` with "
            "more --hours trains it further."
        )
    return world


def check_teacher(world: LearnedWorld, teacher: LearnedWorld) -> LearnedWorld:
    """The teacher; TrainingError unless its generator has the inputs of that of `world`."""
    configs = (world.generator.config, teacher.generator.config)
    inputs = [(one.size, one.slots, one.context, one.moving) for one in configs]
    if inputs[0] == inputs[1] and teacher.config.steps > 1:
        return teacher
    raise TrainingError(
        f"{teacher.spec.name} cannot teach {world.spec.name}: a teacher comes from `terrella train video --flow-steps 8` "
        "with the same size and the same recording."
    )


def _run(pair: Paired, out: str | Path, config: PostTraining, report: Report, **more: Any) -> Run:
    facts = {"world": fingerprint(pair.world.generator), "frames": pair.recording.cache.length}
    settings = replace(config, batch=_batch(config), learning_rate=_rate(config))
    return Run.of(out, settings, report, pair.device, ("hours",), **facts, **more)


def _batch(config: PostTraining) -> int:
    return 16 if config.batch is None else config.batch


def _rate(config: PostTraining) -> float:
    return 3e-4 if config.learning_rate is None else config.learning_rate


def _trained(pair: Paired, run: Run, trainer: Trainer, student: Student, about: Callable[[int], dict]) -> dict:
    """Trains and returns the facts of the run. Strips show a rollout of the old world above one of the new. The new world has no
    uncertainty, for that was fitted to the errors of the old generator: `terrella train uncertainty` trains another."""

    def draw() -> None:
        step, learned = trainer.facts["step"], copy.deepcopy(student.smooth.module)
        card = {"uncertainty": None, **about(step)}
        world = pair.world.replaced(generator=learned, steps=student.flow_steps, uncertainty=None, card=card)
        save_world(world, run.out / "world")
        draw_strip(
            [one.to(run.device) for one in (pair.world, world)], pair.recording, run.out / f"strip-{step:06d}.png"
        )

    trainer.train(draw)
    draw()
    return {"world": str(run.out / "world"), **trainer.summary}
