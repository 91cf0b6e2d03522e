"""Files made to harm: bombs, absurd claims, names that lead elsewhere. Each is a clear error, soon and in little memory."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from layouts import layout_of
from sweeps import sweep

from terrella.care import doctor, thrift
from terrella.core.errors import DatasetError
from terrella.data import Dataset, Layout, Recorder
from terrella.data.format import fill_template, path_inside
from terrella.data.source import Sensor

DATA, EPISODES = "data/chunk-000/file-001.parquet", "meta/episodes/chunk-000/file-001.parquet"
VIDEO = "videos/observation.images.rgb/chunk-000/file-001.mp4"
WORKER = """
import json, sys, time
from pathlib import Path
from terrella.core.errors import DatasetError
from terrella.care import doctor, repair
from terrella.data import Dataset
def memory(name):
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) // 1024 for line in status if line.startswith(name))
def look(root):
    told = {}
    def trial(name, look):
        try:
            told[name] = str(look())[:500]
        except DatasetError as error:
            told[name] = "DatasetError: " + str(error)[:500]
    dataset = []
    trial("open", lambda: dataset.append(Dataset(root)))
    for one in dataset:
        for number in range(min(len(one.episodes), 8)):
            trial(f"episode {number}", lambda: sum(a.nbytes for a in one.episode(number).values()))
            for stream in one.streams:
                trial(f"stream {number}", lambda: sum(v.nbytes for v in one.readings(number, stream).values))
    trial("doctor", lambda: [fault.what for fault in doctor(root)])
    trial("repair", lambda: repair(root, Path(root).with_name("mended")))
    return told
for line in sys.stdin:
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted anew
    base, began = memory("VmRSS"), time.perf_counter()
    told = look(line.strip())
    print(json.dumps({"told": told, "mib": memory("VmHWM") - base, "seconds": time.perf_counter() - began}), flush=True)
"""
MIB, SECONDS = 1200, 60
_worker: list[subprocess.Popen] = []


def look(root: Path) -> dict[str, str]:
    """What opening, each episode, the doctor and a repair say, in a process of its own (one for all tests, while it lives).

    A crash, a hang or a lot of memory fails the test.
    """
    if not _worker or _worker[-1].poll() is not None:
        command = [sys.executable, "-W", "error", "-c", WORKER]
        _worker.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    worker = _worker[-1]
    assert worker.stdin and worker.stdout
    watch = threading.Timer(SECONDS, worker.kill)
    watch.start()
    worker.stdin.write(f"{root}\n")
    worker.stdin.flush()
    line = worker.stdout.readline()
    watch.cancel()
    assert line, f"exit code {worker.wait()} (-9: a hang)"
    found = json.loads(line)
    assert found["mib"] < MIB, found
    return found["told"]


@pytest.fixture(scope="module", autouse=True)
def _no_worker_stays():
    yield
    for worker in _worker:
        with worker:
            worker.kill()


def refused(told: dict[str, str], *names: str) -> bool:
    return all(told[name].startswith("DatasetError: ") for name in names)


def others_are_kept(recording: Path, kept: int = 3) -> None:
    lengths = [episode.length for episode in Dataset(recording.with_name("mended")).episodes]
    assert len(lengths) >= kept and lengths[0] == 30 and lengths[-1] == 10, lengths


def footer(path: Path, change) -> None:
    """Rewrites a parquet file's footer; `change` edits its fields."""
    raw = path.read_bytes()
    size = int.from_bytes(raw[-8:-4], "little")
    fields, _ = thrift.read_struct(raw[-8 - size : -8])
    change(fields)
    new = thrift.write_struct(fields)
    path.write_bytes(raw[: -8 - size] + new + len(new).to_bytes(4, "little") + b"PAR1")


def rewritten(path: Path, name: str, column: pa.Array, **options) -> None:
    table = pq.read_table(path, partitioning=None)  # pyright: ignore
    at = table.schema.get_field_index(name)
    pq.write_table(table.set_column(at, name, column), path, **options)


def info(root: Path, **changes) -> None:
    told = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**told, **changes}))


# -- bombs in tables -------------------------------------------------------------------------------------------------


