"""The recent past as an MP4: the JPEGs of a moment side by side, enlarged by whole factors."""

import io
from collections.abc import Sequence
from fractions import Fraction

import av
import numpy as np
import simplejpeg

MIN_HEIGHT = 480


def make_clip(pictures: Sequence[tuple[bytes, ...]], dt_s: float) -> bytes:
    """An H.264 MP4 of `pictures` (JPEGs per moment, for each world and camera), one frame per `dt_s` seconds."""
    rate = Fraction(1 / dt_s).limit_denominator(1000)
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as file:
        stream = None
        for images in pictures:
            frame = _side_by_side([simplejpeg.decode_jpeg(image, colorspace="RGB") for image in images])
            if stream is None:
                stream = file.add_stream("libx264", rate=rate, options={"crf": "18", "preset": "veryfast"})
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.thread_count = 1
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if stream is not None:
            file.mux(stream.encode())
    return buffer.getvalue()


def _side_by_side(images: list[np.ndarray]) -> np.ndarray:
    height = max(image.shape[0] for image in images)
    images = [_enlarge(image, max(1, height // image.shape[0])) for image in images]
    height = min(image.shape[0] for image in images)
    frame = np.concatenate([image[:height] for image in images], axis=1)
    frame = _enlarge(frame, max(1, -(-MIN_HEIGHT // frame.shape[0])))
    return np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])  # yuv420p wants even sides


def _enlarge(image: np.ndarray, times: int) -> np.ndarray:
    return image if times == 1 else image.repeat(times, axis=0).repeat(times, axis=1)
