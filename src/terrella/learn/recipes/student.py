"""A student: a small flow network, for CPUs and browsers, learns what a larger world of frames draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from ...core.errors import TrainingError
from ...worlds.flow import FlowNetwork
from ...worlds.learned import LearnedWorld
from ..paired import open_paired
from ..presets import PRESETS, PresetName
from ..trainer import Paced, Report
from .adapt_frames import settings_of
from .video import train_video
from .video_config import TrainConfig
from .video_flat import network_of
from .video_parts import Continued

TEACHING = 0.5  # weight of what the teacher draws, against the recorded frames


def student_settings(teacher: LearnedWorld, preset: PresetName = "small") -> TrainConfig:
    """Settings of `train video` for a student of this preset."""
    name = f"{teacher.spec.name}-student"
    return replace(settings_of(teacher), name=name, channels=(), preset=preset, compile=True)


def train_student(
    teacher: LearnedWorld,
    data: str | Path,
    out: str | Path,
    settings: TrainConfig,
    report: Report,
    *,
    teaching: float = TEACHING,
    paced: Paced | None = None,
    say: Callable[[str], object] = lambda line: None,
) -> dict:
    """Trains, or resumes, a student in the folder `out`; its world is in `out`/world. It begins with the teacher's most important
    channels and draws in its own rollouts; its targets are the recorded frames and what the teacher draws from the same history.
    Returns the facts of the run, with the GFLOP of a frame of both. TrainingError where it would be no smaller."""
    large = network_of(teacher).config
    named = {one.name: one.channels for one in PRESETS}
    widths = settings.channels or named.get(settings.preset, PRESETS[0].channels)
    if widths == large.channels or any(narrow > wide for narrow, wide in zip(widths, large.channels)):
        raise TrainingError(
            f"{teacher.spec.name} has {_words(large.channels)} channels, and a student of {_words(widths)} is no smaller; a "
            "teacher comes from `terrella train video --preset medium` or larger."
        )
    settings = replace(settings, channels=widths)
    open_paired(teacher, data, None, report)  # refuses another game
    begin = Continued(teacher, teaching=teaching)
    facts = train_video(data, out, settings, report, paced, say, begin)
    pair = {"student": replace(large, channels=widths, steps=settings.flow_steps), "teacher": large}
    return facts | {"gflop_per_frame": {name: gflop_per_frame(FlowNetwork(config)) for name, config in pair.items()}}


def gflop_per_frame(network: FlowNetwork) -> float:
    """Floating point operations to draw a frame, in 10^9; a product and its sum are two."""
    network, config = network.to("meta"), network.config
    with torch.no_grad(), FlopCounterMode(display=False) as count:
        frames = torch.zeros(1, config.slots, 3, *config.size, device="meta")
        network.sample(frames, frames.new_zeros(1, config.context), None, None, frames[:, 0], config.steps)
    return round(count.get_total_flops() / 1e9, 2)


def _words(channels: tuple[int, ...]) -> str:
    return " ".join(map(str, channels))
