"""train video: a recording into a playable world. What is learned depends on the recording: video_posed.py, video_flat.py."""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch

from ...core.errors import TrainingError
from ...core.files import replacing
from ...data import Dataset
from ...worlds.folder import save_world
from ...worlds.learned import LearnedWorld
from ..budget import Stage
from ..devices import describe_device, device_named, free_bytes
from ..objectives.uncertainty import discard_uncertainty, uncertainty_seconds
from ..paired import fingerprint
from ..presets import STEPS, TrainingPlan
from ..recording import Recording, joined_cameras
from ..run_folder import load_run, resume_file
from ..sized_feed import SizedFeed
from ..strips import draw_strip
from ..trainer import Paced, Report, Run, Trainer
from .parts import SensesConfig, learn_senses
from .video_config import TrainConfig, video_config
from .video_flat import FlowRecipe
from .video_parts import Continued, VideoRecipe
from .video_posed import PosedRecipe

FEWEST_FRAMES = 200  # from which an uncertainty is learned
WHY = "a world is learned from frames and actions (`terrella train latent-actions` finds actions where there are none)"


def train_video(
    data: str | Path,
    out: str | Path,
    config: TrainConfig,
    report: Report,
    paced: Paced | None = None,
    say: Callable[[str], object] = lambda line: None,
    begin: Continued | None = None,
    meanwhile: Path | None = None,
) -> dict:
    """Trains, or resumes, the run in `out`; the finished world is in `out`/world. Returns the facts of the run. `paced` as in
    `Trainer.train`, of the generator's steps. `say` is given a sentence of what is about to be trained. `begin`: see `adapt`.
    meanwhile: the folder of another recording of the same kind, which may grow; a world of frames alone learns its new episodes,
    too, with each picture of truth and prediction."""
    recipe = _recipe(data, out, config, report, begin=begin, meanwhile=meanwhile)
    say(recipe.plan.sentence(describe_device(str(recipe.plan.device)), recipe.channels))
    return _Training(recipe, paced, say).learn()


class TrainingPace(NamedTuple):
    """How fast this machine trains: seconds before the generator's first step and of a gradient step, and the part of the hours
    that are left for its steps at least."""

    setup_s: float
    step_s: float
    share: float
    compiles: bool = False  # the training compiles its steps, which the trial does not

    def steps_in(self, seconds: float) -> int:
        """The steps for which a run of `seconds` has time."""
        return max(0, int((seconds * self.share - self.setup_s) / self.step_s))


def time_training(data: str | Path, config: TrainConfig, seconds: float) -> TrainingPace:
    """A trial of `seconds` or a few training steps, on a recording of a few frames. On a CPU it also sets PyTorch to one thread
    where that is faster: on busy cores threads wait for each other."""
    began = time.monotonic()
    with TemporaryDirectory() as folder:
        recipe = _recipe(data, folder, replace(config, hours=0.0, compile=False), lambda *_: None, config.minutes)
        setup_s, trained = time.monotonic() - began, _Training(recipe)
        rest = sum(stage.share or 0.0 for stage in trained.stages)
        many = torch.get_num_threads()
        counts = {many} if recipe.parts.run.device.type != "cpu" else {1, many}
        pace: dict[int, float] = {}
        for threads in counts:
            torch.set_num_threads(threads)
            pace[threads] = trained.new_trainer().time_steps(seconds / len(counts))
        best = min(pace, key=pace.__getitem__)
        torch.set_num_threads(best)
        return TrainingPace(setup_s, pace[best], 1 - rest, recipe.plan.device.type == "cuda" and config.compile)


