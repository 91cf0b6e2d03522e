"""Each injected fault is named with its file and row, and a sound recording has none."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from layouts import layout_of
from sweeps import sweep

from terrella.care import doctor
from terrella.care.doctor import examine, is_being_written
from terrella.core import files
from terrella.core.errors import DatasetError
from terrella.data import Layout, Recorder
from terrella.data.source import Sensor
from terrella.data.storage.mp4 import Mp4Writer

DATA = "data/chunk-000/file-001.parquet"
VIDEO = "videos/observation.images.rgb/chunk-000/file-001.mp4"


def change(root: Path, column: str, change) -> None:
    table = pq.read_table(root / DATA)
    values = table[column].to_pylist()
    at = table.schema.get_field_index(column)
    new = pa.array(change(values), table.schema.field(column).type)
    pq.write_table(table.set_column(at, table.schema.field(column), new), root / DATA)


def put(values: list, at: int, value) -> list:
    return [*values[:at], value, *values[at + 1 :]]


def cut(path: Path, share: float = 0.5) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def _short_video(root: Path) -> None:
    writer = Mp4Writer(root / VIDEO, (48, 64), 35)
    for _ in range(21):
        writer.add(np.zeros((48, 64, 3), np.uint8))
    writer.close()


def _info(root: Path, **changes) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, **changes}))


def _without_column(root: Path) -> None:
    pq.write_table(pq.read_table(root / DATA).drop_columns(["next.reward"]), root / DATA)


def _without_rows(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(pa.concat_tables([table.slice(0, 10), table.slice(12)]), root / DATA)


def small_video(root: Path) -> None:
    writer = Mp4Writer(root / VIDEO, (24, 32), 35)
    for i in range(30):
        writer.add(np.full((24, 32, 3), 8 * i, np.uint8))
    writer.close()


def _slow_video(root: Path) -> None:
    writer = Mp4Writer(root / VIDEO, (48, 64), 10)
    for _ in range(30):
        writer.add(np.zeros((48, 64, 3), np.uint8))
    writer.close()


def _spoilt_frame(root: Path) -> None:
    raw = bytearray((root / VIDEO).read_bytes())
    at = raw.rfind(b"mdat") + 4
    raw[at : at + 900] = bytes(900)
    (root / VIDEO).write_bytes(raw)


def twin(root: Path) -> None:
    """Episode 1 once more, as episode 2."""
    for name in (DATA, VIDEO):
        shutil.copy(root / name, root / name.replace("001", "002"))
    path = root / DATA.replace("001", "002")
    table = pq.read_table(path)
    for name in ("index", "episode_index"):
        at = table.schema.get_field_index(name)
        more = 30 if name == "index" else 1
        table = table.set_column(at, name, pa.array([value + more for value in table[name].to_pylist()], pa.int64()))
    pq.write_table(table, path)


def _stats(root: Path) -> None:
    told = json.loads((root / "meta/stats.json").read_text())
    told["action"]["mean"][2] += 1
    (root / "meta/stats.json").write_text(json.dumps(told))


def _episode_away(root: Path) -> None:
    (root / "meta/episodes/chunk-000/file-002.parquet").unlink()


def _episode(root: Path, number: int, name: str, value) -> None:
    path = root / f"meta/episodes/chunk-000/file-00{number}.parquet"
    table = pq.read_table(path, partitioning=None)  # pyright: ignore
    at = table.schema.get_field_index(name)
    pq.write_table(table.set_column(at, name, pa.array([value], table.schema.field(name).type)), path)


FAULTS = {
    "missing table": (lambda root: (root / DATA).unlink(), DATA, 30, "missing"),
    "cut table": (lambda root: cut(root / DATA), DATA, 30, "truncated"),
    "missing video": (lambda root: (root / VIDEO).unlink(), VIDEO, 30, "missing"),
    "cut video": (lambda root: cut(root / VIDEO), VIDEO, None, "frames|truncated"),
    "empty video": (lambda root: (root / VIDEO).write_bytes(b""), VIDEO, 30, "truncated"),
    "short video": (_short_video, VIDEO, 51, "21 frames"),
    "missing column": (_without_column, DATA, 30, "'next.reward' is missing"),
    "missing rows": (_without_rows, DATA, 40, "index is 42 where 40 is expected"),
    "index gap": (lambda root: change(root, "index", lambda v: put(v, 7, 99)), DATA, 37, "index is 99"),
    "timestamps": (
        lambda root: change(root, "timestamp", lambda v: [2 * t for t in v]),
        DATA,
        31,
        "frames per second",
    ),
    "nan reward": (lambda root: change(root, "next.reward", lambda v: put(v, 3, float("nan"))), DATA, 33, "finite"),
    "nan pose": (
        lambda root: change(root, "observation.state", lambda v: put(v, 4, [float("inf")] * 7)),
        DATA,
        34,
        "finite",
    ),
    "early done": (lambda root: change(root, "next.done", lambda v: put(v, 5, True)), DATA, 35, "24 rows before"),
    "total": (lambda root: _info(root, total_frames=101), "meta/info.json", None, "101 rows"),
    "no info": (lambda root: (root / "meta/info.json").unlink(), "meta/info.json", None, "missing"),
    "info": (lambda root: cut(root / "meta/info.json"), "meta/info.json", None, "cannot be read"),
    "fps": (lambda root: _info(root, fps="fast"), "meta/info.json", None, "fps"),
    "no fps": (lambda root: _info(root, fps=0), "meta/info.json", None, "0 frames a second"),
    "templates": (lambda root: _info(root, data_path="../{x}"), "meta/info.json", None, "not one of LeRobot"),
    "features": (lambda root: _info(root, features={"action": {}}), "meta/info.json", None, "a dtype and shape"),
    "terrella.json": (lambda root: cut(root / "meta/terrella.json"), "meta/terrella.json", None, "cannot be read"),
    "episode away": (_episode_away, "meta/episodes", None, "episode 2 is not listed"),
    "no episodes": (lambda root: shutil.rmtree(root / "meta/episodes"), "meta/episodes", None, "no table"),
    "episode table": (
        lambda root: cut(root / "meta/episodes/chunk-000/file-002.parquet"),
        "meta/episodes/chunk-000/file-002.parquet",
        None,
        "truncated",
    ),
    "episode length": (lambda root: _episode(root, 1, "dataset_to_index", 58), DATA, 30, "30 rows here, but 28 in"),
    "episode start": (
        lambda root: _episode(root, 1, "dataset_from_index", 31),
        "meta/episodes",
        30,
        "starts at row 31",
    ),
    "episode file": (lambda root: _episode(root, 1, "data/file_index", 9), DATA.replace("1", "9"), 30, "missing"),
    "video begins": (
        lambda root: _episode(root, 1, "videos/observation.images.rgb/from_timestamp", 0.2),
        VIDEO,
        None,
        "30 frames, but episode 1 needs 37",
    ),
    "small video": (small_video, VIDEO, 30, "24x32, but info.json states 48x64"),
    "slow video": (_slow_video, VIDEO, None, "frames"),
    "spoilt frame": (_spoilt_frame, VIDEO, 30, "cannot be decoded"),
    "twin": (twin, DATA.replace("001", "002"), 60, "same actions and states as episode 1"),
    "statistics": (_stats, "meta/stats.json", None, "action: mean .* differs from .*, computed from the rows"),
    "task": (lambda root: change(root, "task_index", lambda v: put(v, 9, 4)), DATA, 39, "task 4 is not in"),
    "stats": (lambda root: (root / "meta/stats.json").unlink(), "meta/stats.json", None, "missing"),
    "tasks": (lambda root: cut(root / "meta/tasks.parquet"), "meta/tasks.parquet", None, "truncated"),
    "leftover": (
        lambda root: shutil.copy(root / DATA, root / "data/chunk-000/file-004.parquet"),
        "data/chunk-000/file-004.parquet",
        None,
        "no episode",
    ),
}


def test_a_sound_recording_has_no_fault(recording):
    assert doctor(recording) == []
    (recording / "look.jpg").touch()  # a picture of it that `record` writes
    assert examine(recording).notes == ["observation.state: z_m, qx, qy never change in 100 rows"]


@pytest.mark.parametrize("name", sweep(FAULTS, *list(FAULTS)[::3]))
def test_each_fault_is_named_with_its_place_and_mend(recording, name):
    inject, file, row, words = FAULTS[name]
    inject(recording)
    faults = doctor(recording)
    found = [fault for fault in faults if fault.file == file]
    assert found, faults
    assert any(re.search(words, fault.what) for fault in found), found
    assert row is None or row in {fault.row for fault in found}, found
    assert all(fault.mend for fault in faults)


def test_actions_that_never_change_are_named(tmp_path):
    with Recorder(tmp_path, layout_of(10, ("go",))) as recorder:
        for _ in range(40):
            recorder.add({}, [1.0])
    assert [fault.what for fault in doctor(tmp_path)] == ["the action is [1.0] in all 39 rows"]


def test_there_must_be_a_dataset_to_examine(tmp_path):
    with pytest.raises(DatasetError):
        doctor(tmp_path)


def test_a_recording_in_progress_is_no_fault(tmp_path):
    layout = layout_of(10, ("go",), pose=True)
    with Recorder(tmp_path, layout) as recorder:
        for _ in range(3):
            recorder.add({"pose": np.arange(7)}, [1.0])
        assert is_being_written(tmp_path)
        found = examine(tmp_path)
        assert found.faults == [] and found.notes == [
            "a recorder is writing to this folder now; the episode that it is recording was not examined"
        ]
    assert not is_being_written(tmp_path)


@pytest.mark.parametrize(
    "name, nth", [("move_into_place", 1), ("move_into_place", 2), ("write_json", 1), ("write_json", 2)]
)
def test_a_killed_commit_is_told_from_damage(recording, monkeypatch, name, nth):
    """Whatever of it lies there already is named as left over, and goes with the next recording."""
    info = json.loads((recording / "meta/info.json").read_text())
    about = json.loads((recording / "meta/terrella.json").read_text())
    named = {name: feature["names"] or () for name, feature in info["features"].items()}
    layout = layout_of(info["fps"], tuple(named["action"]), (48, 64), (12, 16), True, world=about["world"])

    class Killed(BaseException):
        pass

    def row(i: int) -> dict[str, np.ndarray]:
        picture = np.full((48, 64, 3), 8 * i, np.uint8)
        return {"rgb": picture, "depth": np.full((12, 16), 1 + i), "pose": np.arange(7) + i}

    recorder = Recorder(recording, layout)
    for i in range(12):
        recorder.add(row(i), np.full(6, i % 2))
    real, calls = getattr(files, name), []

    def failing(*args, **named):
        calls.append(args)
        if len(calls) == nth:
            raise Killed
        return real(*args, **named)

    monkeypatch.setattr(files, name, failing)
    with pytest.raises(Killed):
        recorder.end_episode()
    monkeypatch.undo()
    recorder._writer._lock.close()
    faults = doctor(recording)
    left = [fault for fault in faults if "recorder was killed while it committed" in fault.mend]
    assert all("interrupted episode" in f.what or f in left or "stats.json" in f.file for f in faults), faults
    assert any("interrupted episode" in fault.what for fault in faults)
    Recorder(recording, layout).close()
    assert doctor(recording) == []


def test_one_number_that_never_changes_is_worth_a_note(tmp_path):
    layout = layout_of(10, ("go", "turn"), vectors={"wheel": 2, "lamp": 1})
    rng = np.random.default_rng(0)
    with Recorder(tmp_path, layout) as recorder:
        for _ in range(40):
            recorder.add({"wheel": rng.normal(size=2), "lamp": [0.5]}, [rng.normal(), 0.25])
    found = examine(tmp_path)
    assert found.faults == []
    assert found.notes == [
        "the observation.lamp is [0.5] in all 40 rows: is the sensor covered, or not plugged in?",
        "action: turn never changes in 40 rows",
    ]


def test_the_same_pictures_twice_are_named(tmp_path):
    rng = np.random.default_rng(0)
    pictures = np.kron(rng.integers(0, 255, (20, 4, 4, 3)), np.ones((1, 8, 8, 1))).astype(np.uint8)
    with Recorder(tmp_path, layout_of(10, ("go",), rgb=(32, 32))) as recorder:
        for episode in range(3):
            for i in range(20):
                recorder.add({"rgb": pictures[i] if episode != 1 else np.zeros((32, 32, 3), np.uint8)}, [rng.normal()])
            recorder.end_episode()
        for _ in range(20):
            recorder.add({"rgb": np.zeros((32, 32, 3), np.uint8)}, [rng.normal()])
    faults = doctor(tmp_path)
    assert [fault.what for fault in faults] == [
        "episode 2 shows the same pictures as episode 0"
    ]  # dark ones are no twins


LIDAR, SIDE = "observation.points.lidar", "observation.images.side"


def _stream_table(root: Path, name: str, **columns) -> None:
    path = root / f"streams/{name}/chunk-000/file-001.parquet"
    table = pq.read_table(path).to_pydict()
    table |= {key: make(table[key]) for key, make in columns.items()}
    form = {"value": pa.large_list(pa.float32()), "time_s": pa.float64()}
    pq.write_table(pa.table({key: pa.array(values, form[key]) for key, values in table.items()}), path)


STREAMS = {
    "times": (
        lambda root: _stream_table(root, LIDAR, time_s=lambda v: put(v, 4, 0.0)),
        LIDAR,
        "reading 4 .* not ascend",
    ),
    "nan time": (
        lambda root: _stream_table(root, LIDAR, time_s=lambda v: put(v, 4, float("nan"))),
        LIDAR,
        "not ascend",
    ),
    "values": (lambda root: _stream_table(root, LIDAR, value=lambda v: put(v, 4, [1.0] * 4)), LIDAR, "reading 4 has 4"),
    "cut": (lambda root: cut(root / f"streams/{LIDAR}/chunk-000/file-001.parquet"), LIDAR, "truncated"),
    "film length": (
        lambda root: _stream_table(root, SIDE, time_s=lambda v: v[:-1]),
        SIDE,
        "6 frames, its table 5 times",
    ),
    "film": (lambda root: (root / f"streams/{SIDE}/chunk-000/file-001.mp4").unlink(), SIDE, "is missing"),
    "film times": (
        lambda root: (root / f"streams/{SIDE}/chunk-000/file-001.parquet").unlink(),
        SIDE,
        "times of this film",
    ),
    "all": (lambda root: shutil.rmtree(root / f"streams/{LIDAR}"), LIDAR, "no episode has any of it"),
    "left over": (
        lambda root: shutil.copy(
            root / f"streams/{LIDAR}/chunk-000/file-001.parquet", root / f"streams/{LIDAR}/chunk-000/file-007.parquet"
        ),
        LIDAR,
        "no episode and no stream",
    ),
}


@pytest.mark.parametrize("name", STREAMS)
def test_faults_of_streams_are_named(tmp_path, name):
    streams = {LIDAR: Sensor(LIDAR, "points", (0, 3)), SIDE: Sensor(SIDE, "image", (16, 16, 3), "uint8", rate_hz=5)}
    layout = Layout(10, layout_of(10, ("go",), pose=True).sensors, streams=streams)
    with Recorder(tmp_path, layout) as recorder:
        for _ in range(3):
            for i in range(6):
                recorder.add({"pose": np.arange(7) + i}, [np.random.default_rng(i).normal()])
                recorder.log(LIDAR, np.full((1 + i, 3), i, np.float32), time_s=i / 10)
                recorder.log(SIDE, np.full((16, 16, 3), 40 * i, np.uint8), time_s=i / 10)
            recorder.end_episode()
    inject, stream, words = STREAMS[name]
    twins = doctor(tmp_path)
    assert all("same" in fault.what for fault in twins)
    inject(tmp_path)
    found = [fault for fault in doctor(tmp_path) if fault not in twins]
    assert len(found) == 1 and found[0].file.startswith(f"streams/{stream}") and re.search(words, found[0].what), found
    assert found[0].mend


def test_a_file_of_many_episodes_is_read_once(recording, monkeypatch):
    from strangers import shared

    from terrella.care import pieces

    root = shared(recording, recording.parent / "shared")
    opened: list[Path] = []
    real = pieces.open_parquet
    monkeypatch.setattr(pieces, "open_parquet", lambda path: opened.append(path) or real(path))
    assert doctor(root) == []
    assert sum("data" in str(path.relative_to(root)) for path in opened) <= 2
