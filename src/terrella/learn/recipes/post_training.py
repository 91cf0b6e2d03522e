"""train distil and train dreams: a finished world's generator goes on learning, as a student of a teacher or in its own dreams."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ...core.errors import TrainingError
from ...worlds.codec import Codec
from ...worlds.folder import save_world
from ...worlds.learned import LearnedWorld
from ..feeds import Drawn
from ..objectives.distillation import Student
from ..objectives.dreams import Dreams, Rollouts, beginnings
from ..paired import Paired, fingerprint, paired
from ..recording import Box
from ..strips import draw_strip
from ..trainer import Report, Run, Trainer, held


@dataclass(frozen=True)
class PostTraining:
    """Settings that both trainings share.

    Args:
        batch: Frames per step, or dreams at a time.
        learning_rate: Highest learning rate of the generator.
        teacher_weight: Weight of the teacher's distribution, if there is a teacher.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees. Default: the one the world was
            trained without.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth and prediction.
        seed: Random seed.
    """

    batch: int = 16
    learning_rate: float = 3e-4
    teacher_weight: float = 1.0
    keep_out: Box | None = None
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0


@dataclass(frozen=True)
class DistilConfig(PostTraining):
    """Settings of a distillation.

    Args:
        flow_steps: Steps in which the student draws a frame.
        steps: Training steps.
        truth_weight: Weight of the recorded frames. On their own they blur whatever is not determined.
        critic_weight: Weight of a critic of small patches.
    """

    flow_steps: int = 1
    steps: int = 2000
    truth_weight: float = 0.25
    critic_weight: float = 0.2


@dataclass(frozen=True)
class DreamsConfig(PostTraining):
    """Settings of a training on dreams.

    Args:
        steps: Batches of dreams to train on.
        horizon: Frames of a dream. Each is one update.
        truth_weight: Weight of the recorded frames. More is nearer to the recording, and blurs.
        critic_weight: Weight of a critic of small patches.
    """

    steps: int = 150
    horizon: int = 12
    truth_weight: float = 0.05
    critic_weight: float = 1.0


def distil(teacher: LearnedWorld, data: str | Path, out: str | Path, config: DistilConfig, report: Report) -> dict:
    """Trains, or goes on with, the student in the folder `out`; its world lies in `out`/world. Returns the run's facts."""
    name, steps = teacher.spec.name, teacher.config.steps
    if steps == 1:
        raise TrainingError(
            f"{name} draws a frame in one step already; a teacher comes from `terrella train video --flow-steps 8`."
        )
    if not 1 <= config.flow_steps < steps:
        raise TrainingError(f"--flow-steps is 1 to {steps - 1}: {name} takes {steps}.")
    if config.steps < 1 or config.batch < 1:
        raise TrainingError("--steps and --batch are 1 or more.")
    pair = paired(teacher, data, config.keep_out, report)
    torch.manual_seed(config.seed)
    weights, rate = (config.truth_weight, config.teacher_weight, config.critic_weight), held(config.learning_rate, 50)
    student = Student("student", teacher.generator, config.flow_steps, rate, 0.0, weights, teacher.generator)
    run = _run(pair, out, config, report)
    trainer = Trainer(run, "distil", pair.feed(config.batch, config.seed, student.dream), student, config.steps)
    about = f"{steps} to {config.flow_steps} steps a frame, {{}} updates"
    return _trained(pair, run, trainer, student, lambda step: {"distilled": about.format(step)})


def train_dreams(
    world: LearnedWorld,
    data: str | Path,
    out: str | Path,
    config: DreamsConfig,
    report: Report,
    teacher: LearnedWorld | None = None,
) -> dict:
    """Trains, or goes on with, the run in the folder `out`; the world lies in `out`/world. Returns the run's facts.

    teacher: a world of the same kind that draws a frame in many steps (see `distil`).
    """
    if min(config.steps, config.horizon, config.batch) < 1:
        raise TrainingError("--steps, --horizon and --batch are 1 or more.")
    if isinstance(world.generator, Codec):
        raise TrainingError(
            f"{world.spec.name} has learned on its own dreams already, as worlds without depth do: nothing is left to do here."
        )
    pair = paired(world, data, config.keep_out, report)
    beginnings(pair.recording, config.horizon)
    more = {} if teacher is None else {"teacher": fingerprint(like(world, teacher).generator)}
    torch.manual_seed(config.seed)
    weights, rate = (config.truth_weight, config.teacher_weight, config.critic_weight), held(config.learning_rate, 10)
    likely = None if teacher is None else teacher.generator
    student = Student("generator", world.generator, world.config.steps, rate, 0.9, weights, likely)
    dreams = Dreams(student, config.horizon, lambda now: pair.real(config.batch, now))
    run = _run(pair, out, config, report, **more)
    feed = Drawn(lambda now: Rollouts(world, pair.recording, config.horizon, config.batch, now))
    trainer = Trainer(run, "dreams", feed, dreams, config.steps)
    about = lambda step: {"dreams": f"{step * config.batch:,} of {config.horizon} frames"}  # noqa: E731
    return _trained(pair, run, trainer, student, about)


def like(world: LearnedWorld, teacher: LearnedWorld) -> LearnedWorld:
    """The teacher; TrainingError unless its generator takes what that of `world` does."""
    made = (world.generator.config, teacher.generator.config)
    taken = [(make.size, make.slots, make.context, getattr(make, "moving", None)) for make in made]
    if taken[0] == taken[1] and teacher.config.steps > 1:
        return teacher
    raise TrainingError(
        f"{teacher.spec.name} cannot teach {world.spec.name}: a teacher comes from `terrella train video --flow-steps 8` "
        "with the same size and the same recording."
    )


def _run(pair: Paired, out: str | Path, config: PostTraining, report: Report, **more: Any) -> Run:
    facts = {"world": fingerprint(pair.world.generator), "frames": pair.recording.cache.length}
    return Run.of(out, config, report, pair.device, **facts, **more)


def _trained(pair: Paired, run: Run, trainer: Trainer, student: Student, about: Callable[[int], dict]) -> dict:
    """The facts of the run once it is trained, each strip a dream of the old world above one of the new. The new one is without
    uncertainty, for that knew the errors of the old generator: `terrella train uncertainty` learns another."""

    def draw() -> None:
        step, learned = trainer.facts["step"], copy.deepcopy(student.smooth.module)
        card = {"uncertainty": None, **about(step)}
        world = pair.world.replaced(generator=learned, steps=student.flow_steps, uncertainty=None, card=card)
        save_world(world, run.out / "world")
        draw_strip((pair.world, world), pair.recording, run.out / f"strip-{step:06d}.png")

    trainer.train(draw)
    draw()
    return {"world": str(run.out / "world"), **trainer.summary}
