"""Frames read back, as web/link.js reads them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from terrella.core.errors import ProtocolError
from terrella.serve import protocol
from terrella.serve.history import Image, Moment
from terrella.serve.protocol import HeldControls


@dataclass(frozen=True)
class Frame:
    """What a page reads of a frame: see protocol.encode_frame."""

    seq: int
    step: int
    oldest: int
    newest: int
    images: tuple[Image, ...]
    flags: int = 0
    action_id: int = 0
    generation_ms: float = 0.0
    episode_return: float = 0.0
    client_ms: float = 0.0
    server_s: float = 0.0
    uncertainty: float = -1.0
    drifted: float = 0.0
    vitals: tuple[float, ...] = ()


def encode(frame: Frame) -> bytes:
    moment = Moment(
        frame.step, frame.images, frame.flags, frame.episode_return, uncertainty=frame.uncertainty, drifted=frame.drifted,
        vitals=frame.vitals,
    )  # fmt: skip
    controls = HeldControls(frame.action_id, t=frame.client_ms)
    past = frame.oldest, frame.newest
    return protocol.encode_frame(moment, frame.seq, *past, controls, frame.generation_ms, frame.server_s)


def decode_frame(data: bytes) -> Frame:
    """What `encode_frame` wrote; ProtocolError where the bytes are cut short or of another version."""
    try:
        fields = protocol._HEADER.unpack_from(data)
        version, flags, count, seq, step, oldest, newest, action_id, made, score, client, server, *gauge = fields
        if version != protocol.VERSION:
            raise ProtocolError(
                f"a frame of protocol version {version} came, this side speaks {protocol.VERSION}; reload the page."
            )
        images, at = [], protocol._HEADER.size
        for _ in range(count):
            world, camera, _, length = protocol._IMAGE.unpack_from(data, at)
            at += protocol._IMAGE.size
            images.append(Image(world, camera, data[at : at + length]))
            at += length
        vitals = struct.unpack(f"<{max(len(data) - at, 0) // 4}f", data[at:])
    except struct.error as error:
        raise ProtocolError(f"a frame of {len(data)} bytes is cut short; reload the page.") from error
    if at > len(data):
        raise ProtocolError(f"a frame of {len(data)} bytes should have {at}; reload the page.")
    return Frame(
        seq, step, oldest, newest, tuple(images), flags, action_id, made, score, client, server, *gauge, vitals
    )
