"""train video: a recording into a playable world. What is learned depends on the recording: video_posed.py, video_flat.py."""

from pathlib import Path

import torch

from ...core.errors import TrainingError
from ...data import Dataset
from ...worlds.folder import save_world
from ...worlds.learned import LearnedWorld
from ..budget import Stage
from ..objectives.uncertainty import discard_uncertainty, uncertainty_seconds
from ..recording import Recording
from ..strips import draw_strip
from ..trainer import Report, Run, Trainer, device_named
from .parts import SensesConfig, learn_senses
from .video_config import TrainConfig, video_config
from .video_flat import CodecRecipe, FlatFlowRecipe
from .video_parts import VideoRecipe
from .video_posed import PosedRecipe

WHY = "a world is learned from frames and actions (`terrella train latent-actions` finds actions where there are none)"


def train_video(data: str | Path, out: str | Path, config: TrainConfig, report: Report) -> dict:
    """Trains, or resumes, the run in `out`; the finished world is in `out`/world. Returns the facts of the run."""
    if config.size and any(length < 16 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 16 or more.")
    device = device_named(config.device)
    dataset = Dataset(data)
    facts = {"frames": dataset.length, "recording of": dataset.world.get("name")}
    run = Run.of(out, config, report, device, ("hours", "learning_rate"), **facts)
    run.saved_facts("flow")
    recording = Recording.open(dataset, config.size, report, needs=("rgb", "action"), why=WHY)
    torch.manual_seed(config.seed)
    video = video_config(recording, config)
    make = PosedRecipe if video.geometry else CodecRecipe if config.flow_steps == 1 else FlatFlowRecipe
    return _Training(make(run, recording, config, video)).learn()


class _Training:
    """The stages of a run, each of which resumes where it was stopped."""

    def __init__(self, recipe: VideoRecipe):
        self.recipe, self.parts = recipe, recipe.parts
        self.run, self.config = recipe.parts.run, recipe.parts.config
        self.stages = [
            *recipe.preparations(),
            Stage("flow", None, self._train_generator),
            Stage("uncertainty", 0.1, self._finish),
        ]
        self.run.budget.divide(self.stages)

    def learn(self) -> dict:
        for stage in self.stages:
            stage.run()
        senses = self.trainer.facts.pop("senses")
        return {"world": str(self.run.out / "world"), **self.trainer.summary, **self.parts.facts, **senses}

    def _train_generator(self) -> None:
        feed = self.recipe.feed(self.config.batch or (64 if self.run.device.type == "cuda" else 8))
        objective = self.recipe.objective
        strides = objective.losses_per_batch
        self.trainer = trainer = Trainer(self.run, "flow", feed, objective, self.config.steps, strides=strides)
        trainer.limit_s = self._limit_s()
        if not trainer.finished:
            discard_uncertainty(self.run.out)  # it was fitted to the errors of an earlier generator
            trainer.facts.pop("senses", None)
        trainer.train(self._save_with_strip)

    def _limit_s(self) -> float:
        """Seconds of the generator's training: what the preparations left of the hours, less what tuning and uncertainty will
        take by a trial. A finished run stays finished until it is given more hours."""
        trainer, took_s = self.trainer, self.trainer.facts["seconds"]
        if self.config.hours <= trainer.facts.get("asked", 0.0):
            return took_s
        budget, frames, world = self.run.budget, self.config.uncertainty_frames, self.recipe.world(trainer)
        after_s = self.recipe.tuning_s(world)
        if frames:
            trial_s = uncertainty_seconds(world, self.parts.recording, frames)
            after_s += min(budget.most_s("uncertainty"), 1.2 * trial_s)
        return max(1e-6, took_s + budget.left_s - after_s)

    def _finish(self) -> None:
        """Tunes and saves the trained world, then gives it an estimator and an uncertainty."""
        trainer, config = self.trainer, self.config
        if "senses" in trainer.facts and (self.run.out / "world" / "world.json").exists():
            return
        trainer.facts["asked"] = config.hours
        trainer.save()
        save_world(
            self.recipe.world(trainer), self.run.out / "world"
        )  # playable, should a kill come before the rest is done
        tuned = self.recipe.tune(self.recipe.world(trainer))
        world = self._save_with_strip()
        settings = SensesConfig(config.estimator_steps, config.uncertainty_frames, config.seed)
        sensing, facts = learn_senses(self.run, world, self.parts.recording, config.keep_out, settings)
        facts |= tuned
        save_world(sensing.replaced(card=facts), self.run.out / "world")
        trainer.compute_once("senses", lambda: facts)

    def _save_with_strip(self) -> LearnedWorld:
        """Saves the world as it now is, so that it can be played while it trains, and a picture of truth above rollouts of it,
        with its memory and without."""
        world = self.recipe.world(self.trainer)
        worlds = (world, world.without_memory()) if self.parts.video.geometry else (world,)
        draw_strip(worlds, self.parts.recording, self.run.out / f"strip-{self.trainer.steps_done:06d}.png")
        save_world(world, self.run.out / "world")
        return world
