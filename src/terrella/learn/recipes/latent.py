"""train latent: a recording into a latent world; see worlds/latent.py and objectives/latent_prediction.py."""

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
from ...data.channels import usually_seen
from ...worlds.checkpoint import WORLD_FILE
from ...worlds.folder import save_latent, with_saved_keys
from ...worlds.latent import LatentWorld
from ...worlds.latent_network import LatentConfig, LatentNetwork
from ...worlds.learned import About
from ..devices import device_named
from ..feeds import ClipStream
from ..latent_validation import ARMS, calibrate, encode_rows, fitting_horizons, rollout_frames, validate
from ..objectives.latent_prediction import LatentPrediction, latent_clips, parameters, set_scale
from ..objectives.lawful import LawLoss
from ..objectives.outcome import levels
from ..paired import fingerprint
from ..recording import Recording
from ..rehearsal import Rehearsal
from ..sized_feed import Feed, SizedFeed
from ..strips import write_lines
from ..trainer import Paced, Report, Run, Trainer

STAGE = "latent"
SIDE, COARSE = 64, 16  # pixels: the longer side at most, and of what sides are multiples
WIDEST = 512  # numbers of a channel at most, to be treated as a vector
LATENT_WIDEST = 64  # numbers of all vectors at most, to be the latent themselves
STARTS = 64
LEAP = 5  # steps at once, by default
NO_VECTORS = frozenset(
    "rgb depth reward done done_probability uncertainty known keyframes mosaic instruction latent".split()
)  # kinds of channels that are not learned as vectors
WHY = "a latent world is learned from actions and observations (`terrella train latent-actions` finds actions in pictures)"


@dataclass(frozen=True)
class LatentTraining:
    """Settings of a training run."""

    name: str = "latent"  # Name of the world.
    # --no-pictures: observe the recording's state vectors alone; the world then renders no pictures.
    pictures: bool = True
    # --no-vectors: observe the recording's pictures alone; the state vectors are predicted, but not observed.
    vectors: bool = True
    # State vectors of the recording to learn, such as observation. Default: all but expert, truth, action_confidence and masks.
    channels: tuple[str, ...] = ()
    # Height and width of pictures, multiples of 16. Default: their own shape, scaled to fit within 64 x 64.
    size: tuple[int, int] | None = None
    # Dimensions of the latent. Default: 64 with pictures; without, the scaled state vectors themselves where they have 64 numbers
    # or fewer, else 32.
    latent: int | None = None
    # Past latents and actions that the predictor sees. 1 is enough, and fast, where the vectors contain velocities.
    history: int = 3
    # Last pictures that a latent is made of; one picture shows no velocity.
    frames: int = 3
    hidden: int = 192  # Width of the hidden layers.
    # Predictors in the ensemble, whose disagreement is the uncertainty; with 1 there is none.
    members: int = 3
    # Horizon in steps of the training rollouts. Default: 12, and with pictures 6; fewer where episodes are short.
    rollout: int | None = None
    # Steps predicted at once (a leap), for planners that hold an action for as many steps; 0 trains none. Default: 5, if the
    # rollout is that long.
    leap: int | None = None
    # Training steps. Training ends after these or after --hours, whichever comes first. Default: 4000, and with pictures 2500.
    steps: int | None = None
    hours: float = 24.0  # Hours of training, earlier runs included.
    # Clips per step. Default: 128, and with pictures 32.
    batch: int | None = None
    learning_rate: float = 1e-3  # Peak learning rate.
    save_every_s: float = 60.0  # Seconds between saves.
    strip_every_s: float = 300.0  # Seconds between pictures of truth and prediction.
    seed: int = 0  # Random seed.
    device: str = "auto"  # cpu, cuda or auto.


@dataclass(frozen=True)
class Beginning:
    """What a training continues: a finished world, and a recording of what it learned before, if there is one."""

    world: LatentWorld
    kept: Recording | None = None
    laws: bool = False  # whether the laws of physics are a part of the loss, where the recording describes its bodies


