"""adapt of worlds of frames, with or without places: the network that draws goes on learning on those of another camera or body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...core.errors import DatasetError, TrainingError
from ...core.world import make_rng, without_end
from ...worlds.body import MotionBody
from ...worlds.folder import load_world
from ...worlds.keyframe_scene import KeyframeScene
from ...worlds.learned import LearnedWorld
from ...worlds.parts import newest_frame
from ...worlds.uncertainty import NoUncertainty
from ..objectives.flow import CRITIC_AHEAD
from ..paired import open_paired
from ..recording import Recording, open_views
from ..trainer import Report
from .video import train_video
from .video_config import TrainConfig
from .video_parts import Continued
from .video_posed import places_of

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
    """Trains, or resumes, a copy of the world on `data`, beside `keep`; returns the facts of the run, and the errors of both
    recordings before and after, as `frame_errors`. Size, history and step count follow the world. A world of places gets those of
    `data`, and is measured on `data` with them before, too, and on `keep` with its own. Its estimator is learned anew for another
    camera."""
    places = isinstance(world.body, MotionBody) and isinstance(world.scene, KeyframeScene)
    if not places and world.generator.kind != "flow":
        raise TrainingError(f"{world.spec.name} does not adapt: it is no world that `terrella train video` makes now.")
    recordings = {name: _fitting(world, one, report) for name, one in (("new", data), ("old", keep)) if one is not None}
    kept = recordings.get("old")
    if world.estimator and tuple(recordings["new"].cache.world["camera"]) == tuple(world.estimator.config.camera):
        settings = replace(settings, estimator_steps=0)  # it keeps its estimator

    def errors(**of: LearnedWorld) -> dict[str, dict[str, float]]:
        report(0, 1, "measuring its errors")
        return {name: frame_errors(of[name], recording) for name, recording in recordings.items()}

    before = errors(new=_placed(world, recordings["new"]) if places else world, old=world)
    begin = Continued(world, kept)
    facts = train_video(data, out, settings, report, begin=begin)
    adapted = load_world(facts["world"])
    after = errors(new=adapted, old=adapted.replaced(scene=world.scene) if places else adapted)
    return facts, {name: {"before": before[name], "after": after[name]} for name in before}


def _placed(world: LearnedWorld, recording: Recording) -> LearnedWorld:
    """The world in the places of a recording, as its camera sees them."""
    fx, fy, cx, cy = recording.cache.world["camera"]
    memory, config = places_of(recording, (fx, fy, cx, cy), len(world.memory)), world.scene.config
    scene = KeyframeScene(replace(config, camera=(fx, fy, cx, cy)), memory, open_views(memory, 32))
    return world.replaced(scene=scene.to(world.device))


def settings_of(world: LearnedWorld) -> TrainConfig:
    """Settings of `train video` that repeat what the world is made of."""
    shape, drawn = world.config, world.generator.config
    frames = 0 if isinstance(world.uncertainty, NoUncertainty) else TrainConfig.uncertainty_frames
    settings = TrainConfig(
        world.spec.name, shape.size, shape.geometry, drawn.channels, frames=drawn.slots, flow_steps=drawn.steps,
        uncertainty_frames=frames, compile=False, predict=world.outcome.vectors,
    )  # fmt: skip
    if not shape.geometry:
        return settings
    return replace(
        settings, moving=shape.moving, keyframes=max(1, len(world.memory)), critic_from=CRITIC_AHEAD,
        objects_steps=TrainConfig.objects_steps if shape.objects else 0,
        estimator_steps=TrainConfig.estimator_steps if world.estimator else 0,
    )  # fmt: skip


def _fitting(world: LearnedWorld, data: str | Path, report: Report) -> Recording:
    recording = open_paired(world, data, None, report).recording
    if world.config.geometry and not recording.posed:
        raise DatasetError(f"{data} does not say its camera, which {world.spec.name} needs beside depth and poses.")
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
            state = world.imagine(without_end(state), recording.recorded_actions(world.spec, rows + step - 1), rng)
            if step in HORIZONS:
                truth = recording.rgb(rows + step).float()
                apart = newest_frame(state).cpu().float() - truth
                sums[step] += [
                    float(apart.square().mean()) * len(rows),
                    float((last - truth).square().mean()) * len(rows),
                ]
    return {str(step): round(float(mine / max(copied, 1e-9)), 4) for step, (mine, copied) in sums.items()}
