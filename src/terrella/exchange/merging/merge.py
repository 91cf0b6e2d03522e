"""Merges several robots' recordings into one source of common named numbers and cameras, padded, with masks.

A take of T rows, `mapping.rows.fps` per second, has
  action                  float32 [D], the named numbers of `mapping.action`; 0 where the robot has none. Its readings end
                          with the last row that has an action: T - 1 of T rows where the original has a terminal
                          observation, none in a take without actions.
  action_mask             bool [T, D], True where this robot has that number in this row.
  observation.state       float32 [T, S], of `mapping.state`; 0 where the robot has none.
  observation.state_mask  bool [T, S], True where the robot has that number in this row.
  every merged camera     uint8 [H, W, 3], scaled with its aspect ratio kept, on black; depth float32 [H, W] in metres, nearest
                          pixels, on inf. All black or inf where there is no picture.
  observation.cameras_mask  bool [T, cameras], True where a camera (in the order of `names`) has a picture.
  embodiment              int64 [T, 1], the index of the robot in `facts["embodiments"]`.
  sensors kept whole      with `NAME_mask`, bool [T, 1], True where there is a value. Points keep their own clock (the newest
                          scan at the first row is dated to it); missing vectors are zero. next.reward is float32 [1], the
                          sum of all rewards from this row until the next (so that returns are kept at any fps); bools are
                          True if any was; others are the newest value. Like actions, they end with their last valid row.
The instruction and the facts of a take are kept; start_ns moves to the first row. Numbers are resampled by the policies of
`mapping.rows` (see `resample`), which leave gaps empty; the last action lasts for one period of its own clock. Numbers that
are not finite, also as float32, are masked. A take with fewer than two rows is skipped.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image

from ...core.errors import DatasetError
from ...data.resample import SAME_TIME_S, blank_value, clock_of, picked_rows, resample, row_times, stacked
from ...data.source import Lazy, Readings, Sensor, Source, Take
from .mapping import (
    ACTION,
    CAMERAS_MASK,
    EMBODIMENT,
    FOLLOWS,
    STATE,
    MergeMapping,
    SourceMapping,
    affine,
    check_mapping,
    mask_of,
)
from .report import MergeReport, SensorCount, SourceCount


def merge(
    sources: Mapping[str, Source],
    mapping: MergeMapping,
    report: MergeReport | None = None,
    name: str = "merged",
    terminal: bool = True,
) -> Source:
    """One source of all takes of the mapping's sources (path -> Source), in the mapping's order, merged as they are read.

    report:   filled while the takes are read.
    terminal: False gives the last rows an action (zeros, masked) too, for formats in which all takes end alike.
    DatasetError where the mapping does not fit the sources.
    """
    check_mapping(mapping, sources)
    report = report if report is not None else MergeReport()
    sensors = _sensors(mapping, sources)

    def takes() -> Iterator[Take]:
        robots = {
            robot: {
                "sources": [it.path for it in mapping.sources if it.embodiment == robot],
                "cameras": _views(mapping, sources, robot),
                "actions": _actions(mapping, sources, robot),
            }
            for robot in mapping.embodiments
        }
        counts = [_count(source, sources[source.path], mapping) for source in mapping.sources]
        report.begin(counts, robots, {ACTION: tuple(mapping.action), STATE: tuple(mapping.state)})
        for source, count in zip(mapping.sources, counts):
            for number, take in enumerate(sources[source.path].takes()):
                try:
                    merged = _take(take, source, sources[source.path], mapping, sensors, count, report, terminal)
                except DatasetError as error:
                    raise DatasetError(f"take {number} of {source.path}: {error}") from error
                if merged is None:
                    count.skipped.append(f"take {number}: its mapped sensors give fewer than two rows")
                else:
                    origin = {"embodiment": source.embodiment, "source": source.path, "take": number}
                    yield replace(merged, facts={**take.facts, **merged.facts, **origin}, notes=take.notes)
        report.complete = True

    robots = set(mapping.embodiments)
    return Source(
        name=name,
        sensors=sensors,
        takes=takes,
        fps=mapping.rows.fps,
        robot=robots.pop() if len(robots) == 1 else "several",
        notes=tuple(
            f"{source.embodiment}: {what} was left out: {why}"
            for source in mapping.sources
            for what, why in _left_out(source, sources[source.path]).items()
        ),
        facts={"embodiments": [{"id": number, "name": robot} for number, robot in enumerate(mapping.embodiments)]},
    )


def letterbox(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Fits an image (uint8 [H, W, 3]; box filter or bilinear, on black) or depth (float32 [H, W]; nearest pixels, on inf) into
    height x width, centred, with its aspect ratio kept."""
    if picture.shape[:2] == (height, width):
        return picture
    down, across, top, left = fit(picture.shape[0], picture.shape[1], height, width)
    if picture.ndim == 2:
        fitted = np.full((height, width), np.inf, np.float32)
        rows = (np.arange(down) + 0.5) * picture.shape[0] / down
        columns = (np.arange(across) + 0.5) * picture.shape[1] / across
        inner = picture[rows.astype(int)[:, None], columns.astype(int)]
    else:
        fitted = np.zeros((height, width, 3), np.uint8)
        filter = Image.Resampling.BOX if down <= picture.shape[0] else Image.Resampling.BILINEAR
        inner = np.asarray(Image.fromarray(np.ascontiguousarray(picture)).resize((across, down), filter))
    fitted[top : top + down, left : left + across] = inner
    return fitted


