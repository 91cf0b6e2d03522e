"""MCAP: our files open in the real reader, the real writer's open in ours, and damage costs what is damaged, no more."""

from __future__ import annotations

import importlib
import io
import json
import struct
import sys
import tracemalloc
from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from terrella.core.errors import DatasetError
from terrella.data import Dataset
from terrella.data.source import Lazy, Readings, Sensor, Source, Take

pytest.importorskip("mcap")
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.json_format import MessageToDict
from mcap.reader import SeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.writer import Writer as ProtobufWriter

from terrella.exchange import write_source
from terrella.exchange.formats import mcap, mcap_index, mcap_write, messages

START_NS = 1_700_000_000_000_000_123
CALIBRATION = {"width": 24, "height": 16, "distortion_model": "plumb_bob", "K": [9.0, 0, 12, 0, 9, 8, 0, 0, 1]}
SENSORS = (
    Sensor(
        "observation.images.front", "image", (16, 24, 3), "uint8", frame="cam", rate_hz=30.0, facts={"a": [1, None]}
    ),
    Sensor("observation.images.left/wrist", "image", (9, 7, 3), "uint8", facts={"calibration": CALIBRATION}),
    Sensor("observation.depth", "depth", (6, 8), frame="cam"),
    Sensor("observation.points.lidar", "points", (0, 4), names=("x", "y", "z", "intensity"), rate_hz=10.0),
    Sensor("observation.points.bare", "points", (0, 3)),
    Sensor("observation.pose", "vector", (7,), "float32", messages.POSE_NAMES, {"x_m": "m"}, "map"),
    Sensor(
        "observation.tool", "vector", (7,), "float64", messages.POSE_NAMES, frame="base", facts={"child_frame": "tool"}
    ),
    Sensor("observation.imu", "vector", (2, 3), "float64", units={"acceleration_x": "m/s2"}),
    Sensor("observation.ticks", "vector", (2,), "int64"),
    Sensor("observation.serial", "vector", (1,), "uint64"),
    Sensor("action", "vector", (2,), "float32", ("steer", "gas")),
    Sensor("next.done", "vector", (1,), "bool"),
)


def _values(sensor: Sensor, count: int, rng: np.random.Generator):
    if sensor.kind == "points":
        return [rng.normal(size=(int(rng.integers(0, 6)), sensor.shape[1])).astype("f4") for _ in range(count)]
    if sensor.dtype in ("int64", "uint64", "uint8"):
        info = np.iinfo(sensor.dtype)
        return rng.integers(info.min, info.max, (count, *sensor.shape), sensor.dtype, endpoint=True)
    values = rng.normal(size=(count, *sensor.shape)).astype(sensor.dtype)
    if sensor.kind == "depth":
        values[:, 0, 0] = np.inf
    return values


def _take(seed: int, count: int = 5, sensors=SENSORS) -> Take:
    rng = np.random.default_rng(seed)
    readings = {}
    for sensor in sensors:
        time_ns = np.sort(rng.integers(-(10**6), 10**10, count))
        readings[sensor.name] = Readings(time_ns / 1e9, _values(sensor, count, rng))
    return Take(readings, f"task {seed}", START_NS + seed, {"seed": seed})


def _source(*takes: Take, sensors=SENSORS) -> Source:
    declared = {sensor.name: sensor for sensor in sensors}
    return Source("mine", declared, lambda: iter(takes), 12.5, "aloha", ("a note",), {"licence": "MIT"})


def _same(one: Take, other: Take) -> None:
    assert (one.task, one.start_ns, dict(one.facts)) == (other.task, other.start_ns, dict(other.facts))
    assert list(one.readings) == list(other.readings)
    for name, readings in one.readings.items():
        found = other.readings[name]
        assert np.array_equal(np.rint(readings.time_s * 1e9), np.rint(found.time_s * 1e9)), name
        assert len(readings.values) == len(found.values)
        for value, again in zip(readings.values, found.values):
            assert value.dtype == again.dtype and np.array_equal(value, again, equal_nan=value.dtype.kind == "f"), name


