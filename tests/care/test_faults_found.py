"""Faults that people met: each is named as what it is, first, and repaired without loss, or not without being asked."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from layouts import layout_of
from PIL import Image
from sweeps import sweep
from test_doctor import DATA

from terrella.care import doctor, repair
from terrella.care.doctor import examine
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Layout, Recorder
from terrella.data.source import Sensor
from terrella.data.storage import mp4

CAMERA, OTHER = "observation.images.rgb", "observation.images.side"
LENGTHS = [20, 20, 20, 12, 12, 12, 9, 9]


def info(root: Path, **changes) -> None:
    told = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**told, **changes}))


def column(path: Path, name: str, values) -> None:
    table = pq.read_table(path, partitioning=None)  # pyright: ignore
    at = table.schema.get_field_index(name)
    kind = table.schema.field(name)
    pq.write_table(table.set_column(at, kind, pa.array(values, kind.type)), path)


@pytest.fixture(scope="module")
def _thirteen(tmp_path_factory) -> Path:
    """Eight episodes at 13 frames a second: a picture that brightens, a state that moves, actions at random."""
    root, rng = tmp_path_factory.mktemp("thirteen") / "set", np.random.default_rng(0)
    layout = layout_of(13, ("go", "turn"), rgb=(32, 48), pose=True)
    y, x = np.mgrid[:32, :48]
    with Recorder(root, layout) as recorder:
        for number, length in enumerate(LENGTHS):
            for i in range(length):
                grey = (60 + 12 * number + 2 * i + 30 * np.sin((x + number) / 5) + 20 * np.cos(y / 4)).clip(0, 255)
                picture = np.stack([grey, 255 - grey, grey // (1 + number % 3)], -1).astype(np.uint8)
                pose = np.array([i + number, number, 1, 1, 0, 0, 0]) + rng.normal(size=7) / 50
                recorder.add({"rgb": picture, "pose": pose}, rng.normal(size=2))
            recorder.end_episode()
    return root


@pytest.fixture
def thirteen(_thirteen, tmp_path) -> Path:
    shutil.copytree(_thirteen, tmp_path / "set")
    return tmp_path / "set"


def video(number: int, camera: str = CAMERA) -> str:
    return f"videos/{camera}/chunk-000/file-{number:03d}.mp4"


def test_a_moving_set_is_sound(thirteen, tmp_path):
    assert doctor(thirteen) == []
    repair(thirteen, tmp_path / "out")
    assert doctor(tmp_path / "out") == []


# -- the rate --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", sweep([30, 12.5, 26], 26))
def test_a_wrong_fps_is_named_as_one_fault_and_repaired_without_loss(thirteen, tmp_path, wrong):
    info(thirteen, fps=wrong)
    faults = doctor(thirteen)
    assert [fault.file for fault in faults] == ["meta/info.json"], faults
    assert f"fps is {wrong:g}" in faults[0].what and "13 frames per second" in faults[0].what
    said = repair(thirteen, tmp_path / "out")
    mended = Dataset(tmp_path / "out")
    assert mended.fps == 13 and [episode.length for episode in mended.episodes] == LENGTHS
    assert any("fps" in sentence for sentence in said) and doctor(tmp_path / "out") == []
    whole = Dataset(thirteen.parent / "set")
    assert len(whole.episodes) == len(mended.episodes)


def test_timestamps_alone_that_disagree_are_not_taken_for_the_fps(thirteen):
    for number, length in enumerate(LENGTHS):
        column(thirteen / f"data/chunk-000/file-{number:03d}.parquet", "timestamp", np.arange(length) / 30)
    found = examine(thirteen)
    assert all("timestamp" in fault.what for fault in found.faults) and len(found.groups) == 2


def _slow_videos(root: Path) -> None:
    """Videos at half the rate: every second row has no frame."""
    for number, length in enumerate(LENGTHS):
        pictures = list(mp4.decode_frames(root / video(number), 0, length, 13))
        writer = mp4.Mp4Writer(root / "growing.mp4", (32, 48), 6.5)
        for picture in pictures:
            writer.add(picture)
        writer.close()
        mp4.finish_video(root / "growing.mp4", root / video(number))
        (root / "growing.mp4").unlink()


def test_a_repair_that_would_lose_most_rows_asks_first(thirteen, tmp_path):
    _slow_videos(thirteen)
    assert "the videos run at 6.5 frames per second" in doctor(thirteen)[0].what
    with pytest.raises(DatasetError, match="would be kept.*allow the loss"):
        repair(thirteen, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    asked: list[str] = []
    with pytest.raises(DatasetError):
        repair(thirteen, tmp_path / "out", allow_loss=lambda sentence: bool(asked.append(sentence)))
    assert len(asked) == 1 and "114 rows" in asked[0] and not (tmp_path / "out").exists()
    repair(thirteen, tmp_path / "out", allow_loss=True)
    assert 0 < Dataset(tmp_path / "out").length < 80


# -- films -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", sweep([(0, 1), (0.4, 0.6), (0.7, 1)], (0.4, 0.6)))
def test_zeroed_bytes_of_a_film_are_named_and_left_out(thirteen, tmp_path, part):
    path = thirteen / video(1)
    raw = bytearray(path.read_bytes())
    first = raw.rfind(b"mdat") + 4
    begin, end = (first + int(share * (len(raw) - first)) for share in part)
    raw[begin:end] = bytes(end - begin)
    path.write_bytes(raw)
    faults = doctor(thirteen)
    assert [fault.file for fault in faults] == [video(1)] and "overwritten with zeros" in faults[0].what
    assert faults[0].row is not None and 20 <= faults[0].row < 40
    repair(thirteen, tmp_path / "out")
    assert doctor(tmp_path / "out") == []
    assert sum(LENGTHS) - 20 <= Dataset(tmp_path / "out").length < sum(LENGTHS)


def test_a_black_film_is_named(thirteen):
    writer = mp4.Mp4Writer(thirteen / video(1), (32, 48), 13)
    for _ in range(20):
        writer.add(np.zeros((32, 48, 3), np.uint8))
    writer.close()
    faults = doctor(thirteen)
    assert [fault.file for fault in faults] == [video(1)] and "mean brightness is 0%" in faults[0].what


def _exchange(root: Path, a: str, b: str) -> None:
    first, second = (root / a).read_bytes(), (root / b).read_bytes()
    (root / a).write_bytes(second)
    (root / b).write_bytes(first)


@pytest.mark.parametrize(
    "one, two", [(3, 5), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((0, 1), (6, 7)))]
)
def test_exchanged_films_are_named_and_put_back(thirteen, tmp_path, one, two):
    before = [Dataset(thirteen).episode(number)["rgb"] for number in (one, two)]
    _exchange(thirteen, video(one), video(two))
    faults = doctor(thirteen)
    assert {fault.file for fault in faults} == {video(one), video(two)}, faults
    assert all("the two videos were exchanged" in fault.what for fault in faults)
    said = repair(thirteen, tmp_path / "out")
    assert any(f"shows episode {two}" in sentence for sentence in said)
    mended = Dataset(tmp_path / "out")
    for number, pictures in zip((one, two), before):
        assert np.array_equal(mended.episode(number)["rgb"], pictures)
    assert doctor(tmp_path / "out") == []


def test_exchanged_films_of_other_lengths_are_named_first(thirteen, tmp_path):
    _exchange(thirteen, video(2), video(3))
    faults = doctor(thirteen)
    assert "the two videos were exchanged" in faults[0].what and any("needs 20" in fault.what for fault in faults)
    repair(thirteen, tmp_path / "out")
    assert [episode.length for episode in Dataset(tmp_path / "out").episodes] == LENGTHS


@pytest.mark.parametrize("episodes", sweep([[1], [0, 1, 2, 3, 4]], [1]))
def test_films_exchanged_between_cameras_are_named_and_put_back(tmp_path, episodes):
    cameras = {name: Sensor(name, "image", (32, 32, 3), "uint8") for name in (CAMERA, OTHER)}
    action = {"action": Sensor("action", "vector", (1,), names=("go",))}
    rng = np.random.default_rng(0)
    with Recorder(tmp_path / "set", Layout(13, {**cameras, **action})) as recorder:
        for number in range(5):
            for i in range(20):
                dark = np.full((32, 32, 3), 20 + 3 * number + i, np.uint8)
                row = {CAMERA: dark, OTHER: 255 - dark // 2, "action": rng.normal(size=1).astype(np.float32)}
                recorder.add_row(row)
            recorder.end_episode()
    assert doctor(tmp_path / "set") == []
    before = [Dataset(tmp_path / "set").episode(number, [CAMERA])[CAMERA] for number in range(5)]
    for number in episodes:
        _exchange(tmp_path / "set", video(number), video(number, OTHER))
    faults = doctor(tmp_path / "set")
    assert len(faults) == 2 * len(episodes) and all("the two videos were exchanged" in fault.what for fault in faults)
    repair(tmp_path / "set", tmp_path / "out")
    for number, pictures in enumerate(before):
        assert np.array_equal(Dataset(tmp_path / "out").episode(number, [CAMERA])[CAMERA], pictures)
    assert doctor(tmp_path / "out") == []


def test_films_that_are_all_black_are_named(thirteen):
    for number, length in enumerate(LENGTHS):
        writer = mp4.Mp4Writer(thirteen / video(number), (32, 48), 13)
        for _ in range(length):
            writer.add(np.zeros((32, 48, 3), np.uint8))
        writer.close()
    found = examine(thirteen)
    assert len(found.faults) == len(LENGTHS) and len(found.groups) == 1


# -- rows ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frozen_from", [0, 5])
def test_a_frozen_state_is_named(tmp_path, frozen_from):
    rng = np.random.default_rng(1)
    with Recorder(tmp_path / "set", layout_of(13, ("go",), pose=True)) as recorder:
        for number in range(3):
            for i in range(60):
                still = number == 1 and i >= frozen_from
                pose = np.full(7, 3.0) if still else rng.normal(size=7)
                recorder.add({"pose": pose}, rng.normal(size=1))
            recorder.end_episode()
    faults = doctor(tmp_path / "set")
    assert len(faults) == 1 and "observation.state of episode 1 is frozen" in faults[0].what
    assert faults[0].row == 60 + frozen_from


def test_a_body_at_rest_is_not_frozen(tmp_path):
    """Nothing is done, or it holds still for a while: that is no fault."""
    rng = np.random.default_rng(1)
    with Recorder(tmp_path / "set", layout_of(13, ("go",), pose=True)) as recorder:
        for number in range(3):
            for i in range(60):
                rest = number == 1 or i < 25
                action = np.zeros(1) if rest else rng.normal(size=1)
                recorder.add({"pose": np.full(7, 3.0) if rest else rng.normal(size=7)}, action)
            recorder.end_episode()
    assert [fault for fault in doctor(tmp_path / "set") if "frozen" in fault.what] == []


@pytest.mark.parametrize("length", sweep([7, 300], 300))
def test_a_wrong_length_in_the_table_of_episodes_is_named(thirteen, tmp_path, length):
    path = "meta/episodes/chunk-000/file-002.parquet"
    column(thirteen / path, "length", [length])
    faults = doctor(thirteen)
    assert [fault.file for fault in faults] == [path] and f"length {length}" in faults[0].what
    repair(thirteen, tmp_path / "out")
    assert doctor(tmp_path / "out") == []


# -- pictures in the rows --------------------------------------------------------------------------------------------


@pytest.fixture
def pictured(tmp_path) -> Path:
    layout = Layout(10, layout_of(10, ("go",), rgb=(8, 8), pose=True).sensors, pictures="png")
    rng = np.random.default_rng(0)
    with Recorder(tmp_path / "set", layout) as recorder:
        for length in (30, 31, 10):
            for _ in range(length):
                recorder.add(
                    {"rgb": rng.integers(0, 255, (8, 8, 3), np.uint8), "pose": rng.normal(size=7)}, rng.normal(size=1)
                )
            recorder.end_episode()
    return tmp_path / "set"


def test_pictures_that_cannot_be_decoded_are_named_and_left_out(pictured, tmp_path):
    column_of = pq.read_table(pictured / DATA)[CAMERA].to_pylist()
    for row in (4, 5, 20):
        column_of[row] = {"bytes": column_of[row]["bytes"][:60], "path": None}
    column(pictured / DATA, CAMERA, column_of)
    faults = doctor(pictured)
    assert [fault.what for fault in faults] == [f"3 of 31 pictures of {CAMERA} cannot be decoded"]
    assert faults[0].file == DATA and faults[0].row == 34
    repair(pictured, tmp_path / "out")
    assert Dataset(tmp_path / "out").length == 71 - 3 and doctor(tmp_path / "out") == []


def _depth_png(depth_mm: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(depth_mm.astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.fixture
def deep(pictured) -> Path:
    """With a camera of one channel of 16 bits, as LeRobot keeps depth."""
    rng = np.random.default_rng(3)
    for path in sorted((pictured / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        pictures = [_depth_png(rng.integers(300, 9000, (8, 8))) for _ in range(len(table))]
        form = table.schema.field(CAMERA).type
        made = pa.array([{"bytes": picture, "path": None} for picture in pictures], form)
        pq.write_table(table.append_column("observation.images.depth", made), path)
    told = json.loads((pictured / "meta/info.json").read_text())
    feature = {"dtype": "image", "shape": [8, 8, 1], "names": ["height", "width", "channels"]}
    told["features"]["observation.images.depth"] = feature
    (pictured / "meta/info.json").write_text(json.dumps(told))
    return pictured


@pytest.mark.parametrize("info_lost", sweep([False, True], True))
def test_depth_of_sixteen_bits_keeps_them(deep, tmp_path, info_lost):
    before = pq.read_table(deep / DATA)["observation.images.depth"].to_pylist()
    assert [fault for fault in doctor(deep) if fault.file != "meta/stats.json"] == []
    if info_lost:
        (deep / "meta/info.json").unlink()
        (deep / "meta/terrella.json").unlink()
    repair(deep, tmp_path / "out")
    told = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert told["features"]["observation.images.depth"]["shape"] == [8, 8, 1]
    after = pq.read_table(tmp_path / "out" / DATA)["observation.images.depth"].to_pylist()
    for was, now in zip(before, after, strict=True):
        with Image.open(io.BytesIO(was["bytes"])) as a, Image.open(io.BytesIO(now["bytes"])) as b:
            assert np.array_equal(np.asarray(a), np.asarray(b)) and np.asarray(b).max() > 255
    assert doctor(tmp_path / "out") == []


# -- the report ------------------------------------------------------------------------------------------------------


def test_the_report_has_the_verdict_first_and_groups_what_is_alike(thirteen):
    for number, length in enumerate(LENGTHS):
        (thirteen / video(number)).unlink()
        column(thirteen / f"data/chunk-000/file-{number:03d}.parquet", "next.reward", [float("nan")] * length)
    found = examine(thirteen)
    lines = found.report("SET").splitlines()
    assert lines[0] == "SET: 16 faults of 2 kinds" and lines[1].startswith("likeliest cause: ")
    assert len(found.groups) == 2 and sum(map(len, found.groups)) == len(found.faults) == 16
    assert len(lines) < 10 and any("8 of this kind" in line and "5 more" in line for line in lines)


def test_the_report_of_a_sound_recording_is_one_line(thirteen):
    assert examine(thirteen).report("SET") == "SET: sound, no fault"
