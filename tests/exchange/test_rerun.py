"""Rerun's files hold every reading at its own time: written here, read back by Rerun itself."""

from __future__ import annotations

import numpy as np
import pytest
import simplejpeg

from terrella.core.errors import DatasetError
from terrella.data.source import Lazy, Readings, Sensor, Source, Take

pytest.importorskip("rerun", reason="Rerun is not installed: pip install 'terrella[rerun]'")
chunk = pytest.importorskip("rerun.chunk", reason="this Rerun cannot read its own files: pip install 'rerun-sdk>=0.41'")

CAMERA, DEPTH, LIDAR, POSE = (
    "observation.images.front",
    "observation.depth",
    "observation.points.lidar",
    "observation.pose",
)
START_NS = 1_700_000_000_123_456_789


def picture(index: int) -> np.ndarray:
    return np.full((16, 24, 3), 20 * index, np.uint8)


def take_of(number: int) -> Take:
    slow, fast = np.array([0.0, 0.1, 0.25, 0.3]), np.linspace(0.0, 0.3, 31)
    pose = np.stack([np.cos(fast), np.sin(fast), fast, 0 * fast + number], -1)
    readings = {
        CAMERA: Readings(slow, Lazy(4, picture)),
        DEPTH: Readings(slow, np.full((4, 3, 5), [1, 2, np.inf, 3, 4], np.float32)),
        LIDAR: Readings(slow, [np.ones((count, 3), np.float32) for count in (2, 0, 5, 1)]),
        POSE: Readings(fast, pose),
        "next.done": Readings(fast, fast > 0.29),
    }
    return Take(readings, f"task {number}", START_NS if number else None)


SENSORS = [
    Sensor(CAMERA, "image", (16, 24, 3), "uint8"),
    Sensor(DEPTH, "depth", (3, 5)),
    Sensor(LIDAR, "points", (0, 3), names=("x", "y", "z")),
    Sensor(POSE, "vector", (4,), "float64", ("x_m", "y_m", "z_m", "yaw"), {"yaw": "rad"}),
    Sensor("next.done", "vector", (1,), "bool"),
]


def source_of(count: int) -> Source:
    return Source("small", {sensor.name: sensor for sensor in SENSORS}, lambda: map(take_of, range(count)))


def columns(file, entity: str) -> dict[str, list]:
    """Every column of the readings of one entity, in the order of their times, which are whole nanoseconds."""
    found = [part for part in chunk.RrdReader(file).stream().to_chunks() if part.entity_path == entity]
    rows = []
    for part in found:
        if not part.is_static:
            batch = part.to_record_batch()
            times = [name for name in ("time", "wall_time") if name in batch.schema.names]
            named = {name: batch[name].cast("int64").to_pylist() for name in times}
            named |= {name: batch[name].to_pylist() for name in batch.schema.names if ":" in name}
            rows += [dict(zip(named, row, strict=True)) for row in zip(*named.values(), strict=True)]
    rows.sort(key=lambda row: row["time"])
    return {name: [row[name] for row in rows] for name in rows[0]}


def test_every_reading_is_there_at_its_time(tmp_path):
    from terrella.exchange.formats import rerun

    assert rerun._left_out(source_of(2)) == [f"units, frames and calibration of {POSE} have no place in Rerun"]
    for number, take in enumerate(source_of(2).takes()):
        file = tmp_path / f"{number}.rrd"
        stream = rerun._stream(source_of(2), number)
        stream.save(file)
        rerun._log(stream, source_of(2), take)
        stream.disconnect()
        poses = columns(file, "/observation/pose")
        clock = np.round(take.readings[POSE].time_s * 1e9).astype(int)
        np.testing.assert_allclose(poses["time"], clock, atol=1)
        np.testing.assert_array_equal(poses["Scalars:scalars"], take.readings[POSE].values)
        assert ("wall_time" in poses) == bool(number)
        if number:
            np.testing.assert_array_equal(np.array(poses["wall_time"]) - START_NS, clock)
        cameras = columns(file, "/observation/images/front")
        np.testing.assert_allclose(cameras["time"], [0, 100_000_000, 250_000_000, 300_000_000], atol=1)
        for index, blob in enumerate(cameras["EncodedImage:blob"]):
            seen = simplejpeg.decode_jpeg(bytes(blob[0]), colorspace="RGB").astype(int)
            assert np.abs(seen - picture(index)).max() <= 3
        assert len(columns(file, "/observation/depth")["time"]) == 4
        clouds = columns(file, "/observation/points/lidar")["Points3D:positions"]
        assert [len(cloud or ()) for cloud in clouds] == [2, 0, 5, 1]
        path = columns(file, "/world/body")["Transform3D:translation"]
        np.testing.assert_allclose([place[0] for place in path], take.readings[POSE].values[:, :3], atol=1e-6)


def test_a_viewer_that_cannot_be_reached_is_a_sentence(monkeypatch):
    import rerun as rr

    from terrella.exchange.formats import rerun

    def nowhere(self):
        raise RuntimeError("no viewer")

    monkeypatch.setattr(rr.RecordingStream, "spawn", nowhere)
    with pytest.raises(DatasetError, match="cannot be reached"):
        rerun.show(source_of(1))
