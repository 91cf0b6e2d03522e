"""Browse: any source, opened for looking; its faults are sentences, its marks outlive it, and few takes stay open."""

from __future__ import annotations

import gc
import json
import weakref

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrella.core.errors import DatasetError
from terrella.data.source import Lazy, Readings, Sensor, Source, Take
from terrella.exchange.browse import MARKS, Browse, EpisodeEntry, pose_columns

CAMERA, STATE = "observation.images.front", "observation.state"


def take_of(number: int, rows: int = 6, **changed: Readings) -> Take:
    clock = np.arange(rows) / 10
    readings = {
        CAMERA: Readings(clock, Lazy(rows, lambda i: np.full((4, 6, 3), (10 * number + i) % 256, np.uint8))),
        STATE: Readings(np.arange(2 * rows) / 20, np.arange(4 * rows, dtype=np.float32).reshape(2 * rows, 2) + number),
    }
    return Take({**readings, **changed}, f"task {number}")


SENSORS = {
    STATE: Sensor(STATE, "vector", (2,), names=("x_m", "y_m")),
    CAMERA: Sensor(CAMERA, "image", (4, 6, 3), "uint8", rate_hz=10),
}


def source_of(count: int = 5, make=take_of, sensors=None) -> Source:
    return Source("small", sensors or SENSORS, lambda: map(make, range(count)), fps=10.0)


def test_lists_and_reads_any_source(tmp_path):
    browse = Browse(source_of(), tmp_path / MARKS)
    assert browse.entries == tuple(EpisodeEntry(6, 0.55, f"task {number}") for number in range(5))
    about = browse.about()
    assert [sensor["label"] for sensor in about["sensors"]] == ["front", "state"], "pictures come first"
    assert not about["can_export"]
    for number in (3, 0, 4, 2, 2, 1):
        assert browse.episode(number)["task"] == f"task {number}"
        assert browse.reading(number, CAMERA, 5)[0, 0, 0] == 10 * number + 5
        np.testing.assert_array_equal(browse.series(number, STATE), np.arange(24).reshape(12, 2) + number)
    facts = browse.episode(1)
    assert facts["seconds"] == 0.55 and facts["sensors"][CAMERA] == {"count": 6, "fault": ""}


def test_a_list_and_an_opener_spare_the_walk(tmp_path):
    source = Source("far", SENSORS, lambda: Lazy(10_000, take_of))
    browse = Browse(source, tmp_path / MARKS, entries=[EpisodeEntry(6, 0.5)] * 10_000)
    assert browse.reading(9_999, CAMERA, 0).shape == (4, 6, 3)
    assert len(browse.listing()) == 10_000


def test_a_source_whose_takes_are_a_sequence_is_not_walked(tmp_path):
    opened = []

    def opens(number: int) -> Take:
        opened.append(number)
        return take_of(number)

    takes = Lazy(1000, opens)
    browse = Browse(Source("lazy", SENSORS, lambda: takes), tmp_path / MARKS, entries=[EpisodeEntry(6, 0.5)] * 1000)  # type: ignore[arg-type]
    assert browse.episode(900)["task"] == "task 900" and browse.episode(20)["task"] == "task 20"
    assert opened == [900, 20]


def test_at_most_two_takes_stay_open(tmp_path):
    opened: list[weakref.ref] = []

    def opens(number: int) -> Take:
        take = take_of(number)
        opened.append(weakref.ref(take.readings[CAMERA].values))
        return take

    source = Source("lazy", SENSORS, lambda: Lazy(8, opens))
    browse = Browse(source, tmp_path / MARKS, entries=[EpisodeEntry(6, 0.5)] * 8)
    for number in (0, 1, 0, 1, 2, 3, 4, 3):
        browse.series(number, STATE)
    gc.collect()
    assert len(opened) == 5, "what was open was not opened again"
    assert sum(reference() is not None for reference in opened) == 2


