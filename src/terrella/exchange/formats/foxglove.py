"""Foxglove's well-known messages, in JSON and in Protobuf: one reading of a sensor is one message."""

from __future__ import annotations

import base64
import binascii
import io
import json
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import Any

import av
import numpy as np
import simplejpeg
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Kind, Sensor

try:
    from foxglove_schemas_protobuf import (
        CameraCalibration_pb2,
        CompressedImage_pb2,
        CompressedVideo_pb2,
        FrameTransform_pb2,
        PointCloud_pb2,
        PoseInFrame_pb2,
        RawImage_pb2,
    )
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
    from google.protobuf.message import Message
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

POSE_NAMES = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
VECTOR = "terrella.Vector"
CALIBRATION = "foxglove.CameraCalibration"
TRANSFORM, TRANSFORMS = "foxglove.FrameTransform", "foxglove.FrameTransforms"
VIDEO = "foxglove.CompressedVideo"
IMAGE_CODINGS = ("png", "jpeg", "raw", "h264")
MAX_PIXELS = 2**26
MAX_NUMBERS = 2**16  # in one vector
_JPEG_QUALITY = 90
_DEEPEST = 16  # levels of nesting that are looked into
_POINT_TYPES = {i + 1: np.dtype(name) for i, name in enumerate(("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"))}
_COLOUR = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "8UC3": (3, (2, 1, 0)), "mono8": (1, (0, 0, 0))}
_COLOUR |= {"8UC1": (1, (0, 0, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))}
_CLOCK = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_NOT_NUMBERS = ("timestamp", "stamp", "header")  # of a message that nobody declared: its time, not its values


# -- messages: a plain dict of fields <-> bytes ------------------------------------------------------------------------


@dataclass(frozen=True)
class Codec:
    """One type of message in one encoding: `pack` makes bytes of a dict of its fields, `unpack` a dict of the bytes."""

    schema_name: str
    schema_encoding: str
    schema: bytes
    message_encoding: str
    pack: Callable[[Mapping[str, Any]], bytes]
    unpack: Callable[[bytes], dict[str, Any]]


@cache
def codec(schema_name: str, encoding: str) -> Codec:
    """A well-known message, or `terrella.Vector`, in "protobuf" or "json"; times are {"sec", "nsec"}."""
    cls = _vector_class() if schema_name == VECTOR else _WELL_KNOWN[schema_name]
    if encoding == "json":
        schema = json.dumps(_json_schema(cls.DESCRIPTOR)).encode()
        return Codec(schema_name, "jsonschema", schema, "json", _pack_json, unpack_json)
    if encoding != "protobuf":
        raise DatasetError(f"Messages are written as 'protobuf' or 'json', not as '{encoding}'.")

    def pack(fields: Mapping[str, Any]) -> bytes:
        message = cls()
        _fill(message, fields)
        return message.SerializeToString()

    return Codec(schema_name, "protobuf", _descriptors(cls), "protobuf", pack, _unpack_with(cls))


def foreign(schema_name: str, schema_encoding: str, schema: bytes, message_encoding: str) -> Callable[[bytes], dict]:
    """How to unpack the messages of a file's own schema; DatasetError where that cannot be done."""
    if message_encoding == "json":
        return unpack_json
    if message_encoding != "protobuf" or schema_encoding != "protobuf":
        coding = message_encoding or "unknown"
        raise DatasetError(f"its messages are '{coding}' ({schema_name}), and only JSON and Protobuf are read")
    try:
        return _unpack_with(_class_in(schema_name, schema))
    except Exception as error:  # whatever the library makes of a stranger's descriptors
        raise DatasetError(f"its Protobuf schema '{schema_name}' cannot be used ({error})") from error


def unpack_json(data: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"it is no JSON ({error})") from error
    if not isinstance(fields, dict):
        raise DatasetError("it is no JSON object")
    return fields


def stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}


