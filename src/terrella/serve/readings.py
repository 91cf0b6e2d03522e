"""Encodings of sensor readings for the page of a recording: JPEG, half-float depth, points, and series at screen resolution."""

import struct

import numpy as np
import simplejpeg
from PIL import Image

MOST_POINTS = 60_000  # of one cloud; more are thinned evenly
MOST_COLUMNS = 64  # of one vector
_DEPTH_ACROSS = 512
_FARTHEST_M = 65504.0  # the largest half float


def picture(rgb: np.ndarray, across: int, quality: int = 88) -> bytes:
    """JPEG of uint8 [H, W, 3], averaged down by a whole factor while it stays at least `across` pixels wide."""
    factor = max(1, rgb.shape[1] // max(across, 16))
    if factor > 1:
        rgb = np.asarray(Image.fromarray(rgb).reduce(factor))
    return simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=quality, colorspace="RGB")


def depth(depth_m: np.ndarray, span_m: tuple[float, float]) -> bytes:
    """Little-endian uint32 h, w, float32 near and far of the colours in metres, then float16 [h, w] metres, inf beyond 65 km."""
    step = -(-max(depth_m.shape) // _DEPTH_ACROSS) or 1
    shown = depth_m[::step, ::step]
    with np.errstate(over="ignore"):
        half = shown.astype("<f2")
    return struct.pack("<IIff", *shown.shape, *span_m) + half.tobytes()


def depth_span(samples: list[np.ndarray]) -> tuple[float, float]:
    """Near and far, in metres, of 98% of the measured depths; (0, 1) without any."""
    seen = [sample[(sample > 0) & (sample < _FARTHEST_M)] for sample in samples]
    seen = np.concatenate(seen) if seen else np.zeros(0)
    if not seen.size:
        return 0.0, 1.0
    near, far = (float(edge) for edge in np.percentile(seen, (1, 99)))
    return near, max(far, 1.001 * near + 0.001)


def points(cloud: np.ndarray) -> bytes:
    """Little-endian uint32 n, k, then float32 [n, k]: at most MOST_POINTS, without those that are not finite."""
    cloud = cloud[np.isfinite(cloud[:, :3]).all(axis=1)]
    cloud = cloud[:: max(1, -(-len(cloud) // MOST_POINTS))].astype("<f4")
    return struct.pack("<II", *cloud.shape) + cloud.tobytes()


def times(time_s: np.ndarray) -> bytes:
    """float64 [n], little-endian."""
    return time_s.astype("<f8").tobytes()


EXACT, ENVELOPE = 0, 1


def series(
    time_s: np.ndarray, values: np.ndarray, start_s: float, stop_s: float, buckets: int, pick: bool = False
) -> bytes:
    """A vector between two times, with one more reading on either side. It is exact if there are at most two readings per
    bucket, else the minimum and maximum of each bucket or, with `pick`, every n-th reading.

    Little-endian uint32 mode, n, k, index of the first reading; float64 [n] seconds; then EXACT: float64 [n, k];
    ENVELOPE: float64 [n, k] minima, float64 [n, k] maxima, without empty buckets. NaN stays NaN."""
    first = max(0, int(np.searchsorted(time_s, start_s, "left")) - 1)
    last = min(len(time_s), int(np.searchsorted(time_s, stop_s, "right")) + 1)
    time_s, values = time_s[first:last], values[first:last, :MOST_COLUMNS]
    if len(time_s) <= 2 * buckets or pick:
        step = max(1, -(-len(time_s) // (2 * buckets)))
        return _packed(EXACT, first, time_s[::step], values[::step])
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], buckets, endpoint=False))
    edges = np.unique(edges)
    return _packed(ENVELOPE, first, time_s[edges], np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges))


def _packed(mode: int, first: int, time_s: np.ndarray, *blocks: np.ndarray) -> bytes:
    head = struct.pack("<IIII", mode, *blocks[0].shape, first)
    return head + b"".join(block.astype("<f8").tobytes() for block in (time_s, *blocks))
