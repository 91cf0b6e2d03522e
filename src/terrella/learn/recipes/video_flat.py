"""Worlds of frames alone: recordings without depth or poses. Stages: scroll, outcome, then a flow network."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...core.errors import DatasetError, TrainingError, is_out_of_memory
from ...data import Dataset
from ...space.ground import joined
from ...space.matching import scroll_index
from ...space.mosaic import read_mosaic
from ...space.overlap import MountedCamera
from ...worlds.config import VideoConfig
from ...worlds.controls import Controls
from ...worlds.flow import FlowConfig, FlowNetwork, carry
from ...worlds.frame_history import FrameHistory, StartClips
from ...worlds.generator import channels_last
from ...worlds.learned import LearnedWorld
from ...worlds.outcome import ConstantConfig
from ..budget import Stage
from ..device_clips import ROOM, DeviceClips, DeviceGrounds, bytes_of
from ..devices import free_bytes
from ..feeds import ClipStream, clips_of, fitting_rollout
from ..growing_feed import GrowingFeed
from ..moves import Scrolling, StitchedEpisodes, changed_pixels, mosaics, stitch_episodes
from ..objectives.flow_frames import EarlierFrames, FlowClipMaker, FlowFrames
from ..objectives.scroll import learn_scroll
from ..presets import GIB, TrainingPlan
from ..recording import Recording
from ..rehearsal import Rehearsal
from ..run_folder import resume_file
from ..sized_feed import Feed
from ..subcloning import subclone
from ..trainer import Run, Trainer
from .video_config import TrainConfig
from .video_parts import Continued, VideoParts

PAIR_PIXELS = 1 << 20  # pixels of the pairs of frames in which moves are searched, in QUARTER hours or more
QUARTER = 0.25
FLOW_ROLLOUT = 8  # steps of a clip that a flow network predicts
APART, WHOLE = 16, 0.3  # steps, and the share of pixels that differ where pictures change as a whole
REMEMBERED = 64  # steps before a start from which its mosaic is made
CHANGED_SHARE = 0.4  # the pixels that change weigh this share of all others in the loss,
MAX_STRESS = 16.0  # but each at most this much: with 128, long trainings get worse


class FlowRecipe:
    """A flow network: each frame is a sample of what may follow the last frames, with the mosaic as memory where pictures
    scroll."""

    def __init__(
        self,
        run: Run,
        recording: Recording,
        config: TrainConfig,
        video: VideoConfig,
        plan: TrainingPlan,
        begin: Continued | None = None,
        meanwhile: Path | None = None,
    ):
        """meanwhile: the folder of a recording that may grow while training has begun."""
        self.begin, self.meanwhile = begin, meanwhile
        self.growing: GrowingFeed | None = None
        self.knows_outcome = False
        self.channels = config.channels
        if config.keep_out is not None:
            raise DatasetError(
                f"without depth and poses no part of the map of {recording.name} can be kept out; drop --keep-out."
            )
        self.parts = VideoParts(run, recording.require_rows(), config, video)
        self.video = self.parts.video
        widths = config.channels or plan.preset.channels
        if len(widths) != 3 or any(width % 8 for width in widths):
            raise TrainingError("--channels: a flow network has three, each a multiple of 8, as 64 112 160.")
        if self.video.slots < 2:
            raise TrainingError("--frames 1: how things move is seen in two frames; give 2 or more.")
        network, plain = self._network(widths), self.video.generator
        moves, self.over = network.moves.clone(), network.over.clone()
        lengths = np.array([np.diff(recording.cache.episodes[number])[0] for number in recording.seen] or [0])
        rollout, stress = (
            fitting_rollout(lengths, plain.slots, FLOW_ROLLOUT),
            stress_of(recording, network, config.seed),
        )
        teacher = None
        if begin is not None and begin.teaching:
            teacher = channels_last(copy.deepcopy(network_of(begin.world)).to(run.device).eval().requires_grad_(False))
        teaching = begin.teaching if begin is not None else 0.0
        self.objective = FlowFrames(network, config.learning_rate or 6e-3, rollout, stress, teacher, teaching)
        if begin is not None and network.scrolling is not None:
            self.objective.freeze_scroll()
        if plan.compiled:
            self.objective.compile()
        self.stitched = stitch_episodes(recording, moves, self.over) if len(moves) > 1 else None
        self.ground = None if self.stitched is None else joined(list(self.stitched.grounds.values()))
        self.starts: StartClips | None = None  # made once
        self.held, where = self._on_device(free_bytes(run.device))
        self.plan = replace(plan, recording=where)

    def _network(self, widths: tuple[int, ...]) -> FlowNetwork:
        """A new network for the recording, or a copy of the one that the training continues."""
        if self.begin is not None:
            generator = network_of(self.begin.world)
            self.knows_outcome = self.parts.continue_outcome(self.begin.world) and self.begin.teaching > 0
            if self.begin.teaching:
                generator = smaller(generator, widths, self.parts.config.flow_steps)
            return copy.deepcopy(generator).to(self.parts.run.device).train().requires_grad_(True)
        recording, plain, config = self.parts.recording, self.video.generator, self.parts.config
        scrolling = _scrolling_of(self.parts)
        steps = config.flow_steps if config.flow_steps > 1 else FlowConfig.steps
        recalls = len(scrolling.moves) == 1 and comes_back(recording, config.seed)
        views = tuple(MountedCamera(lens.intrinsics, lens.mount) for lens in recording.lenses().values())
        views = views if len(views) == len(recording.cameras) else ()  # where it is known of each how it is mounted
        moves = len(scrolling.moves) - 1
        settings = FlowConfig(plain.size, plain.slots, plain.context, moves, widths, steps, recalls, views, normed=True)
        network = FlowNetwork(settings)
        network.moves[:], network.over[:] = scrolling.moves, scrolling.over
        return network

    def _on_device(self, free_bytes: float) -> tuple[DeviceClips | None, str]:
        """The recording on a GPU with as many bytes free, if there is room for it, and a sentence of that."""
        device, recording = self.parts.run.device, self.parts.recording
        if device.type != "cuda" or (self.begin is not None and self.begin.kept is not None):
            return None, ""
        size = bytes_of(recording, self.stitched)
        whole, lacking = f"the recording ({size / GIB:.2g} GiB)", "its memory: clips come from the CPU"
        if size > ROOM * free_bytes:
            return None, f"{whole} takes more than half of {lacking}"
        try:
            grounds = None if self.stitched is None else DeviceGrounds(self.stitched, self.over, device)
            held = self._device_clips(recording, grounds)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            return None, f"{whole} does not fit into {lacking}"
        return held, f"the recording on it ({size / GIB:.2g} GiB)"

    def _device_clips(self, recording: Recording, grounds: DeviceGrounds | None) -> DeviceClips:
        rollout, recalls = self.objective.losses_per_batch, self.objective.generator.config.recalls
        return DeviceClips(recording, self.video.slots, rollout, self.parts.run.device, grounds, recalls)

    def feed(self, batch: int) -> Feed:
        """Clips chosen from three times as many, preferring those that change more; on a GPU from all, which lie there."""
        first = self._first_feed(batch)
        if self.meanwhile is None:
            return first
        rows = int(self.parts.recording.usable.sum())
        self.growing = GrowingFeed(first, rows, self._counted, lambda episodes: self._further_feed(batch, episodes))
        return self.growing

    def _counted(self) -> tuple[int, int]:
        """Episodes and rows of what is recorded meanwhile."""
        if self.meanwhile is None or not (self.meanwhile / "meta" / "info.json").exists():
            return 0, 0
        dataset = Dataset(self.meanwhile)
        return len(dataset.episodes), dataset.length

    def _further_feed(self, batch: int, episodes: int) -> tuple[Feed, int]:
        """Clips of the first episodes of what is recorded meanwhile, and their rows."""
        assert self.meanwhile is not None
        mine, run = self.parts.recording, self.parts.run
        opened = Recording.open(self.meanwhile, self.video.size, run.report, joined=mine.cameras)
        recording = replace(
            Recording.of(opened.cache, list(range(episodes)), None), controls=mine.controls, cameras=mine.cameras
        )
        moves, device = self.objective.generator.moves.cpu(), run.device
        stitched = stitch_episodes(recording, moves, self.over) if len(moves) > 1 else None
        rows = int(recording.usable.sum())
        if self.held is None:
            return self._clips(recording, stitched, 2 * batch), rows
        grounds = None if stitched is None else DeviceGrounds(stitched, self.over, device)
        return self._device_clips(recording, grounds).sized(2 * batch), rows

    def _first_feed(self, batch: int) -> Feed:
        if self.held is not None:
            return self.held.sized(2 * batch)
        if self.begin is None or self.begin.kept is None:
            return self._clips(self.parts.recording, self.stitched, 2 * batch)
        kept, moves = self.begin.kept, self.objective.generator.moves.cpu()
        stitched = stitch_episodes(kept, moves, self.over) if len(moves) > 1 else None
        streams = self._clips(self.parts.recording, self.stitched, batch), self._clips(kept, stitched, batch)
        return Rehearsal(*streams, interleaved=True, every=2)

    def _clips(self, recording: Recording, stitched: StitchedEpisodes | None, batch: int) -> Feed:
        slots, seed = self.video.slots, self.parts.config.seed
        controls = recording.controls or Controls.buttons(self.video.actions)
        past = None
        if self.objective.generator.config.recalls:
            past = EarlierFrames(torch.from_numpy(recording.start), lambda rows: recording.rgb(rows.numpy()))
        maker = FlowClipMaker(controls, slots, batch, stitched, self.over, past)
        length = slots + self.objective.losses_per_batch
        return ClipStream(clips_of(recording, length, 3 * batch, self.video, seed), maker)

    def preparations(self) -> list[Stage]:
        scrolls = [Stage("scroll", 0.1, self._learn_scroll)] if self.stitched is not None and self.begin is None else []
        return [*scrolls, *([] if self.knows_outcome else self.parts.outcome_stages())]

    def _learn_scroll(self) -> None:
        run, network = self.parts.run, self.objective.generator
        assert network.scrolling is not None
        if not resume_file(run.out, "flow").exists():
            learn_scroll(run, network.scrolling, self.parts.recording, network.moves, self.video.slots)
        self.objective.freeze_scroll()

    def world(self, trainer: Trainer) -> LearnedWorld:
        moves, parts = self.objective.generator.moves.cpu(), self.parts
        scrolls = len(moves) > 1
        if self.starts is None:
            self.starts, rows = _starts(parts), _start_rows(parts)
            if scrolls:
                self.starts = replace(self.starts, known=_mosaics_before(parts, rows, moves, self.over))
        whole = tuple((int(x), int(y)) for x, y in moves) if scrolls else ()
        return LearnedWorld(
            parts.about(trainer, (self.objective.generator,), 0),
            scene=FrameHistory(
                replace(self.video.frames, moves=whole, recalls=self.objective.generator.config.recalls),
                self.starts,
                self.over,
                self.ground,
            ),
            generator=copy.deepcopy(self.objective.smooth.module).cpu().float(),
            outcome=parts.trained_outcome(ConstantConfig(parts.median_reward)),
        )


def network_of(world: LearnedWorld) -> FlowNetwork:
    """The flow network of a world of frames alone."""
    assert isinstance(world.generator, FlowNetwork)
    return world.generator


def smaller(teacher: FlowNetwork, widths: tuple[int, ...], steps: int) -> FlowNetwork:
    """A narrower network for the same inputs, which begins with a part of the teacher's weights and predicts scrolls as it does."""
    network = FlowNetwork(replace(teacher.config, channels=(widths[0], widths[1], widths[2]), steps=steps))
    same = {
        name: part
        for name, part in teacher.state_dict().items()
        if name.partition(".")[0] in ("moves", "over", "scrolling")
    }
    network.load_state_dict(same, strict=False)
    return subclone(teacher, network)


