"""Which features the tables and videos of a recording have, where meta/info.json does not say it or says it wrongly."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
from PIL import Image

from ..core.errors import DatasetError
from ..data.format import AUTOMATIC, PICTURE, TIME, Layout, contained, sensor_from_json
from ..data.storage import mp4
from ..data.storage.tables import open_parquet, read_whole

BROKEN = (OSError, pa.ArrowException, ValueError, KeyError, TypeError, OverflowError, AttributeError, DatasetError)
_UNREADABLE = (*BROKEN, av.FFmpegError, IndexError, Image.DecompressionBombError, Image.DecompressionBombWarning)
_LOOKED_AT = 15  # videos of a camera that are asked for their size
_PIXELS = ["height", "width", "channels"]


def features_without_info(
    root: Path, about: Mapping, data: list[str], films: list[str], video_path: str, fps: float
) -> dict[str, dict]:
    """Without info.json: what meta/terrella.json, the tables and the videos tell."""
    form = next(schemas_of(root, data), None)
    try:
        sensors = {name: sensor_from_json(name, said) for name, said in dict(about["sensors"]).items()}
        pictures = "png" if form is not None and PICTURE in form.types else "video"
        return Layout(fps, sensors, clock=form is not None and TIME in form.names, pictures=pictures).features()
    except BROKEN:
        return features_of_files(root, data, films, video_path)


def features_of_files(root: Path, data: list[str], films: list[str], video_path: str) -> dict[str, dict]:
    """The features that the tables and videos have."""
    found = {}
    for part in next(schemas_of(root, data), ()):
        found |= {part.name: feature} if (feature := _of_column(root, data, part)) else {}
    for name in sorted({camera for file in films if (camera := camera_of(file, video_path))}):
        size = film_size(root, films, video_path, name)
        if size:
            found[name] = {"dtype": "video", "shape": [*size, 3], "names": _PIXELS}
    ordered = [*(name for name in found if name not in AUTOMATIC), *(name for name in AUTOMATIC if name in found)]
    return {name: found[name] for name in ordered}


def mended_features(
    root: Path, features: Mapping[str, dict], data: list[str], films: list[str], video_path: str, said: list[str]
) -> dict[str, dict]:
    """The features as the rows and videos have them; what info.json says otherwise is added to `said`."""
    found = {name: dict(feature) for name, feature in features.items()}
    forms = list(schemas_of(root, data))
    cameras = {camera for file in films if (camera := camera_of(file, video_path))}
    if forms or cameras:  # else there is no episode yet: what is promised may still come
        columns = {name for form in forms for name in form.names}
        _swap(found, columns if forms else None, cameras, said)
        if len(found) < len(features):
            for name, feature in features_of_files(root, data, films, video_path).items():
                if name not in found:
                    said.append(f"'{name[:100]}' is in the files, though info.json does not say so, and kept")
                    found[name] = feature
    for name, feature in list(found.items()):
        if feature["dtype"] == "video":
            size = film_size(root, films, video_path, name)
            if size and list(size) != feature["shape"][:2]:
                said.append(f"the pictures of {name} are {size[0]}x{size[1]}, and so in info.json now")
                found[name] = {**feature, "shape": [*size, 3]}
        elif feature["dtype"] != "image" and name not in AUTOMATIC:
            kinds = list(dict.fromkeys(form.field(name).type for form in forms if name in form.names))
            if len(kinds) == 1 and (changed := _retyped(feature, kinds[0])) != feature:
                said.append(f"'{name}' is {changed['dtype']} {changed['shape']} in the rows, and so in info.json now")
                found[name] = changed
    for name in AUTOMATIC:
        found.setdefault(name, {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None})
    return found


def _swap(features: dict[str, dict], columns: set[str] | None, cameras: set[str], said: list[str]) -> None:
    """Takes away what no table and no video has."""
    for name, feature in list(features.items()):
        there = cameras if feature["dtype"] == "video" else columns
        if there is not None and name not in there and name not in AUTOMATIC:
            said.append(f"no file has '{name[:100]}', which info.json promises: it is left out")
            del features[name]


def camera_of(file: str, video_path: str) -> str | None:
    """The camera whose file it is, by the part of its path where the template has the camera's name."""
    parts, pattern = file.split("/"), video_path.split("/")
    at = pattern.index("{video_key}") if "{video_key}" in pattern else None
    return parts[at] if at is not None and len(parts) == len(pattern) else None