def test_a_billion_rows_of_one_number(recording):
    """Run-length coding holds them in some bytes, but the footer and meta/episodes know of thirty."""
    table = pq.read_table(recording / DATA)
    rows = 4_000_000
    columns = {
        name: pa.array(np.zeros(rows, np.int64)) for name in ("index", "frame_index", "episode_index", "task_index")
    }
    pq.write_table(pa.table(columns), recording / DATA)
    assert (recording / DATA).stat().st_size < 1_000_000 and len(table) == 30
    told = look(recording)
    assert refused(told, "episode 1") and "episode 2" in told and not refused(told, "episode 2")
    others_are_kept(recording)


@pytest.mark.parametrize("rows", sweep([10**9, 2**62, -1], 10**9))
def test_a_footer_that_claims_a_billion_rows(recording, rows):
    def claim(fields):
        fields[3] = (thrift.I64, rows)
        group = fields[4][1][1][0]
        group[3] = (thrift.I64, rows)
        for column in group[1][1][1]:
            column[3][1][5] = (thrift.I64, rows)

    footer(recording / DATA, claim)
    assert refused(look(recording), "episode 1")
    others_are_kept(recording)


def test_pages_that_claim_more_than_the_footer(recording):
    """A page header alone says that its numbers unpack to two gigabytes."""
    path = recording / DATA
    at = pq.read_metadata(path).row_group(0).column(0).data_page_offset
    raw = path.read_bytes()
    header, end = thrift.read_struct(raw, at)
    for field, value in ((2, 2**31 - 1), (5, None)):
        forged = dict(header)
        if value is not None:
            forged[field] = (thrift.I32, value)
        else:
            forged[5] = (thrift.STRUCT, {**header[5][1], 1: (thrift.I32, 2**31 - 1)})  # type: ignore[dict-item]
        new = thrift.write_struct(forged)
        body = bytearray(raw)
        body[at:end] = new  # the rest moves: the column's end is then wrong too
        path.write_bytes(bytes(body))
        assert refused(look(recording), "episode 1")
        shutil.rmtree(recording.with_name("mended"))


def test_a_text_that_a_dictionary_repeats(recording):
    """One text of 8 MiB for each of many rows: some kilobytes on disk, terabytes in memory."""
    features = json.loads((recording / "meta/info.json").read_text())["features"]
    info(recording, features={**features, "note": {"dtype": "string", "shape": [1], "names": None}})
    for number in range(4):
        path = recording / f"data/chunk-000/file-00{number}.parquet"
        table = pq.read_table(path)
        bomb = number == 1
        if bomb:
            table = pa.concat_tables([table] * 100).combine_chunks()
        text = pa.array(["a" * (8 << 20 if bomb else 8)])
        note = pa.DictionaryArray.from_arrays(np.zeros(len(table), np.int32), text)
        pq.write_table(table.append_column("note", note), path, compression="zstd", store_schema=not bomb)
    assert (recording / DATA).stat().st_size < 1 << 20
    told = look(recording)
    assert refused(told, "episode 1") and not refused(told, "episode 2")


def test_a_list_that_holds_all_numbers_in_one_row(recording):
    path = recording / DATA
    rows = pq.read_metadata(path).num_rows
    lists = pa.ListArray.from_arrays(
        np.array([0, *[10_000_000] * rows], np.int32), pa.array(np.zeros(10_000_000, np.float32))
    )
    rewritten(path, "observation.state", lists, compression="zstd")
    assert path.stat().st_size < 1 << 20
    told = look(recording)
    assert refused(told, "episode 1")
    others_are_kept(recording)


@pytest.mark.parametrize(
    "name", ["dataset_to_index", "episode_index", "data/file_index", "videos/observation.images.rgb/chunk_index"]
)
@pytest.mark.parametrize("value", sweep([2**63 - 1, -5], 2**63 - 1))
def test_meta_episodes_that_claims_absurd_numbers(recording, name, value):
    table = pq.read_table(recording / EPISODES, partitioning=None)  # pyright: ignore
    rewritten(recording / EPISODES, name, pa.array([value] * len(table), pa.int64()))
    told = look(recording)
    assert told["doctor"] != "[]"
    others_are_kept(recording)


# -- absurd claims of info.json --------------------------------------------------------------------------------------


ABSURD = {
    "many rows": {"total_frames": 10**12},
    "many episodes": {"total_episodes": 10**9},
    "episodes without number": {"total_episodes": "many"},
    "infinite fps": {"fps": float("inf")},
    "tiny fps": {"fps": 1e-300},
    "no features": {"features": []},
    "huge number": {"fps": int("9" * 4000)},
    "chunks": {"chunks_size": -1, "data_files_size_in_mb": "x"},
}