def _pack_json(fields: Mapping[str, Any]) -> bytes:
    return json.dumps(_jsonable(fields), separators=(",", ":")).encode()


def _jsonable(value: Any) -> Any:
    """As Protobuf's own JSON has it: bytes in base64, what is not finite by name."""
    if isinstance(value, Mapping):
        return {name: _jsonable(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(item) for item in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _fill(message: Any, fields: Mapping[str, Any]) -> None:
    if message.DESCRIPTOR.full_name in _CLOCK:
        message.seconds, message.nanos = fields["sec"], fields["nsec"]
        return
    for name, value in fields.items():
        if isinstance(value, Mapping):
            getattr(message, name).SetInParent()
            _fill(getattr(message, name), value)
        elif isinstance(value, (list, tuple)):
            into = getattr(message, name)
            for item in value:
                if isinstance(item, Mapping):
                    _fill(into.add(), item)
                else:
                    into.append(item)
        else:
            setattr(message, name, value)


def _unpack_with(cls: Any) -> Callable[[bytes], dict[str, Any]]:
    def unpack(data: bytes) -> dict[str, Any]:
        message = cls()
        try:
            message.ParseFromString(data)
            return _plain(message)
        except Exception as error:  # DecodeError, and whatever else hostile bytes bring up
            raise DatasetError(f"it is no {cls.DESCRIPTOR.full_name} ({error})") from error

    return unpack


def _plain(message: Any) -> dict[str, Any]:
    """The message's fields by name; an unset message within is left out, since its type may hold itself."""
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


# -- schemas -----------------------------------------------------------------------------------------------------------

_WELL_KNOWN: dict[str, Any] = {
    "foxglove.CompressedImage": CompressedImage_pb2.CompressedImage,
    "foxglove.RawImage": RawImage_pb2.RawImage,
    "foxglove.PointCloud": PointCloud_pb2.PointCloud,
    "foxglove.PoseInFrame": PoseInFrame_pb2.PoseInFrame,
    VIDEO: CompressedVideo_pb2.CompressedVideo,
    TRANSFORM: FrameTransform_pb2.FrameTransform,
    CALIBRATION: CameraCalibration_pb2.CameraCalibration,
}


@cache
def _vector_class() -> Any:
    """terrella.Vector {timestamp, values, names, integers}: Foxglove has no message for a named row of numbers.

    `integers` repeats the values of 64-bit integers, which a double cannot hold.
    """
    kind = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="terrella/Vector.proto", package="terrella", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    vector = file.message_type.add(name="Vector")
    vector.field.add(
        name="timestamp",
        number=1,
        type=kind.TYPE_MESSAGE,
        label=kind.LABEL_OPTIONAL,
        type_name=".google.protobuf.Timestamp",
    )
    many = {"values": kind.TYPE_DOUBLE, "names": kind.TYPE_STRING, "integers": kind.TYPE_INT64}
    for number, (name, type_) in enumerate(many.items(), 2):
        vector.field.add(name=name, number=number, type=type_, label=kind.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(VECTOR))


def _descriptors(cls: Any) -> bytes:
    """The message's file and all that it imports, as MCAP wants a Protobuf schema."""
    files, seen = descriptor_pb2.FileDescriptorSet(), set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for imported in file.dependencies:
                add(imported)
            file.CopyToProto(files.file.add())

    add(cls.DESCRIPTOR.file)
    return files.SerializeToString()


def _class_in(schema_name: str, schema: bytes) -> Any:
    """The class of a message that a FileDescriptorSet describes, in a pool of its own."""
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


def _json_schema(descriptor: Any) -> dict[str, Any]:
    """The same message as a JSON schema: times are {sec, nsec}, bytes are base64."""
    if descriptor.full_name in _CLOCK:
        integer = {"type": "integer"}
        return {"type": "object", "properties": {"sec": integer, "nsec": integer}}
    proto = descriptor_pb2.DescriptorProto()
    descriptor.CopyToProto(proto)
    kind, properties = descriptor_pb2.FieldDescriptorProto, {}
    for described, entry in zip(descriptor.fields, proto.field, strict=True):
        if entry.type == kind.TYPE_MESSAGE:
            one = _json_schema(described.message_type)
        elif entry.type == kind.TYPE_BYTES:
            one = {"type": "string", "contentEncoding": "base64"}
        elif entry.type == kind.TYPE_ENUM:
            values = [{"title": value.name, "const": value.number} for value in described.enum_type.values]
            one = {"type": "integer", "oneOf": values}
        elif entry.type in (kind.TYPE_DOUBLE, kind.TYPE_FLOAT):
            one = {"type": "number"}
        else:
            one = {"type": {kind.TYPE_STRING: "string", kind.TYPE_BOOL: "boolean"}.get(entry.type, "integer")}
        properties[entry.name] = {"type": "array", "items": one} if entry.label == kind.LABEL_REPEATED else one
    return {"title": descriptor.full_name, "type": "object", "properties": properties}


# -- a reading becomes a message ---------------------------------------------------------------------------------------


class Encoder:
    """Makes messages of one sensor's readings, in their order in time (video depends on what came before).

    image: "png" (exact), "jpeg", "raw" (exact) or "h264"; a picture of odd size is not made H.264 but PNG.
    """

    def __init__(self, sensor: Sensor, encoding: str = "protobuf", image: str = "png"):
        if image not in IMAGE_CODINGS:
            raise DatasetError(f"Images are written as {', '.join(IMAGE_CODINGS)}, not as '{image}'.")
        self._sensor, self._fields = sensor, _Fields(sensor)
        self.note = ""
        name = VECTOR
        if sensor.kind == "image":
            if image == "h264" and (sensor.shape[0] % 2 or sensor.shape[1] % 2):
                image = "png"
                self.note = f"'{sensor.name}' is written as PNG: H.264 needs even sizes, and it is {sensor.shape[:2]}."
            elif image in ("jpeg", "h264"):
                self.note = f"'{sensor.name}' is written as {image.upper()}, which is not exact; 'png' is."
            name = {"raw": "foxglove.RawImage", "h264": VIDEO}.get(image, "foxglove.CompressedImage")
            self._make: Callable[[np.ndarray], dict] = getattr(self._fields, image)
        elif sensor.kind == "vector" and sensor.names == POSE_NAMES:
            child = sensor.facts.get("child_frame")
            name, self._make = (
                (TRANSFORM, self._fields.transform) if child else ("foxglove.PoseInFrame", self._fields.pose)
            )
        else:
            self._make = getattr(self._fields, sensor.kind)
            name = {"depth": "foxglove.RawImage", "points": "foxglove.PointCloud"}.get(sensor.kind, VECTOR)
        self.codec = codec(name, encoding)

    def __call__(self, value: np.ndarray, time_ns: int) -> bytes:
        """One message; DatasetError where the value is not what the sensor declares."""
        return self.codec.pack({"timestamp": stamp(time_ns), **self._make(checked(self._sensor, value))})


def checked(sensor: Sensor, value: Any) -> np.ndarray:
    """The value as an array of the sensor's shape and dtype; DatasetError where it has another."""
    value = np.asarray(value)
    if sensor.kind == "points":
        fits = value.ndim == 2 and value.shape[1:] == tuple(sensor.shape[1:])
    else:
        fits = value.shape == tuple(sensor.shape)
    if not fits or value.dtype != sensor.dtype:
        what = f"{value.dtype} {list(value.shape)} where {sensor.dtype} {list(sensor.shape)} is declared"
        raise DatasetError(f"A reading of '{sensor.name}' is {what}; mend the sensor's declaration or the reading.")
    return value


class _Fields:
    """The fields of each kind of message, but for the time."""

    def __init__(self, sensor: Sensor):
        self._sensor, self._video = sensor, None
        self._frame = {"frame_id": sensor.frame}

    def png(self, value: np.ndarray) -> dict:
        out = io.BytesIO()
        Image.fromarray(value).save(out, "PNG", compress_level=1)
        return {**self._frame, "data": out.getvalue(), "format": "png"}

    def jpeg(self, value: np.ndarray) -> dict:
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(value), quality=_JPEG_QUALITY, colorspace="RGB")
        return {**self._frame, "data": data, "format": "jpeg"}

    def raw(self, value: np.ndarray) -> dict:
        return self._pixels(value, "rgb8", 3)

    def depth(self, value: np.ndarray) -> dict:
        return self._pixels(value.astype("<f4"), "32FC1", 4)

    def h264(self, value: np.ndarray) -> dict:
        if self._video is None:
            self._video = _h264_encoder(value.shape[1], value.shape[0])
        return {**self._frame, "data": self._video(value), "format": "h264"}

    def points(self, value: np.ndarray) -> dict:
        columns = value.shape[1]
        names = self._sensor.names if len(self._sensor.names) == columns else _column_names(columns)
        fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate(names)]
        data = value.astype("<f4").tobytes()
        pose = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
        return {**self._frame, "pose": pose, "point_stride": 4 * columns, "fields": fields, "data": data}

    def pose(self, value: np.ndarray) -> dict:
        position, orientation = _place(value)
        return {**self._frame, "pose": {"position": position, "orientation": orientation}}

    def transform(self, value: np.ndarray) -> dict:
        translation, rotation = _place(value)
        child = str(self._sensor.facts["child_frame"])
        return {
            "parent_frame_id": self._sensor.frame,
            "child_frame_id": child,
            "translation": translation,
            "rotation": rotation,
        }

    def vector(self, value: np.ndarray) -> dict:
        flat = value.reshape(-1)
        fields: dict[str, Any] = {"values": flat.astype(np.float64).tolist(), "names": list(self._sensor.names)}
        if flat.dtype.kind in "iu" and flat.dtype.itemsize == 8:
            fields["integers"] = flat.view(np.int64).tolist()
        return fields

    def _pixels(self, value: np.ndarray, encoding: str, pixel_bytes: int) -> dict:
        height, width = value.shape[:2]
        size = {"width": width, "height": height, "encoding": encoding, "step": width * pixel_bytes}
        return {**self._frame, **size, "data": value.tobytes()}


