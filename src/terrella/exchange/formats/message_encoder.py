"""Encodes sensor readings as Foxglove messages (Protobuf) with Foxglove's SDK."""

import io
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import simplejpeg
from PIL import Image

from ...core.errors import DatasetError
from ...data.source import Sensor
from .messages import POSE_NAMES, VECTOR

try:
    from foxglove import Schema
    from foxglove import messages as fox
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
except ImportError as error:
    raise DatasetError("MCAP needs packages that are not installed: pip install 'terrella[mcap]'.") from error

_JPEG_QUALITY = 90


class MessageEncoder:
    """Encodes the readings of one sensor; pictures become PNG (exact), or JPEG if `jpeg`."""

    def __init__(self, sensor: Sensor, jpeg: bool = False):
        self._sensor = sensor
        kind: str = sensor.kind
        if kind == "image":
            kind = "jpeg" if jpeg else "png"
        elif kind == "vector" and sensor.names == POSE_NAMES:
            kind = "transform" if sensor.facts.get("child_frame") else "pose"
        self.schema, self._make = _vector_schema() if kind == "vector" else _SCHEMAS[kind](), getattr(self, f"_{kind}")

    def __call__(self, value: np.ndarray, time_ns: int) -> bytes:
        """One message; DatasetError where the value differs from the sensor's declaration."""
        return self._make(checked(self._sensor, value), fox.Timestamp(time_ns // 10**9, time_ns % 10**9))

    def _picture(self, time: fox.Timestamp, data: bytes, format: str) -> bytes:
        return fox.CompressedImage(timestamp=time, frame_id=self._sensor.frame, data=data, format=format).encode()

    def _png(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        out = io.BytesIO()
        Image.fromarray(value).save(out, "PNG", compress_level=1)
        return self._picture(time, out.getvalue(), "png")

    def _jpeg(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        pixels = np.ascontiguousarray(value)
        return self._picture(time, simplejpeg.encode_jpeg(pixels, quality=_JPEG_QUALITY, colorspace="RGB"), "jpeg")

    def _depth(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        height, width = value.shape
        return fox.RawImage(
            timestamp=time,
            frame_id=self._sensor.frame,
            width=width,
            height=height,
            encoding="32FC1",
            step=width * 4,
            data=value.astype("<f4").tobytes(),
        ).encode()

    def _points(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        columns, names = value.shape[1], self._sensor.names
        names = names if len(names) == columns else (*"xyz", *(f"c{i}" for i in range(3, columns)))[:columns]
        number = fox.PackedElementFieldNumericType.Float32
        return fox.PointCloud(
            timestamp=time,
            frame_id=self._sensor.frame,
            pose=fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1)),
            point_stride=4 * columns,
            fields=[fox.PackedElementField(name=name, offset=4 * i, type=number) for i, name in enumerate(names)],
            data=value.astype("<f4").tobytes(),
        ).encode()

    def _pose(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        position, orientation = _place(value)
        pose = fox.Pose(position=position, orientation=orientation)
        return fox.PoseInFrame(timestamp=time, frame_id=self._sensor.frame, pose=pose).encode()

    def _transform(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        translation, rotation = _place(value)
        return fox.FrameTransform(
            timestamp=time,
            parent_frame_id=self._sensor.frame,
            child_frame_id=str(self._sensor.facts["child_frame"]),
            translation=translation,
            rotation=rotation,
        ).encode()

    def _vector(self, value: np.ndarray, time: fox.Timestamp) -> bytes:
        flat = value.reshape(-1)
        message = _vector_class()(values=flat.astype(np.float64), names=self._sensor.names)
        message.timestamp.seconds, message.timestamp.nanos = time.sec, time.nsec
        if flat.dtype.kind in "iu" and flat.dtype.itemsize == 8:
            message.integers.extend(flat.view(np.int64).tolist())
        return message.SerializeToString()


_SCHEMAS: dict[str, Callable[[], Schema]] = {
    "png": fox.CompressedImage.get_schema,
    "jpeg": fox.CompressedImage.get_schema,
    "depth": fox.RawImage.get_schema,
    "points": fox.PointCloud.get_schema,
    "pose": fox.PoseInFrame.get_schema,
    "transform": fox.FrameTransform.get_schema,
}
calibration_schema = fox.CameraCalibration.get_schema


def checked(sensor: Sensor, value: Any) -> np.ndarray:
    """The value as an array; DatasetError where its shape or dtype differs from the sensor's."""
    value = np.asarray(value)
    if sensor.kind == "points":
        fits = value.ndim == 2 and value.shape[1:] == tuple(sensor.shape[1:])
    else:
        fits = value.shape == tuple(sensor.shape)
    if not fits or value.dtype != sensor.dtype:
        what = f"{value.dtype} {list(value.shape)} where {sensor.dtype} {list(sensor.shape)} is declared"
        raise DatasetError(f"A reading of '{sensor.name}' is {what}; mend the sensor's declaration or the reading.")
    return value


def calibration(sensor: Sensor, time_ns: int) -> bytes | None:
    """A CameraCalibration message of facts["calibration"], in the form that `mcap.read` gives it; else None."""
    value = sensor.facts.get("calibration")
    if not isinstance(value, Mapping) or len(value.get("K") or ()) != 9:
        return None
    try:
        return fox.CameraCalibration(
            timestamp=fox.Timestamp(time_ns // 10**9, time_ns % 10**9),
            frame_id=str(value.get("frame_id", sensor.frame)),
            width=int(value.get("width", 0)),
            height=int(value.get("height", 0)),
            distortion_model=str(value.get("distortion_model", "")),
            **{name: [float(number) for number in value.get(name) or ()] for name in ("D", "K", "R", "P")},
        ).encode()
    except (TypeError, ValueError, OverflowError):
        return None


def _place(value: np.ndarray) -> tuple[fox.Vector3, fox.Quaternion]:
    x, y, z, qw, qx, qy, qz = value.astype(np.float64).tolist()
    return fox.Vector3(x=x, y=y, z=z), fox.Quaternion(x=qx, y=qy, z=qz, w=qw)


@cache
def _vector_file() -> Any:
    """terrella.Vector {timestamp, values, names, integers}, for Foxglove has no message for a named vector. `integers` repeats the
    values of 64-bit integers, which doubles would round."""
    kind = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="terrella/Vector.proto", package="terrella", syntax="proto3")
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    vector = file.message_type.add(name=VECTOR.rpartition(".")[2])
    time = {"type": kind.TYPE_MESSAGE, "type_name": ".google.protobuf.Timestamp"}
    vector.field.add(name="timestamp", number=1, label=kind.LABEL_OPTIONAL, **time)
    many = {"values": kind.TYPE_DOUBLE, "names": kind.TYPE_STRING, "integers": kind.TYPE_INT64}
    for number, (name, type_) in enumerate(many.items(), 2):
        vector.field.add(name=name, number=number, type=type_, label=kind.LABEL_REPEATED)
    return file


@cache
def _vector_class() -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(_vector_file().SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(VECTOR))


def _vector_schema() -> Schema:
    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    files.file.add().CopyFrom(_vector_file())
    return Schema(name=VECTOR, encoding="protobuf", data=files.SerializeToString())
