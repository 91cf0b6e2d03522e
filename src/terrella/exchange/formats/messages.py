"""Foxglove's well-known messages, JSON and any Protobuf, as they stand in an MCAP file: a message becomes a reading."""

import base64
import binascii
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import simplejpeg
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Kind, Sensor
from . import rows

try:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from google.protobuf.message import Message
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

POSE_NAMES = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
VECTOR = "terrella.Vector"
CALIBRATION = "foxglove.CameraCalibration"
TRANSFORM, TRANSFORMS = "foxglove.FrameTransform", "foxglove.FrameTransforms"
VIDEO = "foxglove.CompressedVideo"
MAX_NUMBERS = 2**16  # in one vector
_MAX_DEPTH = 16  # levels of nested fields that are read
_POINT_TYPES = {i + 1: np.dtype(name) for i, name in enumerate(("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"))}
_COLOUR = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "8UC3": (3, (2, 1, 0)), "mono8": (1, (0, 0, 0))}
_COLOUR |= {"8UC1": (1, (0, 0, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))}
_CLOCK = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_NOT_NUMBERS = ("timestamp", "stamp", "header")  # fields of an undeclared message that hold its time


def unpacker(schema_name: str, schema_encoding: str, schema: bytes, message_encoding: str) -> Callable[[bytes], dict]:
    """A function that unpacks messages of a file's schema into fields; DatasetError where the schema cannot be used."""
    if message_encoding == "json":
        return unpack_json
    if message_encoding != "protobuf" or schema_encoding != "protobuf":
        coding = message_encoding or "unknown"
        raise DatasetError(f"its messages are '{coding}' ({schema_name}), and only JSON and Protobuf are read")
    try:
        return _unpack_with(_class_in(schema_name, schema))
    except Exception as error:  # the library fails in many ways on foreign descriptors
        raise DatasetError(f"its Protobuf schema '{schema_name}' cannot be used ({error})") from error


def unpack_json(data: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"it is not JSON ({error})") from error
    if not isinstance(fields, dict):
        raise DatasetError("it is not a JSON object")
    return fields


def _unpack_with(cls: Any) -> Callable[[bytes], dict[str, Any]]:
    def unpack(data: bytes) -> dict[str, Any]:
        message = cls()
        try:
            message.ParseFromString(data)
            return _plain(message)
        except Exception as error:  # DecodeError, and other errors from hostile bytes
            raise DatasetError(f"it is not a {cls.DESCRIPTOR.full_name} ({error})") from error

    return unpack


def _plain(message: Any) -> dict[str, Any]:
    """The message's fields by name, without unset inner messages, whose types may be recursive."""
    if message.DESCRIPTOR.full_name in _CLOCK:
        return {"sec": message.seconds, "nsec": message.nanos}
    fields = {}
    for name in message.DESCRIPTOR.fields_by_name:
        value = getattr(message, name)
        if isinstance(value, Message):
            if message.HasField(name):
                fields[name] = _plain(value)
        elif isinstance(value, (str, bytes, int, float)):
            fields[name] = value
        elif hasattr(value, "items"):
            fields[name] = {str(k): _plain(v) if isinstance(v, Message) else v for k, v in value.items()}
        else:
            fields[name] = [_plain(item) if isinstance(item, Message) else item for item in value]
    return fields


def _class_in(schema_name: str, schema: bytes) -> Any:
    """The class of a message in a FileDescriptorSet, in its own descriptor pool."""
    pool = descriptor_pool.DescriptorPool()
    waiting = {file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file}

    def add(file: Any) -> None:
        for name in file.dependency:
            if name in waiting:
                add(waiting.pop(name))
        pool.AddSerializedFile(file.SerializeToString())

    while waiting:
        add(waiting.pop(next(iter(waiting))))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name))


@dataclass(frozen=True)
class Reading:
    """The sensor reading in one message."""

    kind: Kind
    value: np.ndarray
    names: tuple[str, ...] = ()
    frame: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)
    by_path: bool = False  # the names are paths of fields, and may differ between messages
    left_out: tuple[str, ...] = ()  # parts of the message that `value` does not hold, such as text fields


def decode(schema_name: str, fields: Mapping[str, Any]) -> Reading:
    """The reading in a message other than video and transforms; DatasetError where it is broken."""
    try:
        return _DECODERS.get(schema_name, _numbers)(fields)
    except DatasetError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DatasetError(f"it is not a valid {schema_name} ({type(error).__name__}: {error})") from error


