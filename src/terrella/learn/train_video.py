"""train_video: a recording into a VideoWorld, by flow matching with the last frame dreamt and a sharpness critic."""

from __future__ import annotations

import copy
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import DatasetError, TrainingError
from ..core.world import make_rng
from ..data import ClipCache, Dataset, split
from ..space.keyframes import Keyframes
from ..worlds.controls import BUTTONS
from ..worlds.folder import save_world, video_spec
from ..worlds.generator import Generator, VideoConfig, channels_last, generate
from ..worlds.history import HistoryWorld, Starts
from ..worlds.motion import Motion
from ..worlds.objects import ROWS, STARTS, Objects, ObjectsConfig
from ..worlds.outcome import Outcome
from ..worlds.video import VideoWorld
from .lessons import recorded_lesson
from .losses import Critic, flow_losses, frame_losses, half_precision, sharpened
from .motion import train_motion
from .objects import learn_objects
from .outcome import Happenings, train_outcome
from .samples import (
    CAST,
    INSTANCES,
    THINGS,
    Box,
    Lesson,
    Recording,
    choose_keyframes,
    controls_of,
    open_views,
    usable_rows,
)
from .senses import SensesConfig, learn_senses
from .strips import draw_strip
from .updates import Report, Updates, descend, device_named


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Args:
        name: What the world will be called.
        size: Height and width of its frames in pixels.
        geometry: Use the depth and poses of a recording that has them; --no-geometry learns from pictures and actions alone.
        channels: Of the generator at 1/2, 1/4, 1/8, ... of the size.
        frames: Last frames that a world without geometry sees.
        objects_steps: Training steps of what things that the recording tells apart do next (`cast`, `instances`), which makes
            cards of them that walk and fall; 0 leaves it out, and they are drawn as the rest.
        outcome_steps: Training steps of what reads reward, end and vitals off the frames, which is learned first.
        moving: Learn what moves (monsters, doors, pick-ups), where a recording with depth and poses marks it as `things`.
        flow_steps: Steps in which a frame is drawn. With more than one the whole flow from noise to frame is learned, so that
            a frame is one of those that could be and not their mean: a teacher for `train distil`.
        steps: Training steps; training ends here or after `hours`.
        hours: Hours of training, those of earlier runs counted in.
        batch: Frames a step; by itself 8 on a CPU and 64 on a GPU.
        learning_rate: Of the generator at its height.
        motion_steps: Training steps of the motion model, which is learned first.
        keyframes: Of the recording, that become the world's memory.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees, to score new places.
        critic_from: The step from which a critic judges sharpness.
        critic_weight: How hard it pulls, beside the loss itself.
        estimator_steps: Training steps of the eye that sees depth in a lone picture, which is learned last; 0 leaves it out.
        uncertainty_frames: Dreamt frames from which the finished world learns to say when it invents; 0 leaves it out.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth against dream.
        seed: Of everything random.
        device: cpu, cuda or auto.
    """

    name: str = "world"
    size: tuple[int, int] = (96, 128)
    geometry: bool = True
    channels: tuple[int, ...] = (32, 56, 88, 128)
    frames: int = 4
    outcome_steps: int = 1500
    objects_steps: int = 2500
    moving: bool = True
    flow_steps: int = 1
    steps: int = 8000
    hours: float = 24.0
    batch: int | None = None
    learning_rate: float = 8e-4
    motion_steps: int = 6000
    keyframes: int = 640
    keep_out: Box | None = None
    critic_from: int = 1500
    critic_weight: float = 0.3
    estimator_steps: int = 2500
    uncertainty_frames: int = 9000
    save_every_s: float = 120.0
    strip_every_s: float = 300.0
    seed: int = 0
    device: str = "auto"


def train_video(data: str | Path, out: str | Path, config: TrainConfig, report: Report) -> dict:
    """Trains, or goes on with, the run in `out`; the finished world lies in `out`/world. Returns its facts."""
    out = Path(out)
    if any(length < 16 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 16 or more.")
    device = device_named(config.device)
    out.mkdir(parents=True, exist_ok=True)
    dataset = Dataset(data)
    cache = ClipCache.open(dataset, config.size, lambda done, total: report(done, total, "building the clip cache"))
    if cache.rgb is None:
        raise DatasetError(f"{data} holds no pictures (rgb); a world of pictures cannot be learned from it.")
    run = _Run(dataset, cache, out, config, device)
    run.learn(report)
    return run.finish(report)


class _Run:
    """The pieces of one training run."""

    def __init__(self, dataset: Dataset, cache: ClipCache, out: Path, config: TrainConfig, device: torch.device):
        self.dataset, self.cache, self.out, self.config, self.device = dataset, cache, out, config, device
        torch.manual_seed(config.seed)
        posed = (
            config.geometry and cache.depth is not None and cache.pose is not None and bool(cache.world.get("camera"))
        )
        camera = tuple(cache.world["camera"]) if posed else (1.0, 1.0, 0.5, 0.5)
        controls = controls_of(cache)
        if posed and controls.kind != BUTTONS:
            raise DatasetError(
                f"{dataset.root} has actions that are no buttons (0 or 1 each), from which a world with depth and poses is "
                "learned; --no-geometry learns one from pictures and any actions."
            )
        self.video = VideoConfig(
            camera,
            controls.told,
            config.size,
            config.channels,
            slots=3 if posed else config.frames,
            geometry=posed,
            steps=config.flow_steps,
            residual=not posed and config.flow_steps == 1,
            moving=posed and config.moving and THINGS in cache.arrays,
        )
        if config.keep_out is not None and not posed:
            raise DatasetError(f"{dataset.root} has no poses, so no part of its map can be kept out; drop --keep-out.")
        train, self.held_out = split(len(cache.episodes))
        start = np.zeros(cache.length, np.int64)
        for first, last in cache.episodes:
            start[first:last] = first
        usable = usable_rows(cache, train, config.keep_out, self.video.camera)
        if usable.sum() < 64:
            raise DatasetError(
                f"{dataset.root} leaves {usable.sum()} frames to train on; record more, or a smaller keep_out."
            )
        self.recording = Recording(cache, start, usable, controls)
        told_apart = {CAST, INSTANCES} <= set(cache.arrays)
        if self.video.moving and told_apart and config.objects_steps:
            if cache.arrays[CAST].shape[1:] != (ROWS, 4):
                raise DatasetError(
                    f"{dataset.root} lists things as {cache.arrays[CAST].shape[1:]}, and {(ROWS, 4)} is read: number and place of "
                    f"up to {ROWS}. Record it so, or train with --objects-steps 0."
                )
            self.video = replace(self.video, objects=True)
        known = ObjectsConfig(controls.told, self.video.history)
        self.objects = Objects(known) if self.video.objects else None  # small: it is learned on the CPU
        self.happened, self.outcome = self._begin_outcome(usable, posed)
        self.memory = self._choose_memory() if posed else None
        self.generator = channels_last(Generator(self.video)).to(self.device)
        self.critic = Critic().to(self.device)
        self.motion = Motion(self.video)
        self.smooth = copy.deepcopy(self.generator).eval().requires_grad_(False)
        modules: dict[str, nn.Module] = {
            "generator": self.generator,
            "smooth": self.smooth,
            "motion": self.motion,
            "critic": self.critic,
        }
        if self.outcome is not None:
            modules["outcome"] = self.outcome
        if self.objects is not None:
            modules["objects"] = self.objects
        self.optimiser = torch.optim.AdamW(
            self.generator.parameters(), config.learning_rate, (0.9, 0.99), weight_decay=1e-4
        )
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), 3e-4, (0.0, 0.99))
        optimisers = {"optimiser": self.optimiser, "critic_optimiser": self.critic_optimiser}
        self.updates = Updates(
            out, _recipe(config, dataset), modules, optimisers, motion=None, outcome=None, objects=None
        )
        self.facts = self.updates.facts

    def _begin_outcome(self, usable: np.ndarray, posed: bool) -> tuple[Happenings, Outcome | None]:
        """What the recording tells of rewards, ends and vitals, and what will learn it, if there is anything to learn."""
        happened = Happenings.of(self.cache, self.recording.action(slice(None)).numpy(), usable)
        if (posed and not self.video.moving) or not happened.tells_something:
            return happened, None
        self.video = replace(self.video, vitals=_at_first(happened.vitals, self.recording))
        return happened, Outcome(happened.config()).to(self.device)

    def _choose_memory(self) -> Keyframes:
        rows = choose_keyframes(
            np.asarray(self.cache.pose), np.flatnonzero(self.recording.usable), self.config.keyframes
        )
        return self._keyframes_at(rows)

    def _keyframes_at(self, rows: np.ndarray) -> Keyframes:
        rgb = torch.from_numpy(self.dataset.rgb_at(rows)).permute(0, 3, 1, 2).float()
        size = [2 * length for length in self.config.size]  # as the keyframes of a dream, whatever size was recorded
        rgb = F.interpolate(rgb, size, mode="area" if rgb.shape[-1] >= size[1] else "nearest-exact")
        return Keyframes.of(
            rgb.round().to(torch.uint8), self.recording.lasting(rows), self.recording.pose(rows), self.video.camera
        )

    def learn(self, report: Report) -> None:
        config = self.config
        if self.facts["motion"] is None and self.memory is not None:
            self.facts["motion"] = train_motion(
                self.motion, self.recording, self.memory, self.video, config.motion_steps, config.seed, report
            )
            self.updates.save()
        if self.outcome is not None and self.facts["outcome"] is None:
            settings = config.outcome_steps, config.seed, report
            self.facts["outcome"] = train_outcome(self.outcome, self.recording.rgb, self.happened, *settings)
            self.updates.save()
        if self.objects is not None and self.facts["objects"] is None:
            settings = self.video.camera, config.objects_steps, config.seed, report
            part = self.recording
            self.facts["objects"] = learn_objects(
                self.objects, part, self.dataset.rgb_at, part.pose(self._beginnings()), *settings
            )
            self.updates.save()
        every_s = config.save_every_s, config.strip_every_s
        self.updates.run(config.steps, self._step, self.draw_strip, *every_s, report, config.hours)

    def _step(self, step: int) -> dict[str, float]:
        """One step; all its randomness comes from (seed, step), so a resumed run sees what an unbroken one would."""
        config = self.config
        rng = np.random.default_rng([config.seed, step])
        batch = config.batch or (64 if self.device.type == "cuda" else 8)
        noise_rng = make_rng(int(rng.integers(2**62)))
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * min(1, (step + 1) / 200) * (0.05 + 0.95 * _cosine(step / config.steps))
        with torch.no_grad():
            lesson = self._lesson(batch, rng, noise_rng).to(self.device)
            glimpse, truth = lesson.glimpse, lesson.truth
            noise = torch.randn(truth.shape, generator=noise_rng).to(self.device)
            from_noise = 0.75 if config.flow_steps == 1 else 0.0
            time_ = np.where(rng.random(batch) < from_noise, 0, rng.random(batch))
            time_ = torch.from_numpy(time_).float().to(self.device)
            noisy = truth * time_[:, None, None, None] + noise * (1 - time_[:, None, None, None])
            if lesson.weight is not None:
                noisy = torch.where(lesson.weight > 0, noisy, noise)
        with half_precision(self.device):
            clean = lesson.judged(self.generator(noisy, time_, glimpse, lesson.last, lesson.told).float())
            drawn, found = clean[:, :4], truth[:, :4]
            losses = (
                frame_losses(drawn, found, lesson.weight)
                if config.flow_steps == 1
                else flow_losses(drawn, found, time_)
            )
        total = losses["rgb"] + 0.5 * losses["depth"] + 0.5 * losses.get("edges", 0.0)
        if self.video.moving:
            losses["things"] = F.binary_cross_entropy_with_logits(clean[:, 4], truth[:, 4])
            total = total + 0.2 * losses["things"]
        judged = config.flow_steps == 1
        if judged and step >= config.critic_from:
            total = total + sharpened(self.critic, clean, total, glimpse, config.critic_weight)
        if not torch.isfinite(total):
            raise TrainingError(
                f"the loss is not a number at step {step}; the last save is good: lower --learning-rate."
            )
        descend(self.optimiser, total, step, self.generator)
        if judged and step >= config.critic_from - 200:
            with half_precision(self.device):
                real, fake = self.critic(truth[:, :3], glimpse), self.critic(clean[:, :3].detach(), glimpse)
                losses["critic"] = F.relu(1 - real).mean() + F.relu(1 + fake).mean()
            descend(self.critic_optimiser, losses["critic"], step, self.critic)
        keep = min(0.999, (step + 1) / (step + 20))
        with torch.no_grad():
            for smooth, raw in zip(self.smooth.parameters(), self.generator.parameters()):
                smooth.lerp_(raw, 1 - keep)
        return {name: float(value.detach()) for name, value in losses.items()}

    def _lesson(self, batch: int, rng: np.random.Generator, noise_rng: torch.Generator) -> Lesson:
        # A teacher sees recorded frames alone: its own, drawn in one step, would be those of another network.
        def dream(shown: Lesson) -> torch.Tensor:
            noise = torch.randn(batch, 4, *self.video.size, generator=noise_rng)
            shown = shown.to(self.device)
            with half_precision(self.device):
                clean = generate(self.generator, noise.to(self.device), shown.glimpse, shown.last, shown.told, 1)
            return clean.float().cpu()

        dreamer = dream if self.config.flow_steps == 1 else None
        return recorded_lesson(self.recording, self.memory, self.video, batch, rng, dreamer)

    def world(self) -> VideoWorld | HistoryWorld:
        """The world as it now is."""
        about = self.cache.world
        modules = (self.generator, self.motion) if self.memory is not None else (self.generator,)
        card = {
            "what": f"Learned from {self.dataset.length:,} frames of {about.get('name', self.dataset.root.name)}",
            "data": f"{self.recording.usable.sum():,} frames, {len(self.cache.episodes) - len(self.held_out)} episodes",
            "steps": self.facts["step"],
            "hours": round(self.facts["seconds"] / 3600, 2),
            "keep_out": self.config.keep_out,
            "keyframes": 0 if self.memory is None else len(self.memory),
            "parameters": sum(p.numel() for module in modules for p in module.parameters()),
            **(self.facts["motion"] or {}),
            **(self.facts["outcome"] or {}),
            **(self.facts["objects"] or {}),
        }
        dt_s = about.get("dt_s", 1 / self.cache.fps)
        outcome = None if self.outcome is None else copy.deepcopy(self.outcome).cpu().float()
        vitals = () if outcome is None else outcome.config.vitals
        names = about.get("action_names") or self.cache.action_names  # of a choice, the recording names each
        named = (dt_s, names, about.get("keys", {}), card)
        spec = video_spec(self.config.name, self.video, *named, self.recording.controls, vitals)
        told = (self.cache.reward, self.cache.done)  # what a recording lacks is none of either
        reward, done = (np.zeros(self.cache.length) if part is None else np.array(part) for part in told)
        usual = float(np.median(reward))
        generator = copy.deepcopy(self.smooth).cpu().float()
        if self.memory is None:
            return HistoryWorld(spec, self.video, generator, self._starts(), usual, outcome, self.recording.controls)
        rewards = (usual, _ending_pays(reward - usual, done & np.array(self.cache.action_valid)))
        starts = open_views(self.memory, 32)
        if self.video.moving:  # monsters wait where episodes begin, and the player is well
            first = self._beginnings()
            starts = self._keyframes_at(first) if len(first) else starts
        body = {name: value for name, value in (self.facts["motion"] or {}).items() if name in ("body_m", "short")}
        return VideoWorld(
            spec, replace(self.video, **body), generator, self.motion, self.memory, starts, rewards,
            outcome=outcome, objects=None if self.objects is None else copy.deepcopy(self.objects),
        )  # fmt: skip

    def _beginnings(self) -> np.ndarray:
        """Some 32 rows with which episodes begin."""
        first = np.intersect1d(self.recording.start, np.flatnonzero(self.recording.usable))
        return first[:: max(1, len(first) // STARTS)][:STARTS]

    def _starts(self) -> Starts:
        """Where stories begin, in a world of history: some 32 moments of the recording, evenly."""
        slots, recording = self.video.slots, self.recording
        since = np.arange(self.cache.length) - recording.start
        rows = np.flatnonzero(self.happened.real & (since >= slots))  # from which it goes on
        if not len(rows):
            raise DatasetError(f"no episode is longer than the {slots} frames of history that a story begins with.")
        rows = rows[:: max(1, len(rows) // 32)]
        frames, led = rows[:, None] - np.arange(slots), rows[:, None] - 1 - np.arange(slots)
        return Starts(
            recording.rgb(frames.ravel()).view(*frames.shape, 3, *self.video.size),
            recording.action(led.ravel()).view(*led.shape, -1),
            torch.from_numpy(self.happened.vitals[rows]),
        )

    def draw_strip(self) -> None:
        """Truth above dream, with the memory and without; and the world as it now is, so that it can be played while it
        learns."""
        world = self.world()
        worlds = (world, world.without_memory()) if isinstance(world, VideoWorld) else (world,)
        draw_strip(worlds, self.recording, self.held_out, self.out / f"strip-{self.facts['step']:06d}.png")
        save_world(world, self.out / "world", dict(world.spec.card))

    def finish(self, report: Report) -> dict:
        config, done = self.config, (self.out / "world" / "world.json").exists()
        if not done or self.facts.get("sensed") != self.facts["step"]:
            self._finish(config, report)
        return {"world": str(self.out / "world"), **self.updates.outcome}

    def _finish(self, config: TrainConfig, report: Report) -> None:
        """The last strip, and the senses of the finished world."""
        self.draw_strip()
        world = self.world()
        settings = SensesConfig(config.estimator_steps, config.uncertainty_frames, config.seed)
        keep = self.out / "eye.safetensors"
        sensing, facts = learn_senses(world, self.recording, self.held_out, config.keep_out, settings, report, keep)
        save_world(sensing, self.out / "world", {**world.spec.card, **facts})
        self.facts |= {**facts, "sensed": self.facts["step"]}
        self.updates.save()


def _at_first(vitals: np.ndarray, recording: Recording) -> tuple[float, ...]:
    """The vitals [N, V] with which episodes begin."""
    first = np.unique(recording.start[recording.usable])
    return tuple(float(value) for value in np.median(vitals[first], 0))


def _ending_pays(extra: np.ndarray, ends: np.ndarray) -> float:
    """Reward above the usual in the last steps before an episode's end (games may pay a step or two before it)."""
    rows = np.flatnonzero(ends)
    return float(np.mean([extra[max(row - 3, 0) : row + 1].sum() for row in rows])) if len(rows) else 0.0


def _recipe(config: TrainConfig, dataset: Dataset) -> dict:
    """What must not change within a run; how long it goes on, and where, may."""
    fixed = asdict(replace(config, hours=0.0, device="", learning_rate=0.0, save_every_s=0, strip_every_s=0))
    return json.loads(json.dumps({**fixed, "frames": dataset.length}))


def _cosine(share: float) -> float:
    return 0.5 + 0.5 * float(np.cos(np.pi * min(share, 1.0)))
