"""Worlds of places: recordings with depth and poses. Stages: motion, outcome, objects, estimator, then a U-Net over a Glimpse."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TypeVar

import numpy as np
from torch import nn

from ...space.camera import Intrinsics
from ...space.keyframes import Keyframes
from ...worlds.body import Motion, MotionBody
from ...worlds.config import VideoConfig
from ...worlds.generator import UNet
from ...worlds.keyframe_scene import KeyframeScene
from ...worlds.learned import LearnedWorld
from ...worlds.objects import STARTS, Billboards, BillboardsConfig
from ...worlds.outcome import ConstantConfig
from ..budget import Stage
from ..feeds import RandomBatches, place_feed
from ..objectives.estimator import learn_estimator
from ..objectives.flow import Flow
from ..objectives.motion import learn_motion
from ..objectives.objects import learn_objects
from ..presets import TrainingPlan
from ..recording import Recording, choose_keyframes, open_views
from ..sized_feed import Feed
from ..trainer import Run, Trainer
from .video_config import TrainConfig
from .video_parts import Continued, VideoParts

KEPT_EVERY = 4  # batches, of which one rehearses
Part = TypeVar("Part", bound=nn.Module)


class PosedRecipe:
    """A generator over a memory of keyframes, a body that slides along walls and, where they were recorded, objects. begin: its
    generator, motion and outcome go on from those of a world; its places are those of the recording."""

    def __init__(
        self,
        run: Run,
        recording: Recording,
        config: TrainConfig,
        video: VideoConfig,
        plan: TrainingPlan,
        begin: Continued | None = None,
    ):
        self.begin = begin
        if begin is not None:
            video = replace(begin.world.config, camera=video.camera)
        self.plan, self.channels = replace(plan, compiled=False, lacking=""), video.channels
        if config.keep_out is not None:
            recording = replace(recording, usable=Recording.of(recording.cache, recording.seen, config.keep_out).usable)
        recording = recording.require_rows()
        self.objects = Billboards(BillboardsConfig(video.actions, video.history)) if video.objects else None
        self.parts = VideoParts(run, recording, config, video)
        self.video = self.parts.video
        self.memory = places_of(recording, self.video.camera, config.keyframes)
        critic, rate = (config.critic_from, config.critic_weight), config.learning_rate or 8e-4
        generator, self.motion = UNet(self.video.generator), Motion(self.video.motion)
        if begin is not None:
            body = begin.world.body
            assert isinstance(body, MotionBody)
            generator, self.motion = _learning(begin.world.generator), _learning(body.motion)
            self.parts.continue_outcome(begin.world)
        self.objective = Flow(generator, config.flow_steps, rate, *critic)

    def feed(self, batch: int) -> Feed:
        dream = self.objective.dream if self.video.steps == 1 else None  # a teacher sees recorded frames alone
        feed, begin = place_feed(self.parts.recording, self.memory, self.video, batch, dream), self.begin
        if begin is None or begin.kept is None:
            return feed
        kept = place_feed(begin.kept, begin.world.memory.to("cpu"), begin.world.config, batch, dream)
        return RandomBatches(lambda now: (feed if now.step % KEPT_EVERY else kept).batch(now))

    def preparations(self) -> list[Stage]:
        stages = [Stage("motion", 0.08, self._learn_motion), *self.parts.outcome_stages()]
        if self.objects is not None:
            stages.append(Stage("objects", 0.1, self._learn_objects))
        if self.parts.config.estimator_steps:
            stages.append(Stage("estimator", 0.12, self._learn_estimator))
        return stages

    def _learn_motion(self) -> None:
        parts = self.parts
        parts.facts |= learn_motion(parts.run, self.motion, parts.recording, self.memory, parts.config.motion_steps)

    def _learn_objects(self) -> None:
        parts, recording = self.parts, self.parts.recording
        assert self.objects is not None
        starts, rgb, camera = recording.pose(self._first_rows()), recording.dataset.rgb_at, self.video.camera
        parts.facts |= learn_objects(
            parts.run, self.objects, recording, rgb, starts, camera, parts.config.objects_steps
        )

    def _learn_estimator(self) -> None:
        learn_estimator(self.parts.run, self.parts.recording, self.parts.config.estimator_steps)

    def world(self, trainer: Trainer) -> LearnedWorld:
        parts, recording, video = self.parts, self.parts.recording, self.video
        ends = parts.happened.done & np.array(recording.cache.action_valid)
        usual = parts.median_reward
        terminal = _terminal_reward(parts.happened.reward - usual, ends)
        starts = open_views(self.memory, 32)
        if video.moving:  # monsters wait where episodes begin, and the player is well
            first = self._first_rows()
            starts = recording.sharp_keyframes(first, video.camera) if len(first) else starts
        fitted = {name: parts.facts[name] for name in ("body_m", "short")}
        return LearnedWorld(
            parts.about(trainer, (self.objective.generator, self.motion), len(self.memory)),
            scene=KeyframeScene(video.keyframes, self.memory, starts),
            generator=copy.deepcopy(self.objective.smooth.module).cpu().float(),
            body=MotionBody(copy.deepcopy(self.motion), replace(video.motion, **fitted)),
            objects=copy.deepcopy(self.objects),
            outcome=parts.trained_outcome(ConstantConfig(usual, terminal)),
            estimator=None if self.begin is None or parts.config.estimator_steps else self.begin.world.estimator,
        )

    def _first_rows(self) -> np.ndarray:
        """About STARTS first rows of episodes."""
        recording = self.parts.recording
        first = np.intersect1d(recording.start, np.flatnonzero(recording.usable))
        return first[:: max(1, len(first) // STARTS)][:STARTS]


def places_of(recording: Recording, camera: Intrinsics, count: int) -> Keyframes:
    """Keyframes of the rows that may be trained on, spread over places and headings."""
    picks = choose_keyframes(np.asarray(recording.cache.pose), np.flatnonzero(recording.usable), count)
    return recording.sharp_keyframes(picks, camera)


def _learning(part: Part) -> Part:
    """A copy on the CPU that goes on learning."""
    return copy.deepcopy(part).cpu().float().train().requires_grad_(True)


def _terminal_reward(extra: np.ndarray, ends: np.ndarray) -> float:
    """Mean reward above the usual in the last steps of an episode (games may pay a step or two before its end)."""
    rows = np.flatnonzero(ends)
    return float(np.mean([extra[max(row - 3, 0) : row + 1].sum() for row in rows])) if len(rows) else 0.0
