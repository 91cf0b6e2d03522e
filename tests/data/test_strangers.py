"""What other writers put into a LeRobot folder is read as what it is: texts, depth as pictures, numbers or video."""

from __future__ import annotations

import io
import json
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from layouts import layout_of
from PIL import Image

from terrella.core.errors import DatasetError
from terrella.data import ClipCache, Dataset, Layout, Recorder, Sensor
from terrella.data.format import PICTURE
from terrella.data.resample import resample
from terrella.exchange.convert import open_source, write_source

ROWS, HEIGHT, WIDTH = 12, 6, 8
MILLIMETRES = (np.arange(ROWS * HEIGHT * WIDTH).reshape(ROWS, HEIGHT, WIDTH) * 100 + 300).astype(np.uint16)


@pytest.fixture
def plain(tmp_path) -> Path:
    with Recorder(tmp_path / "plain", layout_of(10, ("go",), pose=True)) as recorder:
        for i in range(ROWS):
            recorder.add({"pose": np.arange(7) + i}, [i])
    return tmp_path / "plain"


def add(root: Path, name: str, feature: dict, column: pa.Array | None) -> Dataset:
    """The dataset with a feature more, as a stranger may have written it."""
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][name] = feature
    (root / "meta/info.json").write_text(json.dumps(info))
    about = json.loads((root / "meta/terrella.json").read_text())
    (root / "meta/terrella.json").write_text(json.dumps({"world": about["world"]}))
    if column is not None:
        path = root / "data/chunk-000/file-000.parquet"
        table = pq.read_table(path, partitioning=None)  # pyright: ignore
        pq.write_table(table.append_column(pa.field(name, column.type), column), path)
    return Dataset(root)


def pngs(frames: np.ndarray) -> pa.Array:
    rows = []
    for frame in frames:
        buffer = io.BytesIO()
        Image.fromarray(frame).save(buffer, "PNG")
        rows.append({"bytes": buffer.getvalue(), "path": None})
    return pa.array(rows, PICTURE)


def in_metres(dataset: Dataset, name: str, unit_m: float = 0.001) -> None:
    metres = (MILLIMETRES * unit_m).astype(np.float32)
    np.testing.assert_allclose(dataset.episode(0, ["depth"])["depth"], metres, rtol=1e-6)
    np.testing.assert_allclose(np.stack(list(dataset.readings(0, name).values)), metres, rtol=1e-6)
    cached = ClipCache.open(dataset, (8, 8))
    np.testing.assert_allclose(cached.depth, metres, rtol=1e-3)
    assert dataset.sensors[name].kind == "depth" and dataset.sensors[name].shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("shape", [[HEIGHT, WIDTH, 1], [1, HEIGHT, WIDTH]])
@pytest.mark.parametrize("name", ["observation.images.depth", "observation.images.front"])
def test_a_picture_of_one_channel_of_16_bits_is_depth(plain, shape, name):
    dataset = add(plain, name, {"dtype": "image", "shape": shape, "names": None}, pngs(MILLIMETRES))
    in_metres(dataset, name)
    assert dataset.cameras == ()


def test_a_grey_picture_of_8_bits_stays_a_picture(plain):
    grey = (MILLIMETRES % 200).astype(np.uint8)
    feature = {"dtype": "image", "shape": [HEIGHT, WIDTH, 1], "names": None}
    dataset = add(plain, "observation.images.front", feature, pngs(grey))
    assert np.array_equal(dataset.episode(0, ["rgb"])["rgb"], np.repeat(grey[..., None], 3, -1))
    assert np.array_equal(dataset.rgb_at([3]), np.repeat(grey[3:4, ..., None], 3, -1))


@pytest.mark.parametrize(
    ("shape", "more", "unit_m"),
    [
        ([HEIGHT, WIDTH], {}, 0.001),
        ([HEIGHT, WIDTH, 1], {}, 0.001),
        ([1, HEIGHT, WIDTH], {"info": {"depth_unit": "cm"}}, 0.01),
        ([HEIGHT, WIDTH], {"info": {"is_depth_map": True, "depth_scale": 0.00025}}, 0.00025),
    ],
)
def test_numbers_of_16_bits_are_depth_in_metres_of_the_unit_that_they_say(plain, shape, more, unit_m):
    name = "observation.range" if "is_depth_map" in more.get("info", {}) else "observation.wrist_depth"
    lists = pa.array(MILLIMETRES.reshape(ROWS, *shape).tolist(), _lists(len(shape)))
    in_metres(add(plain, name, {"dtype": "uint16", "shape": shape, "names": None, **more}, lists), name, unit_m)