def calibration_message(value: object, frame: str, time_ns: int, encoding: str) -> bytes | None:
    """A CameraCalibration of facts["calibration"] as `read` puts it there; None where it is of another form."""
    if not isinstance(value, Mapping) or len(value.get("K") or ()) != 9:
        return None
    fields: dict[str, Any] = {"timestamp": stamp(time_ns), "frame_id": str(value.get("frame_id", frame))}
    try:
        fields |= {name: int(value.get(name, 0)) for name in ("width", "height")}
        fields["distortion_model"] = str(value.get("distortion_model", ""))
        fields |= {name: [float(number) for number in value.get(name) or ()] for name in ("D", "K", "R", "P")}
        return codec(CALIBRATION, encoding).pack(fields)
    except (TypeError, ValueError):
        return None


def _column_names(columns: int) -> tuple[str, ...]:
    return (*"xyz", *(f"c{i}" for i in range(3, columns)))[:columns]


def _place(value: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
    x, y, z, qw, qx, qy, qz = value.astype(np.float64).tolist()
    return {"x": x, "y": y, "z": z}, {"x": qx, "y": qy, "z": qz, "w": qw}


def _h264_encoder(width: int, height: int) -> Callable[[np.ndarray], bytes]:
    """One message per frame: Annex B, no B-frames, the parameter sets with every keyframe."""
    options = {"preset": "veryfast", "tune": "zerolatency", "crf": "18", "g": "30", "bf": "0", "threads": "1"}
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt, codec.options = width, height, "yuv420p", options  # type: ignore[attr-defined]
    codec.time_base = Fraction(1, 30)  # nobody reads it: each message has its own time
    count = 0

    def encode(value: np.ndarray) -> bytes:
        nonlocal count
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(value), format="rgb24")
        frame.pts, count = count, count + 1
        return b"".join(bytes(packet) for packet in codec.encode(frame))  # type: ignore[attr-defined]

    return encode


