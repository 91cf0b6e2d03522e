"""Turns a recording of ours into one as other writers lay it out: many episodes a file, nothing of Terrella's own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import av
import pyarrow as pa
import pyarrow.parquet as pq

from terrella.data import Dataset

EXTRA = ("action_valid",)  # columns that no other writer has


def shared(ours: Path, root: Path) -> Path:
    """All rows in one data file (a row group for each episode), all pictures in one video with B-frames and rare keyframes."""
    dataset = Dataset(ours)
    camera = dataset.cameras[0]
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    for name in ("info.json", "stats.json", "tasks.parquet"):
        shutil.copy(ours / "meta" / name, root / "meta" / name)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"] = {name: feature for name, feature in info["features"].items() if name not in EXTRA}
    info |= {"robot_type": "corridor", "splits": {"train": "0:3", "test": "3:4"}, "license": "mit"}
    (root / "meta/info.json").write_text(json.dumps(info))
    data = root / "data/chunk-000/file-000.parquet"
    data.parent.mkdir(parents=True)
    tables = [pq.read_table(ours / episode.data).drop_columns(list(EXTRA)) for episode in dataset.episodes]
    with pq.ParquetWriter(data, tables[0].schema, compression="snappy") as writer:
        for table in tables:
            writer.write_table(table)
    _film(dataset, camera, root / f"videos/{camera}/chunk-000/file-000.mp4")
    rows = [pq.read_table(file, partitioning=None) for file in sorted((ours / "meta/episodes/chunk-000").iterdir())]  # pyright: ignore
    table = pa.concat_tables(rows)
    for name, values in {
        f"videos/{camera}/file_index": [0] * 4,
        "data/file_index": [0] * 4,
        f"videos/{camera}/from_timestamp": [episode.start / dataset.fps for episode in dataset.episodes],
        f"videos/{camera}/to_timestamp": [episode.stop / dataset.fps for episode in dataset.episodes],
    }.items():
        at = table.schema.get_field_index(name)
        table = table.set_column(at, name, pa.array(values, table.schema.field(name).type))
    pq.write_table(table, root / "meta/episodes/chunk-000/file-000.parquet")
    return root


def killed(whole: Path, root: Path) -> Path:
    """As LeRobot leaves a recording whose process was killed: the data file has no footer, meta/episodes is not there."""
    shutil.copytree(whole, root)
    data = root / "data/chunk-000/file-000.parquet"
    raw = data.read_bytes()
    data.write_bytes(raw[: -8 - int.from_bytes(raw[-8:-4], "little")])
    shutil.rmtree(root / "meta/episodes")
    return root


def _film(dataset: Dataset, camera: str, path: Path) -> None:
    """A keyframe at the beginning of each episode but the last, whose first frame leans on the one before."""
    path.parent.mkdir(parents=True)
    starts = {episode.start for episode in list(dataset.episodes)[:-1]}
    height, width = dataset.features[camera]["shape"][:2]
    with av.open(str(path), "w") as container:
        options = {"g": "1000", "keyint_min": "1000", "bf": "2", "sc_threshold": "0", "forced-idr": "1", "crf": "10"}
        stream = container.add_stream("libx264", rate=int(dataset.fps), options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        at = 0
        for episode in dataset.episodes:
            for picture in dataset.frames(episode.number, camera):
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                frame.pts = at
                if at in starts:
                    frame.pict_type = av.video.frame.PictureType.I
                container.mux(stream.encode(frame))
                at += 1
        container.mux(stream.encode())