def test_depth_of_another_unit_keeps_its_steps_when_it_is_converted(plain, tmp_path):
    feature = {"dtype": "uint16", "shape": [HEIGHT, WIDTH], "names": None, "info": {"depth_scale": 0.0001}}
    add(plain, "observation.depth", feature, pa.array(MILLIMETRES.tolist(), _lists(2)))
    write_source(open_source(plain), tmp_path / "again")
    in_metres(Dataset(tmp_path / "again"), "observation.depth", 0.0001)


def _lists(axes: int) -> pa.DataType:
    kind = pa.uint16()
    for _ in range(axes):
        kind = pa.list_(kind)
    return kind


def test_numbers_of_16_bits_that_are_no_depth_stay_numbers(plain):
    feature = {"dtype": "uint16", "shape": [HEIGHT, WIDTH], "names": None}
    dataset = add(plain, "observation.heat", feature, pa.array(MILLIMETRES.tolist(), _lists(2)))
    assert np.array_equal(dataset.episode(0)["observation.heat"], MILLIMETRES) and not dataset.has("depth")


def test_a_video_of_one_channel_of_16_bits_is_depth(plain):
    name = "observation.images.depth"
    path = plain / f"videos/{name}/chunk-000/file-000.mp4"
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray16le"
        for i, frame in enumerate(MILLIMETRES):
            picture = av.VideoFrame.from_ndarray(frame, format="gray16le")
            picture.pts = i
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    told = plain / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(told, partitioning=None)  # pyright: ignore
    for key, value in (("chunk_index", 0), ("file_index", 0), ("from_timestamp", 0.0), ("to_timestamp", ROWS / 10)):
        table = table.append_column(f"videos/{name}/{key}", pa.array([value]))
    pq.write_table(table, told)
    info = json.loads((plain / "meta/info.json").read_text())
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (plain / "meta/info.json").write_text(json.dumps(info))
    about = {"video.pix_fmt": "gray16le", "video.is_depth_map": True}
    in_metres(add(plain, name, {"dtype": "video", "shape": [HEIGHT, WIDTH, 1], "info": about}, None), name)


def test_texts_are_read_as_texts_and_block_nothing(plain, tmp_path):
    words = [f"row {i} of many" for i in range(ROWS)]
    dataset = add(plain, "observation.note", {"dtype": "string", "shape": [1], "names": None}, pa.array(words))
    assert dataset.episode(0)["observation.note"].reshape(-1).tolist() == words
    note = dataset.readings(0, "observation.note")
    assert [str(value[0]) for value in note.values] == words and len(note.time_s) == ROWS
    aligned, valid = _aligned(dataset, 0, "observation.note")
    assert valid.all() and [str(value[0]) for value in aligned] == words
    ClipCache.open(dataset, (8, 8))
    write_source(open_source(plain), tmp_path / "again")
    assert Dataset(tmp_path / "again").episode(0)["observation.note"].reshape(-1).tolist() == words


def test_sensors_that_share_the_times_of_the_rows_are_read_after_a_conversion(tmp_path):
    """A converted recording declares them as streams too, but keeps them in the rows alone."""
    imu = "observation.imu"
    sensors = {**layout_of(10, ("go",), pose=True).sensors, imu: Sensor(imu, "vector", (2,))}
    with Recorder(tmp_path / "recording", Layout(10, sensors, {imu: sensors[imu]}, clock=True)) as recorder:
        for i in range(ROWS):
            row = {"observation.state": np.arange(7) + i, imu: np.array([i, -i]), "action": [1.0]}
            recorder.add_row(row, time_s=0.1 * i)
    dataset = Dataset(tmp_path / "recording")
    for name in (imu, "observation.state"):
        assert len(dataset.readings(0, name).time_s) == ROWS
        values, valid = _aligned(dataset, 0, name, "linear")
        assert valid.all() and np.array_equal(values, dataset.episode(0, [name])[name])
    with pytest.raises(DatasetError, match="no sensor 'observation.none'"):
        dataset.readings(0, "observation.none")


def _aligned(dataset, number, name, policy="previous", max_gap_s=None):
    sensor = (dataset.streams | dataset.sensors)[name]
    return resample(dataset.readings(number, name), sensor, dataset.time_s(number), policy, max_gap_s)
