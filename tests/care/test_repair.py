"""A repair keeps every row that is whole, as it was, and what it makes is sound."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import layout_of
from strangers import killed, shared
from sweeps import sweep
from test_doctor import DATA, VIDEO, change, cut, put, small_video, twin
from test_interrupted import LAYOUT, LIDAR, SIDE, drive

from terrella.care import doctor, repair
from terrella.cli import main
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Recorder
from terrella.data.storage.films import read_packets

COUNTERS = ("index", "frame_index", "episode_index", "timestamp", "task_index")


def rows(dataset: Dataset, number: int) -> dict[str, np.ndarray]:
    """All that an episode's rows hold, but for the counters."""
    names = [name for name in dataset.features if name not in COUNTERS]
    return dataset.episode(number, names)


def check(root: Path, out: Path, kept: list[tuple[int, int, int]], truth: Path | None = None) -> list[str]:
    """Repairs; the copy has just these rows (episode, begin, end) of the original `truth`, and no fault."""
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    said = repair(root, out)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    whole, mended = Dataset(truth or root), Dataset(out)
    assert [episode.length for episode in mended.episodes] == [end - begin for _, begin, end in kept]
    for number, (old, begin, end) in enumerate(kept):
        was, now = rows(whole, old), rows(mended, number)
        for name, array in now.items():
            if name == "action_valid":
                array, was[name] = array[:-1], np.concatenate([was[name][: end - 1], [False]])
                end_here = end - 1
            else:
                end_here = end
            exact = name not in mended.cameras or not any(f"episode {old}: the video" in sentence for sentence in said)
            off = np.abs(array.astype(float) - was[name][begin:end_here].astype(float))
            assert off.max(initial=0) == 0 if exact else off.mean() < 4, (name, number)
    assert doctor(out) == []
    return said


@pytest.fixture
def sound(recording, tmp_path) -> Path:
    shutil.copytree(recording, tmp_path / "sound")
    return tmp_path / "sound"


ALL = [(0, 0, 30), (1, 0, 30), (2, 0, 30), (3, 0, 10)]
WITHOUT = [(0, 0, 30), (2, 0, 30), (3, 0, 10)]


def _info(root: Path, **changes) -> None:
    told = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**told, **changes}))


def _remove(*names: str) -> Callable[[Path], None]:
    def inject(root: Path) -> None:
        for name in names:
            shutil.rmtree(root / name) if (root / name).is_dir() else (root / name).unlink()

    return inject


def _shape(root: Path) -> None:
    told = json.loads((root / "meta/info.json").read_text())
    told["features"]["observation.images.rgb"]["shape"] = [64, 48, 3]
    (root / "meta/info.json").write_text(json.dumps(told))


def _renamed(root: Path) -> None:
    text = (root / "meta/info.json").read_text()
    (root / "meta/info.json").write_text(text.replace("observation.images.rgb", "observation.images.lost"))