def _scrolling_of(parts: VideoParts) -> Scrolling:
    """How the pictures scroll, which the run's folder keeps."""
    run, config = parts.run, parts.config
    scrolling = Scrolling.read(run.out, run.recipe)
    if scrolling is None or scrolling.over.shape != parts.video.size:
        pixels = int(PAIR_PIXELS * min(1.0, max(config.limit_hours / QUARTER, 1 / 16)))
        scrolling = Scrolling.of(parts.recording, config.seed, pixels)
        scrolling.write(run.out, run.recipe)
    return scrolling


def comes_back(recording: Recording, seed: int) -> bool:
    """Whether pictures change as a whole, so that earlier ones may come back: APART steps apart, WHOLE of the pixels
    differ."""
    rows = recording.rows_within(APART, 0)
    if not len(rows):
        return False
    rows = np.random.default_rng(seed).choice(rows, min(len(rows), 500), replace=False)
    return bool(changed_pixels(recording.rgb(rows - APART), recording.rgb(rows)).float().mean() > WHOLE)


def stress_of(recording: Recording, network: FlowNetwork, seed: int) -> float:
    """The weight of pixels that change, apart from the scroll of the whole picture, in the loss of a flow network: such that they
    weigh up to CHANGED_SHARE of all others."""
    rows = recording.rows_within(1, 0)
    rows = np.random.default_rng(seed).choice(rows, min(len(rows), 1000), replace=False)
    before, after = recording.rgb(rows - 1), recording.rgb(rows)
    if network.scrolling is not None:
        index = scroll_index(before, after, network.moves)
        before = carry(before, index, network.moves, network.over)
    change = changed_pixels(before, after).mean()
    return float(np.clip(CHANGED_SHARE / max(float(change), 1e-4), 1, MAX_STRESS))


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
