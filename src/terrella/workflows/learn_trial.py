"""A trial of seconds before `learn` begins: what this machine will manage in the minutes, and a refusal where that is nothing."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..core.errors import DatasetError, TerrellaError, TrainingError
from ..core.world import World, make_rng
from ..data import RecordOptions
from ..learn.devices import one_thread
from ..learn.recipes.video import TrainConfig, TrainingPace, time_training
from .collect import explore, storage_of

FEW_STEPS, HOPELESS_STEPS = 600, 100  # training steps with which a world has learned little, and nothing
TRIAL_FRAMES, TRIAL_STEPS = 160, 40  # frames of a trial recording, and steps of its episodes
TRIAL_S = 4.0  # of its training steps


@dataclass(frozen=True)
class Pace:
    """How fast this machine records an environment and trains on it."""

    frames_per_s: float
    training: TrainingPace

    def steps_in(self, training_s: float) -> int:
        """Training steps of a training of `training_s` seconds."""
        return self.training.steps_in(training_s)

    def minutes_for(self, steps: int) -> int:
        """Whole minutes for that many training steps, recording and scoring included."""
        training_s = (steps * self.training.step_s + self.training.setup_s) / self.training.share
        return math.ceil(max(training_s / 0.7, training_s + 60) / 60)


def time_environment(world: World, seed: int, config: TrainConfig) -> Pace | None:
    """Records a few frames in a temporary folder and takes a few training steps on them; None where so few cannot be trained
    on, as of a very slow game."""
    world.render(world.start(1, make_rng(seed)), list(world.spec.channels))  # the first takes longer than those to come
    with TemporaryDirectory() as folder:
        began, rows = time.monotonic(), 1

        def counted(done: float, total: float) -> None:
            nonlocal rows
            rows = int(done)

        def enough() -> bool:
            return time.monotonic() - began > 3 * TRIAL_S

        options = RecordOptions(max_episode_steps=TRIAL_STEPS, pictures=storage_of(world.spec))
        try:
            with one_thread():
                explore(world, Path(folder), TRIAL_FRAMES, seed, counted, options, enough=enough)
            frames_per_s = rows / (time.monotonic() - began)
            return Pace(frames_per_s, time_training(folder, config, TRIAL_S))
        except (DatasetError, TrainingError):
            return None


def slower(steps: int, minutes: float) -> str | None:
    """What to say once training has begun and its pace allows `steps` steps in `minutes` minutes; None where that is enough."""
    if steps >= FEW_STEPS:
        return None
    what = "too few to learn anything" if steps < HOPELESS_STEPS else "which is little"
    return (
        f"At the pace of its first steps training will have about {steps:,} steps, {what}. It can be stopped now (Ctrl-C); the "
        f"same command with --minutes {math.ceil(minutes * FEW_STEPS / max(steps, 1))} continues it."
    )


def forecast(pace: Pace, minutes: float, frames: int, training_s: float) -> str:
    """One sentence of what the minutes will give; TerrellaError where nothing can be learned in them."""
    steps, better = pace.steps_in(training_s), f"--minutes {max(pace.minutes_for(FEW_STEPS), math.ceil(minutes) + 1)}"
    what = f"about {frames:,} frames recorded and {steps:,} training steps"
    if steps < HOPELESS_STEPS:
        raise TerrellaError(
            f"{minutes:g} min are too few on this machine, as busy as it is now: {what}, by a trial. Give {better} or more."
        )
    little = f" That is little: {better} trains {FEW_STEPS} steps." if steps < FEW_STEPS else ""
    compiles = (
        " The trial does not compile; training does, which takes its time once." if pace.training.compiles else ""
    )
    return f"Expected in {minutes:g} min, by a trial on this machine: {what}.{little}{compiles}"
