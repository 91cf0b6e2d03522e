"""train video: a recording into a playable world, by scroll, motion, outcome, objects, estimator, generator, uncertainty."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError, TrainingError
from ...data import Dataset
from ...space.keyframes import Keyframes
from ...space.mosaic import recalled
from ...worlds.body import Motion, MotionBody
from ...worlds.codec import COARSE, Codec, CodecConfig
from ...worlds.config import VideoConfig
from ...worlds.folder import save_world, with_kept
from ...worlds.frame_history import FrameHistory, StartClips
from ...worlds.generator import UNet
from ...worlds.keyframe_scene import KeyframeScene
from ...worlds.learned import About, LearnedWorld
from ...worlds.objects import ROWS, STARTS, Billboards, BillboardsConfig
from ...worlds.outcome import ConstantConfig, ConstantOutcome, FrameOutcome
from ..feeds import codec_feed, frames_feed
from ..moves import Looks, frequent_moves, mosaics, overlay, palette
from ..objectives.codec import CodecObjective, Spans
from ..objectives.estimator import learn_estimator
from ..objectives.flow import Flow
from ..objectives.motion import learn_motion
from ..objectives.objects import learn_objects
from ..objectives.outcome import Happenings, Pieces, learn_outcome
from ..objectives.scroll import learn_scroll
from ..objectives.stress import FRAMES, USUAL, balanced
from ..objectives.uncertainty import dreaming_s, expected_s, forget
from ..recording import INSTANCES, OBJECTS, THINGS, Box, Recording, choose_keyframes, open_views, there
from ..run_folder import resume_file
from ..strips import draw_strip
from ..trainer import Feed, Report, Run, Trainer, device_named
from .parts import SensesConfig, learn_senses

WIDTHS = (32, 56, 88, 128)
MOVES, COLOURS = 24, 64  # among which a codec chooses
MATCHED = 1 << 20  # pixels of the pairs of pictures in which its moves are found
REMEMBERED = 64  # steps before it, of which what a start knows is made
STRESSED, STRESS = 0.4, 16.0  # pixels that change count as if they were so many, at most so many times more than others

# of the hours, what each stage may take at most; the generator has the rest
SHARES = {
    "motion": 0.08,
    "scroll": 0.1,
    "outcome": 0.08,
    "objects": 0.1,
    "estimator": 0.12,
    "dreams": 0.06,
    "uncertainty": 0.04,
}

NEEDS = (
    "a world is learned from frames and actions (`terrella train latent-actions` finds actions where there are none)"
)


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Args:
        name: Name of the world.
        size: Height and width of its frames in pixels. Default: those of the recording, if they are no more than 96 x 128 in all.
        geometry: Use the depth and poses of a recording that has them. --no-geometry learns from frames and actions alone.
        channels: Channels of the generator at 1/2, 1/4, 1/8, ... of the size (without depth at 1/4, 1/8, ...). Default: 32 56 88
            128, and without depth 48 64 96.
        frames: Last frames that a world without geometry sees.
        objects_steps: Training steps of the objects, which are drawn as billboards that move, change and vanish. Needs a
            recording that tells objects apart. 0 draws them like everything else.
        outcome_steps: Training steps of the model that predicts reward, end and vitals.
        moving: Learn what moves (monsters, doors, pick-ups), if a recording with depth and poses marks it.
        flow_steps: Steps in which a frame is drawn. With more than one the whole flow from noise to frame is learned, so that
            a frame is a sample and not a mean: a teacher for `train distil`.
        steps: Training steps of the generator. Training ends after these or after `hours`.
        hours: Hours of training, of all parts together and of earlier runs too; the learning rate falls as they go by.
        batch: Frames per step. Default: 8 on a CPU, 64 on a GPU.
        learning_rate: Highest learning rate of the generator. Default: 8e-4, and without depth 2e-3.
        motion_steps: Training steps of the motion model.
        keyframes: Number of recorded keyframes that the world remembers.
        keep_out: A box x0 y0 x1 y1 of the map, in metres, that training never sees, to score new places.
        critic_from: Step from which a critic judges sharpness.
        critic_weight: Weight of the critic, relative to the loss.
        estimator_steps: Training steps of the depth and odometry estimator. 0 leaves it out.
        uncertainty_frames: Predicted frames from which the uncertainty is learned. 0 leaves it out.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth and prediction.
        seed: Random seed.
        device: cpu, cuda or auto.
    """

    name: str = "world"
    size: tuple[int, int] | None = None
    geometry: bool = True
    channels: tuple[int, ...] = ()
    frames: int = 4
    outcome_steps: int = 1500
    objects_steps: int = 2500
    moving: bool = True
    flow_steps: int = 1
    steps: int = 8000
    hours: float = 24.0
    batch: int | None = None
    learning_rate: float | None = None
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
    if config.size and any(length < 16 or length % 8 for length in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of 8, 16 or more.")
    device = device_named(config.device)
    dataset = Dataset(data)
    facts = {"frames": dataset.length, "recording of": dataset.world.get("name")}
    run = Run.of(out, config, report, device, ("hours", "learning_rate"), SHARES, **facts)
    run.found("flow")
    recording = Recording.open(dataset, config.size, report, needs=("rgb", "action"), why=NEEDS)
    torch.manual_seed(config.seed)
    return _Learned(run, recording, config).learn()


def plan(recording: Recording, config: TrainConfig) -> VideoConfig:
    """What kind of world can be learned of a recording."""
    cache, controls = recording.cache, recording.controls
    posed = config.geometry and recording.posed
    moving = posed and config.moving and THINGS in cache.arrays
    objects = moving and there(cache, OBJECTS) and there(cache, INSTANCES) and config.objects_steps > 0
    if objects and cache.arrays[OBJECTS].shape[1:] != (ROWS, 4):
        raise DatasetError(
            f"{recording.name} lists objects as {cache.arrays[OBJECTS].shape[1:]}, and {(ROWS, 4)} is read: number and place "
            f"of up to {ROWS}. Record it so, or train with --objects-steps 0."
        )
    height, width = cache.rgb.shape[1:3]
    return VideoConfig(
        tuple(cache.world["camera"]) if posed else (1.0, 1.0, 0.5, 0.5),
        controls.numbers,
        (height, width),
        config.channels or WIDTHS,
        slots=3 if posed else config.frames,
        geometry=posed,
        steps=config.flow_steps,
        residual=not posed and config.flow_steps == 1,
        moving=moving,
        objects=objects,
    )


class _Learned:
    """The parts of a world, which its stages train one after another."""

    def __init__(self, run: Run, recording: Recording, config: TrainConfig):
        self.run, self.config, self.video = run, config, plan(recording, config)
        if config.keep_out is not None:
            if not self.video.geometry:
                raise DatasetError(
                    f"without depth and poses no part of the map of {recording.name} can be kept out; drop --keep-out."
                )
            usable = Recording.of(recording.cache, recording.seen, config.keep_out).usable
            recording = replace(recording, usable=usable)
        self.recording = recording.enough()
        known = BillboardsConfig(self.video.actions, self.video.history)
        self.objects = Billboards(known) if self.video.objects else None
        self.happened = Happenings.of(recording.cache, recording.action(slice(None)).numpy(), recording.usable)
        self.outcome: FrameOutcome | None = None
        if self.happened.tells_something and (self.video.moving or not self.video.geometry):
            begins = _at_first(self.happened.vitals, recording)
            self.video = replace(self.video, vitals=begins)
            self.outcome = FrameOutcome(replace(self.happened.config(), begins=begins)).to(run.device)
        self.memory = self._memory() if self.video.geometry else None
        fetches = self.memory is None and config.flow_steps == 1  # neither memory nor a flow draws frames
        self.flow = self._codec() if fetches else self._flow()
        self.motion = Motion(self.video.motion)
        self.facts: dict = {}
        self.starts: StartClips | None = None  # of a world without depth, made once

    def _flow(self) -> Flow:
        config = self.config
        parts = config.flow_steps, config.learning_rate or 8e-4, config.critic_from, config.critic_weight
        return Flow(UNet(self.video.generator), *parts)

    def _codec(self) -> CodecObjective:
        """A codec that knows how pictures of the recording move, and their colours; the run keeps what was found."""
        if self.video.slots < 2:
            raise TrainingError("--frames 1: how things move is seen in two frames; give 2 or more.")
        plain, found = self.video.generator, Looks.read(self.run.out, self.run.recipe)
        if found is None or found.over.shape != plain.size:
            found = self._looks()
            found.write(self.run.out, self.run.recipe)
        settings = CodecConfig(plain.size, plain.slots, plain.context, len(found.moves), len(found.palette))
        levels = int(np.log2(min(plain.size) // COARSE)) + 1  # that so small a picture has room for
        codec = Codec(replace(settings, channels=(self.config.channels or settings.channels)[:levels]))
        codec.moves[1:], codec.palette[:] = found.moves, found.palette
        codec.stress.fill_(found.stress**USUAL)
        ranges = self.recording.cache.episodes
        lengths = np.array([np.diff(ranges[number])[0] for number in self.recording.seen] or [0])
        spans = Spans.fitting(lengths, self.video.slots)
        return CodecObjective(codec, self.config.learning_rate or 2e-3, spans, found.stress, found.over)

    def _looks(self) -> Looks:
        recording, rng = self.recording, np.random.default_rng(self.config.seed)
        rows = recording.within(1, 0)
        rows = np.sort(rng.choice(rows, min(len(rows), 2000), replace=False))
        before, after = recording.rgb(rows - 1), recording.rgb(rows)
        change = ((before.int() - after.int()).abs().amax(1) > 8).float().mean((1, 2)).numpy() + 1e-4
        most = max(32, MATCHED // before[0, 0].numel())  # pairs: each is matched at 625 displacements
        some = rng.choice(len(rows), min(len(rows), most), replace=False, p=change / change.sum())
        moves, colours = frequent_moves(before[some], after[some], MOVES), palette(after, COLOURS, rng)
        over = overlay(before, after, F.pad(moves, (0, 0, 1, 0)))
        return Looks(moves, colours, float(np.clip(STRESSED / change.mean(), 1, STRESS)), over)

    def _feed(self, batch: int) -> Feed:
        parts = self.video, batch, self.config.seed
        if isinstance(self.flow, CodecObjective):
            return codec_feed(self.recording, self.video, self.flow, *parts[1:])
        dream = self.flow.dream if self.config.flow_steps == 1 else None  # a teacher sees recorded frames alone
        return frames_feed(self.recording, self.memory, *parts, dream)

    def _memory(self) -> Keyframes:
        rows = np.flatnonzero(self.recording.usable)
        picks = choose_keyframes(np.asarray(self.recording.cache.pose), rows, self.config.keyframes)
        return self.recording.sharp_keyframes(picks, self.video.camera)

    def learn(self) -> dict:
        """All stages; each goes on where it was stopped."""
        config, run, recording = self.config, self.run, self.recording
        feed = self._feed(config.batch or (64 if run.device.type == "cuda" else 8))
        if isinstance(self.flow, CodecObjective):
            if not resume_file(run.out, "flow").exists():  # the codec has learned with the scroll that it knows
                learn_scroll(run, self.flow.scroll, recording, self.flow.generator.moves, self.video.slots)
            self.flow.knows_scroll()
        trainer = Trainer(run, "flow", feed, self.flow, config.steps, strides=self.flow.strides)
        if self.memory is not None:
            self.facts |= learn_motion(run, self.motion, recording, self.memory, config.motion_steps)
        if self.outcome is not None:
            pieces = Pieces(self.outcome, recording.rgb, self.happened)
            self.facts |= learn_outcome(run, pieces, config.outcome_steps)
        if self.objects is not None:
            starts, rgb = recording.pose(self._beginnings()), recording.dataset.rgb_at
            parts = self.objects, recording, rgb, starts, self.video.camera, config.objects_steps
            self.facts |= learn_objects(run, *parts)
        self._divide(trainer)
        done = (run.out / "world" / "world.json").exists() and "senses" in trainer.facts
        if not trainer.finished:
            forget(run.out)  # it knew the errors of an earlier generator
            trainer.facts.pop("senses", None)
            done = False
        trainer.train(lambda: self.draw_strip(trainer))
        if not done:
            trainer.facts["asked"] = config.hours
            trainer.save()
            self._finish(trainer)
        senses = trainer.facts.pop("senses")
        return {"world": str(run.out / "world"), **trainer.summary, **self.facts, **senses}

    def _divide(self, trainer: Trainer) -> None:
        """Gives the generator what is left of the hours when the other stages have had theirs: before it is trained those that
        can be, and for the stress and the uncertainty, which come after, as long as a trial says. A run that has had its hours
        keeps to them."""
        config, budget, took_s = self.config, self.run.budget, trainer.facts["seconds"]
        if config.hours <= trainer.facts.get("asked", 0.0):
            trainer.limit_s = took_s
            return
        if self.memory is not None and config.estimator_steps:
            learn_estimator(self.run, self.recording, config.estimator_steps)
        after_s = 0.0
        if config.uncertainty_frames:
            most_s = budget.most_s("dreams") + budget.most_s("uncertainty")
            after_s = min(most_s, 1.2 * expected_s(self.world(trainer), self.recording, config.uncertainty_frames))
        if isinstance(self.flow, CodecObjective):
            after_s += dreaming_s(self.world(trainer), self.recording, FRAMES)
        trainer.limit_s = max(1e-6, took_s + budget.left_s - after_s)

    def _finish(self, trainer: Trainer) -> None:
        """The last strip, and the estimator and uncertainty of the finished world."""
        config = self.config
        balance = self._balanced(self.flow, trainer) if isinstance(self.flow, CodecObjective) else {}
        self.draw_strip(trainer)
        world = self.world(trainer)
        settings = SensesConfig(config.estimator_steps, config.uncertainty_frames, config.seed)
        sensing, facts = learn_senses(self.run, world, self.recording, config.keep_out, settings)
        facts |= balance
        save_world(sensing.replaced(card=facts), self.run.out / "world")
        trainer.once("senses", lambda: facts)

    def _balanced(self, flow: CodecObjective, trainer: Trainer) -> dict:
        """How likely pixels are to stay is told by how dreams of recorded episodes come out."""
        world = self.world(trainer)
        assert isinstance(world.generator, Codec)
        power = balanced(world, world.generator, self.recording, flow.stress, self.config.seed)
        flow.smooth.module.stress.copy_(world.generator.stress)
        return {"taken_back": power}

    def world(self, trainer: Trainer) -> LearnedWorld:
        """The world as it now is, on the CPU; of copies, since a finished world's weights learn no more."""
        recording, cache = self.recording, self.recording.cache
        about = with_kept(cache.world, self.run.out / "world")
        names = about.get("action_names") or cache.action_names  # of a choice, the recording names each
        named = about.get("dt_s", 1 / cache.fps), tuple(names), about.get("keys", {}), self._card(trainer)
        assert recording.controls is not None  # see NEEDS
        limits = {"idle": tuple(about.get("idle", ())), "max_episode_steps": about.get("max_episode_steps")}
        what = About(self.config.name, recording.controls, *named, ignored=recording.ignored, **limits)
        generator = copy.deepcopy(self.flow.smooth.module).cpu().float()
        usual = float(np.median(self.happened.reward))
        if self.memory is None:
            outcome = self._outcome(ConstantConfig(usual))
            moves, over = torch.zeros(0, 2), None
            if isinstance(self.flow, CodecObjective):
                moves, over = self.flow.generator.moves.cpu(), self.flow.over
            kept = replace(self.video.frames, moves=tuple((int(x), int(y)) for x, y in moves))
            self.starts = self.starts or self._starts(moves, over)
            scene = FrameHistory(kept, self.starts, over)
            return LearnedWorld(what, scene=scene, generator=generator, outcome=outcome)
        ends = self.happened.done & np.array(cache.action_valid)
        outcome = self._outcome(ConstantConfig(usual, _ending_pays(self.happened.reward - usual, ends)))
        starts = open_views(self.memory, 32)
        if self.video.moving:  # monsters wait where episodes begin, and the player is well
            first = self._beginnings()
            starts = recording.sharp_keyframes(first, self.video.camera) if len(first) else starts
        fitted = {name: self.facts[name] for name in ("body_m", "short")}
        body = MotionBody(copy.deepcopy(self.motion), replace(self.video.motion, **fitted))
        scene = KeyframeScene(self.video.keyframes, self.memory, starts)
        objects = copy.deepcopy(self.objects)
        return LearnedWorld(what, scene=scene, generator=generator, body=body, objects=objects, outcome=outcome)

    def _outcome(self, constant: ConstantConfig) -> FrameOutcome | ConstantOutcome:
        return ConstantOutcome(constant) if self.outcome is None else copy.deepcopy(self.outcome).cpu().float()

    def _card(self, trainer: Trainer) -> dict:
        recording, parts = self.recording, [self.flow.generator] + [self.motion] * (self.memory is not None)
        source, episodes = recording.dataset, len(recording.cache.episodes) - len(recording.held_out)
        name = recording.cache.world.get("name", source.root.name)
        return {
            "what": f"Learned from {source.length:,} frames of {name}",
            "game": recording.cache.world.get("name"),
            "data": f"{recording.usable.sum():,} frames, {episodes} episodes",
            "steps": trainer.taken,
            "hours": round(trainer.facts["seconds"] / 3600, 2),
            "keep_out": self.config.keep_out,
            "keyframes": 0 if self.memory is None else len(self.memory),
            "parameters": sum(weight.numel() for module in parts for weight in module.parameters()),
            **self.facts,
        }

    def _beginnings(self) -> np.ndarray:
        """Some 32 rows with which episodes begin."""
        first = np.intersect1d(self.recording.start, np.flatnonzero(self.recording.usable))
        return first[:: max(1, len(first) // STARTS)][:STARTS]

    def _starts(self, moves: torch.Tensor, over: torch.Tensor | None) -> StartClips:
        """Where episodes begin in a world without geometry: some 32 moments of the recording, evenly."""
        slots, recording = self.video.slots, self.recording
        since = np.arange(recording.cache.length) - recording.start
        rows = np.flatnonzero(self.happened.real & (since >= slots))  # from which it goes on
        if not len(rows):
            raise DatasetError(f"no episode is longer than the {slots} frames of history that one begins with.")
        rows = rows[:: max(1, len(rows) // 32)]
        frames = rows[:, None] - np.arange(slots)
        begun = StartClips.of(
            recording.rgb(frames.ravel()).view(*frames.shape, 3, *self.video.size), self.video.actions
        )
        acts, vitals = (
            recording.actions_before(rows, np.arange(1, slots + 1)),
            torch.from_numpy(self.happened.vitals[rows]),
        )
        known = begun.known if over is None else self._known(rows, moves, over)
        return replace(begun, actions=acts, vitals=vitals, known=known)

    def _known(self, rows: np.ndarray, moves: torch.Tensor, over: torch.Tensor) -> torch.Tensor:
        """What mosaics of their episodes know of the pictures before `rows`: uint8 [n, 4, H, W]."""
        recording, past = self.recording, rows[:, None] - np.arange(REMEMBERED, 0, -1)
        real = torch.from_numpy(past >= recording.start[rows][:, None])
        pictures = recording.rgb(np.maximum(past, 0).ravel()).unflatten(0, past.shape)
        nowhere = torch.zeros(len(rows), 2, dtype=torch.int64)
        return recalled(mosaics(pictures, moves, over, real), self.video.size, nowhere)

    def draw_strip(self, trainer: Trainer) -> None:
        """Truth above dream, with the memory and without; and the world as it now is, so that it can be played while it
        learns."""
        world = self.world(trainer)
        worlds = (world, world.without_memory()) if self.video.geometry else (world,)
        draw_strip(worlds, self.recording, self.run.out / f"strip-{trainer.taken:06d}.png")
        save_world(world, self.run.out / "world")


def _at_first(vitals: np.ndarray, recording: Recording) -> tuple[float, ...]:
    """The vitals [N, V] with which episodes begin."""
    first = np.unique(recording.start[recording.usable])
    return tuple(float(value) for value in np.median(vitals[first], 0))


def _ending_pays(extra: np.ndarray, ends: np.ndarray) -> float:
    """Reward above the usual in the last steps before an episode's end (games may pay a step or two before it)."""
    rows = np.flatnonzero(ends)
    return float(np.mean([extra[max(row - 3, 0) : row + 1].sum() for row in rows])) if len(rows) else 0.0
