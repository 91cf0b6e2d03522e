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

from terrella.core.errors import DatasetError
from terrella.data import Layout, Recorder, doctor
from terrella.data.mp4 import Mp4Writer

DATA = "data/chunk-000/file-001.parquet"
VIDEO = "videos/observation.images.rgb/chunk-000/file-001.mp4"


def _change(root: Path, column: str, change) -> None:
    table = pq.read_table(root / DATA)
    values = table[column].to_pylist()
    at = table.schema.get_field_index(column)
    new = pa.array(change(values), table.schema.field(column).type)
    pq.write_table(table.set_column(at, table.schema.field(column), new), root / DATA)


def _set(values: list, at: int, value) -> list:
    return [*values[:at], value, *values[at + 1 :]]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


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


FAULTS = {
    "missing table": (lambda root: (root / DATA).unlink(), DATA, 30, "missing"),
    "cut table": (lambda root: _cut(root / DATA), DATA, 30, "truncated"),
    "missing video": (lambda root: (root / VIDEO).unlink(), VIDEO, 30, "missing"),
    "cut video": (lambda root: _cut(root / VIDEO), VIDEO, None, "frames|truncated"),
    "empty video": (lambda root: (root / VIDEO).write_bytes(b""), VIDEO, 30, "truncated"),
    "short video": (_short_video, VIDEO, 51, "21 frames"),
    "missing column": (_without_column, DATA, 30, "'next.reward' is missing"),
    "missing rows": (_without_rows, DATA, 40, "index is 42 where 40 is due"),
    "index gap": (lambda root: _change(root, "index", lambda v: _set(v, 7, 99)), DATA, 37, "index is 99"),
    "timestamps": (
        lambda root: _change(root, "timestamp", lambda v: [2 * t for t in v]),
        DATA,
        31,
        "frames per second",
    ),
    "nan reward": (lambda root: _change(root, "next.reward", lambda v: _set(v, 3, float("nan"))), DATA, 33, "finite"),
    "nan pose": (
        lambda root: _change(root, "observation.state", lambda v: _set(v, 4, [float("inf")] * 7)),
        DATA,
        34,
        "finite",
    ),
    "early done": (lambda root: _change(root, "next.done", lambda v: _set(v, 5, True)), DATA, 35, "24 rows before"),
    "total": (lambda root: _info(root, total_frames=101), "meta/info.json", None, "101 rows"),
    "stats": (lambda root: (root / "meta/stats.json").unlink(), "meta/stats.json", None, "missing"),
    "tasks": (lambda root: _cut(root / "meta/tasks.parquet"), "meta/tasks.parquet", None, "truncated"),
    "leftover": (
        lambda root: shutil.copy(root / DATA, root / "data/chunk-000/file-004.parquet"),
        "data/chunk-000/file-004.parquet",
        None,
        "no episode",
    ),
}


def test_a_sound_recording_has_no_fault(recording):
    assert doctor(recording) == []


@pytest.mark.parametrize("name", FAULTS)
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
    with Recorder(tmp_path, Layout(10, ("go",))) as recorder:
        for _ in range(40):
            recorder.add({}, [1.0])
    assert [fault.what for fault in doctor(tmp_path)] == ["the action is [1.0] in all 39 rows"]


def test_there_must_be_a_dataset_to_examine(tmp_path):
    with pytest.raises(DatasetError):
        doctor(tmp_path)
