"""Settings of runs that take seconds."""

from __future__ import annotations

from dataclasses import replace

from terrella.learn.recipes.post_training import DistilConfig, DreamsConfig
from terrella.learn.recipes.video_config import TrainConfig

BARE = TrainConfig(
    size=(24, 32), channels=(8, 8, 8), steps=4, batch=2, motion_steps=20, outcome_steps=3, keyframes=8, critic_from=1,
    strip_every_s=1e9, estimator_steps=0, uncertainty_frames=0,
)  # fmt: skip
POSED = replace(BARE, estimator_steps=4, uncertainty_frames=60)
FLAT = replace(BARE, geometry=False, steps=12, uncertainty_frames=60)
TEACHER = replace(BARE, flow_steps=4, steps=3)
STUDENT = DistilConfig(steps=3, batch=2)
DREAMS = DreamsConfig(steps=2, horizon=3, batch=2)
