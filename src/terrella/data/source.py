"""Source: the common form of all recording formats: episodes of sensor readings, each reading with its own time.

A `Source` is a recording in any format: its sensors and its takes. A `Take` is one episode: for each sensor its
`Readings`, n values at n times. Importers make Sources, exporters write them; merging, resampling and conversion lie in
between. Values are decoded when they are read, so a Source may be larger than memory.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

Kind = Literal["image", "depth", "points", "vector"]


@dataclass(frozen=True)
class Sensor:
    """One sensor, named like a LeRobot feature.

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
    facts: further JSON values (an image's camera calibration under "calibration", for example).
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
    """The readings of a sensor: values[i] at time_s[i]."""

    time_s: np.ndarray  # float64 [n], ascending, seconds since the take began
    values: Sequence[np.ndarray] | np.ndarray  # [n, ...], or n arrays, which may be decoded each time they are read


@dataclass(frozen=True)
class Take:
    """One episode.

    Action i was taken at time_s[i], after the observation at that time; reward and done i followed it. So an episode of T
    observations has T - 1 actions where its format has a terminal observation, else T.
    """

    readings: Mapping[str, Readings]  # sensor -> its readings; sensors without a reading may be absent
    task: str = ""  # the instruction, "" for none. Where it changes, facts["language"] is [[time_s, text], ...]
    start_ns: int | None = None  # wall-clock time of time_s = 0, nanoseconds since 1970 (UTC); None where unknown
    facts: Mapping[str, object] = field(default_factory=dict)  # further JSON values
    notes: tuple[str, ...] = ()  # sentences about parts of it that could not be read; equal ones are listed once


@dataclass(frozen=True)
class Source:
    """A recording in any format."""

    name: str
    sensors: Mapping[str, Sensor]  # name -> Sensor
    takes: Callable[[], Iterable[Take]]
    """Gives the takes from the first on, at each call; a sequence where the format allows random access."""
    fps: float | None = None  # rows a second, for formats with rows; None where every sensor has a clock of its own
    robot: str = ""  # type of the robot ("terrella", "aloha", …), "" where unknown
    notes: tuple[str, ...] = ()  # sentences about parts of the original that could not be converted
    facts: Mapping[str, object] = field(default_factory=dict)  # JSON values stored with the recording


def without(source: Source, names: Collection[str]) -> Source:
    """The source without some of its sensors."""

    def takes() -> Iterator[Take]:
        for take in source.takes():
            yield replace(take, readings={name: it for name, it in take.readings.items() if name not in names})

    sensors = {name: sensor for name, sensor in source.sensors.items() if name not in names}
    return replace(source, sensors=sensors, takes=takes) if names else source


def is_action(name: str) -> bool:
    """Whether a sensor is the action, or a part of it ("action.gripper")."""
    return name == "action" or name.startswith("action.")


def is_outcome(name: str) -> bool:
    """Whether a sensor is an action or its outcome ("next.…"), which the last row may lack."""
    return is_action(name) or name.startswith("next.")


class Lazy(Sequence):
    """A sequence of `count` values, each made by `make(i)` when it is read."""

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
