"""Worlds of frames alone: recordings without depth or poses. Stages: scroll, outcome, then a codec, or a flow as a teacher."""

import copy
from dataclasses import replace
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F

from ...core.errors import DatasetError, TrainingError
from ...space.ground import joined
from ...space.matching import scroll_index
from ...space.mosaic import read_mosaic
from ...worlds.codec import COARSE, Codec, CodecConfig
from ...worlds.config import VideoConfig
from ...worlds.controls import Controls
from ...worlds.flow import FlowConfig, FlowNetwork, carry
from ...worlds.frame_history import FrameHistory, StartClips
from ...worlds.generator import pixels
from ...worlds.learned import LearnedWorld
from ...worlds.outcome import ConstantConfig
from ..budget import Stage
from ..feeds import codec_feed, flow_feed, frames_feed
from ..moves import CodecStatistics, frequent_moves, mosaics, overlay, palette, stitch_episodes
from ..objectives.codec import CodecObjective, Spans
from ..objectives.flow import Flow
from ..objectives.flow_frames import FlowClipMaker, FlowFrames
from ..objectives.fog import CLIPS as FOG_CLIPS
from ..objectives.fog import choose_fog
from ..objectives.scroll import learn_scroll
from ..objectives.stress import FRAMES, USUAL, choose_stress
from ..objectives.uncertainty import dreaming_seconds
from ..recording import Recording
from ..run_folder import resume_file
from ..trainer import Feed, Run, Trainer
from .video_config import TrainConfig
from .video_parts import VideoParts, flow_objective

MOVES, COLOURS = 24, 64  # sizes of a codec's vocabularies
PAIR_PIXELS = 1 << 20  # pixels of the pairs of frames in which moves are searched, in QUARTER hours or more
QUARTER = 0.25
ONE_FRAME = "--frames 1: how things move is seen in two frames; give 2 or more."
SCROLLS, HALF = 0.01, 0.5  # see `scrolls_of`
FLOW_ROLLOUT = 8  # steps of a clip that a flow network predicts
REMEMBERED = 64  # steps before a start from which its mosaic is made
CHANGED_SHARE, MAX_STRESS = (
    0.4,
    16.0,
)  # pixels that change are weighted up to this share of the loss, at most by this factor


