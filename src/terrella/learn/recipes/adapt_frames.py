"""adapt of worlds of frames alone: the network that draws goes on learning on the frames of another camera or body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ...core.errors import DatasetError, TrainingError
from ...core.world import make_rng
from ...worlds.folder import load_world
from ...worlds.learned import LearnedWorld
from ...worlds.parts import newest_frame
from ...worlds.uncertainty import NoUncertainty
from ..paired import open_paired
from ..recording import Recording
from ..trainer import Report
from .video import train_video
from .video_config import TrainConfig
from .video_flat import FlowBeginning

HORIZONS = 1, 8, 16  # steps after which errors are measured
ROLLOUTS, AT_ONCE = 32, 8  # of held-out frames


def adapt_frames(
    world: LearnedWorld,
    data: str | Path,
    out: str | Path,
    settings: TrainConfig,
    report: Report,
    keep: str | Path | None,
) -> tuple[dict, dict]:
    """Trains, or resumes, a copy of a world of frames alone on `data`, beside `keep`; returns the facts of the run, and the errors
    of both recordings before and after, as `frame_errors`. Size, history and step count follow the world."""
    if world.config.geometry or world.generator.kind != "flow":
        raise TrainingError(
            f"{world.spec.name} is a world with depth and poses, and these do not adapt; `terrella train dreams` continues its "
            "training."
        )
    recordings = {name: _fitting(world, one, report) for name, one in (("new", data), ("old", keep)) if one is not None}
    before = {name: frame_errors(world, one) for name, one in recordings.items()}
    begin = FlowBeginning(world, recordings.get("old"))
    facts = train_video(data, out, settings, report, begin=begin)
    adapted = load_world(facts["world"])
    after = {name: frame_errors(adapted, one) for name, one in recordings.items()}
    return facts, {name: {"before": before[name], "after": after[name]} for name in before}


def settings_of(world: LearnedWorld) -> TrainConfig:
    """Settings of `train video` that repeat what the world is made of."""
    shape, drawn = world.config, world.generator.config
    frames = 0 if isinstance(world.uncertainty, NoUncertainty) else TrainConfig.uncertainty_frames
    return TrainConfig(
        world.spec.name, shape.size, False, drawn.channels, frames=drawn.slots, flow_steps=drawn.steps,
        uncertainty_frames=frames, compile=False,
    )  # fmt: skip


def _fitting(world: LearnedWorld, data: str | Path, report: Report) -> Recording:
    recording = open_paired(world, data, None, report).recording
    fps, own = recording.cache.fps, 1 / world.spec.dt_s
    if abs(fps / own - 1) > 0.01:
        raise DatasetError(f"{data} has {fps:g} steps a second, and {world.spec.name} {own:g}; record it at that rate.")
    if not len(_starts(world, recording)):
        least = world.generator.config.slots + max(HORIZONS)
        raise DatasetError(
            f"{data} has no held-out episode of {least} frames to measure on; record two or more longer episodes."
        )
    return recording


def _starts(world: LearnedWorld, recording: Recording) -> np.ndarray:
    """Rows of held-out episodes with a history before and the longest horizon after them, evenly spread."""
    slots, rows = world.generator.config.slots, []
    for number in recording.held_out:
        first, last = recording.cache.episodes[number]
        rows.append(np.arange(first + slots - 1, last - max(HORIZONS)))
    every = np.concatenate(rows) if rows else np.zeros(0, np.int64)
    return every[:: max(1, -(-len(every) // ROLLOUTS))]


@torch.inference_mode()
def frame_errors(world: LearnedWorld, recording: Recording) -> dict[str, float]:
    """The squared error of drawn frames after some steps under the recorded actions, as a share of copy-last's."""
    sums = {step: np.zeros(2) for step in HORIZONS}
    starts = _starts(world, recording)
    for rows in np.array_split(starts, -(-len(starts) // AT_ONCE)):
        rng, first = make_rng(0), rows - world.generator.config.slots + 1
        state = world.observe(recording.evidence(world.config, first), None, rng)
        for row in range(int(first[0]), int(rows[0])):
            ahead = row - int(first[0])
            state = world.imagine(state, recording.recorded_actions(world.spec, first + ahead), rng)
            state = world.observe(recording.evidence(world.config, first + ahead + 1), state, rng)
        last = recording.rgb(rows).float()
        for step in range(1, max(HORIZONS) + 1):
            state = world.imagine(state, recording.recorded_actions(world.spec, rows + step - 1), rng)
            if step in HORIZONS:
                truth = recording.rgb(rows + step).float()
                apart = newest_frame(state).cpu().float() - truth
                sums[step] += [
                    float(apart.square().mean()) * len(rows),
                    float((last - truth).square().mean()) * len(rows),
                ]
    return {str(step): round(float(mine / max(copied, 1e-9)), 4) for step, (mine, copied) in sums.items()}