# -- a message becomes a reading ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reading:
    """What one message shows.

    by_path:  whether its names are the paths of its fields, of which another message may have others.
    left_out: what of it is not in `value`, fields that are no numbers above all.
    """

    kind: Kind
    value: np.ndarray
    names: tuple[str, ...] = ()
    frame: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)
    by_path: bool = False
    left_out: tuple[str, ...] = ()


def decode(schema_name: str, fields: Mapping[str, Any]) -> Reading:
    """The reading that a message holds (video and transforms apart); DatasetError with the reason where it is broken."""
    try:
        return _DECODERS.get(schema_name, _numbers)(fields)
    except DatasetError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DatasetError(f"it is no valid {schema_name} ({type(error).__name__}: {error})") from error


def fit(reading: Reading, sensor: Sensor) -> np.ndarray:
    """The reading as an array of the sensor's shape and dtype; numbers that it lacks become NaN."""
    value = reading.value
    if reading.kind != sensor.kind:
        raise DatasetError(f"it shows {reading.kind} where '{sensor.name}' is {sensor.kind}")
    if sensor.kind == "vector":
        if reading.names != sensor.names and reading.by_path:
            found = dict(zip(reading.names, value.tolist()))
            value = np.array([found.get(name, math.nan) for name in sensor.names])
        if value.size != math.prod(sensor.shape):
            raise DatasetError(f"it has {value.size} numbers where '{sensor.name}' has {math.prod(sensor.shape)}")
        target = np.dtype(sensor.dtype)
        if value.dtype == np.int64 and target == np.uint64:
            return value.view(np.uint64).reshape(sensor.shape)
        with np.errstate(invalid="ignore"):
            return value.astype(target).reshape(sensor.shape)
    same = value.shape[1:] == sensor.shape[1:] if sensor.kind == "points" else value.shape == sensor.shape
    if not same:
        raise DatasetError(f"it is {list(value.shape)} where '{sensor.name}' is {list(sensor.shape)}")
    return value