def test_a_round_trip_loses_nothing(tmp_path):
    takes = _take(1), Take({"action": _take(2).readings["action"]}, facts={"only": "actions"}), _take(3, 0)
    source = _source(*takes)
    told = []
    assert mcap_write.write(source, tmp_path / "set", lambda *done: told.append(done)) == []
    assert told[0] == (1, 60) and told[59] == (60, 60)
    assert [file.name for file in sorted((tmp_path / "set").iterdir())] == [f"take-{i:06d}.mcap" for i in range(3)]
    again = mcap.read(tmp_path / "set")
    assert (again.name, again.fps, again.robot, again.facts) == (source.name, source.fps, source.robot, source.facts)
    assert again.notes == source.notes and again.sensors == source.sensors
    for written, found in zip(takes, again.takes(), strict=True):
        _same(written, found)
    mcap_write.write(again, tmp_path / "again")
    for written, found in zip(again.takes(), mcap.read(tmp_path / "again").takes(), strict=True):
        _same(written, found)
        assert all(np.array_equal(r.time_s, found.readings[n].time_s) for n, r in written.readings.items())


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=st.sampled_from(["float32", "float64", "int64", "uint64", "int8", "bool"]).flatmap(
        lambda dtype: hnp.arrays(dtype, st.tuples(st.integers(1, 4), st.integers(1, 5)))
    ),
    start_ns=st.none() | st.integers(10**15, 2**61),
    first_ns=st.integers(-(10**15), 10**15),
)
def test_any_numbers_at_any_time_come_back(tmp_path_factory, values, start_ns, first_ns):
    path = tmp_path_factory.mktemp("any") / "take.mcap"
    sensor = Sensor("observation.state", "vector", values.shape[1:], str(values.dtype))
    time_s = (first_ns + np.arange(len(values))) / 1e9
    take = Take({sensor.name: Readings(time_s, values)}, start_ns=start_ns)
    mcap_write.write(_source(take, sensors=[sensor]), path)
    found = next(mcap.read(path).takes())
    assert found.start_ns == start_ns
    assert np.array_equal(np.rint(found.readings[sensor.name].time_s * 1e9), np.rint(time_s * 1e9))
    assert np.array_equal(np.stack(found.readings[sensor.name].values), values, equal_nan=values.dtype.kind == "f")


@given(st.lists(st.text("abc_09", min_size=1), min_size=1, max_size=4).map(".".join))
def test_our_names_are_topics_and_back(rest):
    for name, kind in (
        (f"observation.images.{rest}", "image"),
        (f"observation.{rest}", "vector"),
        ("action", "vector"),
    ):
        assert mcap.key_of(mcap.topic_of(name), Sensor(name, kind, (1,))) == name