def fit(reading: Reading, sensor: Sensor) -> np.ndarray:
    """The reading as an array of the sensor's shape and dtype; missing numbers become NaN."""
    value = reading.value
    if reading.kind != sensor.kind:
        raise DatasetError(f"it shows {reading.kind} where '{sensor.name}' is {sensor.kind}")
    if sensor.kind == "vector":
        if reading.names != sensor.names and reading.by_path:
            numbers = dict(zip(reading.names, value.tolist()))
            value = np.array([numbers.get(name, math.nan) for name in sensor.names])
        if value.size != math.prod(sensor.shape):
            raise DatasetError(f"it has {value.size} numbers where '{sensor.name}' has {math.prod(sensor.shape)}")
        target = np.dtype(sensor.dtype)
        if value.dtype == np.int64 and target == np.uint64:
            return value.view(np.uint64).reshape(sensor.shape)
        with np.errstate(invalid="ignore"):
            return value.astype(target).reshape(sensor.shape)
    if not (value.shape[1:] == sensor.shape[1:] if sensor.kind == "points" else value.shape == sensor.shape):
        raise DatasetError(f"it is {list(value.shape)} where '{sensor.name}' is {list(sensor.shape)}")
    return value


def calibration_of(fields: Mapping[str, Any]) -> dict[str, object]:
    """facts["calibration"]: width, height, distortion_model, D, K, R, P and frame_id, as Foxglove names them."""
    try:
        values: dict[str, object] = {name: int(fields.get(name) or 0) for name in ("width", "height")}
        values["distortion_model"] = str(fields.get("distortion_model") or "")
        values |= {name: [float(number) for number in fields.get(name) or ()] for name in ("D", "K", "R", "P")}
        return values | {"frame_id": str(fields.get("frame_id") or "")}
    except (TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"it is not a valid {CALIBRATION} ({error})") from error


def transforms_of(schema_name: str, fields: Mapping[str, Any]) -> Iterator[tuple[str, str, np.ndarray]]:
    """(parent frame, child frame, float64 [7] as POSE_NAMES) of each transform in the message."""
    try:
        for item in fields.get("transforms") or () if schema_name == TRANSFORMS else (fields,):
            value = _joined(item.get("translation"), item.get("rotation"))
            yield str(item.get("parent_frame_id") or ""), str(item.get("child_frame_id") or ""), value
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"it is not a valid {schema_name} ({error})") from error


def video_of(fields: Mapping[str, Any]) -> tuple[str, bytes]:
    """(format, data) of a CompressedVideo message."""
    return str(fields.get("format") or "").lower(), _bytes(fields)


def _compressed_image(fields: Mapping[str, Any]) -> Reading:
    data, frame = _bytes(fields), str(fields.get("frame_id") or "")
    if data[:2] == b"\xff\xd8":
        try:
            height, width = simplejpeg.decode_jpeg_header(data)[:2]
            rows.check_size(int(height), int(width), "its picture")
            return Reading("image", simplejpeg.decode_jpeg(data, colorspace="RGB"), frame=frame)
        except ValueError as error:
            raise DatasetError(f"its JPEG is broken ({error})") from error
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "WEBP")) as picture:
            rows.check_size(picture.height, picture.width, "its picture")
            if picture.mode.startswith("I"):
                return Reading("depth", rows.metres(np.asarray(picture)), frame=frame)
            return Reading("image", np.asarray(picture.convert("RGB")), frame=frame)
    except rows.PICTURE_ERRORS as error:
        raise DatasetError(f"its picture is not a valid JPEG, PNG or WebP ({error})") from error


def _raw_image(fields: Mapping[str, Any]) -> Reading:
    width, height, step = (int(fields[name]) for name in ("width", "height", "step"))
    encoding, data = str(fields["encoding"]), _bytes(fields)
    rows.check_size(height, width, "its picture")
    channels = _COLOUR[encoding][0] if encoding in _COLOUR else {"16UC1": 2, "32FC1": 4}.get(encoding, 0)
    if not channels:
        raise DatasetError(f"its pixels are '{encoding}', only rgb8, bgr8, mono8, rgba8, 16UC1, 32FC1 are read")
    if step < width * channels or len(data) < step * (height - 1) + width * channels:
        raise DatasetError(f"its {len(data)} bytes are too few for {width} x {height} pixels of {encoding}")
    lines = np.ndarray((height, width * channels), np.uint8, data, strides=(step, 1))
    frame = str(fields.get("frame_id") or "")
    if encoding == "32FC1":
        return Reading("depth", np.ascontiguousarray(lines).view("<f4").astype(np.float32), frame=frame)
    if encoding == "16UC1":
        return Reading("depth", rows.metres(np.ascontiguousarray(lines).view("<u2")), frame=frame)
    pixels = lines.reshape(height, width, channels)[:, :, list(_COLOUR[encoding][1])]
    return Reading("image", pixels, frame=frame, left_out=("alpha",) if channels == 4 else ())