def train_latent(
    data: str | Path,
    out: str | Path,
    config: LatentTraining,
    report: Report,
    paced: Paced | None = None,
    begin: Beginning | None = None,
) -> dict:
    """Trains, or resumes, the run in `out`; the finished world is in `out`/world. Returns the facts of the run. `paced` as in
    `Trainer.train`; `begin`: see `adapt`."""
    _check(config)
    dataset = Dataset(data)
    facts = {"frames": dataset.length, "recording of": dataset.world.get("name")}
    if begin is not None:
        facts |= {"begins with": fingerprint(begin.world.network), "keeps": len(begin.kept.start) if begin.kept else 0}
        facts["laws"] = begin.laws
    run = Run.of(out, config, report, device_named(config.device), ("hours",), **facts)
    run.saved_facts(STAGE)
    recording = open_rows(dataset, config.size or fitted_size(dataset), report)
    torch.manual_seed(config.seed)
    return _Training(run, recording, config, begin).learn(paced)


def open_rows(data: str | Path | Dataset, size: tuple[int, int] | None, report: Report) -> Recording:
    """A recording with actions, and rows enough to train on."""
    return Recording.open(data, size, report, needs=("action",), why=WHY).require_rows()


def _check(config: LatentTraining) -> None:
    if config.size and any(side < COARSE or side % COARSE for side in config.size):
        raise TrainingError(f"--size {config.size[0]} {config.size[1]}: give multiples of {COARSE}.")
    if not 1 <= config.frames <= 16:
        raise TrainingError(f"--frames {config.frames}: a latent is made of 1 to 16 pictures.")
    sizes = (config.history, config.hidden, config.members)
    counts = (config.latent, config.rollout, config.steps, config.batch, config.leap or None, *sizes)
    if any(count is not None and count < 1 for count in counts) or (config.batch or 2) < 2 or config.history > 16:
        raise TrainingError(
            "--latent, --rollout, --steps, --hidden and --members are 1 or more, --history is 1 to 16, and a --batch has 2 "
            "clips or more."
        )
    if not (config.pictures or config.vectors):
        raise TrainingError("--no-pictures --no-vectors leaves nothing to see; leave one of them out.")


def fitted_size(dataset: Dataset) -> tuple[int, int]:
    """Height and width of pictures in multiples of 16: their own shape, scaled so that the longer side is at most 64."""
    if dataset.rgb_key is None:
        return SIDE, SIDE
    sides = dataset.sensors[dataset.rgb_key].shape[:2]
    share = min(1.0, SIDE / max(sides))
    height, width = (max(COARSE, COARSE * round(share * side / COARSE)) for side in sides)
    return height, width


def vectors_of(recording: Recording, wanted: tuple[str, ...] = ()) -> tuple[tuple[str, int], ...]:
    """(channel, width) of the vectors of a recording, such as state, pose and vitals: those usually seen, or those in `wanted`."""
    cache, widths = recording.cache, {}
    for channel, key in cache.keys.items():
        array = cache.arrays.get(key)
        if (
            array is None
            or kind_of(channel) in NO_VECTORS
            or key in ("action", "action_valid", "task")
            or array.ndim > 2
        ):
            continue
        if (width := int(np.prod(array.shape[1:]))) <= WIDEST:
            widths[channel] = width
    if lacks := [name for name in wanted if name not in widths]:
        raise DatasetError(
            f"{recording.name} has no vector {', '.join(lacks)}; it has {', '.join(sorted(widths)) or 'none'}."
        )
    chosen = wanted or [name for name in widths if usually_seen(name)]
    return tuple((name, width) for name, width in sorted(widths.items()) if name in chosen)


def _has_ends(recording: Recording) -> bool:
    """Whether an episode that training sees ended; a limit of steps is no end. Without one, ends would be made up."""
    done = recording.cache.done
    return done is not None and bool(np.asarray(done)[recording.usable].any())