def test_the_real_reader_opens_what_we_write(tmp_path):
    take = _take(4)
    mcap_write.write(_source(take), tmp_path / "take.mcap")
    counts: dict[str, int] = {}
    with open(tmp_path / "take.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert isinstance(reader, SeekingReader)
        summary = reader.get_summary()
        assert summary and summary.statistics and summary.statistics.message_count == 61  # 12 sensors and a calibration
        assert {record.name for record in reader.iter_metadata()} == {
            "terrella.source",
            "terrella.sensors",
            "terrella.take",
        }
        seen, times = {}, []
        for _, channel, message in reader.iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            times.append(message.log_time)
            assert message.publish_time == message.log_time
        for schema, channel, _, decoded in reader.iter_decoded_messages():
            seen[channel.topic] = schema.name, MessageToDict(decoded, preserving_proto_field_name=True)
    assert times == sorted(times)
    assert set(counts.values()) == {5, 1}
    names = {topic: name for topic, (name, _) in seen.items()}
    assert names["/observation/images/front"] == "foxglove.CompressedImage"
    assert names["/observation/images/left/wrist/calibration"] == "foxglove.CameraCalibration"
    assert names["/observation/depth"] == "foxglove.RawImage"
    assert names["/observation/points/lidar"] == "foxglove.PointCloud"
    assert names["/observation/pose"] == "foxglove.PoseInFrame"
    assert names["/observation/tool"] == "foxglove.FrameTransform"
    assert names["/action"] == "terrella.Vector"
    last = take.readings["action"].values[-1]
    assert seen["/action"][1]["values"] == last.astype(float).tolist() and seen["/action"][1]["names"] == [
        "steer",
        "gas",
    ]
    pose = seen["/observation/pose"][1]["pose"]["orientation"]
    assert [pose[axis] for axis in "wxyz"] == take.readings["observation.pose"].values[-1][3:].astype(float).tolist()


def test_foxgloves_own_classes_read_our_protobuf(tmp_path):
    take = _take(5)
    mcap_write.write(_source(take), tmp_path / "take.mcap")
    pictures = []
    with open(tmp_path / "take.mcap", "rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics="/observation/images/front"):
            picture = CompressedImage.FromString(message.data)
            assert picture.format == "png" and picture.frame_id == "cam"
            assert picture.timestamp.seconds * 10**9 + picture.timestamp.nanos == message.log_time
            pictures.append(np.asarray(Image.open(io.BytesIO(picture.data))))
    assert np.array_equal(pictures, take.readings["observation.images.front"].values)


# -- strangers' files --------------------------------------------------------------------------------------------------


class Stranger:
    """Writes JSON messages with the mcap package alone; message i of the file is at 5 s + i ms."""

    def __init__(self, path, **options):
        self.path = path
        self._file = open(path, "wb")
        self.writer = Writer(self._file, **options)
        self.writer.start()
        self._channels: dict[tuple[str, str], int] = {}
        self.count = 0

    def add(self, topic: str, name: str, message, encoding="json", schema_encoding="jsonschema", schema=b"{}"):
        if (topic, name) not in self._channels:
            number = self.writer.register_schema(name, schema_encoding, schema)
            self._channels[topic, name] = self.writer.register_channel(topic, encoding, number)
        data = message if isinstance(message, bytes) else json.dumps(message, default=_base64).encode()
        time_ns = 5 * 10**9 + self.count * 10**6
        self.writer.add_message(self._channels[topic, name], time_ns, data, time_ns)
        self.count += 1

    def finish(self):
        self.writer.finish()
        self._file.close()
        return self.path


def _base64(data: memoryview) -> str:
    import base64

    return base64.b64encode(data).decode()


def _raw(encoding: str, pixels: np.ndarray, padding: int = 0) -> dict:
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    height, width = pixels.shape[:2]
    size = {"width": width, "height": height, "step": padded.shape[1], "encoding": encoding}
    return {**size, "frame_id": "cam", "data": memoryview(padded.tobytes())}


def _first(source: Source) -> dict[str, np.ndarray]:
    return {name: readings.values[0] for name, readings in next(source.takes()).readings.items()}


def test_a_strangers_pictures_are_read(tmp_path):
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 255, (4, 6, 3), np.uint8)
    mm = rng.integers(1, 60000, (4, 6), np.uint16)
    mm[0, 0] = 0
    metres = rng.normal(size=(4, 6)).astype("<f4")
    png, jpeg, png16 = io.BytesIO(), io.BytesIO(), io.BytesIO()
    Image.fromarray(colour).save(png, "PNG")
    Image.fromarray(colour).save(jpeg, "JPEG", quality=95)
    Image.fromarray(mm).save(png16, "PNG")
    stranger = Stranger(tmp_path / "pictures.mcap")
    stranger.add("/rgb", "foxglove.RawImage", _raw("rgb8", colour, padding=5))
    stranger.add("/bgr", "foxglove.RawImage", _raw("bgr8", np.ascontiguousarray(colour[:, :, ::-1])))
    stranger.add("/mono", "foxglove.RawImage", _raw("mono8", np.ascontiguousarray(colour[:, :, :1])))
    stranger.add("/mm", "foxglove.RawImage", _raw("16UC1", mm, padding=3))
    stranger.add("/metres", "foxglove.RawImage", _raw("32FC1", metres))
    stranger.add("/yuv", "foxglove.RawImage", _raw("yuv422", colour))
    stranger.add(
        "/camera/front/image", "foxglove.CompressedImage", {"data": memoryview(png.getvalue()), "format": "png"}
    )
    stranger.add("/camera/front.image", "foxglove.CompressedImage", {"data": memoryview(jpeg.getvalue())})
    stranger.add("/png16", "foxglove.CompressedImage", {"data": memoryview(png16.getvalue())})
    stranger.add("/camera/front/calibration", "foxglove.CameraCalibration", {**CALIBRATION, "frame_id": "x"})
    source = mcap.read(stranger.finish())
    found = _first(source)
    assert np.array_equal(found["observation.images.rgb"], colour)
    assert np.array_equal(found["observation.images.bgr"], colour)
    assert np.array_equal(found["observation.images.mono"], np.repeat(colour[:, :, :1], 3, 2))
    assert np.array_equal(found["observation.images.camera_front_image_2"], colour)
    assert found["observation.images.camera_front_image"].shape == (4, 6, 3)  # JPEG
    expected = np.where(mm == 0, np.inf, mm / 1000).astype(np.float32)
    assert np.array_equal(found["observation.depth.mm"], expected) and np.array_equal(
        found["observation.depth.png16"], expected
    )
    assert np.array_equal(found["observation.depth.metres"], metres)
    assert source.sensors["observation.depth.metres"].frame == "cam"
    assert [note for note in source.notes if "yuv422" in note] and len(source.notes) == 1
    calibrated = [name for name, sensor in source.sensors.items() if "calibration" in sensor.facts]
    assert calibrated == ["observation.images.camera_front_image_2"] or calibrated == [
        "observation.images.camera_front_image"
    ]
    take = next(source.takes())
    assert take.start_ns == 5 * 10**9 and take.readings["observation.images.bgr"].time_s.tolist() == [0.001]


def test_points_of_every_type_are_read(tmp_path):
    kinds = np.dtype([(name, name) for name in ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8")])
    points = np.zeros(5, kinds)
    for i, name in enumerate(kinds.names or ()):
        points[name] = np.arange(5) + i
    fields = [{"name": n, "offset": kinds.fields[n][1], "type": i + 1} for i, n in enumerate(kinds.names)]  # type: ignore[index]
    message = {
        "frame_id": "lidar",
        "point_stride": kinds.itemsize,
        "fields": fields,
        "data": memoryview(points.tobytes()),
    }
    stranger = Stranger(tmp_path / "points.mcap")
    stranger.add("/points", "foxglove.PointCloud", message)
    stranger.add("/points", "foxglove.PointCloud", {**message, "data": memoryview(b"")})
    stranger.add("/points", "foxglove.PointCloud", {**message, "data": memoryview(b"x")})
    source = mcap.read(stranger.finish())
    assert list(source.sensors) == ["observation.points.points"]
    values = next(source.takes()).readings["observation.points.points"].values
    assert source.sensors["observation.points.points"].names == kinds.names
    assert np.array_equal(values[0], np.arange(5)[:, None] + np.arange(8)) and values[0].dtype == np.float32
    assert values[1].shape == (0, 8) and any("all digits of '<f8'" in note for note in source.notes)
    with pytest.raises(DatasetError, match="Message 2 of '/points'.*do not hold points"):
        values[2]


def test_numbers_of_unknown_messages_are_named_by_their_path(tmp_path):
    imu = {
        "header": {"stamp": {"sec": 1, "nsec": 2}},
        "linear_acceleration": {"x": 1.5, "y": -2, "z": "NaN"},
        "angular_velocity": [1, 2, 3],
        "ok": True,
        "mode": "walk",
    }
    stranger = Stranger(tmp_path / "imu.mcap")
    stranger.add("/imu", "my.Imu", imu)
    stranger.add("/imu", "my.Imu", {"ok": False})
    stranger.add("/action", "my.Command", {"v": 3})
    stranger.add("/words", "my.Words", {"text": "hello"})
    stranger.add("/scan", "sensor_msgs/LaserScan", b"\0\0", "cdr", "ros2msg", b"float32[] ranges")
    source = mcap.read(stranger.finish())
    sensor = source.sensors["observation.imu"]
    numbers = ("linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z")
    assert sensor.names == (*numbers, "angular_velocity.0", "angular_velocity.1", "angular_velocity.2", "ok")
    values = next(source.takes()).readings["observation.imu"].values
    assert np.array_equal(values[0], [1.5, -2, np.nan, 1, 2, 3, 1], equal_nan=True)
    assert np.isnan(values[1][:-1]).all() and values[1][-1] == 0
    assert set(source.sensors) == {"observation.imu", "action"}
    text = " ".join(source.notes)
    assert all(word in text for word in ("mode", "/words", "cdr", "LaserScan", "different fields"))


def test_what_the_protobuf_writer_writes_is_read(tmp_path):
    with open(tmp_path / "robot.mcap", "wb") as file, ProtobufWriter(file) as writer:
        for i in range(3):
            pose = PoseInFrame(frame_id="map")
            pose.pose.position.x, pose.pose.orientation.w = i, 1
            writer.write_message("/robot/pose", pose, log_time=10 + i, publish_time=9)
            both = FrameTransforms()
            for child in ("wheel", "arm"):
                transform = FrameTransform(parent_frame_id="base", child_frame_id=child)
                transform.translation.y, transform.rotation.z = i, len(child)
                both.transforms.append(transform)
            writer.write_message("/tf", both, log_time=11 + i, publish_time=9)
            joints = JointStates(joints=[JointState(name="knee", position=i), JointState(name="hip", position=2)])
            writer.write_message("/joints", joints, log_time=12 + i, publish_time=9)
    source = mcap.read(tmp_path / "robot.mcap")
    take = next(source.takes())
    pose = source.sensors["observation.robot_pose"]
    assert (pose.names, pose.frame, pose.dtype, pose.units["z_m"]) == (messages.POSE_NAMES, "map", "float64", "m")
    assert np.stack(take.readings["observation.robot_pose"].values).tolist() == [
        [i, 0, 0, 1, 0, 0, 0] for i in range(3)
    ]
    wheel = take.readings["observation.tf_wheel"]
    assert np.stack(wheel.values).tolist() == [[0, i, 0, 0, 0, 0, 5] for i in range(3)]
    assert np.array_equal(wheel.time_s, np.array([1, 2, 3]) / 1e9) and take.start_ns == 10
    assert source.sensors["observation.tf_arm"].facts == {"child_frame": "arm"}
    assert "joints.knee.position" in source.sensors["observation.joints"].names


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4, "chunk_size": 100},
        {"compression": CompressionType.ZSTD, "index_types": IndexType.NONE},
        {"use_chunking": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False, "use_summary_offsets": False},
    ],
)
def test_every_way_of_laying_out_a_file_is_read(tmp_path, options):
    stranger = Stranger(tmp_path / "layout.mcap", **options)
    for i in range(50):
        stranger.add("/a", "my.A", {"value": i})
        stranger.add("/b", "my.B", {"value": -i})
    source = mcap.read(stranger.finish())
    take = next(source.takes())
    assert np.stack(take.readings["observation.a"].values)[:, 0].tolist() == list(range(50))
    assert np.stack(take.readings["observation.b"].values)[:, 0].tolist() == [-i for i in range(50)]
    assert source.notes == () and np.allclose(take.readings["observation.b"].time_s, np.arange(50) * 0.002 + 0.001)


