"""A copy of a recording whose actions an inverse-dynamics model named, with its confidence in each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..data import Dataset, Readings, Sensor, Source, Take
from ..data.source import is_action
from .demonstrations import CONFIDENCE
from .recording import Recording

MEANING = (
    "action_space", "action_shape", "action_names", "action_units", "action_mode", "action_frame", "action_low", "action_high",
    "keys", "idle", "discrete",
)  # fmt: skip


def labelled_source(clips: Recording, labels: Recording, actions: np.ndarray, sure: np.ndarray) -> Source:
    """The recording `clips` with actions [R, A] for all of its rows, as those of `labels` are meant, and the confidence [R] in each
    as `observation.action_confidence`."""
    dataset, meant = clips.dataset, labels.dataset
    assert isinstance(dataset, Dataset) and isinstance(meant, Dataset)
    source, ranges = dataset.source(), clips.cache.episodes

    def take(number: int, recorded: Take) -> Take:
        first, stop = ranges[number]
        kept = {name: readings for name, readings in recorded.readings.items() if not is_action(name)}
        time_s = dataset.time_s(number)
        kept["action"] = Readings(time_s[:-1], actions[first : stop - 1])
        kept[CONFIDENCE] = Readings(time_s, sure[first:stop, None])
        return replace(recorded, readings=kept)

    names = tuple(meant.action_names)
    sensors = {name: sensor for name, sensor in source.sensors.items() if not is_action(name)}
    sensors["action"] = Sensor("action", "vector", (len(names),), names=names)
    sensors[CONFIDENCE] = Sensor(CONFIDENCE, "vector", (1,), names=("action_confidence",))
    world = {key: value for key, value in dataset.world.items() if key not in MEANING}
    world |= {key: meant.world[key] for key in MEANING if key in meant.world}
    takes = lambda: (take(number, recorded) for number, recorded in enumerate(source.takes()))  # noqa: E731
    return replace(source, sensors=sensors, takes=takes, facts={**source.facts, "world": world})


def decoded(encoded: torch.Tensor, labels: Recording) -> np.ndarray:
    """Encoded actions [n, ...] as float32 [n, A], as a recording holds them."""
    controls = labels.controls
    assert controls is not None
    low, high = (np.array(limit, np.float32) for limit in (controls.low, controls.high))
    if controls.kind == "choice":
        parts = encoded.split(list(controls.counts), 1)
        return np.stack([part.argmax(1).numpy() for part in parts], 1).astype(np.float32) + low
    values = encoded.numpy().astype(np.float32)
    return values if controls.kind == "buttons" else low + (values + 1) / 2 * (high - low)