class _Training:
    """The network of a latent world and its training."""

    def __init__(self, run: Run, recording: Recording, config: LatentTraining, begin: Beginning | None = None):
        self.run, self.recording, self.config, self.begin = run, recording, config, begin
        assert recording.controls is not None  # see WHY
        self.controls = recording.controls
        self.sees_pictures = recording.cache.rgb is not None and config.pictures
        shape = self._shape() if begin is None else begin.world.network.config
        shape = replace(shape, ends=_has_ends(recording) or (begin is not None and shape.ends))
        seen = [name for name, _ in shape.vectors] + ["rgb"] * self.sees_pictures
        self.recording = recording = recording.having(seen)
        self.network = LatentNetwork(shape).to(run.device)
        if begin is not None:
            self.network.load_state_dict(begin.world.network.state_dict())
            if shape.leap > (steps := self._rollout()):
                raise DatasetError(
                    f"{begin.world.spec.name} predicts {shape.leap} steps at once, and the episodes of {recording.name} are long "
                    f"enough for {steps}; record longer ones."
                )
            return
        arrays = [self._array(name) for name, _ in shape.vectors]
        rows = np.flatnonzero(recording.usable)
        flat = [np.asarray(array[rows], np.float32).reshape(len(rows), -1) for array in arrays]
        follows = (np.diff(recording.start[rows]) == 0) & (np.diff(rows) == 1)
        set_scale(self.network, np.concatenate(flat, 1) if flat else np.zeros((len(rows), 0)), follows)

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
            frames=config.frames if pictured else 1,
        )

    def _leap(self) -> int:
        rollout, leap = self._rollout(), self.config.leap
        if leap is not None and leap > rollout:
            raise TrainingError(f"--leap {leap} needs a --rollout of {leap} steps or more; it is {rollout}.")
        return leap if leap is not None else LEAP if rollout >= LEAP else 0

    def _rollout(self) -> int:
        """Horizon of a rollout: the one in the settings, or the longest for which the episodes that are long enough hold nine
        tenths of all rows."""
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

    def learn(self, paced: Paced | None) -> dict:
        config, recording = self.config, self.recording
        steps = self._rollout()

        def clips_in(source: Recording) -> int:
            lengths = [np.subtract(*source.cache.episodes[number][::-1]) for number in source.seen]
            return int(sum(max(0, length - config.history - steps + 1) for length in lengths))

        batch = min(config.batch or (32 if self.sees_pictures else 128), clips_in(recording))
        kept = self.begin.kept if self.begin else None
        caches = [recording.cache, *([kept.cache] if kept else [])]
        names = [name for name in ("action", "reward", "done") if all(getattr(one, name) is not None for one in caches)]
        names += [name for name, _ in self.network.config.vectors] + (["rgb"] if self.network.config.size else [])
        laws = LawLoss.of(recording, self.network, steps) if self.begin and self.begin.laws else None
        total = config.steps or (2500 if self.sees_pictures else 4000)

        def stream(source: Recording, size: int) -> Feed:
            least, controls = min(size, clips_in(source)), source.controls
            assert controls is not None  # see WHY
            if not least:
                raise DatasetError(
                    f"no episode of {source.name} that is trained on has {config.history + steps} rows; record longer ones."
                )
            settings = ClipsConfig(config.history + steps, names, least, seed=config.seed, episodes=source.seen)
            make = lambda rows, now: latent_clips(rows, controls, self.network.config, now.device)  # noqa: E731
            return ClipStream(Clips(source.cache, settings), make)

        def feed(size: int) -> Feed:
            half = max(1, size // 2)
            return Rehearsal(stream(recording, half), stream(kept, half)) if kept else stream(recording, size)

        sized = SizedFeed(feed, batch, min(4 if kept else 2, batch))

        def broken(numbers: torch.Tensor) -> torch.Tensor:  # the kept recording may be of another body
            assert laws is not None
            return laws(numbers[: min(max(1, sized.size // 2), clips_in(recording))] if kept else numbers)

        objective = LatentPrediction(self.network, self.controls, config.learning_rate, steps, laws and broken)
        fitting_horizons(self.recording, self.network.config.history - 1)  # refuses before it trains
        trainer = Trainer(self.run, STAGE, sized, objective, total)
        done = (self.run.out / "world" / WORLD_FILE).exists() and "validation" in trainer.facts
        if not trainer.finished:
            trainer.facts.pop("validation", None)
            done = False
        trainer.train(lambda: self.draw_strip(trainer), paced)
        if not done:
            self._finish(trainer)
        summary = {name: fact for name, fact in trainer.summary.items() if name != "validation"}
        return {"world": str(self.run.out / "world"), **summary, **trainer.facts["validation"]}

    def _finish(self, trainer: Trainer) -> None:
        """Saves the trained world, then calibrates and validates it where it was trained, and saves it again with its figures."""
        world = self.world(trainer)
        save_latent(world, self.run.out / "world")  # it can be used, should a kill come before it is validated
        self.run.report(1, 1, "validating on held-out episodes")
        dreamer = world.to(self.run.device)
        calibrate(dreamer, self.recording)
        figures = validate(dreamer, self.recording)
        self._strip(dreamer, trainer)
        world = LatentWorld(_with_figures(world.about, figures), dreamer.network.cpu(), world.starts)
        save_latent(world, self.run.out / "world")
        (self.run.out / "validation.json").write_text(json.dumps(figures, indent=1) + "\n")
        self.network.spread.copy_(world.network.spread)
        self.network.error.copy_(world.network.error)
        trainer.compute_once("validation", lambda: figures)

    def world(self, trainer: Trainer) -> LatentWorld:
        """The world as it now is, on the CPU; a copy."""
        recording, cache = self.recording, self.recording.cache
        about = with_saved_keys(cache.world, self.run.out / "world")
        names = about.get("action_names") or cache.action_names
        named = about.get("dt_s", 1 / cache.fps), tuple(names), about.get("keys", {}), self._card(trainer)
        limits = {"idle": tuple(about.get("idle", ())), "max_episode_steps": about.get("max_episode_steps")}
        what = About(self.config.name, self.controls, *named, ignored=recording.ignored, **limits)
        network = copy.deepcopy(self.network).cpu()
        bare = LatentWorld(what, network, torch.zeros(1, network.config.latent))
        first = np.intersect1d(recording.start, np.flatnonzero(recording.usable))
        first = first[:: max(1, math.ceil(len(first) / STARTS))]
        return LatentWorld(what, network, encode_rows(bare, recording, first))

    def _card(self, trainer: Trainer) -> dict[str, Any]:
        recording, shape = self.recording, self.network.config
        game = recording.cache.world.get("name")
        sees = [*(["rgb"] if shape.pictured else []), *shape.seen]
        began = {"adapted from": self.begin.world.spec.name} if self.begin else {}
        return {
            "what": f"A latent world learned from {recording.cache.length:,} frames of {game or recording.name}",
            **began,
            "game": game,
            "sees": ", ".join(sees),
            "data": f"{recording.usable.sum():,} frames, {len(recording.seen)} episodes",
            "steps": trainer.facts["step"],
            "hours": round(trainer.facts["seconds"] / 3600, 3),
            "parameters": parameters(self.network),
        }

    def draw_strip(self, trainer: Trainer) -> None:
        """Saves the world as it now is, so that it can be used while it trains, and a picture of truth above a rollout."""
        world = self.world(trainer)
        save_latent(world, self.run.out / "world")
        self._strip(world.to(self.run.device), trainer)

    @torch.inference_mode()
    def _strip(self, world: LatentWorld, trainer: Trainer) -> None:
        lines = rollout_frames(world, self.recording)
        if lines:
            write_lines(lines, self.run.out / f"strip-{trainer.facts['step']:06d}.png")


def _with_figures(about: About, figures: dict[str, Any]) -> About:
    latent = figures["errors"]["latent"][ARMS[0]]
    levels = {
        "sure": min(latent.values()),
        "invents": 0.5,
    }  # levels at which the page of play says certain and inventing
    return replace(about, card={**about.card, "uncertainty": levels, "validation": figures})
