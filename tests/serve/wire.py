"""Frames read back, as web/link.js reads them."""

from __future__ import annotations

import struct

from terrella.core.errors import ProtocolError
from terrella.serve import protocol
from terrella.serve.history import Image
from terrella.serve.protocol import Frame


def decode_frame(data: bytes) -> Frame:
    """What `encode_frame` wrote; ProtocolError where the bytes are cut short or of another version."""
    try:
        fields = protocol._HEADER.unpack_from(data)
        version, flags, count, seq, step, oldest, newest, action_id, made, score, client, server, uncertainty = fields
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
        seq, step, oldest, newest, tuple(images), flags, action_id, made, score, client, server, uncertainty, vitals
    )