def calibration_of(fields: Mapping[str, Any]) -> dict[str, object]:
    """What facts["calibration"] holds: width, height, distortion_model, D, K, R, P and frame_id, as Foxglove names them."""
    try:
        found: dict[str, object] = {name: int(fields.get(name) or 0) for name in ("width", "height")}
        found["distortion_model"] = str(fields.get("distortion_model") or "")
        found |= {name: [float(number) for number in fields.get(name) or ()] for name in ("D", "K", "R", "P")}
        return found | {"frame_id": str(fields.get("frame_id") or "")}
    except (TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"it is no valid {CALIBRATION} ({error})") from error


def transforms_of(schema_name: str, fields: Mapping[str, Any]) -> Iterator[tuple[str, str, np.ndarray]]:
    """(parent frame, child frame, float64 [7] as POSE_NAMES) of each transform in the message."""
    try:
        for item in fields.get("transforms") or () if schema_name == TRANSFORMS else (fields,):
            value = _joined(item.get("translation"), item.get("rotation"))
            yield str(item.get("parent_frame_id") or ""), str(item.get("child_frame_id") or ""), value
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"it is no valid {schema_name} ({error})") from error


class VideoDecoder:
    """Frames of a CompressedVideo channel by number, uint8 [H, W, 3].

    read(i) gives the data of message i. Decoding starts at the last keyframe before what is asked for, and goes on
    from where it stands when frames are asked for in order. One thread decodes at a time.
    """

    def __init__(self, read: Callable[[int], bytes], count: int, format: str):
        if format not in _KEY_UNITS:
            raise DatasetError(f"its video is '{format}', and only h264 and h265 are read")
        self._read, self._count, self._format = read, count, format
        self._codec: Any = None
        self._fed, self._given = 0, -1  # the next message to decode, the last picture that came out
        self._frames: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()

    def first_key(self) -> int | None:
        """The first message that a decoder can start from."""
        return next((i for i in range(self._count) if self._is_key(i)), None)

    def __call__(self, index: int) -> np.ndarray:
        with self._lock:
            if index not in self._frames:
                self._go_to(index)
                try:
                    self._decode(index)
                except BaseException:
                    self._codec = None  # start anew, at a keyframe
                    raise
            return self._frames[index]

    def _go_to(self, index: int) -> None:
        ahead = self._codec is not None and index > self._given
        if ahead and index <= self._fed + 2:
            return
        key = next((i for i in range(index, -1, -1) if self._is_key(i)), None)
        if key is None:
            raise DatasetError("no keyframe comes before it")
        if not (ahead and key <= self._fed):
            self._codec = av.CodecContext.create(_CODECS[self._format], "r")
            self._codec.thread_count = 1
            self._codec.options = {"max_pixels": str(MAX_PIXELS)}
            self._fed, self._given, self._frames = key, key - 1, {}

    def _decode(self, index: int) -> None:
        while index not in self._frames:
            if self._fed > min(index + _HELD_BACK, self._count):
                raise DatasetError("it decodes to no picture")
            packet = None  # the end: what the decoder still holds comes out
            if self._fed < self._count:
                packet = av.Packet(self._read(self._fed))
                packet.pts = self._fed
            try:
                pictures = self._codec.decode(packet)
                self._fed += 1
                for picture in pictures:
                    if picture.pts is not None:
                        self._given = picture.pts
                        self._frames[picture.pts] = picture.to_ndarray(format="rgb24")
            except (av.FFmpegError, ValueError, MemoryError) as error:
                raise DatasetError(f"its video cannot be decoded ({error})") from error
            for old in list(self._frames)[:-_REMEMBERED]:
                if old != index:
                    del self._frames[old]

    def _is_key(self, index: int) -> bool:
        data, at, (mask, keys) = self._read(index), -1, _KEY_UNITS[self._format]
        while (at := data.find(b"\x00\x00\x01", at + 1)) >= 0:
            if at + 3 < len(data) and mask(data[at + 3]) in keys:
                return True
        return False