def _point_cloud(fields: Mapping[str, Any]) -> Reading:
    data, stride, columns = _bytes(fields), int(fields["point_stride"]), list(fields["fields"])
    if not 0 < stride <= 2**16 or not columns or len(columns) > 256 or len(data) % stride:
        raise DatasetError(f"its {len(data)} bytes do not hold points of {stride} bytes and {len(columns)} fields")
    count, values, names = len(data) // stride, [], []
    for column in columns:
        kind, offset = _POINT_TYPES.get(int(column.get("type") or 0)), int(column.get("offset") or 0)
        if kind is None or not 0 <= offset <= stride - kind.itemsize:
            raise DatasetError(f"its field '{column.get('name')}' has no known type or lies outside the point")
        if count:
            values.append(np.ndarray((count,), kind, data, offset, (stride,)))
        names.append(str(column.get("name") or f"c{len(names)}"))
    with np.errstate(over="ignore"):
        points = np.stack(values, 1).astype(np.float32) if count else np.zeros((0, len(columns)), np.float32)
    facts: dict[str, object] = {}
    pose = fields.get("pose")
    if pose:
        place = _joined(pose.get("position"), pose.get("orientation"))
        if place.any() and not np.array_equal(place, [0, 0, 0, 1, 0, 0, 0]):
            facts["pose_in_frame"] = dict(zip(POSE_NAMES, place.tolist()))
    rounded = tuple(
        f"all digits of '{name}'" for name, column in zip(names, columns) if int(column["type"]) in (5, 6, 8)
    )
    return Reading("points", points, tuple(names), str(fields.get("frame_id") or ""), facts, left_out=rounded)


def _pose(fields: Mapping[str, Any]) -> Reading:
    pose = fields.get("pose") or {}
    value = _joined(pose.get("position"), pose.get("orientation"))
    return Reading("vector", value, POSE_NAMES, str(fields.get("frame_id") or ""))


def _vector(fields: Mapping[str, Any]) -> Reading:
    names = tuple(str(name) for name in fields.get("names") or ())
    if fields.get("integers"):
        return Reading("vector", np.array([int(number) for number in fields["integers"]], np.int64), names)
    return Reading("vector", np.array([float(number) for number in fields.get("values") or ()]), names)


def _numbers(fields: Mapping[str, Any]) -> Reading:
    """A message of any other type: its numbers, named by the paths of their fields."""
    numbers: dict[str, float] = {}
    left_out: list[str] = []

    def gather(path: str, value: Any, depth: int) -> None:
        if len(numbers) > MAX_NUMBERS:
            raise DatasetError(f"it has more than {MAX_NUMBERS} numbers")
        if isinstance(value, (bool, int, float)):
            numbers[path] = float(value)
        elif value in ("NaN", "Infinity", "-Infinity"):
            numbers[path] = float(value)
        elif isinstance(value, (dict, list)) and depth < _MAX_DEPTH:
            for name, item in _items(value):
                gather(f"{path}.{name}" if path else name, item, depth + 1)
        elif len(left_out) < 8:
            left_out.append(path)

    gather("", {name: value for name, value in fields.items() if name not in _NOT_NUMBERS}, 0)
    if not numbers:
        raise DatasetError("it holds no numbers")
    frame = fields.get("frame_id")
    value = np.array(list(numbers.values()))
    frame = frame if isinstance(frame, str) else ""
    return Reading("vector", value, tuple(numbers), frame, by_path=True, left_out=tuple(left_out))


def _items(value: dict | list) -> Iterator[tuple[str, Any]]:
    """Fields by name; items of a list by index, or by their "name" if each has a unique one."""
    if isinstance(value, dict):
        yield from ((str(name), item) for name, item in value.items())
        return
    named = [item.get("name") if isinstance(item, dict) else None for item in value]
    if value and all(isinstance(name, str) and name for name in named) and len(set(named)) == len(named):
        for name, item in zip(named, value):
            yield str(name), {key: inner for key, inner in item.items() if key != "name"}
    else:
        yield from ((str(i), item) for i, item in enumerate(value))


def _bytes(fields: Mapping[str, Any]) -> bytes:
    data = fields.get("data", b"")
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except (binascii.Error, ValueError) as error:
            raise DatasetError(f"its data are not base64 ({error})") from error
    if not isinstance(data, bytes):
        raise DatasetError("its data are not bytes")
    return data


def _joined(position: Any, orientation: Any) -> np.ndarray:
    position, orientation = position or {}, orientation or {}
    where = [float(position.get(axis) or 0.0) for axis in "xyz"]
    return np.array([*where, *(float(orientation.get(part) or 0.0) for part in "wxyz")])


_DECODERS: dict[str, Callable[[Mapping[str, Any]], Reading]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.PointCloud": _point_cloud,
    "foxglove.PoseInFrame": _pose,
    VECTOR: _vector,
}