@pytest.mark.parametrize("name", sweep(ABSURD, *list(ABSURD)[::3]))
def test_info_json_that_claims_the_absurd(recording, name):
    info(recording, **ABSURD[name])
    told = look(recording)
    assert name == "chunks" or told["doctor"] != "[]"
    others_are_kept(recording, 4)


@pytest.mark.parametrize(
    "feature",
    [
        {"shape": [10**9], "dtype": "float32"},
        {"shape": [2] * 64, "dtype": "float32"},
        {"shape": [-7], "dtype": "float32"},
        {"shape": [7], "dtype": "O"},
        {"shape": [7], "dtype": "float32; import os"},
        {"shape": [7], "dtype": "V1000000000"},
        {"shape": [100_000, 100_000, 3], "dtype": "image"},
        {"shape": "7", "dtype": None},
        [],
    ],
    ids=str,
)
def test_shapes_and_types_that_are_absurd(recording, feature):
    features = json.loads((recording / "meta/info.json").read_text())["features"]
    info(recording, features={**features, "observation.state": feature})
    told = look(recording)
    assert refused(told, "open") or refused(told, "episode 1")
    assert told["doctor"] != "[]"
    others_are_kept(recording, 4)


@pytest.mark.parametrize("name", sweep(["meta/info.json", "meta/terrella.json", "meta/stats.json"], "meta/info.json"))
def test_json_that_nests_without_end(recording, name):
    (recording / name).write_text("[" * 2_000_000 + "]" * 2_000_000)
    assert look(recording)["doctor"] != "[]"
    others_are_kept(recording, 4)


# -- names that lead elsewhere ---------------------------------------------------------------------------------------


TEMPLATES = [
    "/etc/passwd",
    "../../{chunk_index:03d}/secret.parquet",
    "data/../../../{file_index}",
    "~/{file_index}",
    "data/{chunk_index.__class__}/{file_index}",
    "data/{chunk_index:>1000000000}/{file_index}",
    "data/{chunk_index:{file_index}}",
    "data\\..\\..\\{file_index}",
    "data/\0{file_index}",
    "",
    "a/" * 3000,
]


@pytest.mark.parametrize("template", sweep(TEMPLATES, *TEMPLATES[:2]), ids=lambda text: repr(text)[:40])
def test_templates_that_lead_out_of_the_dataset(recording, template):
    with pytest.raises(DatasetError):
        fill_template(template, chunk_index=0, file_index=0, video_key="observation.images.rgb")
    info(recording, data_path=template, video_path=template)
    told = look(recording)
    assert template == "" or refused(told, "open") or refused(told, "episode 0")  # "" is as if it were not there
    others_are_kept(recording, 4)


@pytest.mark.parametrize(
    "camera", sweep(["../../outside", "/etc", "a/../../../outside", "observation.images.\0", ".."], "../../outside")
)
def test_cameras_that_lead_out_of_the_dataset(recording, camera):
    outside = recording.parent / "outside" / "chunk-000"
    shutil.copytree(recording / "videos/observation.images.rgb/chunk-000", outside)
    told = json.loads((recording / "meta/info.json").read_text())
    features = {camera if name == "observation.images.rgb" else name: f for name, f in told["features"].items()}
    info(recording, features=features)
    for number in range(4):
        path = recording / f"meta/episodes/chunk-000/file-00{number}.parquet"
        table = pq.read_table(path, partitioning=None)  # pyright: ignore
        renamed = [name.replace("videos/observation.images.rgb", f"videos/{camera}") for name in table.column_names]
        pq.write_table(table.rename_columns(renamed), path)
    result = look(recording)
    assert refused(result, "open") or refused(result, "episode 1")
    assert "no fault" not in result["doctor"] and result["doctor"] != "[]"


@pytest.mark.parametrize("name", sweep(["../../outside", "/etc", "a/b", "{name}", "\0", ".."], "../../outside"))
def test_streams_that_lead_out_of_the_dataset(recording, name):
    told = json.loads((recording / "meta/terrella.json").read_text())
    sensor = {"kind": "vector", "shape": [1], "dtype": "float32", "names": []}
    (recording / "meta/terrella.json").write_text(json.dumps({**told, "streams": {name: sensor}}))
    table = pa.table({"time_s": [0.0], "value": pa.array([[1.0]], pa.large_list(pa.float32()))})
    (recording.parent / "outside/chunk-000").mkdir(parents=True)
    pq.write_table(table, recording.parent / "outside/chunk-000/file-000.parquet")
    result = look(recording)
    assert refused(result, "open") or result.get("stream 0", "0") == "0" or refused(result, "stream 0")
    assert result["doctor"] != "[]"
    others_are_kept(recording, 4)


