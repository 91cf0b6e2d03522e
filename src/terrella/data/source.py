"""What every format is read into and written from: takes of sensors, each reading with its own true time.

A `Source` is a recording in any format: which sensors it has, and its takes one after another. A `Take` is one episode:
for each sensor its `Readings`, n values seen at n times. Importers make Sources, exporters write them; merging,
resampling and conversion lie between. Values are decoded when they are looked at, so a Source may be larger than memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Kind = Literal["image", "depth", "points", "vector"]


@dataclass(frozen=True)
class Sensor:
    """One stream of readings, named as LeRobot names features.

    name:  "action", "next.reward", "next.done", or "observation.…": "observation.images.front", "observation.depth",
           "observation.depth.front", "observation.points.lidar", "observation.state", "observation.imu", ….
    kind:  image   uint8 [H, W, 3], RGB;
           depth   float32 [h, w], metres along the optical axis; inf where nothing was hit;
           points  float32 [n, k], metres in the sensor's own frame, n may differ between readings;
           vector  `dtype` [k].
    shape: of one reading; points: (0, k), for any n.
    dtype: of a vector's numbers, a numpy name ("float32", "float64", "int64", "bool"); images "uint8", others "float32".
    names: one per number of a vector, or per column of points ("x", "y", "z", "intensity"); () where unknown.
    units: name of a number -> its unit ("m", "rad", "m/s2"); what is not listed is unknown.
    frame: coordinate frame of the readings, "" where unknown.
    rate_hz: nominal rate of the sensor's clock; None where it has none or it is unknown.
    facts: whatever else is worth keeping, JSON values (an image's camera calibration under "calibration", say).
    """

    name: str
    kind: Kind
    shape: tuple[int, ...]
    dtype: str = "float32"
    names: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    frame: str = ""
    rate_hz: float | None = None
    facts: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Readings:
    """values[i] was seen at time_s[i] (float64 [n], ascending, seconds since the take began).

    `values` is a numpy array [n, ...] or anything with len and [i]; images and depth may be decoded at each look.
    """

    time_s: np.ndarray
    values: Sequence[np.ndarray] | np.ndarray


@dataclass(frozen=True)
class Take:
    """One episode. Every sensor of the source is in `readings` unless this take lacks it.

    Action i is what was done at time_s[i], after what was observed there; reward and done i are what followed. So an
    episode of T observations has T - 1 actions where its format keeps a terminal observation, else T.

    task:     the instruction in plain language, "" where there is none; where it changes, facts["language"] has
              [[time_s, text], ...], each said until the next.
    start_ns: wall-clock time of time_s = 0 in nanoseconds since 1970 (UTC), None where unknown.
    """

    readings: Mapping[str, Readings]
    task: str = ""
    start_ns: int | None = None
    facts: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Source:
    """A recording in any format.

    takes:    gives the takes from the first on, anew at each call; a sequence of them where any can be had at once.
    sensors:  name -> Sensor.
    fps:      rate of its rows, where the format has rows; None where every sensor has a clock of its own.
    robot:    type of the body ("terrella", "aloha", …), "" where unknown.
    notes:    sentences: what of the original could not be carried over.
    facts:    JSON values kept with the recording.
    """

    name: str
    sensors: Mapping[str, Sensor]
    takes: Callable[[], Iterable[Take]]
    fps: float | None = None
    robot: str = ""
    notes: tuple[str, ...] = ()
    facts: Mapping[str, object] = field(default_factory=dict)


def is_action(name: str) -> bool:
    """Whether a sensor is what was done: "action", or a part of it ("action.gripper")."""
    return name == "action" or name.startswith("action.")


def follows(name: str) -> bool:
    """Whether a sensor tells what was done after an observation or came of it, so that the last row may lack it."""
    return is_action(name) or name.startswith("next.")


class Lazy(Sequence):
    """`count` values (readings, takes) of which each is made by `make(i)` when it is looked at."""

    def __init__(self, count: int, make: Callable[[int], Any]):
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index) -> Any:
        if isinstance(index, slice):
            return [self._make(i) for i in range(*index.indices(self._count))]
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return self._make(int(index) % self._count)