_HELD_BACK = 16  # messages after which a picture must have come out
_REMEMBERED = 4  # pictures
_CODECS = {"h264": "h264", "h265": "hevc"}
_KEY_UNITS = {"h264": (lambda byte: byte & 31, {5}), "h265": (lambda byte: byte >> 1 & 63, set(range(16, 22)))}


def video_of(fields: Mapping[str, Any]) -> tuple[str, bytes]:
    """(format, data) of a CompressedVideo message."""
    return str(fields.get("format") or "").lower(), _bytes(fields)


def _compressed_image(fields: Mapping[str, Any]) -> Reading:
    data, frame = _bytes(fields), str(fields.get("frame_id") or "")
    if data[:2] == b"\xff\xd8":
        try:
            height, width = simplejpeg.decode_jpeg_header(data)[:2]
            _small_enough(int(width), int(height))
            return Reading("image", simplejpeg.decode_jpeg(data, colorspace="RGB"), frame=frame)
        except ValueError as error:
            raise DatasetError(f"its JPEG is broken ({error})") from error
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "WEBP")) as picture:
            _small_enough(*picture.size)
            if picture.mode.startswith("I"):
                return Reading("depth", _from_mm(np.asarray(picture)), frame=frame)
            return Reading("image", np.asarray(picture.convert("RGB")), frame=frame)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise DatasetError(f"its picture is no whole JPEG, PNG or WebP ({error})") from error