def test_marks_outlive_it(tmp_path):
    browse = Browse(source_of(), tmp_path / MARKS)
    browse.mark(3, True)
    browse.mark(1, True)
    browse.mark(3, True)
    assert Browse(source_of(), tmp_path / MARKS).marks() == [1, 3]
    browse.mark(1, False)
    assert Browse(source_of(), tmp_path / MARKS).marks() == [3]
    assert Browse(source_of(2), tmp_path / MARKS).marks() == [], "a shorter recording does not show what it lacks"
    with pytest.raises(DatasetError, match="no episode 5"):
        browse.mark(5, True)
    with pytest.raises(DatasetError, match="no episode -1"):
        browse.mark(-1, True)


def test_a_mark_that_cannot_be_kept_is_not_shown(tmp_path):
    (tmp_path / "file").write_text("in the way")
    browse = Browse(source_of(), tmp_path / "file" / MARKS)
    with pytest.raises(DatasetError, match="cannot be saved"):
        browse.mark(0, True)
    assert browse.marks() == []


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"version": 1}', '{"version": 1, "bad": [1.5]}', '{"version": 1, "bad": [true]}',
             '{"version": 1, "bad": [-1]}', '{"version": 1, "bad": 3}', '{"version": 2, "bad": []}', "\x00\xff", "[" * 100_000],
)  # fmt: skip
def test_unreadable_marks_are_refused(tmp_path, text):
    (tmp_path / MARKS).write_bytes(text.encode("latin-1"))
    with pytest.raises(DatasetError, match="cannot be read"):
        Browse(source_of(), tmp_path / MARKS)
    assert (tmp_path / MARKS).read_bytes() == text.encode("latin-1"), "the file is left for a person to mend"


BROKEN_CLOCKS = {
    "descends": [0.0, 0.2, 0.1],
    "not a number": [0.0, np.nan, 0.2],
    "endless": [0.0, 0.1, np.inf],
    "too short": [0.0, 0.1],
}


@pytest.mark.parametrize("clock", BROKEN_CLOCKS.values(), ids=BROKEN_CLOCKS)
def test_a_broken_clock_is_that_sensors_fault_alone(tmp_path, clock):
    broken = {CAMERA: Readings(np.array(clock), np.zeros((3, 4, 6, 3), np.uint8))}
    entries = [EpisodeEntry(3, 0.2)]
    browse = Browse(source_of(1, lambda n: take_of(n, **broken)), tmp_path / MARKS, entries)
    facts = browse.episode(0)
    assert CAMERA in facts["sensors"][CAMERA]["fault"] and facts["sensors"][STATE] == {"count": 12, "fault": ""}
    with pytest.raises(DatasetError):
        browse.reading(0, CAMERA, 0)
    assert browse.series(0, STATE).shape == (12, 2)


def fails(index: int) -> np.ndarray:
    raise ValueError("moov atom not found")


@pytest.mark.parametrize(
    "value", [np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.float32), np.zeros((0, 6, 3), np.uint8), None]
)
def test_a_foreign_or_broken_picture_is_a_sentence(tmp_path, value):
    broken = {CAMERA: Readings(np.arange(3.0), Lazy(3, fails if value is None else lambda i: value))}
    browse = Browse(source_of(1, lambda n: take_of(n, **broken)), tmp_path / MARKS)
    with pytest.raises(DatasetError, match="reading 1 of observation.images.front in episode 0"):
        browse.reading(0, CAMERA, 1)


def test_what_is_not_there_is_a_sentence(tmp_path):
    lacking = source_of(1, lambda n: Take({STATE: take_of(n).readings[STATE]}))
    browse = Browse(lacking, tmp_path / MARKS)
    for ask in (
        lambda: browse.times(0, CAMERA), lambda: browse.times(0, "observation.nose"), lambda: browse.episode(1),
        lambda: browse.reading(0, STATE, 99), lambda: browse.reading(0, STATE, -1), lambda: browse.series(0, CAMERA),
        lambda: browse.export(tmp_path / "good", [0], print),
    ):  # fmt: skip
        with pytest.raises(DatasetError):
            ask()
    assert list(browse.episode(0)["sensors"]) == [STATE]


