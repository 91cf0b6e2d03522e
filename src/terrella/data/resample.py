"""resample: the readings of a sensor at other times, by a stated policy; row_times: the times of rows."""

import re
from collections.abc import Iterable
from typing import Literal, get_args

import numpy as np

from ..core.errors import DatasetError
from .source import Lazy, Readings, Sensor, Take

Policy = Literal["previous", "nearest", "linear"]

SAME_TIME_S = 1e-4  # closer times are equal: many formats store float32 (LeRobot has the same tolerance)
_MOST_ROWS = 20_000_000
_QUATERNION = re.compile(r"(|.*[^a-z])q(?:uat|uaternion)?[_.]?([wxyz])", re.IGNORECASE)


def row_times(take: Take, sensors: Iterable[str], fps: float) -> np.ndarray:
    """float64 [T]: the times of the rows of a take, `fps` a second, from the time when every sensor has a reading.

    Only sensors named "observation.…" with a reading count; without any, all sensors do. So actions neither start nor
    prolong a take. Row i is at first + i / fps, where `first` is the latest first reading; the last row is not later than
    the latest last reading (+ SAME_TIME_S). Empty where nothing was read. DatasetError where fps is not positive, a clock
    is invalid, or there would be more than twenty million rows.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise DatasetError(f"rows need a positive number per second, not {fps}: give another fps.")
    clocks = {name: clock_of(take.readings[name], name) for name in sensors if name in take.readings}
    clocks = {name: clock for name, clock in clocks.items() if len(clock)}
    seen = {name: clock for name, clock in clocks.items() if name.startswith("observation.")} or clocks
    if not seen:
        return np.zeros(0)
    first, last = max(clock[0] for clock in seen.values()), max(clock[-1] for clock in seen.values())
    count = np.floor((last - first + SAME_TIME_S) * fps) + 1
    if count > _MOST_ROWS:
        raise DatasetError(
            f"a take from {first:g} s to {last:g} s would have {count:.0f} rows at {fps:g} a second; mend its times."
        )
    return first + np.arange(int(count)) / fps


def picked_rows(time_s: np.ndarray, at_s: np.ndarray, policy: Policy, max_gap_s: float | None = None) -> np.ndarray:
    """int64 [T]: the reading that the policy "previous" or "nearest" takes at each time, -1 for none; see `resample`."""
    at_s = np.asarray(at_s, np.float64)
    if not len(time_s):
        return np.full(len(at_s), -1)
    if policy == "previous":
        index = np.searchsorted(time_s, at_s + SAME_TIME_S, side="right") - 1
    else:
        after = np.searchsorted(time_s, at_s, side="right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, len(time_s) - 1)
        index = np.where(np.abs(time_s[after] - at_s) < np.abs(at_s - time_s[before]), after, before)
        index = np.searchsorted(time_s, time_s[index], side="right") - 1
    return np.where((index < 0) | (np.abs(at_s - time_s[np.maximum(index, 0)]) > _limit(max_gap_s)), -1, index)


def resample(
    readings: Readings, sensor: Sensor, at_s: np.ndarray, policy: Policy = "previous", max_gap_s: float | None = None
) -> tuple[np.ndarray | Lazy, np.ndarray]:
    """(values, valid): the readings of a sensor at the times `at_s` (float64 [T], any order).

    values: of a vector, [T, *shape] of the dtype of the sensor; of images, depth and points, a Lazy of T that decodes
            each when it is read. Where not valid: zeros (False); depth inf; no points.
    valid:  bool [T].

    "previous"  The newest reading up to SAME_TIME_S after the row: causal. Not valid before the first reading, nor where
                the reading is older than `max_gap_s`.
    "nearest"   The reading nearest in time; of two equally near the earlier, of several at one time the newest. Not
                valid where it is further away than `max_gap_s`.
    "linear"    Linear interpolation of vectors of floats; others are as "previous". Four numbers named qw, qx, qy, qz
                (with a common prefix) use slerp. A number in rad or deg that differs by more than half a turn has
                wrapped: the nearer reading is taken. Within SAME_TIME_S of a reading it is taken unchanged; after the
                last, the last is. Not valid before the first, between readings more than `max_gap_s` apart, nor more
                than `max_gap_s` after the last. NaN stays NaN.

    `max_gap_s` None sets no limit; gaps may exceed it by SAME_TIME_S. DatasetError where times are not finite and
    ascending, readings and times differ in number, a vector has the wrong shape, or the policy does not suit the kind.
    """
    if policy not in get_args(Policy):
        raise DatasetError(f"there is no resampling policy '{policy}'; choose {', '.join(get_args(Policy))}.")
    at_s = np.asarray(at_s, np.float64)
    if at_s.ndim != 1 or not np.isfinite(at_s).all():
        raise DatasetError(f"{sensor.name} can only be resampled at a line of finite times.")
    time_s = clock_of(readings, sensor.name)
    if sensor.kind != "vector":
        if policy == "linear":
            raise DatasetError(f"{sensor.name} is of kind {sensor.kind}: take 'previous' or 'nearest', not 'linear'.")
        index = picked_rows(time_s, at_s, policy, max_gap_s)
        return _looked_up(readings, sensor, index), index >= 0
    values = stacked(readings, sensor)
    if policy == "linear" and values.dtype.kind == "f":
        return _interpolated(time_s, values, sensor, at_s, max_gap_s)
    index = picked_rows(time_s, at_s, "previous" if policy == "linear" else policy, max_gap_s)
    result = np.full((len(at_s), *sensor.shape), blank_value(sensor))
    result[index >= 0] = values[index[index >= 0]]
    return result, index >= 0


def quaternions(names: tuple[str, ...]) -> list[list[int]]:
    """The quaternions among the names of a vector: the indices of w, x, y, z of each."""
    groups: dict[str, dict[str, int]] = {}
    for place, name in enumerate(names):
        match = _QUATERNION.fullmatch(name)
        if match:
            groups.setdefault(match[1].lower(), {})[match[2].lower()] = place
    return [[group[axis] for axis in "wxyz"] for group in groups.values() if len(group) == 4]


def blank_value(sensor: Sensor) -> np.ndarray:
    """An empty reading: zeros ("" for text), depth inf, no points."""
    nothing = np.inf if sensor.kind == "depth" else "" if sensor.dtype == "string" else 0
    return np.full(sensor.shape, nothing, _dtype(sensor))


def _dtype(sensor: Sensor) -> np.dtype:
    return np.dtype(object if sensor.dtype == "string" else sensor.dtype)


def _limit(max_gap_s: float | None) -> float:
    return np.inf if max_gap_s is None else max_gap_s + SAME_TIME_S


def clock_of(readings: Readings, name: str) -> np.ndarray:
    """float64 [n]: the times of the readings; DatasetError where they are not finite, ascending and n in number."""
    time_s = np.asarray(readings.time_s, np.float64)
    if time_s.ndim != 1 or not np.isfinite(time_s).all() or (np.diff(time_s) < 0).any():
        raise DatasetError(f"the times of {name} are not all finite and ascending; mend or leave out that sensor.")
    if len(readings.values) != len(time_s):
        raise DatasetError(f"{name} has {len(readings.values)} readings at {len(time_s)} times; mend or leave it out.")
    return time_s


def stacked(readings: Readings, sensor: Sensor) -> np.ndarray:
    """[n, *shape]: all readings of a vector, of its dtype (objects for "string"); DatasetError for a wrong shape."""
    try:
        values = np.asarray(readings.values if len(readings.values) else np.zeros((0, *sensor.shape)), _dtype(sensor))
        return values.reshape(len(readings.time_s), *sensor.shape)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"the readings of {sensor.name} are not all of shape {sensor.shape} ({error}).") from error


def _looked_up(readings: Readings, sensor: Sensor, index: np.ndarray) -> Lazy:
    kept: tuple[int, np.ndarray] = (-1, blank_value(sensor))  # consecutive rows often take the same reading

    def look(row: int) -> np.ndarray:
        nonlocal kept
        if index[row] < 0:
            return blank_value(sensor)
        if index[row] != kept[0]:
            kept = int(index[row]), np.asarray(readings.values[int(index[row])])
        return kept[1]

    return Lazy(len(index), look)


def _interpolated(time_s, values, sensor: Sensor, at_s, max_gap_s) -> tuple[np.ndarray, np.ndarray]:
    result = np.zeros((len(at_s), *sensor.shape), values.dtype)
    if not len(time_s):
        return result, np.zeros(len(at_s), bool)
    near = picked_rows(time_s, at_s, "nearest")
    same = np.abs(time_s[near] - at_s) <= SAME_TIME_S
    after = np.searchsorted(time_s, at_s, side="right")
    last = ~same & (after == len(time_s)) & (at_s - time_s[-1] <= _limit(max_gap_s))
    between = np.flatnonzero(~same & (after > 0) & (after < len(time_s)))
    between = between[time_s[after[between]] - time_s[after[between] - 1] <= _limit(max_gap_s)]
    result[same], result[last] = values[near[same]], values[-1]
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # NaN stays NaN
        result[between] = _mixed(time_s, values, sensor, at_s[between], after[between])
    valid = same | last
    valid[between] = True
    return result, valid


def _mixed(time_s, values, sensor: Sensor, at_s, b) -> np.ndarray:
    """Interpolates between the readings b - 1 and b."""
    a = b - 1
    share = ((at_s - time_s[a]) / (time_s[b] - time_s[a]))[:, None]
    flat = values.reshape(len(values), int(np.prod(sensor.shape))).astype(np.float64)
    before, behind = flat[a], flat[b]
    mixed = before * (1 - share) + behind * share
    names = sensor.names if len(sensor.names) == flat.shape[1] else ()
    turn = [{"rad": np.pi, "deg": 180.0}.get(sensor.units.get(name, ""), np.inf) for name in names]
    if names and np.isfinite(turn).any():
        mixed = np.where(np.abs(behind - before) > turn, np.where(share > 0.5, behind, before), mixed)
    for group in quaternions(names):
        mixed[:, group] = slerp(before[:, group], behind[:, group], share)
    return mixed.reshape(len(mixed), *sensor.shape).astype(values.dtype)


def slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions [n, 4] on the shorter arc from a (share 0) to b (share 1), in a's sign; share [n, 1] (Shoemake 1985). Where
    a or b is zero, and so no rotation, the nearer of the two is returned unchanged."""
    long_a, long_b = np.linalg.norm(a, axis=1, keepdims=True), np.linalg.norm(b, axis=1, keepdims=True)
    whole = (long_a > 0) & (long_b > 0)
    unit_a, unit_b = a / np.where(whole, long_a, 1), b / np.where(whole, long_b, 1)
    cosine = (unit_a * unit_b).sum(1, keepdims=True)
    unit_b, cosine = np.where(cosine < 0, -unit_b, unit_b), np.abs(cosine)
    angle = np.arccos(np.clip(cosine, 0, 1))
    sine = np.where(angle > 1e-6, np.sin(angle), 1)
    straight = angle <= 1e-6
    weight_a = np.where(straight, 1 - share, np.sin((1 - share) * angle) / sine)
    weight_b = np.where(straight, share, np.sin(share * angle) / sine)
    mixed = weight_a * unit_a + weight_b * unit_b
    length = np.linalg.norm(mixed, axis=1, keepdims=True)
    return np.where(whole, mixed / np.where(length > 0, length, 1), np.where(share > 0.5, b, a))
