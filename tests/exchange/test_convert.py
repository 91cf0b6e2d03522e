"""From any format into any other: what is lossless comes back as it was, and what lies at a path is told from it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from terrella.care import doctor
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Readings, Sensor, Source, Take
from terrella.exchange import open_source, write_source
from terrella.exchange.formats.lerobot import LeRobotRows

FRONT, DEPTH = "observation.images.front", "observation.depth"
SENSORS = [
    Sensor(FRONT, "image", (32, 48, 3), "uint8"),
    Sensor(DEPTH, "depth", (4, 6)),
    Sensor("observation.state", "vector", (2,), "float64", ("x", "y"), {"x": "m"}, "map"),
    Sensor("observation.grid", "vector", (2, 3), "int16"),
    Sensor("action", "vector", (1,), "int64", ("button",)),
    Sensor("next.reward", "vector", (1,)),
    Sensor("next.done", "vector", (1,), "bool"),
]


def some(
    seed: int, lengths: tuple[int, ...], sensors=SENSORS, fps: float | None = 10.0, terminal: bool = True
) -> Source:
    """Random takes; without `fps` each sensor has its own irregular clock."""
    rng = np.random.default_rng(seed)

    def take(length: int) -> Take:
        readings = {}
        for sensor in sensors:
            count = length - (terminal and sensor.name.startswith(("action", "next.")))
            time_s = np.arange(count) / fps if fps else np.sort(rng.random(count))
            if sensor.kind == "depth":
                values = rng.integers(0, 65_535, (count, *sensor.shape)).astype(np.float32) * np.float32(0.001)
            elif sensor.kind == "points":
                values = [
                    rng.normal(size=(rng.integers(0, 9), sensor.shape[1])).astype(np.float32) for _ in range(count)
                ]
            elif sensor.dtype.startswith("float"):
                values = rng.normal(size=(count, *sensor.shape)).astype(sensor.dtype)
            else:
                values = rng.integers(0, 2 if sensor.dtype == "bool" else 100, (count, *sensor.shape)).astype(
                    sensor.dtype
                )
            readings[sensor.name] = Readings(time_s, values)
        return Take(readings, f"task {length % 2}")

    takes = [take(length) for length in lengths]
    return Source("made", {sensor.name: sensor for sensor in sensors}, lambda: takes, fps, "arm")


def same(one: Source, other: Source) -> None:
    """The takes of `one` are those of `other`, values bit for bit, times within a nanosecond."""
    assert set(one.sensors) <= set(other.sensors)
    takes, others = list(one.takes()), list(other.takes())
    assert len(takes) == len(others)
    for a, b in zip(takes, others):
        assert a.task == b.task
        for name in one.sensors:
            assert len(a.readings[name].time_s) == len(b.readings[name].time_s), name
            np.testing.assert_allclose(a.readings[name].time_s, b.readings[name].time_s, atol=1e-9)
            for x, y in zip(a.readings[name].values, b.readings[name].values):
                np.testing.assert_array_equal(x, y, err_msg=name)
                assert x.dtype == y.dtype


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 99), st.lists(st.integers(2, 9), min_size=1, max_size=3), st.booleans(), st.booleans())
def test_lerobot_with_png_is_the_identity(tmp_path_factory, seed, lengths, own_clocks, terminal):
    folder = tmp_path_factory.mktemp("identity")
    sensors = [*SENSORS, Sensor("observation.points.lidar", "points", (0, 4))] if own_clocks else SENSORS
    if own_clocks:
        terminal = True
    source = some(seed, tuple(lengths), sensors, None if own_clocks else 10.0, terminal)
    png = LeRobotRows(pictures="png")
    write_source(source, folder / "one", rows=png)
    same(source, open_source(folder / "one"))
    write_source(open_source(folder / "one"), folder / "two", rows=png)
    same(open_source(folder / "one"), open_source(folder / "two"))
    for name, sensor in open_source(folder / "two").sensors.items():
        assert (sensor.kind, sensor.shape, sensor.dtype) == (
            source.sensors[name].kind,
            source.sensors[name].shape,
            source.sensors[name].dtype,
        )
    state = open_source(folder / "two").sensors["observation.state"]
    assert (state.names, state.units, state.frame) == (("x", "y"), {"x": "m"}, "map")


@pytest.mark.parametrize("name", ["log", "set-v0", "set.hdf5", "npz"])
def test_every_format_of_numbers_gives_back_what_it_got(tmp_path, name):
    to = {"log": "mcap", "set-v0": "minari", "npz": "rollouts"}.get(name)
    plain = [sensor for sensor in SENSORS if sensor.name != "observation.grid"]
    source = some(3, (5, 8), plain)
    write_source(source, tmp_path / name, to)
    again = open_source(tmp_path / name, 10.0)
    same(source, again)
    write_source(again, tmp_path / "rows", rows=LeRobotRows(pictures="png"))
    assert Dataset(tmp_path / "rows").fps == 10
    same(source, open_source(tmp_path / "rows"))


@pytest.mark.parametrize("to", ["videos", "images"])
def test_pictures_alone_go_out_and_come_back(tmp_path, to):
    source = some(4, (5, 8), SENSORS[:1])
    write_source(source, tmp_path / "out", to)
    again = open_source(tmp_path / "out", 10.0)
    (name,) = again.sensors
    for a, b in zip(source.takes(), again.takes()):
        assert len(a.readings[FRONT].values) == len(b.readings[name].values)
    write_source(again, tmp_path / "rows")
    assert [episode.length for episode in Dataset(tmp_path / "rows").episodes] == [5, 8]


def test_rows_follow_the_fps_that_is_asked_for(tmp_path):
    source = some(5, (21,), SENSORS[2:5], 10.0)
    write_source(source, tmp_path / "slow", rows=LeRobotRows(fps=5.0))
    dataset = Dataset(tmp_path / "slow")
    assert dataset.fps == 5 and dataset.length == 11
    take = next(iter(source.takes()))
    np.testing.assert_array_equal(
        dataset.episode(0, ["observation.state"])["observation.state"], take.readings["observation.state"].values[::2]
    )
    full = dataset.readings(0, "observation.state")  # with its own clock it is all there
    np.testing.assert_array_equal(full.values, take.readings["observation.state"].values)
    mixed = LeRobotRows(fps=20.0, policy="linear")
    write_source(source, tmp_path / "fast", rows=mixed)
    found = Dataset(tmp_path / "fast").episode(0, ["observation.state"])["observation.state"]
    np.testing.assert_allclose(found[::2], take.readings["observation.state"].values, atol=1e-12)
    np.testing.assert_allclose(found[1::2], (found[:-1:2] + found[2::2]) / 2, atol=1e-12)


def test_what_cannot_be_rows_is_said_and_the_rest_is_kept(tmp_path):
    bad = some(6, (5, 6, 7), SENSORS[2:5])
    takes = list(bad.takes())
    takes[1].readings["observation.state"].values[2] = np.nan
    notes = write_source(bad, tmp_path / "set")
    assert len(Dataset(tmp_path / "set").episodes) == 2
    assert any("take 1 was left out" in note and "observation.state" in note for note in notes)
    odd = some(7, (4,), [Sensor(FRONT, "image", (15, 16, 3), "uint8")])
    assert any("15x16" in note for note in write_source(odd, tmp_path / "odd"))
    same(odd, open_source(tmp_path / "odd"))
    cloud = some(8, (4,), [Sensor("observation.points.lidar", "points", (0, 3))])
    with pytest.raises(DatasetError, match="only points"):
        write_source(cloud, tmp_path / "cloud")
    with pytest.raises(DatasetError, match="not empty"):
        write_source(bad, tmp_path / "set")
    with pytest.raises(DatasetError, match="no take"):
        write_source(some(9, ()), tmp_path / "none")


@pytest.mark.parametrize(
    "kept",  # per take: rows that have an action, and rows that have a reward
    [
        [([0, 1, 2, 3, 4], [0, 1, 2, 3, 4]), ([0, 1, 2, 3], [0, 1, 2, 3])],
        [([0, 1, 2, 3], [0, 1, 2, 3]), ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4])],
        [([0, 1, 2, 3], [0, 1, 2, 3, 4]), ([], [0, 1, 2, 3])],
        [([0, 1, 3], [0, 1, 2, 3]), ([0, 1, 2, 3], [])],
    ],
)
def test_takes_need_not_end_alike(tmp_path, kept):
    sensors = [SENSORS[2], SENSORS[4], SENSORS[5], Sensor("action.gripper", "vector", (1,))]
    source = some(11, (5, 5), sensors, terminal=False)
    takes = []
    for take, (acted, rewarded) in zip(source.takes(), kept):
        readings = dict(take.readings)
        for name, rows in (("action", acted), ("next.reward", rewarded)):
            readings[name] = Readings(readings[name].time_s[rows], readings[name].values[rows])
        takes.append(Take({name: it for name, it in readings.items() if len(it.time_s)}, take.task))
    mixed = Source("mixed", source.sensors, lambda: takes, 10.0)
    write_source(mixed, tmp_path / "one")
    write_source(open_source(tmp_path / "one"), tmp_path / "two")
    for name in ("one", "two"):
        for a, b in zip(takes, open_source(tmp_path / name).takes()):
            for sensor in ("action", "next.reward", "observation.state"):
                there = sensor in a.readings
                assert there == (sensor in b.readings), sensor
                if there and not (sensor == "action" and len(a.readings[sensor].time_s) == 3):
                    np.testing.assert_allclose(a.readings[sensor].time_s, b.readings[sensor].time_s)
                    np.testing.assert_array_equal(a.readings[sensor].values, b.readings[sensor].values)


def test_statistics_are_of_every_number_and_of_png_pictures_too(tmp_path):
    source = some(12, (40,), SENSORS[:4])
    write_source(source, tmp_path / "set", rows=LeRobotRows(pictures="png"))
    (take,) = source.takes()
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    grid = take.readings["observation.grid"].values
    np.testing.assert_allclose(stats["observation.grid"]["mean"], grid.mean(0))
    np.testing.assert_allclose(stats["observation.grid"]["max"], grid.max(0))
    seen = take.readings[FRONT].values[::16, ::4, ::4] / 255
    np.testing.assert_allclose(np.ravel(stats[FRONT]["mean"]), seen.mean((0, 1, 2)))
    assert stats[FRONT]["count"] == [40]


def test_language_that_changes_on_the_way_is_kept(tmp_path):
    source = some(10, (6,), SENSORS[2:5])
    (take,) = source.takes()
    said = [[0.0, "open"], [0.2, "close"], [0.4, "open"]]
    told = Take(take.readings, "open", None, {"language": said})
    write_source(Source("made", source.sensors, lambda: [told], 10.0), tmp_path / "set")
    (again,) = open_source(tmp_path / "set").takes()
    assert again.facts["language"] == said and Dataset(tmp_path / "set").episodes[0].tasks == ("open", "close")


def annotated(root, persistent):
    """Adds LeRobot's columns of annotations, as version 3.1 writes them."""
    texts = [("role", pa.string()), ("content", pa.string()), ("style", pa.string()), ("camera", pa.string())]
    tools = [("tool_calls", pa.list_(pa.string()))]
    (file,) = root.glob("data/*/*.parquet")
    table = pq.read_table(file)
    rows = pa.list_(pa.struct([*texts[:3], ("timestamp", pa.float32()), *texts[3:], *tools]))
    events = [[{"role": "user", "content": "stop", "style": "interjection"}] * (at == 3) for at in range(len(table))]
    table = table.append_column("language_persistent", pa.array([persistent] * len(table), rows))
    table = table.append_column("language_events", pa.array(events, pa.list_(pa.struct([*texts, *tools]))))
    pq.write_table(table, file)
    info = json.loads((root / "meta/info.json").read_text())
    language = {"dtype": "language", "shape": [1], "names": None}
    info["features"] |= {"language_persistent": language, "language_events": language}
    (root / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v3.1"}))


def test_subtasks_of_lerobots_annotations_become_instructions(tmp_path):
    source = some(10, (6,), SENSORS[2:5])
    (take,) = source.takes()
    write_source(Source("made", source.sensors, lambda: [replace(take, task="tidy up")], 10.0), tmp_path / "theirs")
    said = [(0.25, "close", "subtask"), (0.0, "open", "subtask"), (0.0, "first open, then close", "plan")]
    said = [{"role": "assistant", "content": text, "style": style, "timestamp": at} for at, text, style in said]
    annotated(tmp_path / "theirs", said)
    assert Dataset(tmp_path / "theirs").episodes[0].task == "tidy up" and doctor(tmp_path / "theirs") == []
    opened = open_source(tmp_path / "theirs")
    assert [note for note in opened.notes if "annotations" in note and "subtasks are kept" in note] == list(
        opened.notes
    )
    info = json.loads((tmp_path / "theirs/meta/info.json").read_text())
    del info["features"]["language_persistent"]
    shutil.copytree(tmp_path / "theirs", tmp_path / "events")
    (tmp_path / "events/meta/info.json").write_text(json.dumps(info))
    assert "of the annotations in language_events nothing is kept." in open_source(tmp_path / "events").notes
    (again,) = opened.takes()
    assert again.facts["language"] == [[0.0, "open"], [0.25, "close"]] and again.task == "tidy up"
    write_source(opened, tmp_path / "ours")
    assert Dataset(tmp_path / "ours").episodes[0].tasks == ("open", "close")
    write_source(Source("made", source.sensors, source.takes, 10.0), tmp_path / "broken")
    annotated(tmp_path / "broken", [{**said[0], "timestamp": None}])
    with pytest.raises(DatasetError, match="annotations in language_persistent are damaged"):
        list(open_source(tmp_path / "broken").takes())


def test_what_is_nothing_known_is_said(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        open_source(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(DatasetError, match="of no known format"):
        open_source(tmp_path / "notes.txt")
    with pytest.raises(DatasetError, match="holds no recording"):
        open_source(tmp_path)
    for name, way in (("demo.zarr", "h5py"), ("take.db3", "mcap convert"), ("rlds/x.tfrecord-00000-of-00002", "npz")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
        with pytest.raises(DatasetError, match=way):
            open_source(tmp_path / name)
    (tmp_path / "take.db3").unlink()
    (tmp_path / "demo.zarr").unlink()
    with pytest.raises(DatasetError, match="npz"):
        open_source(tmp_path)
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "photos" / "1.png")
    assert list(open_source(tmp_path / "photos", 5.0).sensors)
    with pytest.raises(DatasetError, match="no format 'zip'"):
        write_source(some(1, (3,)), tmp_path / "x", "zip")  # type: ignore[arg-type]


def test_names_that_no_file_can_have_are_changed_and_named(tmp_path):
    names = ("observation.arm/pos", "observation.arm_pos", "/wheel speed", "observation.images.front/rgb", ".hidden")
    sensors = {name: Sensor(name, "vector", (2,)) for name in names}
    sensors[names[3]] = Sensor(names[3], "image", (16, 16, 3), "uint8")
    at = np.arange(4) / 10
    numbers = {
        name: np.full((4, *sensor.shape), place, sensor.dtype) for place, (name, sensor) in enumerate(sensors.items())
    }
    take = Take({name: Readings(at, values) for name, values in numbers.items()}, "go")
    notes = write_source(
        Source("arm", sensors, lambda: [take], 10.0), tmp_path / "out", "lerobot", LeRobotRows(pictures="png")
    )
    changed = {
        "observation.arm/pos": "observation.arm_pos_2", "/wheel speed": "_wheel_speed",
        "observation.images.front/rgb": "observation.images.front_rgb", ".hidden": "_.hidden",
    }  # fmt: skip
    assert notes == [f"'{name}' is '{now}' in LeRobot, where it names files." for name, now in changed.items()]
    (back,) = Dataset(tmp_path / "out").source().takes()
    for name, values in numbers.items():
        assert np.array_equal(np.asarray(list(back.readings[changed.get(name, name)].values)), values)
