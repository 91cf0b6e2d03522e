"""train distil: a world that draws a frame in many steps teaches one that draws it in one or two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from ...core.errors import TrainingError
from ...worlds.learned import LearnedWorld
from ..objectives.distillation import Distillation
from ..paired import keep_world, paired, recipe_of, with_generator
from ..recording import Box
from ..trainer import Report, Run


@dataclass(frozen=True)
class DistilConfig:
    """Settings of a distillation.

    Args:
        flow_steps: Steps in which the student draws a frame.
        steps: Training steps.
        batch: Frames per step.
        learning_rate: Highest learning rate of the student.
        truth_weight: Weight of the recorded frames. On their own they blur whatever is not determined.
        teacher_weight: Weight of the teacher's distribution.
        critic_weight: Weight of a critic of small patches.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees. Default: the one the world was
            trained without.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth and prediction.
        seed: Random seed.
    """

    flow_steps: int = 1
    steps: int = 2000
    batch: int = 16
    learning_rate: float = 3e-4
    truth_weight: float = 0.25
    teacher_weight: float = 1.0
    critic_weight: float = 0.2
    keep_out: Box | None = None
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0


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
    weights = config.truth_weight, config.teacher_weight, config.critic_weight
    objective = Distillation(teacher.generator, config.flow_steps, config.learning_rate, *weights)
    times = {"save_every_s": config.save_every_s, "strip_every_s": config.strip_every_s}
    run = Run(Path(out), recipe_of(config, pair), report, config.seed, pair.device, **times)
    trainer = run.stage("distil", pair.feed(config.batch, config.seed, objective.dream), objective, config.steps)

    def draw() -> None:
        step = trainer.facts["step"]
        card = {"distilled": f"{steps} to {config.flow_steps} steps a frame, {step} updates"}
        student = with_generator(teacher, objective.smooth.module, config.flow_steps, card)
        keep_world(pair, student, run.out, step)

    trainer.run(report, draw)
    draw()
    return {"world": str(run.out / "world"), **trainer.told}