def film_size(root: Path, films: list[str], video_path: str, camera: str) -> tuple[int, int] | None:
    """(height, width) of the camera's pictures, as most of some of its videos have it."""
    files = [file for file in films if camera_of(file, video_path) == camera]
    sizes = [
        _first([file], lambda file: _size(contained(root, file))) for file in files[:: max(1, len(files) // _LOOKED_AT)]
    ]
    return max(sizes, key=sizes.count, default=None)


def _size(path: Path) -> tuple[int, int]:
    with mp4.opened(path) as (_, stream):
        return stream.height, stream.width


def _first(files: Sequence[str], look: Callable[[str], Any]) -> Any:
    """What `look` finds in the first file that can be read; None where none can."""
    for file in files:
        try:
            return look(file)
        except _UNREADABLE:
            continue
    return None


def schemas_of(root: Path, data: Sequence[str]) -> Iterator[pa.Schema]:
    """The Arrow schemas of the data files that can be opened."""
    for name in data:
        try:
            with open_parquet(contained(root, name)) as file:
                yield file.schema_arrow
        except BROKEN:
            continue


# -- columns ---------------------------------------------------------------------------------------------------------


def _nested(kind: pa.DataType) -> tuple[pa.DataType, list[int]]:
    """The type of a column's numbers, and the lengths of its lists, 0 where they may differ."""
    lengths = []
    while isinstance(kind, pa.BaseExtensionType):
        kind = kind.storage_type
    while pa.types.is_nested(kind) and hasattr(kind, "value_type"):
        lengths.append(kind.list_size if pa.types.is_fixed_size_list(kind) else 0)
        kind = kind.value_type
    return kind, lengths


def _dtype(kind: pa.DataType) -> str | None:
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return "string"
    try:
        return "bool" if pa.types.is_boolean(kind) else str(np.dtype(kind.to_pandas_dtype()))
    except (NotImplementedError, TypeError):
        return None


def _of_column(root: Path, data: list[str], part: pa.Field) -> dict | None:
    """The feature that a column holds; None where it is none."""
    kind, shape = _nested(part.type)

    def first(name: str):
        return read_whole(contained(root, name), [part.name])[part.name][0].as_py()

    if pa.types.is_struct(kind):
        size = _first(data, lambda name: _picture_shape(first(name)["bytes"]))
        return {"dtype": "image", "shape": size, "names": _PIXELS} if size else None
    dtype = _dtype(kind)
    if dtype is None or dtype == "string":
        return None if dtype is None else {"dtype": dtype, "shape": [1], "names": None}
    if 0 in shape:
        shape = _first(data, lambda name: list(np.array(first(name)).shape)) or shape
    return {"dtype": dtype, "shape": shape or [1], "names": None}


def _picture_shape(raw: bytes) -> list[int]:
    """[height, width, channels] of a picture's bytes; one channel where it is of 16 bits, as LeRobot keeps depth."""
    with Image.open(io.BytesIO(raw), formats=("PNG", "JPEG", "WEBP", "TIFF")) as image:
        return [image.size[1], image.size[0], 1 if image.mode.startswith("I") else 3]


def _retyped(feature: dict, kind: pa.DataType) -> dict:
    """The feature with the type, and for plain lists the length, that the column has."""
    kind, lengths = _nested(kind)
    changed = dict(feature)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        changed["dtype"] = _dtype(kind)
    if len(lengths) == 1 and lengths[0] and len(feature["shape"]) == 1:
        changed["shape"] = [lengths[0]]
    return changed if changed["shape"] == feature["shape"] else {**changed, "names": None}