def test_uneven_vectors_are_a_sentence(tmp_path):
    uneven = {STATE: Readings(np.arange(2.0), [np.zeros(2), np.zeros(3)])}
    browse = Browse(source_of(1, lambda n: take_of(n, **uneven)), tmp_path / MARKS)
    with pytest.raises(DatasetError, match="cannot be decoded"):
        browse.series(0, STATE)


def test_a_recording_without_episodes_or_readings_opens(tmp_path):
    assert Browse(source_of(0), tmp_path / MARKS).listing() == []
    bare = Browse(source_of(1, lambda n: Take({})), tmp_path / MARKS)
    assert bare.listing() == [{"rows": 0, "seconds": 0.0, "task": ""}] and bare.episode(0)["seconds"] == 0.0
    none = {STATE: Readings(np.zeros(0), np.zeros((0, 2)))}
    assert len(Browse(source_of(1, lambda n: take_of(n, **none)), tmp_path / MARKS).series(0, STATE)) == 0


def test_a_source_that_shrank_is_a_sentence(tmp_path):
    browse = Browse(source_of(2), tmp_path / MARKS, entries=[EpisodeEntry(6, 0.5)] * 3)
    with pytest.raises(DatasetError, match="no episode 2 any more"):
        browse.episode(2)
    assert browse.episode(1)["task"] == "task 1"


def test_export_is_handed_on(tmp_path):
    calls = []
    browse = Browse(source_of(), tmp_path / MARKS, export=lambda *given: calls.append(given))
    assert browse.about()["can_export"]
    browse.export(tmp_path / "good", [0, 2], print)
    assert calls == [(tmp_path / "good", [0, 2], print)]
    with pytest.raises(DatasetError, match="no episode 7"):
        browse.export(tmp_path / "good", [7], print)


odd = st.recursive(
    st.none() | st.floats() | st.text(max_size=5), lambda inner: st.lists(inner, max_size=3), max_leaves=8
)


@given(odd)
def test_whatever_was_said_is_json(tmp_path_factory, spoken):
    made = source_of(1, lambda n: Take(take_of(n).readings, "", 2**62, {"language": spoken}))
    browse = Browse(made, tmp_path_factory.getbasetemp() / "none" / MARKS)
    facts = json.loads(json.dumps([browse.about(), browse.listing(), browse.episode(0)], allow_nan=False))
    assert all(len(pair) == 2 and isinstance(pair[1], str) for pair in facts[2]["language"])
    assert facts[2]["start_ns"] == str(2**62)


def vector(name: str, names: tuple[str, ...], **units: str) -> Sensor:
    return Sensor(name, "vector", (len(names),), names=names, units=units)


QUATERNION = {"x": 0, "y": 1, "quaternion": [3, 4, 5, 6], "yaw": None, "degrees": False}
POSES = [
    (vector(STATE, ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")), QUATERNION),
    (vector("a", ("p_x", "p_y", "p_z", "quat_w", "quat_x", "quat_y", "quat_z")), QUATERNION),
    (
        vector("a", ("position.x", "position.y", "yaw")),
        {"x": 0, "y": 1, "quaternion": None, "yaw": 2, "degrees": False},
    ),
    (vector("a", ("x", "y", "heading_deg")), {"x": 0, "y": 1, "quaternion": None, "yaw": 2, "degrees": True}),
    (vector("observation.odometry", ("x", "y")), {"x": 0, "y": 1, "quaternion": None, "yaw": None, "degrees": False}),
    (vector("observation.imu", ("x", "y", "z")), None),
    (vector("observation.gps", ("x", "y"), x="deg", y="deg"), None),
    (vector("observation.position", ("joint_1", "joint_2")), None),
    (vector(STATE, ()), None),
]


@pytest.mark.parametrize("sensor, found", POSES)
def test_a_pose_is_found_by_its_names(sensor, found):
    assert pose_columns(sensor) == found


def test_an_action_is_no_pose(tmp_path):
    action = vector("action", ("x", "y", "yaw"))
    assert Browse(source_of(0, sensors={"action": action}), tmp_path / MARKS).about()["sensors"][0]["pose"] is None
