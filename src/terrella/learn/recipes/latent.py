"""train latent: a recording into a latent world; see worlds/latent.py and objectives/latent_prediction.py."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...core.errors import DatasetError, TrainingError
from ...core.spec import kind_of
from ...data import Clips, ClipsConfig, Dataset
from ...worlds.checkpoint import WORLD_FILE
from ...worlds.folder import save_latent, with_kept
from ...worlds.latent import LatentWorld
from ...worlds.latent_network import LatentConfig, LatentNetwork
from ...worlds.learned import About
from ..feeds import Streamed
from ..latent_validation import ARMS, calibrate, encoded, foreseen, validate
from ..objectives.latent_prediction import LatentPrediction, latent_clips, parameters, settle_scale
from ..objectives.outcome import levels
from ..recording import Recording
from ..strips import write_lines
from ..trainer import Report, Run, Trainer, device_named

STAGE = "latent"
SIDE, COARSE = 64, 16  # pixels: of the larger side at most, and what sides are multiples of
WIDEST = 512  # numbers of a channel that is a vector
LATENT_WIDEST = 64  # numbers of all vectors that may be the latent themselves
STARTS = 64
LEAP = 5  # steps at once, unless it is said
NOT_NUMBERS = (
    "rgb",
    "depth",
    "reward",
    "done",
    "uncertainty",
    "known",
    "keyframes",
    "mosaic",
    "instruction",
    "latent",
    "done_probability",
)
WHY = "a latent world is learned from actions and what follows them (`terrella train latent-actions` finds actions in pictures)"


@dataclass(frozen=True)
class LatentTraining:
    """Settings of a training run.

    Args:
        name: Name of the world.
        pictures: See the recording's pictures. --no-pictures sees its state vectors alone, and draws nothing.
        vectors: See the recording's state vectors. --no-vectors sees its pictures alone, and predicts the vectors all the same.
        channels: Vectors of the recording that it learns, such as observation. Default: all.
        size: Height and width at which pictures are seen, multiples of 16. Default: their own shape, within 64 x 64.
        latent: Width of the latent. Default: 64 with pictures; without, the state vectors themselves, scaled, where they have 64
            numbers or fewer, else 32.
        history: Last latents and actions that the predictor sees. 1 is enough, and fast, where the vectors tell speeds.
        hidden: Width of the layers.
        members: Predictors, whose disagreement says how wrong they may be; with 1 it says nothing.
        rollout: Steps that are predicted one from another. Default: 12, and with pictures 6; fewer where episodes are short.
        leap: Steps that a leap takes at once, for planners that hold or try moves of so many; 0 learns none. Default: 5, where
            the rollout has room for it.
        steps: Training steps. Training ends after these or after `hours`. Default: 4000, and with pictures 2500.
        hours: Hours of training, earlier runs included.
        batch: Clips per step. Default: 128, and with pictures 32.
        learning_rate: Highest learning rate.
        save_every_s: Seconds between saves.
        strip_every_s: Seconds between pictures of truth and prediction.
        seed: Random seed.
        device: cpu, cuda or auto.
    """

    name: str = "latent"
    pictures: bool = True
    vectors: bool = True
    channels: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    latent: int | None = None
    history: int = 3
    hidden: int = 192
    members: int = 3
    rollout: int | None = None
    leap: int | None = None
    steps: int | None = None
    hours: float = 24.0
    batch: int | None = None
    learning_rate: float = 1e-3
    save_every_s: float = 60.0
    strip_every_s: float = 300.0
    seed: int = 0
    device: str = "auto"


def train_latent(data: str | Path, out: str | Path, config: LatentTraining, report: Report) -> dict:
    """Trains, or goes on with, the run in `out`; the finished world lies in `out`/world. Returns its facts."""
    _check(config)
    dataset = Dataset(data)
    size = config.size or fitting(dataset)
    run = Run.of(
        out, config, report, device_named(config.device), ("hours",),
        **{"frames": dataset.length, "recording of": dataset.world.get("name")},
    )  # fmt: skip
    run.found(STAGE)
    recording = Recording.open(dataset, size, report, needs=("action",), why=WHY).enough()
    torch.manual_seed(config.seed)
    return _Learned(run, recording, config).learn()


def _check(config: LatentTraining) -> None:
    if config.size and any(side < COARSE or side % COARSE for side in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of {COARSE}.")
    sizes = (config.history, config.hidden, config.members)
    counts = (config.latent, config.rollout, config.steps, config.batch, config.leap or None, *sizes)
    if any(count is not None and count < 1 for count in counts) or (config.batch or 2) < 2 or config.history > 16:
        raise TrainingError(
            "--latent, --rollout, --steps, --hidden and --members are 1 or more, --history is 1 to 16, and a --batch has 2 "
            "clips or more."
        )
    if not (config.pictures or config.vectors):
        raise TrainingError("--no-pictures --no-vectors leaves nothing to see; leave one of them out.")


def fitting(dataset: Dataset) -> tuple[int, int]:
    """Height and width in multiples of 16 at which pictures are seen: their own shape, the longer side at most 64."""
    if dataset.rgb_key is None:
        return SIDE, SIDE
    sides = dataset.sensors[dataset.rgb_key].shape[:2]
    share = min(1.0, SIDE / max(sides))
    height, width = (max(COARSE, COARSE * round(share * side / COARSE)) for side in sides)
    return height, width


def vectors_of(recording: Recording, wanted: tuple[str, ...] = ()) -> tuple[tuple[str, int], ...]:
    """(channel, width) of what a recording holds in numbers: state vectors, poses, vitals; of all, or of those that are wanted."""
    cache, found = recording.cache, {}
    for channel, key in cache.keys.items():
        array = cache.arrays.get(key)
        if (
            array is None
            or kind_of(channel) in NOT_NUMBERS
            or key in ("action", "action_valid", "task")
            or array.ndim > 2
        ):
            continue
        if (width := int(np.prod(array.shape[1:]))) <= WIDEST:
            found[channel] = width
    if lacks := [name for name in wanted if name not in found]:
        raise DatasetError(
            f"{recording.name} has no vector {', '.join(lacks)}; it has {', '.join(sorted(found)) or 'none'}."
        )
    return tuple((name, width) for name, width in sorted(found.items()) if not wanted or name in wanted)


class _Learned:
    """The network of a latent world, and the trainer's stage that it takes."""

    def __init__(self, run: Run, recording: Recording, config: LatentTraining):
        self.run, self.recording, self.config = run, recording, config
        assert recording.controls is not None  # see WHY
        self.controls = recording.controls
        self.sees_pictures = recording.cache.rgb is not None and config.pictures
        shape = self._shape()
        self.network = LatentNetwork(shape).to(run.device)
        arrays = [self._array(name) for name, _ in shape.vectors]
        rows = np.flatnonzero(recording.usable)
        flat = [np.asarray(array[rows], np.float32).reshape(len(rows), -1) for array in arrays]
        follows = (np.diff(recording.start[rows]) == 0) & (np.diff(rows) == 1)
        settle_scale(self.network, np.concatenate(flat, 1) if flat else np.zeros((len(rows), 0)), follows)

    def _array(self, channel: str) -> np.ndarray:
        return self.recording.cache.arrays[self.recording.cache.keys[channel]]

    def _shape(self) -> LatentConfig:
        recording, config, cache = self.recording, self.config, self.recording.cache
        vectors, has_pictures = vectors_of(recording, config.channels), cache.rgb is not None
        pictured = has_pictures and config.pictures
        if not pictured and not (config.vectors and any(kind_of(name) != "pose" for name, _ in vectors)):
            raise DatasetError(
                f"{recording.name} holds no {'state vectors' if has_pictures else 'pictures and no state vectors'} for the "
                "world to see: record some, or leave --no-pictures and --no-vectors out."
            )
        seen = config.vectors and not pictured and all(kind_of(name) != "pose" for name, _ in vectors)
        width = sum(width for _, width in vectors)
        identity = seen and config.latent is None and width <= LATENT_WIDEST
        paid = np.zeros(1) if cache.reward is None else np.asarray(cache.reward, np.float32)[recording.usable]
        return LatentConfig(
            actions=self.controls.numbers,
            rewards=levels(paid),
            vectors=vectors,
            size=(cache.rgb.shape[1], cache.rgb.shape[2]) if pictured else None,
            sees_pictures=config.pictures,
            sees_vectors=config.vectors,
            latent=width if identity else config.latent or (64 if pictured else 32),
            identity=identity,
            history=config.history,
            hidden=config.hidden,
            members=config.members,
            leap=self._leap(),
        )

    def _leap(self) -> int:
        rollout, asked = self._rollout(), self.config.leap
        if asked is not None and asked > rollout:
            raise TrainingError(f"--leap {asked} needs a --rollout of as many steps or more; it is {rollout}.")
        return asked if asked is not None else LEAP if rollout >= LEAP else 0

    def _rollout(self) -> int:
        """Steps of a rollout: as many as are asked for, or as leave nine tenths of the clips that a single step would have."""
        recording, history = self.recording, self.config.history
        lengths = np.array([np.subtract(*recording.cache.episodes[number][::-1]) for number in recording.seen])
        clips = [np.maximum(lengths - history - steps + 1, 0).sum() for steps in range(1, 65)]
        if not clips[0]:
            raise DatasetError(
                f"no episode of {recording.name} has the {history + 1} rows of a clip; record longer ones."
            )
        if self.config.rollout is not None:
            if not clips[min(self.config.rollout, 64) - 1]:
                raise DatasetError(
                    f"no episode of {recording.name} is long enough for --rollout {self.config.rollout}."
                )
            return self.config.rollout
        most = 6 if self.sees_pictures else 12
        long = [
            steps for steps in range(1, most + 1) if lengths[lengths >= history + steps].sum() >= 0.9 * lengths.sum()
        ]
        return max(long, default=1)

    def learn(self) -> dict:
        config, recording = self.config, self.recording
        steps = self._rollout()
        batch = config.batch or (32 if self.sees_pictures else 128)
        names = [name for name in ("action", "reward", "done") if getattr(recording.cache, name) is not None]
        names += [name for name, _ in self.network.config.vectors] + (["rgb"] if self.network.config.size else [])
        clips = Clips(
            recording.cache,
            ClipsConfig(config.history + steps, names, batch, seed=config.seed, episodes=recording.seen),
        )
        make = lambda found, now: latent_clips(found, self.controls, self.network.config, now.device)  # noqa: E731
        objective = LatentPrediction(self.network, self.controls, config.learning_rate, steps)
        total = config.steps or (2500 if self.sees_pictures else 4000)
        trainer = Trainer(self.run, STAGE, Streamed(clips, make), objective, total)
        trainer.limit_s = 3600 * config.hours
        done = (self.run.out / "world" / WORLD_FILE).exists() and "validation" in trainer.facts
        if not trainer.finished:
            trainer.facts.pop("validation", None)
            done = False
        trainer.train(lambda: self.draw_strip(trainer))
        if not done:
            self._finish(trainer)
        found = trainer.facts["validation"]
        return {
            "world": str(self.run.out / "world"),
            **{k: v for k, v in trainer.summary.items() if k != "validation"},
            **found,
        }

    def _finish(self, trainer: Trainer) -> None:
        """The uncertainty, the figures of the finished world, and the world."""
        self.run.report(1, 1, "validating on held-out episodes")
        world = self.world(trainer)
        calibrate(world, self.recording)
        found = validate(world, self.recording)
        about = LatentWorld(_with(world.about, found), world.network, world.starts)
        save_latent(about, self.run.out / "world")
        (self.run.out / "validation.json").write_text(json.dumps(found, indent=1) + "\n")
        self._strip(world, trainer)
        self.network.spread.copy_(world.network.spread)
        self.network.error.copy_(world.network.error)
        trainer.once("validation", lambda: found)

    def world(self, trainer: Trainer) -> LatentWorld:
        """The world as it now is, on the CPU, of copies."""
        recording, cache = self.recording, self.recording.cache
        about = with_kept(cache.world, self.run.out / "world")
        names = about.get("action_names") or cache.action_names
        named = about.get("dt_s", 1 / cache.fps), tuple(names), about.get("keys", {}), self._card(trainer)
        limits = {"idle": tuple(about.get("idle", ())), "max_episode_steps": about.get("max_episode_steps")}
        what = About(self.config.name, self.controls, *named, ignored=recording.ignored, **limits)
        network = copy.deepcopy(self.network).cpu()
        bare = LatentWorld(what, network, torch.zeros(1, network.config.latent))
        first = np.intersect1d(recording.start, np.flatnonzero(recording.usable))
        first = first[:: max(1, math.ceil(len(first) / STARTS))]
        return LatentWorld(what, network, encoded(bare, recording, first))

    def _card(self, trainer: Trainer) -> dict[str, Any]:
        recording, shape = self.recording, self.network.config
        game = recording.cache.world.get("name")
        sees = [*(["rgb"] if shape.pictured else []), *shape.seen]
        return {
            "what": f"A latent world learned from {recording.cache.length:,} frames of {game or recording.name}",
            "game": game,
            "sees": ", ".join(sees),
            "data": f"{recording.usable.sum():,} frames, {len(recording.seen)} episodes",
            "steps": trainer.facts["step"],
            "hours": round(trainer.facts["seconds"] / 3600, 3),
            "parameters": parameters(self.network),
        }

    def draw_strip(self, trainer: Trainer) -> None:
        """The world as it now is, so that it can be played while it learns, and truth above what it imagines."""
        world = self.world(trainer)
        save_latent(world, self.run.out / "world")
        self._strip(world, trainer)

    @torch.inference_mode()
    def _strip(self, world: LatentWorld, trainer: Trainer) -> None:
        lines = foreseen(world, self.recording)
        if lines:
            write_lines(lines, self.run.out / f"strip-{trainer.facts['step']:06d}.png")


def _with(about: About, found: dict[str, Any]) -> About:
    usual = found["errors"]["latent"][ARMS[0]]
    levels = {"sure": min(usual.values()), "invents": 0.5}  # what the page of play calls sure and invented
    return replace(about, card={**about.card, "uncertainty": levels, "validation": found})