class CodecRecipe:
    """A codec: each pixel stays, is fetched from an earlier frame or from the mosaic, or is painted in a palette colour."""

    def __init__(self, run: Run, recording: Recording, config: TrainConfig, video: VideoConfig):
        self.parts = _flat_parts(run, recording, config, video)
        self.video = self.parts.video
        if self.video.slots < 2:
            raise TrainingError(ONE_FRAME)
        self.objective = self._objective()
        self.starts: StartClips | None = None  # made once
        self.ground: torch.Tensor | None = None  # chosen when the world is tuned
        self.fog_px = 0

    def _objective(self) -> CodecObjective:
        """With the vocabulary of moves and colours of the recording, which the run's folder keeps."""
        config, recording = self.parts.config, self.parts.recording
        plain = self.video.generator
        statistics = _statistics_of(self.parts)
        sizes = len(statistics.moves), len(statistics.palette)
        settings = CodecConfig(plain.size, plain.slots, plain.context, *sizes)
        levels = int(np.log2(min(plain.size) // COARSE)) + 1  # as many as a small frame has room for
        codec = Codec(replace(settings, channels=(config.channels or settings.channels)[:levels]))
        codec.moves[1:], codec.palette[:] = statistics.moves, statistics.palette
        codec.stress.fill_(statistics.stress**USUAL)
        spans = Spans.fitting(_lengths(recording), self.video.slots)
        return CodecObjective(codec, config.learning_rate or 2e-3, spans, statistics.stress, statistics.over)

    def feed(self, batch: int) -> Feed:
        return codec_feed(self.parts.recording, self.video, self.objective, batch, self.parts.config.seed)

    def preparations(self) -> list[Stage]:
        return [Stage("scroll", 0.1, self._learn_scroll), *self.parts.outcome_stages()]

    def _learn_scroll(self) -> None:
        run, codec = self.parts.run, self.objective.generator
        if not resume_file(run.out, "flow").exists():  # else the codec has begun to train with the scroll that it holds
            learn_scroll(run, self.objective.scroll, self.parts.recording, codec.moves, self.video.slots)
        self.objective.freeze_scroll()

    def world(self, trainer: Trainer) -> LearnedWorld:
        codec, over = self.objective.generator, self.objective.over
        moves = codec.moves.cpu()
        if self.starts is None:
            self.starts = _starts(self.parts)
            rows = _start_rows(self.parts)
            self.starts = replace(self.starts, known=_mosaics_before(self.parts, rows, moves, over))
        whole = tuple((int(x), int(y)) for x, y in moves)
        settings = replace(self.video.frames, moves=whole, fog_px=self.fog_px)
        scene = FrameHistory(settings, self.starts, over, self.ground)
        return _flat_world(self.parts, trainer, self.objective, scene)

    def tuning_s(self, world: LearnedWorld) -> float:
        return 2 * dreaming_seconds(world, self.parts.recording, FRAMES)

    def tune(self, world: LearnedWorld, share: float) -> dict:
        """How much the draw favours change, and whether the ground of the recordings is its memory, is chosen by rollouts of
        recorded episodes."""
        objective = self.objective
        assert isinstance(world.generator, Codec)
        recording, frames = self.parts.recording, int(share * FRAMES)
        power = choose_stress(world, world.generator, recording, objective.stress, self.parts.config.seed, frames)
        objective.smooth.module.stress.copy_(world.generator.stress)
        scene = cast(FrameHistory, world.scene)
        scene = choose_fog(world, scene, recording, self.parts.config.seed, int(share * FOG_CLIPS))
        self.ground, self.fog_px = scene.ground, scene.config.fog_px
        return {"taken_back": power, "fog_px": self.fog_px}


class FlowRecipe:
    """A flow network: each frame is a sample of what may follow the last frames, with the mosaic as memory where pictures
    scroll."""

    def __init__(self, run: Run, recording: Recording, config: TrainConfig, video: VideoConfig):
        self.parts = _flat_parts(run, recording, config, video)
        self.video = self.parts.video
        widths = config.channels or FlowConfig.channels
        if len(widths) != 3 or any(width % 8 for width in widths):
            raise TrainingError("--channels: a flow network has three, each a multiple of 8, as 64 112 160.")
        if self.video.slots < 2:
            raise TrainingError(ONE_FRAME)
        statistics = _statistics_of(self.parts)
        moves, self.over = scrolls_of(recording, statistics, config.seed), statistics.over
        plain = self.video.generator
        steps = config.flow_steps if config.flow_steps > 1 else FlowConfig.steps
        settings = FlowConfig(plain.size, plain.slots, plain.context, len(moves) - 1, widths, steps)
        network = FlowNetwork(settings)
        network.moves[:], network.over[:] = moves, self.over & (len(moves) > 1)
        spans = Spans.fitting(_lengths(recording), self.video.slots, 0, FLOW_ROLLOUT)
        self.objective = FlowFrames(
            network, config.learning_rate or 6e-3, spans, stress_of(recording, network, config.seed)
        )
        self.stitched = stitch_episodes(recording, moves, self.over) if len(moves) > 1 else None
        self.ground = None if self.stitched is None else joined(list(self.stitched.grounds.values()))
        self.starts: StartClips | None = None  # made once

    def feed(self, batch: int) -> Feed:
        recording, slots = self.parts.recording, self.video.slots
        controls = recording.controls or Controls.buttons(self.video.actions)
        maker = FlowClipMaker(controls, slots, 2 * batch, self.stitched, self.over)
        return flow_feed(recording, self.video, self.objective.spans, maker, self.parts.config.seed)

    def preparations(self) -> list[Stage]:
        scrolls = [Stage("scroll", 0.1, self._learn_scroll)] if self.stitched is not None else []
        return [*scrolls, *self.parts.outcome_stages()]

    def _learn_scroll(self) -> None:
        run, network = self.parts.run, self.objective.generator
        assert network.scrolling is not None
        if not resume_file(run.out, "flow").exists():
            learn_scroll(run, network.scrolling, self.parts.recording, network.moves, self.video.slots)
        self.objective.freeze_scroll()

    def world(self, trainer: Trainer) -> LearnedWorld:
        moves = self.objective.generator.moves.cpu()
        if self.starts is None:
            self.starts, rows = _starts(self.parts), _start_rows(self.parts)
            if len(moves) > 1:
                self.starts = replace(self.starts, known=_mosaics_before(self.parts, rows, moves, self.over))
        whole = tuple((int(x), int(y)) for x, y in moves) if len(moves) > 1 else ()
        scene = FrameHistory(replace(self.video.frames, moves=whole), self.starts, self.over, self.ground)
        return _flat_world(self.parts, trainer, self.objective, scene)

    def tuning_s(self, world: LearnedWorld) -> float:
        return 0.0

    def tune(self, world: LearnedWorld, share: float) -> dict:
        return {}


class FlatFlowRecipe:
    """A flow of several steps a frame: the teacher of a world of frames alone."""

    def __init__(self, run: Run, recording: Recording, config: TrainConfig, video: VideoConfig):
        self.parts = _flat_parts(run, recording, config, video)
        self.video = self.parts.video
        self.objective = flow_objective(self.video, config)
        self.starts: StartClips | None = None  # made once

    def feed(self, batch: int) -> Feed:
        return frames_feed(self.parts.recording, None, self.video, batch, self.parts.config.seed, None)

    def preparations(self) -> list[Stage]:
        return self.parts.outcome_stages()

    def world(self, trainer: Trainer) -> LearnedWorld:
        self.starts = self.starts or _starts(self.parts)
        return _flat_world(self.parts, trainer, self.objective, FrameHistory(self.video.frames, self.starts, None))

    def tuning_s(self, world: LearnedWorld) -> float:
        return 0.0

    def tune(self, world: LearnedWorld, share: float) -> dict:
        return {}


def _flat_parts(run: Run, recording: Recording, config: TrainConfig, video: VideoConfig) -> VideoParts:
    if config.keep_out is not None:
        raise DatasetError(
            f"without depth and poses no part of the map of {recording.name} can be kept out; drop --keep-out."
        )
    return VideoParts(run, recording.require_rows(), config, video)


def _flat_world(
    parts: VideoParts, trainer: Trainer, objective: Flow | CodecObjective | FlowFrames, scene: FrameHistory
) -> LearnedWorld:
    return LearnedWorld(
        parts.about(trainer, (objective.generator,), 0),
        scene=scene,
        generator=copy.deepcopy(objective.smooth.module).cpu().float(),
        outcome=parts.trained_outcome(ConstantConfig(parts.median_reward)),
    )


def _lengths(recording: Recording) -> np.ndarray:
    """Rows of the episodes for training."""
    ranges = recording.cache.episodes
    return np.array([np.diff(ranges[number])[0] for number in recording.seen] or [0])


def _statistics_of(parts: VideoParts) -> CodecStatistics:
    """The statistics of the recording, which the run's folder keeps."""
    run, config = parts.run, parts.config
    statistics = CodecStatistics.read(run.out, run.recipe)
    if statistics is None or statistics.over.shape != parts.video.size:
        pixels = int(PAIR_PIXELS * min(1.0, max(config.hours / QUARTER, 1 / 16)))
        statistics = codec_statistics(parts.recording, config.seed, pixels)
        statistics.write(run.out, run.recipe)
    return statistics


def scrolls_of(recording: Recording, statistics: CodecStatistics, seed: int) -> torch.Tensor:
    """The moves by which whole pictures scroll, int64 [n, 2], (0, 0) first: those that lead from SCROLLS of the pictures or more
    to the next, and after which at most HALF as many pixels differ. A paddle that moves does not scroll the picture."""
    rows = recording.rows_within(1, 0)
    rows = np.sort(np.random.default_rng(seed).choice(rows, min(len(rows), 1000), replace=False))
    before, after = recording.rgb(rows - 1), recording.rgb(rows)
    moves = F.pad(statistics.moves, (0, 0, 1, 0))
    index = scroll_index(before, after, moves)
    still = changed_pixels(before, after).mean((1, 2))
    carried = changed_pixels(pixels(carry(before.float() / 127.5 - 1, index, moves, statistics.over)), after).mean(
        (1, 2)
    )
    often = [
        number == 0 or len(at) >= SCROLLS * len(rows) and carried[at].mean() <= HALF * still[at].mean()
        for number in range(len(moves))
        for at in [(index == number).nonzero()[:, 0]]
    ]
    return moves[torch.tensor(often)]


def stress_of(recording: Recording, network: FlowNetwork, seed: int) -> float:
    """The weight of pixels that change, apart from the scroll of the whole picture, in the loss of a flow network: such that they
    are up to CHANGED_SHARE of it."""
    rows = recording.rows_within(1, 0)
    rows = np.random.default_rng(seed).choice(rows, min(len(rows), 1000), replace=False)
    before, after = recording.rgb(rows - 1), recording.rgb(rows)
    if network.scrolling is not None:
        index = scroll_index(before, after, network.moves)
        before = pixels(carry(before.float() / 127.5 - 1, index, network.moves, network.over))
    change = changed_pixels(before, after).mean()
    return float(np.clip(CHANGED_SHARE / max(float(change), 1e-4), 1, MAX_STRESS))


def changed_pixels(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """1 where pictures uint8 [B, 3, H, W] differ by more than 8 of 255, else 0: float [B, H, W]."""
    return ((before.int() - after.int()).abs().amax(1) > 8).float()


def codec_statistics(recording: Recording, seed: int, pixels: int = PAIR_PIXELS) -> CodecStatistics:
    """The moves and colours of a recording, how rarely its pixels change, and what stays while it scrolls. Moves are searched in
    `pixels` of it."""
    rng = np.random.default_rng(seed)
    rows = recording.rows_within(1, 0)
    rows = np.sort(rng.choice(rows, min(len(rows), 2000), replace=False))
    before, after = recording.rgb(rows - 1), recording.rgb(rows)
    change = changed_pixels(before, after).mean((1, 2)).numpy() + 1e-4
    most = max(32, pixels // before[0, 0].numel())  # pairs: each is matched at 625 displacements
    some = rng.choice(len(rows), min(len(rows), most), replace=False, p=change / change.sum())
    moves, colours = frequent_moves(before[some], after[some], MOVES), palette(after, COLOURS, rng)
    over = overlay(before, after, F.pad(moves, (0, 0, 1, 0)))
    return CodecStatistics(moves, colours, float(np.clip(CHANGED_SHARE / change.mean(), 1, MAX_STRESS)), over)


def _start_rows(parts: VideoParts) -> np.ndarray:
    """About 32 rows, evenly spread, each with a whole history before it and a valid step after it."""
    slots, recording = parts.video.slots, parts.recording
    since = np.arange(recording.cache.length) - recording.start
    rows = np.flatnonzero(parts.happened.real & (since >= slots))
    if not len(rows):
        raise DatasetError(f"no episode is longer than the {slots} frames of history that one begins with.")
    return rows[:: max(1, len(rows) // 32)]


def _starts(parts: VideoParts) -> StartClips:
    """The histories with which episodes of the world begin."""
    slots, recording, video = parts.video.slots, parts.recording, parts.video
    rows = _start_rows(parts)
    frames = rows[:, None] - np.arange(slots)
    starts = StartClips.of(recording.rgb(frames.ravel()).view(*frames.shape, 3, *video.size), video.actions)
    actions = recording.actions_before(rows, np.arange(1, slots + 1))
    return replace(starts, actions=actions, vitals=torch.from_numpy(parts.happened.vitals[rows]))


def _mosaics_before(parts: VideoParts, rows: np.ndarray, moves: torch.Tensor, over: torch.Tensor) -> torch.Tensor:
    """The mosaics of the episodes of `rows` at these rows: uint8 [n, 4, H, W]."""
    recording, past = parts.recording, rows[:, None] - np.arange(REMEMBERED, 0, -1)
    real = torch.from_numpy(past >= recording.start[rows][:, None])
    frames = recording.rgb(np.maximum(past, 0).ravel()).unflatten(0, past.shape)
    nowhere = torch.zeros(len(rows), 2, dtype=torch.int64)
    return read_mosaic(mosaics(frames, moves, over, real), parts.video.size, nowhere)