def _raw_image(fields: Mapping[str, Any]) -> Reading:
    width, height, step = (int(fields[name]) for name in ("width", "height", "step"))
    encoding, data = str(fields["encoding"]), _bytes(fields)
    _small_enough(width, height)
    channels = _COLOUR[encoding][0] if encoding in _COLOUR else {"16UC1": 2, "32FC1": 4}.get(encoding, 0)
    if not channels:
        raise DatasetError(
            f"its pixels are '{encoding}', of which only rgb8, bgr8, mono8, rgba8, 16UC1, 32FC1 are read"
        )
    if step < width * channels or len(data) < step * (height - 1) + width * channels:
        raise DatasetError(f"its {len(data)} bytes are too few for {width} x {height} pixels of {encoding}")
    rows = np.ndarray((height, width * channels), np.uint8, data, strides=(step, 1))
    frame = str(fields.get("frame_id") or "")
    if encoding == "32FC1":
        return Reading("depth", np.ascontiguousarray(rows).view("<f4").astype(np.float32), frame=frame)
    if encoding == "16UC1":
        return Reading("depth", _from_mm(np.ascontiguousarray(rows).view("<u2")), frame=frame)
    pixels = rows.reshape(height, width, channels)[:, :, list(_COLOUR[encoding][1])]
    return Reading("image", pixels, frame=frame, left_out=("alpha",) if channels == 4 else ())


def _point_cloud(fields: Mapping[str, Any]) -> Reading:
    data, stride, columns = _bytes(fields), int(fields["point_stride"]), list(fields["fields"])
    if not 0 < stride <= 2**16 or not columns or len(columns) > 256 or len(data) % stride:
        raise DatasetError(f"its {len(data)} bytes are no points of {stride} bytes and {len(columns)} fields")
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
    longer = tuple(
        f"all digits of '{name}'" for name, column in zip(names, columns) if int(column["type"]) in (5, 6, 8)
    )
    return Reading("points", points, tuple(names), str(fields.get("frame_id") or ""), facts, left_out=longer)


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
    """Any message at all: its numbers by the path of their field."""
    numbers: dict[str, float] = {}
    left_out: list[str] = []

    def gather(path: str, value: Any, depth: int) -> None:
        if len(numbers) > MAX_NUMBERS:
            raise DatasetError(f"it has more than {MAX_NUMBERS} numbers")
        if isinstance(value, (bool, int, float)):
            numbers[path] = float(value)
        elif value in ("NaN", "Infinity", "-Infinity"):
            numbers[path] = float(value)
        elif isinstance(value, (dict, list)) and depth < _DEEPEST:
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
    """Fields by name; of a list by number, or by the "name" of each where all have one of their own."""
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
            raise DatasetError(f"its data are no base64 ({error})") from error
    if not isinstance(data, bytes):
        raise DatasetError("its data are no bytes")
    return data


def _joined(position: Any, orientation: Any) -> np.ndarray:
    position, orientation = position or {}, orientation or {}
    where = [float(position.get(axis) or 0.0) for axis in "xyz"]
    return np.array([*where, *(float(orientation.get(part) or 0.0) for part in "wxyz")])


def _small_enough(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise DatasetError(f"its picture claims {width} x {height} pixels, and at most {MAX_PIXELS} are read")


def _from_mm(values: np.ndarray) -> np.ndarray:
    """Depth in metres; 0 is how millimetres say that nothing was measured."""
    depth_m = (values / 1000).astype(np.float32)
    depth_m[values == 0] = np.inf
    return depth_m


_DECODERS: dict[str, Callable[[Mapping[str, Any]], Reading]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.PointCloud": _point_cloud,
    "foxglove.PoseInFrame": _pose,
    VECTOR: _vector,
}