@pytest.mark.parametrize(
    "name", sweep([DATA, VIDEO, "meta/info.json", "meta/tasks.parquet", EPISODES, "meta/terrella.json"], DATA, VIDEO)
)
def test_links_that_lead_out_of_the_dataset(recording, name):
    secret = recording.parent / "secret"
    shutil.move(recording / name, secret)
    (recording / name).symlink_to(secret)
    result = look(recording)
    assert refused(result, "open") or refused(result, "episode 1") or name == "meta/tasks.parquet"
    assert "leads out" in result["doctor"] or "cannot" in result["doctor"] or "truncated" in result["doctor"], result[
        "doctor"
    ]


def test_linked_folders_that_lead_out_of_the_dataset(recording):
    shutil.move(recording / "data", recording.parent / "elsewhere")
    (recording / "data").symlink_to(recording.parent / "elsewhere")
    result = look(recording)
    assert refused(result, "episode 0", "episode 3")


def test_a_hugging_face_cache_is_read_through_its_links(recording, tmp_path):
    """snapshots/REVISION/... are links to blobs; a link to anything else is refused there too."""
    home = tmp_path / "datasets--someone--corridor"
    blobs, snapshot = home / "blobs", home / "snapshots" / "0123456789abcdef"
    blobs.mkdir(parents=True)
    for at, file in enumerate(sorted(path for path in recording.rglob("*") if path.is_file())):
        place = snapshot / file.relative_to(recording)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, blobs / str(at))
        place.symlink_to(os.path.relpath(blobs / str(at), place.parent))
    truth = Dataset(recording).episode(1)
    found = Dataset(snapshot).episode(1)
    assert all(np.array_equal(truth[name], found[name]) for name in truth)
    assert doctor(snapshot) == []
    assert path_inside(snapshot, DATA) == snapshot / DATA
    (snapshot / DATA).unlink()
    (snapshot / DATA).symlink_to(recording / DATA)
    with pytest.raises(DatasetError, match="leads out"):
        Dataset(snapshot).episode(1)


# -- pictures and videos ---------------------------------------------------------------------------------------------


@pytest.fixture
def pictured(tmp_path) -> Path:
    layout = Layout(10, layout_of(10, ("go",), rgb=(8, 8), pose=True).sensors, pictures="png")
    rng = np.random.default_rng(0)
    with Recorder(tmp_path / "recording", layout) as recorder:
        for length in (30, 30, 10):
            for i in range(length):
                recorder.add({"rgb": rng.integers(0, 255, (8, 8, 3), np.uint8), "pose": np.arange(7) + i}, [i])
            recorder.end_episode()
    return tmp_path / "recording"


