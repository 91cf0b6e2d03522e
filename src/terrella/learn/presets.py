"""Presets: how large a flow network is and how it trains, by the device, its memory and the minutes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch

PresetName = Literal["auto", "small", "medium", "large", "huge"]
USUAL_MINUTES = 10.0  # where no time is given
GIB = 2**30


@dataclass(frozen=True)
class Preset:
    """A size of flow networks, and what it takes."""

    name: str
    channels: tuple[int, int, int]  # at 1/4, 1/8 and 1/16 of the size of a picture
    millions: float  # parameters
    minutes: float  # of training on a GPU, from which it is chosen there
    memory_gib: float  # that training takes: 128 clips of 96 x 128 pixels in float32


#                 channels        millions  minutes  GiB
PRESETS = (
    Preset("small", (64, 112, 160), 2.4, 0, 3),
    Preset("medium", (144, 256, 352), 11, 5, 5),
    Preset("large", (208, 368, 512), 23, 60, 7),
    Preset("huge", (288, 512, 704), 43, 240, 10),
)
BATCH = {"cpu": 8, "cuda": 64}  # frames that begin a clip of a training step
STEPS = {"cpu": 8000, "cuda": 60_000}  # training steps at most, where none are given


@dataclass(frozen=True)
class TrainingPlan:
    """How a network is trained: its preset and the batch, the device in words, and how it computes."""

    preset: Preset
    batch: int
    device: torch.device
    compiled: bool
    half: bool
    minutes: float | None  # None: not given
    lacking: str = ""  # a sentence about memory
    recording: str = ""  # where it lies

    @staticmethod
    def of(name: str, device: torch.device, minutes: float | None, free_bytes: float, **settings: Any) -> TrainingPlan:
        """name: of a preset, or auto: by the device and the minutes. settings: batch (None: the usual of the device), compiled,
        half. A device without the memory has the next smaller preset."""
        card = device.type == "cuda"
        wanted = min((minutes or USUAL_MINUTES) if card else 0, 1e9)
        at = max(n for n, one in enumerate(PRESETS) if (one.minutes <= wanted if name == "auto" else one.name == name))
        fits = [n for n in range(at + 1) if PRESETS[n].memory_gib * GIB <= free_bytes] or [0]
        lacking = ""
        if fits[-1] < at:
            more = f"the preset {PRESETS[at].name} takes {PRESETS[at].memory_gib:g}"
            less = f"the next smaller that fits is trained, {PRESETS[fits[-1]].name}."
            lacking = f"{device} has {free_bytes / GIB:.1f} GiB free, and {more}: {less}"
        batch = settings.get("batch") or BATCH["cuda" if card else "cpu"]
        how = settings.get("compiled", True) and card, settings.get("half", True)
        return TrainingPlan(PRESETS[fits[-1]], batch, device, *how, minutes, lacking)

    def kept(self, saved: Mapping[str, Any] | None) -> TrainingPlan:
        """The same for a run that was begun: a network keeps its size."""
        if saved is None:
            return self
        name = saved.get("preset", "small")
        return replace(self, preset=next(one for one in PRESETS if one.name == name), lacking="")

    def sentence(self, device_in_words: str, channels: tuple[int, ...] = ()) -> str:
        """What is about to be trained, and which options choose something else."""
        preset = self.preset
        time = "" if self.minutes is None else f", {self.minutes:g} min"
        size = f"channels {' '.join(map(str, channels))}" if channels else f"{preset.millions:g}M parameters"
        what = size if channels else f"the preset {preset.name}, {size} (--preset)"
        how = ["compiled (--no-compile)"] if self.compiled else []
        how += ["bfloat16 (--no-half)"] if self.half and self.device.type == "cuda" else []
        how += [self.recording] if self.recording else []
        line = ", ".join([f"{device_in_words}{time}: {what}", f"batches of {self.batch} (--batch)", *how])
        return f"{self.lacking} {line}.".strip()