def fit(height: int, width: int, to_height: int, to_width: int) -> tuple[int, int, int, int]:
    """(height, width, top, left) in pixels of a height x width picture letterboxed into to_height x to_width."""
    scale = min(to_height / height, to_width / width)
    down = min(max(round(height * scale), 1), to_height)
    across = min(max(round(width * scale), 1), to_width)
    return down, across, (to_height - down) // 2, (to_width - across) // 2


def _sensors(mapping: MergeMapping, sources: Mapping[str, Source]) -> dict[str, Sensor]:
    rate = mapping.rows.fps
    sensors: dict[str, Sensor] = {}

    def vector(name: str, dtype: str, names: tuple[str, ...], **more) -> None:
        sensors[name] = Sensor(name, "vector", (len(names),), dtype, names, rate_hz=rate, **more)

    for key, dimensions in ((ACTION, mapping.action), (STATE, mapping.state)):
        if dimensions:
            names, frames = tuple(dimensions), {name: it.frame for name, it in dimensions.items() if it.frame}
            units = {name: it.unit for name, it in dimensions.items() if it.unit}
            common = {it.frame for it in dimensions.values()}
            frame = common.pop() if len(common) == 1 else ""
            vector(key, "float32", names, units=units, frame=frame, facts={"frames": frames} if frames else {})
            vector(mask_of(key), "bool", names)
    for name, camera in mapping.cameras.items():
        shape = (camera.height, camera.width, 3) if camera.kind == "image" else (camera.height, camera.width)
        sensors[name] = Sensor(name, camera.kind, shape, "uint8" if camera.kind == "image" else "float32", rate_hz=rate)
    if mapping.cameras:
        vector(CAMERAS_MASK, "bool", tuple(mapping.cameras))
    vector(EMBODIMENT, "int64", (EMBODIMENT,), facts={"embodiments": list(mapping.embodiments)})
    for source in mapping.sources:
        for name, to in source.keep.items():
            sensor = sources[source.path].sensors[name]
            dtype = sensor.dtype if to not in sensors else np.result_type(sensors[to].dtype, sensor.dtype).name
            dtype = "float32" if to == f"{FOLLOWS}reward" else dtype
            own = sensor.rate_hz if sensor.kind == "points" else rate
            sensors[to] = replace(sensors.get(to, sensor), name=to, dtype=dtype, rate_hz=own)
            vector(mask_of(to), "bool", (to,))
    return sensors