# -- video -------------------------------------------------------------------------------------------------------------


def _moving(count: int) -> np.ndarray:
    y, x = np.mgrid[:32, :48]
    return np.stack([np.stack([x * 5, y * 7, np.full_like(x, 4 * i)], 2) for i in range(count)]).astype(np.uint8)


def _filmed(path, frames: np.ndarray, first: int = 0, **options):
    """Frames as H.264 messages of the topic /observation/images/front, from message `first` on."""
    codec = av.CodecContext.create("libx264", "w")
    codec.height, codec.width, codec.pix_fmt, codec.time_base = *frames.shape[1:3], "yuv420p", Fraction(1, 30)
    codec.options = {"preset": "veryfast", "tune": "zerolatency", "crf": "18", "g": "30", "bf": "0", "threads": "1"}
    stranger = Stranger(path, **options)
    for i, frame in enumerate(frames):
        picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
        picture.pts = i
        data = b"".join(bytes(packet) for packet in codec.encode(picture))
        if i >= first:
            message = {"format": "h264", "data": memoryview(data)}
            stranger.add("/observation/images/front", messages.VIDEO, message)
    return stranger.finish()


FRONT = "observation.images.front"


def test_video_is_read_in_any_order(tmp_path):
    frames = _moving(50)
    values = next(mcap.read(_filmed(tmp_path / "video.mcap", frames)).takes()).readings[FRONT].values
    in_order = np.stack([values[i] for i in range(50)])
    assert np.abs(in_order.astype(int) - frames).mean() < 4
    for i in (49, 0, 31, 30, 29, 5, 5, 48):
        assert np.array_equal(values[i], in_order[i])