def _rows_away(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(pa.concat_tables([table.slice(0, 10), table.slice(12)]), root / DATA)


DAMAGES: dict[str, tuple[Callable[[Path], None], list[tuple[int, int, int]], str]] = {
    "nothing": (lambda root: None, ALL, "4 whole episodes"),
    "info.json": (_remove("meta/info.json"), ALL, "4 whole episodes"),
    "meta/episodes": (_remove("meta/episodes"), ALL, "4 whole episodes"),
    "info.json and meta/episodes": (_remove("meta/info.json", "meta/episodes"), ALL, "4 whole episodes"),
    "stats and tasks": (_remove("meta/stats.json", "meta/tasks.parquet"), ALL, "4 whole episodes"),
    "terrella.json": (_remove("meta/terrella.json"), ALL, "4 whole episodes"),
    "one table of episodes": (lambda root: cut(root / "meta/episodes/chunk-000/file-002.parquet"), ALL, "4 whole"),
    "totals": (lambda root: _info(root, total_frames=7, total_episodes=99), ALL, "4 whole episodes"),
    "counters": (lambda root: change(root, "index", lambda v: put(v, 7, 99)), ALL, "4 whole episodes"),
    "frame_index": (lambda root: change(root, "frame_index", lambda v: [0] * len(v)), ALL, "4 whole episodes"),
    "timestamps": (lambda root: change(root, "timestamp", lambda v: [2 * t for t in v]), ALL, "4 whole episodes"),
    "a footer": (lambda root: cut(root / DATA, 0.9), ALL, "no readable footer: 30 rows"),
    "a table": (lambda root: cut(root / DATA, 0.1), WITHOUT, "episode 1: none of its 30 rows is kept"),
    "a table away": (_remove(DATA), WITHOUT, "episode 1: none of its 30 rows is kept"),
    "a video away": (_remove(VIDEO), WITHOUT, "episode 1: none of its 30 rows is kept"),
    "a cut video": (
        lambda root: cut(root / VIDEO),
        [(0, 0, 30), (1, 0, 8), (2, 0, 30), (3, 0, 10)],
        "its rows 0 to 7 of 30 are kept",
    ),
    "rows away": (
        _rows_away,
        [(0, 0, 30), (1, 0, 10), (1, 12, 30), (2, 0, 30), (3, 0, 10)],
        "rows 0 to 9, 12 to 29 of 30 are kept as episodes of their own",
    ),
    "a number that is none": (
        lambda root: change(root, "next.reward", lambda v: put(v, 4, float("nan"))),
        [(0, 0, 30), (1, 0, 4), (1, 5, 30), (2, 0, 30), (3, 0, 10)],
        "encoded again",
    ),
    "a small video": (
        small_video,
        WITHOUT,
        "have another size than the others",
    ),
    "a shape in info.json": (_shape, ALL, "48x64, which info.json now states"),
    "a camera's name": (_renamed, ALL, "kept"),
    "a copied file": (lambda root: shutil.copy(root / DATA, root / "data/chunk-000/file-004.parquet"), ALL, "4 whole"),
}


QUICK = (
    "info.json and meta/episodes",
    "a footer",
    "a cut video",
    "a copied file",
    "rows away",
    "a number that is none",
)


@pytest.mark.parametrize("name", sweep(DAMAGES, *QUICK))
def test_what_is_whole_is_kept_as_it_was(recording, sound, name, tmp_path):
    inject, kept, words = DAMAGES[name]
    inject(recording)
    said = check(recording, tmp_path / "out", kept, sound)
    assert any(words in sentence for sentence in said), said


def test_packets_are_copied_without_encoding_anew(recording, tmp_path):
    repair(recording, tmp_path / "out")
    before, after = read_packets(recording / VIDEO, 35), read_packets(tmp_path / "out" / VIDEO, 35)
    assert np.array_equal(before.digests, after.digests) and len(before.frames) == 30
    cut(recording / VIDEO)
    repair(recording, tmp_path / "again")
    after = read_packets(tmp_path / "again" / VIDEO, 35)
    assert np.array_equal(before.digests[: len(after.frames)], after.digests) and len(after.frames) == 8


def test_facts_and_names_stay(recording, tmp_path):
    _info(recording, license="mit", splits={"train": "0:2", "test": "2:4"})
    repair(recording, tmp_path / "out")
    before, after = Dataset(recording), Dataset(tmp_path / "out")
    assert after.features == before.features and after.about == before.about
    assert after.info == before.info
    assert [episode.task for episode in after.episodes] == [episode.task for episode in before.episodes]


def test_a_column_that_is_mostly_missing_is_no_reason_to_drop_rows(recording, sound, tmp_path):
    change(recording, "next.reward", lambda v: [float("nan")] * 20 + v[20:])
    said = repair(recording, tmp_path / "out")
    assert [episode.length for episode in Dataset(tmp_path / "out").episodes] == [30, 30, 30, 10]
    assert any("next.reward is not finite in 20 of 30 rows, which stay" in sentence for sentence in said)


def test_twins_are_kept_both(recording, tmp_path):
    twin(recording)
    assert any("same actions and states" in fault.what for fault in doctor(recording))
    repair(recording, tmp_path / "out")
    assert [episode.length for episode in Dataset(tmp_path / "out").episodes] == [30, 30, 30, 10]


@settings(max_examples=12, deadline=None, derandomize=True)
@given(data=st.data())
def test_every_good_row_is_kept_once_and_no_other(data):
    """Rows are taken away, spoilt by NaN, or have their counters spoilt: each that is left and finite is in the copy once."""
    lengths = data.draw(st.lists(st.integers(2, 12), min_size=1, max_size=4), label="lengths")
    rows = sum(lengths)
    away = data.draw(st.sets(st.integers(0, rows - 1), max_size=4), label="away")
    spoilt = data.draw(st.sets(st.integers(0, rows - 1), max_size=3), label="spoilt")
    counter = data.draw(st.sampled_from(["index", "frame_index", "timestamp", None]), label="counter")
    with tempfile.TemporaryDirectory() as folder:
        root, out = Path(folder) / "root", Path(folder) / "out"
        with Recorder(root, layout_of(10, ("number",), vectors={"wheel": 1})) as recorder:
            at = 0
            for length in lengths:
                for _ in range(length):
                    recorder.add({"wheel": [at]}, [at])
                    at += 1
                recorder.end_episode()
        good, start = [], 0
        for number, length in enumerate(lengths):
            path = root / f"data/chunk-000/file-{number:03d}.parquet"
            table = pq.read_table(path)
            mine = [row for row in range(start, start + length) if row not in away]
            bad = [row for row in mine if row in spoilt]
            wheel = [float("nan") if row in spoilt else float(row) for row in mine]
            table = table.take(pa.array([row - start for row in mine], pa.int64()))
            table = table.set_column(0, table.schema.field(0), pa.array(wheel, pa.float32()))
            if counter and mine:
                at = table.schema.get_field_index(counter)
                column = pa.array([0] * len(mine), table.schema.field(at).type)
                table = table.set_column(at, table.schema.field(at), column)
            pq.write_table(table, path)
            good += mine if len(bad) > len(mine) / 2 else [row for row in mine if row not in spoilt]
            start += length
        if not good:
            with pytest.raises(DatasetError, match="nothing"):
                repair(root, out)
            return
        repair(root, out)
        mended = Dataset(out)
        found = [mended.episode(number) for number in range(len(mended.episodes))]
        assert np.concatenate([episode["action"][:, 0] for episode in found]).tolist() == good
        for episode in found:  # what follows one another in an episode did so before
            assert np.array_equal(np.diff(episode["action"][:, 0]), np.ones(len(episode["action"]) - 1))
        assert [fault for fault in doctor(out) if "finite" not in fault.what] == []


# -- strangers -------------------------------------------------------------------------------------------------------


def test_a_strangers_shared_files_become_episodes_of_their_own(recording, tmp_path):
    root = shared(recording, tmp_path / "stranger")
    assert doctor(root) == []
    said = check(root, tmp_path / "out", ALL)
    again = [sentence for sentence in said if "encoded again" in sentence]
    assert 1 <= len(again) <= 2 and "episode 3: the video of observation.images.rgb from frame 0" in again[-1]
    mended = Dataset(tmp_path / "out")
    assert mended.info["robot_type"] == "corridor" and mended.info["license"] == "mit"
    assert mended.info["splits"] == {"train": "0:3", "test": "3:4"} and "action_valid" not in mended.features


def test_a_killed_strangers_recording_is_found_again_by_its_pages(recording, tmp_path):
    """As LeRobot leaves it: a data file without a footer, no meta/episodes, several episodes in one video."""
    whole = shared(recording, tmp_path / "whole")
    root = killed(whole, tmp_path / "killed")
    with pytest.raises(DatasetError):
        Dataset(root).episode(0)
    assert {fault.file for fault in doctor(root)} == {"meta/episodes", "data/chunk-000/file-000.parquet"}
    said = check(root, tmp_path / "out", ALL, whole)
    assert any("100 rows were recovered from its pages" in sentence for sentence in said)
    assert any("4 episodes were located in the videos" in sentence for sentence in said)


def test_a_row_group_that_cannot_be_read_costs_its_episode_alone(recording, tmp_path):
    whole = shared(recording, tmp_path / "whole")
    root = tmp_path / "stranger"
    shutil.copytree(whole, root)
    path = root / "data/chunk-000/file-000.parquet"
    group = pq.read_metadata(path).row_group(2)
    raw = bytearray(path.read_bytes())
    at = group.column(0).data_page_offset
    raw[at : at + 8] = b"\xff" * 8
    path.write_bytes(raw)
    faults = doctor(root)
    assert [(fault.row, fault.file) for fault in faults if "30 rows" in fault.what] == [
        (60, "data/chunk-000/file-000.parquet")
    ]
    check(root, tmp_path / "out", [(0, 0, 30), (1, 0, 30), (3, 0, 10)], whole)


# -- an interrupted episode, streams ---------------------------------------------------------------------------------


@pytest.fixture
def interrupted(tmp_path) -> Path:
    """Two episodes with streams, and one in flight of a recorder that was killed."""
    recorder = Recorder(tmp_path / "rig", LAYOUT, "patrol")
    for length in (25, 20):
        drive(recorder, length)
        recorder.end_episode()
    drive(recorder, 18)
    recorder._stop()  # all that was added has reached the disk
    shutil.copytree(tmp_path / "rig", tmp_path / "killed")
    recorder._discard()
    recorder.close()
    return tmp_path / "killed"


def test_an_interrupted_episode_is_named_and_recovered(interrupted, tmp_path):
    faults = doctor(interrupted)
    assert [fault.file for fault in faults] == [".staging/rows.log"]
    assert "18 whole rows, 18 frames of observation.images.rgb" in faults[0].what
    said = repair(interrupted, tmp_path / "out")
    assert said[-1] == "the interrupted episode is recovered up to its last whole row: 18 rows"
    mended = Dataset(tmp_path / "out")
    assert [episode.length for episode in mended.episodes] == [25, 20, 18] and doctor(tmp_path / "out") == []
    assert mended.episode(2)["pose"][:, 0].tolist() == list(range(18))
    assert len(mended.readings(2, LIDAR).time_s) == 18 and len(mended.readings(2, SIDE).time_s) == 5


def test_recording_on_keeps_an_interrupted_episode_once(interrupted, tmp_path):
    Recorder(interrupted, LAYOUT).close()
    assert doctor(interrupted) == []
    repair(interrupted, tmp_path / "out")
    assert [episode.length for episode in Dataset(tmp_path / "out").episodes] == [25, 20, 18]


def test_streams_are_carried_over_and_split_with_their_rows(interrupted, tmp_path):
    shutil.rmtree(interrupted / ".staging")
    whole = Dataset(interrupted)
    table = pq.read_table(interrupted / DATA)
    states = table["observation.state"].to_pylist()
    at = table.schema.get_field_index("observation.state")
    states[8] = [float("inf")] * 7
    shutil.copytree(interrupted, tmp_path / "sound")
    pq.write_table(
        table.set_column(at, table.schema.field(at), pa.array(states, table.schema.field(at).type)), interrupted / DATA
    )
    repair(interrupted, tmp_path / "out")
    mended, whole = Dataset(tmp_path / "out"), Dataset(tmp_path / "sound")
    assert [episode.length for episode in mended.episodes] == [25, 8, 11] and doctor(tmp_path / "out") == []
    for name in (LIDAR, SIDE):
        was, now = whole.readings(0, name), mended.readings(0, name)
        assert np.array_equal(was.time_s, now.time_s)
        assert all(np.array_equal(a, b) for a, b in zip(was.values, now.values))
    was = whole.readings(1, LIDAR)
    first, second = mended.readings(1, LIDAR), mended.readings(2, LIDAR)
    assert np.array_equal(first.time_s, was.time_s[:8])
    assert np.allclose(second.time_s + 9 / 20, was.time_s[9:])  # its time 0 is its own first row
    assert all(np.array_equal(a, b) for a, b in zip(was.values[9:], second.values))
    assert mended.time_s(2)[0] == 0 and np.allclose(np.diff(mended.time_s(2)), 1 / 20)
    starts = [episode.start_ns for episode in mended.episodes]
    assert starts[1] and starts[2] and starts[2] - starts[1] == 450_000_000


def test_a_cut_stream_costs_the_stream_alone(interrupted, tmp_path):
    shutil.rmtree(interrupted / ".staging")
    cut(interrupted / f"streams/{LIDAR}/chunk-000/file-001.parquet")
    film = interrupted / f"streams/{SIDE}/chunk-000/file-000.mp4"
    cut(film, 0.97)
    files = {fault.file for fault in doctor(interrupted)}
    assert files == {f"streams/{LIDAR}/chunk-000/file-001.parquet", str(film.relative_to(interrupted))}
    said = repair(interrupted, tmp_path / "out")
    mended = Dataset(tmp_path / "out")
    assert [episode.length for episode in mended.episodes] == [25, 20] and doctor(tmp_path / "out") == []
    assert len(mended.readings(1, LIDAR).time_s) == 0 and len(mended.readings(0, LIDAR).time_s) == 25
    assert 0 < len(mended.readings(0, SIDE).time_s) < 7
    assert any(LIDAR in sentence for sentence in said)


def test_a_spoilt_picture_of_a_stream_cuts_its_film_there(interrupted, tmp_path):
    shutil.rmtree(interrupted / ".staging")
    film = interrupted / f"streams/{SIDE}/chunk-000/file-000.mp4"
    with av.open(str(film)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    raw = bytearray(film.read_bytes())
    at, size = packets[3]
    raw[at : at + size] = b"\xff" * size
    film.write_bytes(raw)
    repair(interrupted, tmp_path / "out")
    mended = Dataset(tmp_path / "out")
    assert [episode.length for episode in mended.episodes] == [25, 20] and doctor(tmp_path / "out") == []
    kept = mended.readings(0, SIDE)
    assert len(kept.time_s) == 3 and len(list(kept.values)) == 3
    assert len(mended.readings(1, SIDE).time_s) == 5


def test_streams_are_declared_anew_from_their_tables(interrupted, tmp_path):
    shutil.rmtree(interrupted / ".staging")
    before = Dataset(interrupted).streams
    (interrupted / "meta/terrella.json").unlink()
    assert "meta/terrella.json" in {fault.file for fault in doctor(interrupted)}
    repair(interrupted, tmp_path / "out")
    assert Dataset(tmp_path / "out").streams == before and doctor(tmp_path / "out") == []


# -- refusals --------------------------------------------------------------------------------------------------------


def test_what_cannot_be_repaired_is_refused_clearly(recording, tmp_path):
    with pytest.raises(DatasetError, match="no dataset"):
        repair(tmp_path / "nowhere", tmp_path / "out")
    (tmp_path / "photos").mkdir()
    with pytest.raises(DatasetError, match="not a LeRobot"):
        repair(tmp_path / "photos", tmp_path / "out")
    for out in (recording, recording / "mended"):
        with pytest.raises(DatasetError, match="another folder|not empty"):
            repair(recording, out)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    with pytest.raises(DatasetError, match="not empty"):
        repair(recording, tmp_path / "full")
    for file in (recording / "data").rglob("*.parquet"):
        file.write_bytes(b"PAR1")
    with pytest.raises(DatasetError, match="nothing in .* is whole"):
        repair(recording, tmp_path / "out")


def test_a_full_disk_is_said_clearly(recording, tmp_path, monkeypatch):
    import errno

    from terrella.core import files

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "move_into_place", full)
    with pytest.raises(DatasetError, match="the disk is full"):
        repair(recording, tmp_path / "out")


@pytest.mark.parametrize("error", sweep(["stopped", "full"], "full"))
def test_a_repair_that_ends_early_leaves_nothing_and_can_be_done_again(recording, tmp_path, error):
    raised = KeyboardInterrupt() if error == "stopped" else OSError(28, "No space left on device")
    before = sorted(path.name for path in tmp_path.iterdir())

    def stop(done, of):
        if done == 2:
            raise raised

    with pytest.raises(KeyboardInterrupt if error == "stopped" else DatasetError):
        repair(recording, tmp_path / "out", progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    repair(recording, tmp_path / "out")
    assert len(Dataset(tmp_path / "out").episodes) == 4


def test_ctrl_c_in_a_repair_says_that_nothing_was_written(recording, tmp_path, monkeypatch, capsys):
    def stopped(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("terrella.core.files.move_into_place", stopped)
    with pytest.raises(SystemExit) as ended:
        main(["data", "doctor", str(recording), "--repair", "--out", str(tmp_path / "out")])
    assert ended.value.code == 130 and "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_names_with_nan_in_them_stay_and_numbers_that_are_none_become_null(recording, tmp_path):
    _info(recording, maker={"NaNo": "NaN or -Infinity", "gain": [float("nan"), float("inf"), 2.5]})
    repair(recording, tmp_path / "out")
    told = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert told["maker"] == {"NaNo": "NaN or -Infinity", "gain": [None, None, 2.5]}


def test_a_repair_of_chosen_episodes_says_nothing_of_the_others(recording, tmp_path):
    said = repair(recording, tmp_path / "out", keep=[1, 3])
    assert said[0].startswith("2 whole episodes (40 rows)") and not any("episode 0" in sentence for sentence in said)
