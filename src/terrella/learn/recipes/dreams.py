"""train dreams: a finished world goes on learning inside its own dreams; see objectives/dreams.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from ...core.errors import TrainingError
from ...worlds.learned import LearnedWorld
from ..feeds import Drawn
from ..objectives.dreams import Dreams, Rollouts, beginnings
from ..paired import fingerprint, keep_world, paired, recipe_of, with_generator
from ..recording import Box
from ..trainer import Report, Run


@dataclass(frozen=True)
class DreamsConfig:
    """Settings of a training on dreams.

    Args:
        steps: Batches of dreams to train on.
        horizon: Frames of a dream. Each is one update.
        batch: Dreams at a time.
        learning_rate: Highest learning rate of the generator.
        truth_weight: Weight of the recorded frames. More is nearer to the recording, and blurs.
        teacher_weight: Weight of the teacher's distribution, if there is a teacher.
        critic_weight: Weight of a critic of small patches.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees. Default: the one the world was
            trained without.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth and prediction.
        seed: Random seed.
    """

    steps: int = 150
    horizon: int = 12
    batch: int = 16
    learning_rate: float = 3e-4
    truth_weight: float = 0.05
    teacher_weight: float = 1.0
    critic_weight: float = 1.0
    keep_out: Box | None = None
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0


def train_dreams(
    world: LearnedWorld,
    data: str | Path,
    out: str | Path,
    config: DreamsConfig,
    report: Report,
    teacher: LearnedWorld | None = None,
) -> dict:
    """Trains, or goes on with, the run in the folder `out`; the world lies in `out`/world. Returns the run's facts.

    teacher: a world of the same kind that draws a frame in many steps (see recipes/distillation.py).
    """
    if min(config.steps, config.horizon, config.batch) < 1:
        raise TrainingError("--steps, --horizon and --batch are 1 or more.")
    pair = paired(world, data, config.keep_out, report)
    beginnings(pair.recording, config.horizon)
    more = {} if teacher is None else {"teacher": fingerprint(like(world, teacher).generator)}
    torch.manual_seed(config.seed)
    objective = Dreams(
        world.generator,
        world.config.steps,
        config.horizon,
        config.learning_rate,
        lambda now: pair.real(config.batch, now),
        None if teacher is None else teacher.generator,
        config.truth_weight,
        config.teacher_weight,
        config.critic_weight,
    )
    times = {"save_every_s": config.save_every_s, "strip_every_s": config.strip_every_s}
    run = Run(Path(out), recipe_of(config, pair, **more), report, config.seed, pair.device, **times)
    feed = Drawn(lambda now: Rollouts(world, pair.recording, config.horizon, config.batch, now))
    trainer = run.stage("dreams", feed, objective, config.steps)

    def draw() -> None:
        step = trainer.facts["step"]
        card = {"dreams": f"{step * config.batch:,} of {config.horizon} frames"}
        keep_world(pair, with_generator(world, objective.smooth.module, world.config.steps, card), run.out, step)

    trainer.run(report, draw)
    draw()
    return {"world": str(run.out / "world"), **trainer.told}


def like(world: LearnedWorld, teacher: LearnedWorld) -> LearnedWorld:
    """The teacher; TrainingError unless its generator takes what that of `world` does."""
    taken = [
        (make.size, make.slots, make.context, make.moving)
        for make in (world.generator.config, teacher.generator.config)
    ]
    if taken[0] == taken[1] and teacher.config.steps > 1:
        return teacher
    raise TrainingError(
        f"{teacher.spec.name} cannot teach {world.spec.name}: a teacher comes from `terrella train video --flow-steps 8` "
        "with the same size and the same recording."
    )