def _png(width: int, height: int, rows: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    packed = zlib.compress(bytes((1 + 3 * width) * rows), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "picture",
    [_png(50_000, 50_000, 200), _png(8, 8, 1_000_000), _png(8, 8, 2), b"", b"%!PS-Adobe-3.0 EPSF-3.0\n", None],
    ids=["huge", "long", "short", "empty", "postscript", "none"],
)
def test_pictures_that_unpack_to_gigabytes(pictured, picture):
    rows = pq.read_metadata(pictured / DATA).num_rows
    form = pq.read_schema(pictured / DATA).field("observation.images.rgb").type
    rewritten(
        pictured / DATA, "observation.images.rgb", pa.array([{"bytes": picture, "path": "/etc/passwd"}] * rows, form)
    )
    told = look(pictured)
    assert refused(told, "episode 1") or picture in (_png(8, 8, 1_000_000), _png(8, 8, 2))  # read up to its size
    assert not refused(told, "episode 0")


def _boxes(raw: bytearray, kind: bytes) -> list[int]:
    found, at = [], 0
    while (at := raw.find(kind, at)) >= 0:
        found.append(at - 4)
        at += 4
    return found


def _index(raw: bytearray) -> None:
    at = _boxes(raw, b"stsz")[0]
    struct.pack_into(">II", raw, at + 12, 1, 170_000_000)
    at = _boxes(raw, b"stsc")[0]
    struct.pack_into(">III", raw, at + 16, 1, 170_000_000, 1)


def _times(raw: bytearray) -> None:
    struct.pack_into(">II", raw, _boxes(raw, b"stts")[0] + 16, 2**31 - 1, 2**31 - 1)


def _size(raw: bytearray) -> None:
    struct.pack_into(">HH", raw, _boxes(raw, b"avc1")[0] + 32, 65535, 65535)


def _endless(raw: bytearray) -> None:
    struct.pack_into(">I", raw, _boxes(raw, b"moov")[0], 0)


@pytest.mark.parametrize("forge", sweep([_index, _times, _size, _endless], _index))
def test_videos_that_claim_the_absurd(recording, forge):
    raw = bytearray((recording / VIDEO).read_bytes())
    forge(raw)
    (recording / VIDEO).write_bytes(raw)
    told = look(recording)
    assert refused(told, "episode 1") or forge in (_size, _endless)  # FFmpeg believes the stream itself
    others_are_kept(recording)


def test_fragments_that_claim_millions_of_frames(recording):
    from terrella.data.storage.mp4 import Mp4Writer

    writer = Mp4Writer(recording / VIDEO, (48, 64), 35)
    for i in range(30):
        writer.add(np.full((48, 64, 3), 8 * i, np.uint8))
    writer.close()
    raw = bytearray((recording / VIDEO).read_bytes())
    for at in _boxes(raw, b"trun"):
        struct.pack_into(">II", raw, at + 8, 1, 80_000_000)  # no table, yet so many frames
    (recording / VIDEO).write_bytes(raw)
    assert refused(look(recording), "episode 1")
    others_are_kept(recording)


def test_a_video_of_enormous_black_pictures(recording):
    import av

    with av.open(str(recording / VIDEO), "w") as container:
        stream = container.add_stream("libx264", rate=35, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 8_100, 8_100, "yuv420p"
        frame = av.VideoFrame(8_100, 8_100, "yuv420p")
        for plane in frame.planes:
            plane.update(bytes(plane.buffer_size))
        container.mux([*stream.encode(frame), *stream.encode()])
    assert refused(look(recording), "episode 1")
    others_are_kept(recording)


# -- streams ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", sweep(["sizes", "nulls", "times", "columns", "many"], "sizes"))
def test_streams_whose_readings_are_not_what_was_promised(tmp_path, damage):
    name = "observation.points.lidar"
    layout = Layout(10, layout_of(10, ("go",), pose=True).sensors, streams={name: Sensor(name, "points", (0, 3))})
    with Recorder(tmp_path / "recording", layout) as recorder:
        for length in (30, 30, 10):
            for i in range(length):
                recorder.add({"pose": np.arange(7) + i}, [i])
                recorder.log(name, np.full((2, 3), i, np.float32), time_s=i / 10)
            recorder.end_episode()
    path = tmp_path / f"recording/streams/{name}/chunk-000/file-001.parquet"
    table = pq.read_table(path)
    values, times = table["value"].to_pylist(), table["time_s"].to_pylist()
    if damage == "sizes":
        values[3] = [1.0] * 7
    elif damage == "nulls":
        values[3] = None
    elif damage == "times":
        times[3] = float("nan")
    elif damage == "many":
        values[3] = [0.0] * 4_000_001
    made = {"time_s": times, "value": pa.array(values, pa.large_list(pa.float32()))}
    pq.write_table(pa.table({"t": times} if damage == "columns" else made), path, compression="zstd")
    told = look(tmp_path / "recording")
    assert refused(told, "stream 1") or damage == "many"
    assert not refused(told, "stream 0", "stream 2") and (told["doctor"] != "[]" or damage == "many")
    lengths = [episode.length for episode in Dataset(tmp_path / "mended").episodes]
    assert lengths == [30, 30, 10]  # the rows are whole


@pytest.mark.slow
def test_thrift_that_nests_or_lists_without_end():
    for raw in (bytes([0x1C] * 100_000), bytes([0x19, 0xFC]) + b"\xff" * 9 + b"\x7f", b"\x18\xff\xff\xff\xff\x0f", b""):
        with pytest.raises((ValueError, IndexError)):
            thrift.read_struct(raw)