def _take(
    take: Take,
    source: SourceMapping,
    origin: Source,
    mapping: MergeMapping,
    sensors: Mapping[str, Sensor],
    count: SourceCount,
    report: MergeReport,
    terminal: bool,
) -> Take | None:
    used = [name for name, vector in source.vectors.items() if any(number.to for number in vector.numbers)]
    used += [*source.cameras, *source.keep]
    at_s = row_times(take, used, mapping.rows.fps)
    if len(at_s) < 2:
        return None
    count.takes, count.rows = count.takes + 1, count.rows + len(at_s)
    count.late_s += float(at_s[0] - min(take.readings[n].time_s[0] for n in used if _has(take, n)))
    for name in used:
        if name in take.readings:
            _tally(count.sensors.setdefault(name, SensorCount()), take.readings[name], len(at_s))
        if not _has(take, name):
            count.sensors.setdefault(name, SensorCount()).rows_without += len(at_s)

    merged: dict[str, np.ndarray | Lazy] = {}
    for key, dimensions in ((ACTION, mapping.action), (STATE, mapping.state)):
        if dimensions:
            values, mask = _numbers(key, take, at_s, source, origin, mapping, count)
            report.add(source.embodiment, key, values, mask)
            merged[key] = _until_last(values, mask) if key == ACTION and terminal else values
            merged[mask_of(key)] = mask
    if mapping.cameras:
        merged |= _pictures(take, at_s, source, origin, mapping, sensors, count)
    merged[EMBODIMENT] = np.full((len(at_s), 1), mapping.embodiments.index(source.embodiment))
    merged |= _kept(take, at_s, source, origin, mapping, sensors, count)
    time_s = np.arange(len(at_s)) / mapping.rows.fps
    readings = {name: Readings(time_s[: len(it)], it) for name, it in merged.items()}
    readings |= _scans(take, at_s, source, mapping, sensors)
    start_ns = None if take.start_ns is None else take.start_ns + round(at_s[0] * 1e9)
    language: Any = take.facts.get("language", ())
    facts = {"language": [[when - at_s[0], words] for when, words in language]} if language else {}
    return Take({name: readings[name] for name in sensors}, take.task, start_ns, facts)


def _has(take: Take, name: str) -> bool:
    return name in take.readings and len(take.readings[name].time_s) > 0


def _tally(count: SensorCount, readings: Readings, rows: int) -> None:
    count.readings, count.rows = count.readings + len(readings.time_s), count.rows + rows
    count.longest_gap_s = max(count.longest_gap_s, float(np.diff(np.asarray(readings.time_s)).max(initial=0)))


def _numbers(key, take, at_s, source, origin, mapping, count) -> tuple[np.ndarray, np.ndarray]:
    """(float32 [T, D], bool [T, D]): the merged action or state of one take, and its mask."""
    dimensions = mapping.action if key == ACTION else mapping.state
    places = {name: place for place, name in enumerate(dimensions)}
    values = np.zeros((len(at_s), len(places)), np.float32)
    mask = np.zeros(values.shape, bool)
    policy = mapping.rows.actions if key == ACTION else mapping.rows.continuous
    for name, vector in source.vectors.items():
        wanted = [i for i, number in enumerate(vector.numbers) if number.to]
        if (name == ACTION) != (key == ACTION) or not wanted or not _has(take, name):
            continue
        sensor = origin.sensors[name]
        if not sensor.names:
            labels = tuple(number.name for number in vector.numbers)
            sensor = replace(sensor, names=labels if all(labels) else ())
        units = {label: number.unit for label, number in zip(sensor.names, vector.numbers)}
        sampled, valid = resample(
            take.readings[name], replace(sensor, units=units), at_s, policy, mapping.rows.max_gap_s
        )
        if name == ACTION:
            valid &= _is_ongoing(take.readings[name], at_s, sensor, source, mapping)
        sensor_count = count.sensors[name]
        sensor_count.rows_without += int((~valid).sum())
        for i in wanted:
            number = vector.numbers[i]
            scale, offset = affine(number, dimensions[number.to])
            column = np.asarray(sampled)[:, i]
            with np.errstate(over="ignore", invalid="ignore"):
                if (scale, offset) != (1.0, 0.0):
                    column = column * scale + offset
                column = column.astype(np.float32)
            finite = np.isfinite(column)
            sensor_count.not_finite += int((valid & ~finite).sum())
            kept = valid & finite
            values[kept, places[number.to]], mask[kept, places[number.to]] = column[kept], True
    return values, mask


def _is_ongoing(readings: Readings, at_s: np.ndarray, sensor: Sensor, source: SourceMapping, mapping: MergeMapping):
    """bool [T]: at most one period of the sensor's clock after its last reading; later rows have no action."""
    time_s = clock_of(readings, sensor.name)
    rate = sensor.rate_hz or source.fps or mapping.rows.fps
    period = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1 / rate
    return at_s < time_s[-1] + max(period - SAME_TIME_S, SAME_TIME_S)


