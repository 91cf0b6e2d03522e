"""Laws of the wire: what is written is read, and junk is named, never believed."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrella.core.errors import ProtocolError
from terrella.serve import protocol
from terrella.serve.actions import MAX_AXES
from terrella.serve.history import Image
from terrella.serve.protocol import HeldControls, Show

from .wire import Frame, decode_frame, encode

u8, u32 = st.integers(0, 255), st.integers(0, 2**32 - 1)
f32 = st.floats(width=32, allow_nan=False)
f64 = st.floats(allow_nan=False)
frames = st.builds(
    Frame,
    seq=u32,
    step=u32,
    oldest=u32,
    newest=u32,
    images=st.lists(st.builds(Image, world=u8, camera=u8, jpeg=st.binary(max_size=64)), max_size=3).map(tuple),
    flags=st.integers(0, 255),
    action_id=u32,
    generation_ms=f32,
    episode_return=f32,
    client_ms=f64,
    server_s=f64,
)


@given(frames)
def test_a_frame_survives_the_wire(frame):
    assert decode_frame(encode(frame)) == frame


@given(frames, st.integers(0, 200))
def test_a_cut_frame_is_refused(frame, cut):
    data = encode(frame)
    short = data[: min(cut, len(data) - 1)]
    with pytest.raises(ProtocolError):
        decode_frame(short)


@given(st.binary(max_size=300))
def test_no_bytes_crash_the_reader(data):
    for read in (protocol.parse_message, decode_frame):
        try:
            read(data)
        except ProtocolError as error:
            assert str(error)


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.integers(),
        lambda inner: st.lists(inner, max_size=3),
    )
)
def test_no_field_crashes_the_reader(value):
    for kind, name in [
        ("controls", "id"),
        ("controls", "held"),
        ("controls", "t"),
        ("controls", "axes"),
        ("show", "cameras"),
        ("drive", "on"),
        ("ack", "seq"),
        ("seek", "step"),
        ("record", "on"),
        ("restart", "seed"),
    ]:
        body = {"type": kind, "id": 1, "held": [], "seq": 1, "step": 1, name: value}
        try:
            protocol.parse_message(json.dumps(body))
        except ProtocolError as error:
            assert str(error)


def test_a_page_sends_as_many_axes_as_it_shows_and_no_more():
    read = lambda many: protocol.parse_message(json.dumps({"type": "controls", "id": 1, "axes": [0.5] * many}))  # noqa: E731
    assert read(MAX_AXES) == ("controls", HeldControls(1, (), (0.5,) * MAX_AXES))
    with pytest.raises(ProtocolError, match=f"at most {MAX_AXES}"):
        read(MAX_AXES + 1)


def test_every_message_is_understood():
    said = {
        '{"type": "controls", "id": 7, "t": 12.5, "held": ["KeyW", "ArrowLeft"]}': (
            "controls",
            HeldControls(7, ("KeyW", "ArrowLeft"), (), 12.5),
        ),
        '{"type": "controls", "id": 8, "held": [], "axes": [0.5, -1]}': ("controls", HeldControls(8, (), (0.5, -1.0))),
        '{"type": "drive", "on": false}': ("drive", False),
        '{"type": "show", "map": true, "invented": false, "cameras": ["rgb.wrist"]}': (
            "show",
            Show(True, False, ("rgb.wrist",)),
        ),
        '{"type": "ack", "seq": 3}': ("ack", 3),
        '{"type": "pause"}': ("pause", None),
        '{"type": "resume"}': ("resume", None),
        '{"type": "restart", "seed": 5}': ("restart", 5),
        '{"type": "restart"}': ("restart", None),
        '{"type": "rewind", "steps": 9}': ("rewind", 9),
        '{"type": "seek", "step": 9}': ("seek", 9),
        '{"type": "branch"}': ("branch", None),
        '{"type": "sync"}': ("sync", None),
        '{"type": "record", "on": true}': ("record", True),
    }
    for text, message in said.items():
        assert protocol.parse_message(text) == message


@pytest.mark.parametrize(
    "text, blame",
    [
        ("", "not JSON"),
        ("[1]", "object"),
        ('{"type": "format"}', "no message is called 'format'"),
        ('{"type": "controls", "id": -1, "held": []}', "'id'"),
        ('{"type": "controls", "id": 1, "held": "KeyW"}', "'held'"),
        ('{"type": "controls", "id": 1, "held": [], "axes": [NaN]}', "'axes'"),
        ('{"type": "controls", "id": 1, "held": [], "axes": [true]}', "'axes'"),
        ('{"type": "ack", "seq": true}', "'seq'"),
        ('{"type": "record", "on": 1}', "'on'"),
        ("[" * 4000, "JSON"),
        ("x" * 5000, "too long"),
    ],
)
def test_junk_is_named(text, blame):
    with pytest.raises(ProtocolError, match=blame):
        protocol.parse_message(text)


def test_a_card_becomes_plain_json():
    class Odd:
        def __str__(self):
            return "odd"

    card = {"a": 1, "b": float("nan"), "c": {"d": (1, 2.5, Odd())}, 3: None}
    assert json.loads(json.dumps(protocol.plain(card))) == {"a": 1, "b": "NaN", "c": {"d": [1, 2.5, "odd"]}, "3": None}


def test_vitals_ride_at_the_end_of_a_frame():
    frame = Frame(1, 2, 0, 2, (Image(0, 0, b"jpeg"), Image(1, 0, b"other")), vitals=(42.0, 3.0))
    assert decode_frame(encode(frame)) == frame
    with pytest.raises(ProtocolError):
        decode_frame(encode(frame)[:-1])
