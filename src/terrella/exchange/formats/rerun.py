"""Shows a recording in the viewer of Rerun (https://rerun.io)."""
# pyright: reportAttributeAccessIssue=false

import contextlib
from collections.abc import Iterator

import numpy as np
import simplejpeg

from ...core.errors import DatasetError
from ...data.source import Readings, Sensor, Source, Take
from ..poses import pose_columns

try:
    import rerun as rr  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise DatasetError("Rerun needs a package that is not installed: pip install 'terrella[rerun]'.") from error

_JPEG_QUALITY = 90
_FLUSH_TIMEOUT_S = 60.0  # for one episode


def show(source: Source) -> list[str]:
    """Opens Rerun's viewer on this machine and sends it all takes; returns notes on what Rerun cannot show.

    Pictures become JPEG; depth is 0 where nothing was hit. Each sensor keeps its own times (timeline "time", seconds since
    the start of the take; "wall_time" where known). Units and coordinate frames are left out. DatasetError without a viewer.
    """
    for number, take in enumerate(source.takes()):
        stream = _stream(source, number)
        try:
            with _reached():
                stream.spawn()  # uses a viewer that is already open
            _log(stream, source, take)
            with _reached():
                stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        finally:
            stream.disconnect()
    return _left_out(source)


@contextlib.contextmanager
def _reached() -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError, OSError) as error:
        raise DatasetError(
            f"Rerun's viewer cannot be reached ({str(error).splitlines()[0]}); start one with `rerun`."
        ) from error


def _stream(source: Source, number: int) -> rr.RecordingStream:
    stream = rr.RecordingStream("terrella")
    stream.send_recording_name(f"{source.name}, episode {number}")
    return stream


def _left_out(source: Source) -> list[str]:
    kept = (sensor for sensor in source.sensors.values() if sensor.units or sensor.frame or sensor.facts)
    names = ", ".join(sensor.name for sensor in kept)
    return [f"units, frames and calibration of {names} have no place in Rerun"] if names else []


def _log(stream: rr.RecordingStream, source: Source, take: Take) -> None:
    if take.task:
        stream.log("task", rr.TextDocument(take.task), static=True)
    for name, readings in take.readings.items():
        sensor = source.sensors[name]
        path = rr.new_entity_path(name.split("."))
        if sensor.kind == "vector":
            _log_vector(stream, path, sensor, readings, take.start_ns)
            continue
        for time_s, value in zip(np.asarray(readings.time_s, np.float64), readings.values, strict=True):
            stream.reset_time()
            stream.set_time("time", duration=float(time_s))
            if take.start_ns is not None:
                stream.set_time("wall_time", timestamp=np.datetime64(take.start_ns + round(time_s * 1e9), "ns"))
            stream.log(path, _shown(sensor, np.asarray(value)))


def _shown(sensor: Sensor, value: np.ndarray) -> rr.AsComponents:
    if sensor.kind == "image":
        jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(value), quality=_JPEG_QUALITY, colorspace="RGB")
        return rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
    if sensor.kind == "depth":
        return rr.DepthImage(np.where(np.isfinite(value), value, 0).astype(np.float32), meter=1.0)
    return rr.Points3D(value[:, :3])


def _log_vector(
    stream: rr.RecordingStream, path: str, sensor: Sensor, readings: Readings, start_ns: int | None
) -> None:
    count = len(readings.time_s)
    if not count:
        return
    times = np.asarray(readings.time_s, np.float64)
    values = np.asarray(list(readings.values)).astype(np.float64).reshape(count, -1)
    indexes = [rr.TimeColumn("time", duration=times)]
    if start_ns is not None:
        wall = start_ns + np.round(times * 1e9).astype(np.int64)
        indexes.append(rr.TimeColumn("wall_time", timestamp=wall.astype("datetime64[ns]")))
    width = values.shape[1]
    if len(sensor.names) == width:
        stream.log(path, rr.SeriesLines(names=list(sensor.names)), static=True)
    stream.send_columns(path, indexes, rr.Scalars.columns(scalars=values.reshape(-1)).partition([width] * count))
    pose = pose_columns(sensor) if sensor.name != "action" else None
    if pose is None:
        return
    height = next((at for at, name in enumerate(sensor.names) if name in ("z", "z_m")), None)
    place = values[:, [pose["x"], pose["y"]]]
    place = np.column_stack([place, values[:, height] if height is not None else np.zeros(count)])
    turn = {}
    if pose["quaternion"]:
        w, *rest = pose["quaternion"]
        turn = {"quaternion": values[:, [*rest, w]]}
    stream.log("world/path", rr.LineStrips3D([place]), static=True)
    stream.send_columns("world/body", indexes, rr.Transform3D.columns(translation=place, **turn))