def test_video_that_begins_between_keyframes_loses_only_those_frames(tmp_path):
    source = mcap.read(_filmed(tmp_path / "video.mcap", _moving(40), 20))
    assert any("first 10 frames" in note for note in source.notes)
    readings = next(source.takes()).readings[FRONT]
    assert len(readings.values) == 10 and readings.time_s[0] == 0.010
    assert abs(int(readings.values[9][..., 2].mean()) - 4 * 39) < 4


# -- damage ------------------------------------------------------------------------------------------------------------


def _small(path, count=40, **options):
    stranger = Stranger(path, chunk_size=400, **options)
    for i in range(count):
        stranger.add("/a", "my.A", {"value": i})
    return stranger.finish()


@pytest.mark.parametrize("options", [{}, pytest.param({"use_chunking": False}, marks=pytest.mark.slow)])
def test_a_file_cut_at_any_byte_is_read_up_to_there(tmp_path, options):
    whole = _small(tmp_path / "whole.mcap", 16, **options).read_bytes()
    cut = tmp_path / "cut.mcap"
    most = 0
    for size in range(len(whole)):
        cut.write_bytes(whole[:size])
        try:
            source = mcap.read(cut)
        except DatasetError:
            assert most == 0
            continue
        values = next(source.takes()).readings["observation.a"].values
        assert np.stack(values)[:, 0].tolist() == list(range(len(values))) and len(values) >= most
        most = len(values)
        assert size >= len(whole) - 8 or any("cut off" in note for note in source.notes)
    assert most == 16