def _until_last(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    rows = np.flatnonzero(mask.any(1))
    return values[: rows[-1] + 1 if len(rows) else 0]


def _pictures(take, at_s, source, origin, mapping, sensors, count) -> dict[str, np.ndarray | Lazy]:
    pictures: dict[str, np.ndarray | Lazy] = {}
    mask = np.zeros((len(at_s), len(mapping.cameras)), bool)
    filled = {to: name for name, to in source.cameras.items()}
    for place, to in enumerate(mapping.cameras):
        name = filled.get(to, "")
        seen = None
        if name and _has(take, name):
            sensor, policy = origin.sensors[name], mapping.rows.images
            seen, mask[:, place] = resample(take.readings[name], sensor, at_s, policy, mapping.rows.max_gap_s)
            count.sensors[name].rows_without += int((~mask[:, place]).sum())
        pictures[to] = _letterboxed(seen, mask[:, place], sensors[to], name)
    return {**pictures, CAMERAS_MASK: mask}


def _letterboxed(seen, valid: np.ndarray, sensor: Sensor, name: str) -> Lazy:
    def look(row: int) -> np.ndarray:
        if not valid[row]:
            return blank_value(sensor)
        picture, shape = np.asarray(seen[row]), sensor.shape
        fits = picture.ndim == len(shape) and picture.shape[2:] == shape[2:] and picture.size
        if not fits or picture.dtype != sensor.dtype:
            raise DatasetError(
                f"row {row} of {name} is {picture.dtype} {picture.shape}, not {sensor.kind}; restore it."
            )
        return letterbox(picture, shape[0], shape[1])

    return Lazy(len(valid), look)


def _scans(take, at_s, source, mapping, sensors) -> dict[str, Readings]:
    """Points with their own clock, from the newest scan at the first row on."""
    scans: dict[str, Readings] = {}
    filled = {to: name for name, to in source.keep.items()}
    for to in {to: None for it in mapping.sources for to in it.keep.values() if sensors[to].kind == "points"}:
        name = filled.get(to, "")
        scans[to] = Readings(np.zeros(0), [])
        if name and _has(take, name):
            readings = take.readings[name]
            time_s = clock_of(readings, name)
            first = max(int(np.searchsorted(time_s, at_s[0] + SAME_TIME_S, side="right")) - 1, 0)
            values = Lazy(len(time_s) - first, lambda i, values=readings.values, first=first: values[first + i])
            scans[to] = Readings(np.maximum(time_s[first:] - at_s[0], 0), values)
    return scans


def _kept(take, at_s, source, origin, mapping, sensors, count) -> dict[str, np.ndarray]:
    """The sensors kept whole of any source: values (except of points) and masks."""
    kept: dict[str, np.ndarray] = {}
    filled = {to: name for name, to in source.keep.items()}
    for to in {to: None for it in mapping.sources for to in it.keep.values()}:
        name, sensor = filled.get(to, ""), sensors[to]
        if not name or not _has(take, name):
            valid = np.zeros(len(at_s), bool)
            values = np.zeros((len(at_s), *sensor.shape), sensor.dtype)
        elif to.startswith(FOLLOWS):
            values, valid = _outcomes(take.readings[name], origin.sensors[name], sensor, at_s, source, mapping)
        elif sensor.kind == "points":
            index = picked_rows(clock_of(take.readings[name], name), at_s, mapping.rows.images, mapping.rows.max_gap_s)
            values, valid = np.zeros(0), index >= 0
        else:
            policy, gap = mapping.rows.continuous, mapping.rows.max_gap_s
            values, valid = resample(take.readings[name], origin.sensors[name], at_s, policy, gap)
            values = np.array(values, sensor.dtype)
            finite = np.isfinite(values).reshape(len(values), -1).all(1)
            count.sensors[name].not_finite += int((valid & ~finite).sum())
            valid = valid & finite
            values[~valid] = 0
        if name and _has(take, name):
            count.sensors[name].rows_without += int((~valid).sum())
        follows = to.startswith(FOLLOWS)
        if sensor.kind != "points":
            kept[to] = _until_last(np.asarray(values), valid[:, None]) if follows else np.asarray(values)
        kept[mask_of(to)] = valid[:, None]
    return kept


def _outcomes(readings, sensor: Sensor, merged: Sensor, at_s, source, mapping) -> tuple[np.ndarray, np.ndarray]:
    """Outcomes from each row until the next: rewards are summed, bools are True if any was, others are the newest."""
    time_s, values = clock_of(readings, sensor.name), stacked(readings, sensor)
    row = np.searchsorted(at_s, time_s + SAME_TIME_S, side="right") - 1
    values, row = values[row >= 0], row[row >= 0]
    covered = (at_s >= time_s[0] - SAME_TIME_S) & _is_ongoing(readings, at_s, sensor, source, mapping)
    valid = covered | np.isin(np.arange(len(at_s)), row)
    if merged.name == f"{FOLLOWS}reward":
        result = np.zeros((len(at_s), 1))
        np.add.at(result, row, values.astype(np.float64))
    elif merged.dtype == "bool":
        result = np.zeros((len(at_s), 1), bool)
        np.logical_or.at(result, row, values)
    else:
        result = np.array(resample(readings, sensor, at_s, "previous")[0])
        result[row] = values  # the newest in each row, because readings ascend in time
    valid &= np.isfinite(result[:, 0])
    return np.where(valid[:, None], result, 0).astype(merged.dtype), valid


def _views(mapping: MergeMapping, sources: Mapping[str, Source], robot: str) -> dict[str, dict]:
    """Merged camera -> the robot's sensor, its size and calibration, and where its picture is placed."""
    views: dict[str, dict] = {}
    for source in mapping.sources:
        for name, to in source.cameras.items() if source.embodiment == robot else ():
            sensor, camera = sources[source.path].sensors[name], mapping.cameras[to]
            down, across, top, left = fit(sensor.shape[0], sensor.shape[1], camera.height, camera.width)
            placed = {"height": down, "width": across, "top": top, "left": left}
            views.setdefault(to, {"sensor": name, "size": list(sensor.shape[:2]), "placed": placed})
            if "calibration" in sensor.facts:
                views[to].setdefault("calibration", sensor.facts["calibration"])
    return views


def _actions(mapping: MergeMapping, sources: Mapping[str, Source], robot: str) -> dict[str, Any] | None:
    """The robot's own actions: the facts of their space, and for each of their numbers which merged number it fills, with scale and
    offset. None where a number is left out, or its recordings differ."""
    places, declared = {name: place for place, name in enumerate(mapping.action)}, []
    for source in mapping.sources:
        if source.embodiment == robot:
            origin, vector = sources[source.path], source.vectors.get(ACTION)
            world: Any = origin.facts.get("world") or {}
            if vector is None or any(number.out for number in vector.numbers):
                return None
            numbers = [(places[one.to], *affine(one, mapping.action[one.to])) for one in vector.numbers]
            space = {key: value for key, value in world.items() if key.startswith("action_") or key == "discrete"}
            declared.append({"space": {**space, "embodiment": origin.robot}, "numbers": numbers})
    return declared[0] if declared and all(one == declared[0] for one in declared) else None


def _left_out(source: SourceMapping, origin: Source) -> dict[str, str]:
    reasons = dict(source.out)
    for name, vector in source.vectors.items():
        for place, number in enumerate(vector.numbers):
            if number.out:
                reasons[f"{name}[{place}]" + (f" {number.name}" if number.name else "")] = number.out
    mentioned = {*source.vectors, *source.cameras, *source.keep, *source.out}
    return reasons | {name: "the mapping does not mention it" for name in origin.sensors if name not in mentioned}


def _count(source: SourceMapping, origin: Source, mapping: MergeMapping) -> SourceCount:
    notes = [*origin.notes, *source.notes]
    if ACTION in source.vectors and source.fps and abs(source.fps - mapping.rows.fps) > 1e-6:
        ratio = source.fps / mapping.rows.fps
        notes.append(
            f"{ACTION} at {source.fps:g} rows a second is read at {mapping.rows.fps:g}: numbers that are steps per row "
            f"(deltas) need their scale multiplied by {ratio:g}; positions and speeds do not."
        )
    return SourceCount(source.path, source.embodiment, notes=notes, left_out=_left_out(source, origin))
