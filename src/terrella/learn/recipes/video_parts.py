"""What the recipes of video worlds share: the recording, the outcome model, and what a world's card says."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import nn

from ...core.errors import DatasetError, TrainingError
from ...worlds.config import VideoConfig
from ...worlds.folder import with_saved_keys
from ...worlds.learned import About, LearnedWorld
from ...worlds.outcome import ConstantConfig, ConstantOutcome, FrameOutcome
from ..budget import Stage
from ..objectives.flow import Flow
from ..objectives.flow_frames import FlowFrames
from ..objectives.outcome import Happenings, OutcomeObjective, learn_outcome
from ..presets import TrainingPlan
from ..recording import Recording
from ..sized_feed import Feed
from ..trainer import Run, Trainer
from .latent import vectors_of
from .video_config import TrainConfig


@dataclass(frozen=True)
class Continued:
    """What a training continues: a finished world, and a recording of what it learned before, to rehearse, if there is one.
    teaching: 0 for the world's own network, which learns on; above, for a world of frames alone, a new network learns, with this
    weight, what the world draws, and the recorded frames with the rest."""

    world: LearnedWorld
    kept: Recording | None = None
    teaching: float = 0.0


class VideoRecipe(Protocol):
    """What differs between worlds with depth and poses and worlds of frames alone.

    channels: of the generator, where they are not those of a preset.
    preparations: the stages before the generator. world: a copy, on the CPU, of the world as it now is.
    """

    plan: TrainingPlan

    @property
    def parts(self) -> VideoParts: ...
    @property
    def channels(self) -> tuple[int, ...]: ...
    @property
    def objective(self) -> Flow | FlowFrames: ...
    def feed(self, batch: int) -> Feed: ...
    def preparations(self) -> Sequence[Stage]: ...
    def world(self, trainer: Trainer) -> LearnedWorld: ...


class VideoParts:
    """A recording, the kind of world to learn from it, and its outcome model, if there is anything for one to learn."""

    def __init__(self, run: Run, recording: Recording, config: TrainConfig, video: VideoConfig):
        self.run, self.recording, self.config = run, recording, config
        self.facts: dict = {}  # of the stages so far, for the world's card
        vectors = vectors_to_predict(recording, config.predict, video)
        self.happened = Happenings.of(recording.cache, recording.action(slice(None)).numpy(), recording.usable, vectors)
        self.outcome: FrameOutcome | None = None
        if self.happened.is_informative and (video.moving or not video.geometry):
            begins = _first_vitals(self.happened.vitals, recording)
            video = replace(video, vitals=begins)
            outcome = replace(self.happened.config(len(recording.cameras) or 1), begins=begins)
            self.outcome = FrameOutcome(outcome).to(run.device)
        self.video = video

    def outcome_stages(self) -> list[Stage]:
        outcome = self.outcome
        if outcome is None:
            return []

        def learn() -> None:
            objective = OutcomeObjective(outcome, self.recording.rgb, self.happened)
            self.facts |= learn_outcome(self.run, objective, self.config.outcome_steps)

        return [Stage("outcome", 0.08, learn)]

    def continue_outcome(self, world: LearnedWorld) -> bool:
        """The model of rewards and ends goes on from that of the world, where both predict the same; whether they do."""
        mine, theirs = self.outcome, world.outcome
        if mine is None or not isinstance(theirs, FrameOutcome) or mine.config != theirs.config:
            return False
        mine.load_state_dict(theirs.state_dict())
        return True

    def trained_outcome(self, constant: ConstantConfig) -> FrameOutcome | ConstantOutcome:
        """A copy of the outcome model on the CPU; without one, the constant."""
        return ConstantOutcome(constant) if self.outcome is None else copy.deepcopy(self.outcome).cpu().float()

    @property
    def median_reward(self) -> float:
        return float(np.median(self.happened.reward))

    def about(self, trainer: Trainer, modules: Sequence[nn.Module], keyframes: int) -> About:
        """Name, controls, limits and card of the world; `modules` are those whose parameters the card counts."""
        recording, cache = self.recording, self.recording.cache
        kept = with_saved_keys(cache.world, self.run.out / "world")
        names = kept.get("action_names") or cache.action_names  # of a choice, the recording names each
        assert recording.controls is not None  # a recording without actions was refused
        return About(
            self.config.name,
            recording.controls,
            kept.get("dt_s", 1 / cache.fps),
            tuple(names),
            kept.get("keys", {}),
            self._card(trainer, modules, keyframes),
            ignored=recording.ignored,
            idle=tuple(kept.get("idle", ())),
            max_episode_steps=kept.get("max_episode_steps"),
            cameras=recording.lenses(),
        )

    def _card(self, trainer: Trainer, modules: Sequence[nn.Module], keyframes: int) -> dict:
        recording, source = self.recording, self.recording.dataset
        name = recording.cache.world.get("name", source.root.name)
        return {
            "what": f"Learned from {source.length:,} frames of {name}",
            "game": recording.cache.world.get("name"),
            "data": f"{recording.usable.sum():,} frames, {len(recording.seen)} episodes",
            "steps": trainer.steps_done,
            "hours": round(trainer.facts["seconds"] / 3600, 2),
            "keep_out": self.config.keep_out,
            "keyframes": keyframes,
            "parameters": sum(weight.numel() for module in modules for weight in module.parameters()),
            **self.facts,
        }


def vectors_to_predict(recording: Recording, wanted: Sequence[str], video: VideoConfig) -> dict[str, np.ndarray]:
    """The vectors [N, D] that are wanted beside the vitals. DatasetError for names of none, TrainingError for a world with
    geometry."""
    if not wanted:
        return {}
    if video.geometry:
        raise TrainingError("--predict is for worlds of frames alone; add --no-geometry, or leave it out.")
    cache, known = recording.cache, dict(vectors_of(recording))
    if lacks := [name for name in wanted if name not in known and name not in cache.vitals]:
        raise DatasetError(f"{recording.name} has no vector {', '.join(lacks)}; it has {', '.join(known) or 'none'}.")
    return {name: cache.arrays[cache.keys[name]] for name in wanted if known.get(name, 1) > 1}


def _first_vitals(vitals: np.ndarray, recording: Recording) -> tuple[float, ...]:
    """The median of the vitals [N, V] at the first rows of episodes."""
    first = np.unique(recording.start[recording.usable])
    return tuple(float(value) for value in np.median(vitals[first], 0))