def test_flipped_bits_never_crash(tmp_path):
    takes = _take(7, 2)
    mcap_write.write(_source(takes, sensors=SENSORS), tmp_path / "ours.mcap")
    small = _small(tmp_path / "small.mcap")
    rng = np.random.default_rng(11)
    file = tmp_path / "flipped.mcap"
    for path, cases in ((small, 250), (tmp_path / "ours.mcap", 100)):
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(cases):
            flipped = whole.copy()
            flipped[rng.integers(len(whole), size=rng.integers(1, 4))] ^= np.uint8(1 << rng.integers(8))
            file.write_bytes(flipped.tobytes())
            _numbers_of_any(file)


def _numbers_of_any(path) -> None:
    try:
        source = mcap.read(path)
        for take in source.takes():
            for name, readings in take.readings.items():
                assert len(readings.time_s) == len(readings.values) and (np.diff(readings.time_s) >= 0).all()
                for i in range(len(readings.values)):
                    try:
                        value = readings.values[i]
                    except DatasetError:
                        continue
                    sensor = source.sensors[name]
                    assert value.dtype == sensor.dtype
                    assert value.shape == sensor.shape or sensor.kind == "points"
    except DatasetError:
        pass


def _flip(path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    path.write_bytes(data)


def _chunks(path) -> list[int]:
    """Where the content of each chunk lies, about its middle."""
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary
    return [index.chunk_start_offset + index.chunk_length // 2 for index in summary.chunk_indexes]


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
def test_a_damaged_chunk_costs_itself_alone_and_is_said(tmp_path, compression):
    path = _small(tmp_path / "a.mcap", compression=compression)
    chunks = _chunks(path)
    _flip(path, chunks[len(chunks) // 2])
    source = mcap.read(path)
    kept = np.stack(next(source.takes()).readings["observation.a"].values)[:, 0].astype(int).tolist()
    lost = sorted(set(range(40)) - set(kept))
    assert 0 < len(lost) < 20 and lost == list(range(lost[0], lost[0] + len(lost))) and kept == sorted(kept)
    assert [note for note in source.notes if "damaged" in note] and len(source.notes) == 1


@pytest.mark.parametrize("which", [0, 2, -1])
def test_a_damaged_chunk_of_film_costs_no_more_than_up_to_the_next_keyframe(tmp_path, which):
    path = _filmed(tmp_path / "film.mcap", _moving(100), chunk_size=2_000)
    whole = next(mcap.read(path).takes()).readings[FRONT]
    chunks = _chunks(path)
    assert len(chunks) >= 5
    _flip(path, chunks[which])
    source = mcap.read(path)
    found = next(source.takes()).readings[FRONT]
    assert len(whole.values) == 100 and 100 - 60 <= len(found.values) < 100
    at = np.rint(found.time_s * 1000 + (next(source.takes()).start_ns - 5 * 10**9) / 10**6).astype(int)
    for i, frame in zip(at.tolist(), found.values, strict=True):
        assert np.array_equal(frame, whole.values[i]), "what is given is what was filmed"
    text = " ".join(source.notes)
    assert "damaged" in text
    out = tmp_path / "rows"
    told = write_source(source, out)
    assert any("damaged" in sentence for sentence in told)
    assert Dataset(out).length == len(found.values)


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _hostile_chunk(unpacked: int, compression: bytes, data: bytes) -> bytes:
    body = (
        struct.pack("<QQQII", 0, 1, unpacked, 0, len(compression)) + compression + struct.pack("<Q", len(data)) + data
    )
    return mcap_index.MAGIC + _record(1, struct.pack("<II", 0, 0)) + _record(6, body)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x89MCAP",
        mcap_index.MAGIC,
        mcap_index.MAGIC * 2,
        mcap_index.MAGIC + bytes(5000),
        mcap_index.MAGIC + struct.pack("<BQ", 5, 2**64 - 1),
        mcap_index.MAGIC + _record(3, b"\1\0" + struct.pack("<I", 2**32 - 1)),
        _hostile_chunk(2**62, b"zstd", zstandard.compress(bytes(10))),
        _hostile_chunk(2**20, b"zstd", zstandard.compress(bytes(2**26))),
        _hostile_chunk(2**20, b"lz4", b"\x04\x22\x4d\x18garbage"),
        _hostile_chunk(10, b"brotli", bytes(10)),
        _hostile_chunk(64, b"", b"\x05" + struct.pack("<Q", 2**63) + bytes(55)),
    ],
    ids=range(12),
)
def test_files_made_to_harm_are_refused_within_bounded_memory(tmp_path, data):
    (tmp_path / "bad.mcap").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match="bad.mcap"):
            mcap.read(tmp_path / "bad.mcap")
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


def test_messages_made_to_harm_are_told(tmp_path):
    import zlib

    huge = b"IHDR" + struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + huge + struct.pack(">I", zlib.crc32(huge))
    stranger = Stranger(tmp_path / "bad.mcap")
    stranger.add(
        "/huge", "foxglove.RawImage", {"width": 10**9, "height": 10**9, "step": 0, "encoding": "rgb8", "data": ""}
    )
    stranger.add(
        "/short", "foxglove.RawImage", {"width": 9, "height": 9, "step": 27, "encoding": "rgb8", "data": "AAAA"}
    )
    stranger.add("/bomb", "foxglove.CompressedImage", {"data": memoryview(bomb)})
    stranger.add("/deep", "my.Deep", b"[" * 100_000)
    stranger.add("/deeper", "my.Deeper", b'{"a":' * 900 + b"1" + b"}" * 900)
    stranger.add("/digits", "my.Digits", b'{"a": 1' + b"0" * 400 + b"}")
    stranger.add("/many", "my.Many", {"a": [0] * 70_000})
    stranger.add("/base64", "foxglove.CompressedImage", {"data": "no!"})
    stranger.add("/points", "foxglove.PointCloud", {"point_stride": 0, "fields": [{}], "data": "AAAA"})
    stranger.add("/proto", "my.Proto", b"\xff", "protobuf", "protobuf", b"\xff\xff")
    stranger.add("/pose", "foxglove.PoseInFrame", {"pose": [1]})
    stranger.add("/video", messages.VIDEO, {"format": "h264", "data": memoryview(b"\0\0\1\x65" + bytes(50))})
    stranger.add("/film", messages.VIDEO, {"format": "mpeg2", "data": ""})
    with pytest.raises(DatasetError, match="no known messages"):
        mcap.read(stranger.finish())
    stranger = Stranger(tmp_path / "half.mcap")
    stranger.add("/good", "my.Good", {"a": 1})
    stranger.add("/bad", "my.Bad", b"{")
    source = mcap.read(stranger.finish())
    assert list(source.sensors) == ["observation.good"] and "'/bad'" in source.notes[0]


def test_broken_metadata_is_noted_and_the_messages_are_read(tmp_path):
    stranger = Stranger(tmp_path / "meta.mcap")
    stranger.writer.add_metadata("terrella.sensors", {"action": '{"kind": "spell"}', "b": "{", "c": '{"topic": "/a"}'})
    stranger.writer.add_metadata("terrella.take", {"zero_ns": "-5", "start_ns": '"noon"', "facts": "[]"})
    stranger.writer.add_metadata("weather", {"rain": "yes"})
    stranger.add("/a", "my.A", {"value": 3})
    source = mcap.read(stranger.finish())
    assert len(source.notes) == 7 and any("weather" in note for note in source.notes)
    take = next(source.takes())
    assert take.start_ns == 5 * 10**9 and take.readings["observation.a"].values[0].tolist() == [3]


def test_a_folder_with_a_broken_file_loses_that_file(tmp_path):
    mcap_write.write(_source(_take(1), _take(2), _take(3)), tmp_path / "set")
    broken = tmp_path / "set" / "take-000001.mcap"
    broken.write_bytes(b"not at all")
    source = mcap.read(tmp_path / "set")
    assert [take.task for take in source.takes()] == ["task 1", "task 3"]
    assert any("take-000001.mcap is left out" in note for note in source.notes)
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "nowhere", tmp_path / "nowhere.mcap"):
        with pytest.raises(DatasetError, match="no .mcap file"):
            mcap.read(path)