def _recipe(
    data: str | Path,
    out: str | Path,
    config: TrainConfig,
    report: Report,
    minutes: float | None = None,
    begin: Continued | None = None,
    meanwhile: Path | None = None,
) -> VideoRecipe:
    """What is learned from the recording, by a preset for `minutes`, by default those of the settings. TrainingError or
    DatasetError for settings and recordings that do not fit."""
    if config.size and any(length < 16 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 16 or more.")
    device = device_named(config.device)
    begun = (load_run(resume_file(Path(out), "flow"), {}, {}) or {}).get("recipe", {})  # maybe on another device
    usual = STEPS["cuda" if device.type == "cuda" else "cpu"]
    minutes = minutes or config.minutes
    config = replace(config, steps=config.steps or begun.get("steps") or usual, hours=config.limit_hours)
    dataset = Dataset(data)
    facts = {"frames": dataset.length, "recording of": dataset.world.get("name")}
    if begin is not None:
        kept = begin.kept.cache.length if begin.kept else 0
        facts |= {"begins with": fingerprint(begin.world.generator), "keeps": kept}
    run = Run.of(out, config, report, device, ("hours", "learning_rate", "compile", "half"), **facts)
    settings = {"batch": config.batch, "compiled": config.compile, "half": config.half}
    plan = TrainingPlan.of(config.preset, device, minutes, free_bytes(device), **settings)
    plan = plan.kept(run.saved_facts("flow"))
    joined = joined_cameras(dataset, config.geometry)
    recording = Recording.open(dataset, config.size, report, needs=("rgb", "action"), why=WHY, joined=joined)
    torch.manual_seed(config.seed)
    video = video_config(recording, config)
    if video.geometry:
        return PosedRecipe(run, recording, config, video, plan, begin)
    return FlowRecipe(run, recording, config, video, plan, begin, meanwhile)


class _Training:
    """The stages of a run, each of which resumes where it was stopped."""

    def __init__(
        self, recipe: VideoRecipe, paced: Paced | None = None, say: Callable[[str], object] = lambda line: None
    ):
        self.recipe, self.parts, self.paced, self.say = recipe, recipe.parts, paced, say
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

    def new_trainer(self) -> Trainer:
        recipe, plan = self.recipe, self.recipe.plan
        feed, strides = SizedFeed(recipe.feed, plan.batch), recipe.objective.losses_per_batch
        assert self.config.steps is not None
        trainer = Trainer(self.run, "flow", feed, recipe.objective, self.config.steps, strides=strides)
        trainer.facts["preset"] = plan.preset.name
        if not plan.half:
            trainer.facts["float32"] = True
        return trainer

    def _train_generator(self) -> None:
        self.trainer = trainer = self.new_trainer()
        trainer.limit_s = self._limit_s()
        if not trainer.finished:
            discard_uncertainty(self.run.out)  # it was fitted to the errors of an earlier generator
            trainer.facts.pop("senses", None)
        trainer.train(self._show, self.paced)

    def _limit_s(self) -> float:
        """Seconds of the generator's training: what the preparations left of the hours, less what the uncertainty will take by a
        trial. Where that is more than its part of the hours, it makes fewer rollouts: a `share` of the usual number. A finished run
        stays finished until it is given more hours."""
        trainer, took_s = self.trainer, self.trainer.facts["seconds"]
        if self.config.limit_hours <= trainer.facts.get("asked", 0.0):
            return took_s
        budget, frames, usual_s = self.run.budget, self.config.uncertainty_frames, 0.0
        if frames:
            world = self.recipe.world(trainer).to(self.run.device)
            usual_s = 1.2 * uncertainty_seconds(world, self.parts.recording, frames)
        share = min(1.0, budget.most_s("uncertainty") / max(usual_s, 1e-6))
        trainer.facts["share"] = share
        return max(1e-6, took_s + budget.left_s - share * usual_s)

    def _finish(self) -> None:
        """Saves the trained world, which can then be played, and gives it an estimator and an uncertainty."""
        trainer, config = self.trainer, self.config
        if "senses" in trainer.facts and (self.run.out / "world" / "world.json").exists():
            return
        trainer.facts["asked"] = config.limit_hours
        trainer.save()
        world = self._save_with_strip()
        frames = int(trainer.facts.get("share", 1.0) * config.uncertainty_frames)
        fewest = min(FEWEST_FRAMES, config.uncertainty_frames)
        settings = SensesConfig(config.estimator_steps, frames if frames >= fewest else 0, config.seed)
        sensing, facts = learn_senses(self.run, world, self.parts.recording, config.keep_out, settings)
        save_world(sensing.replaced(card=facts), self.run.out / "world")
        trainer.compute_once("senses", lambda: facts)

    def _show(self) -> None:
        """Saves the world with a picture, and takes in what was recorded since."""
        self._save_with_strip()
        growing = self.recipe.growing if isinstance(self.recipe, FlowRecipe) else None
        if growing is not None and growing.pick_up():
            self.say(f"It trains on {growing.further:,} frames more, recorded meanwhile.")

    def _save_with_strip(self) -> LearnedWorld:
        """Saves the world as it now is, so that it can be played while it trains, and a picture of truth above rollouts of it,
        with its memory and without."""
        world = self.recipe.world(self.trainer)
        worlds = (world, world.without_memory()) if self.parts.video.geometry else (world,)
        strip = self.run.out / f"strip-{self.trainer.steps_done:06d}.png"
        draw_strip([one.to(self.run.device) for one in worlds], self.parts.recording, strip)
        with replacing(self.run.out / "newest.png") as staged:
            shutil.copyfile(strip, staged)
        save_world(world, self.run.out / "world")
        return world