def test_a_file_larger_than_memory_is_read_one_chunk_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_index, "_CACHE_BYTES", 2**20)
    sensor = Sensor("observation.images.front", "image", (200, 200, 3), "uint8")
    noise = np.random.default_rng(0).integers(0, 255, (300, 200, 3), np.uint8)
    values = Lazy(100, lambda i: noise[i : i + 200] ^ np.uint8(i))
    source = _source(Take({sensor.name: Readings(np.arange(100) / 30, values)}), sensors=[sensor])
    tracemalloc.start()
    try:
        mcap_write.write(source, tmp_path / "big.mcap")
        for readings in next(mcap.read(tmp_path / "big.mcap").takes()).readings.values():
            assert all(np.array_equal(readings.values[i], values[i]) for i in range(100))
        assert (tmp_path / "big.mcap").stat().st_size > 11e6
        assert tracemalloc.get_traced_memory()[1] < 11e6
    finally:
        tracemalloc.stop()


# -- writing what cannot be written ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: Readings(r.time_s, r.values[:-1]), "times"),
        (lambda r: Readings(r.time_s * np.nan, r.values), "times"),
        (lambda r: Readings(r.time_s - 2e9, r.values), "mend its start"),
        (lambda r: Readings(r.time_s, np.zeros((5, 3), "f4")), r"float32 \[3\] where float32 \[2\]"),
        (lambda r: Readings(r.time_s, np.zeros((5, 2), "f8")), r"float64 \[2\] where float32 \[2\]"),
    ],
)
def test_readings_that_are_not_as_declared_are_refused(tmp_path, change, message):
    take = _take(1)
    take = Take({**take.readings, "action": change(take.readings["action"])}, start_ns=START_NS)
    for path in (tmp_path / "take.mcap", tmp_path / "set"):
        with pytest.raises(DatasetError, match=message):
            mcap_write.write(_source(_take(0), take) if path.suffix == "" else _source(take), path)
    assert list(tmp_path.iterdir()) == []


def test_paths_and_options_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="more than one take"):
        mcap_write.write(_source(_take(1), _take(2)), tmp_path / "one.mcap")
    with pytest.raises(DatasetError, match="no takes"):
        mcap_write.write(_source(), tmp_path / "set")
    with pytest.raises(DatasetError, match="does not declare"):
        mcap_write.write(_source(_take(1), sensors=SENSORS[1:]), tmp_path / "set")
    with pytest.raises(DatasetError, match="JSON"):
        mcap_write.write(_source(Take(_take(1).readings, facts={"x": object()})), tmp_path / "set")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "taken.mcap").write_bytes(b"mine")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").write_bytes(b"mine")
    for name in ("taken.mcap", "taken"):
        with pytest.raises(DatasetError, match="exists already"):
            mcap_write.write(_source(_take(1)), tmp_path / name)
    with pytest.raises(DatasetError, match="was not written"):
        mcap_write.write(_source(_take(1)), tmp_path / "taken.mcap" / "set")


@pytest.mark.parametrize(
    ("leaf", "missing"),
    [
        ("message_encoder", "foxglove"),
        ("messages", "google.protobuf"),
        ("mcap_index", "zstandard"),
        ("mcap_write", "mcap.writer"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(monkeypatch, leaf, missing):
    monkeypatch.delitem(sys.modules, f"terrella.exchange.formats.{leaf}")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(DatasetError, match=r"pip install 'terrella\[mcap\]'"):
        importlib.import_module(f"terrella.exchange.formats.{leaf}")
