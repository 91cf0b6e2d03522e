"""Features read from tables and videos, for recordings whose meta/info.json is missing or wrong."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
from PIL import Image

from ..core.errors import DatasetError
from ..data.format import AUTOMATIC, PICTURE, TIME, Layout, path_inside, sensor_from_json
from ..data.storage import mp4
from ..data.storage.tables import open_parquet, read_whole

BROKEN = (OSError, pa.ArrowException, ValueError, KeyError, TypeError, OverflowError, AttributeError, DatasetError)
_UNREADABLE = (*BROKEN, av.FFmpegError, IndexError, Image.DecompressionBombError, Image.DecompressionBombWarning)
_LOOKED_AT = 15  # videos of a camera whose size is read
_PIXELS = ["height", "width", "channels"]


def features_without_info(
    root: Path, about: Mapping, data: list[str], films: list[str], video_path: str, fps: float
) -> dict[str, dict]:
    """The features of a recording without info.json, from meta/terrella.json, the tables and the videos."""
    form = next(schemas_of(root, data), None)
    try:
        sensors = {name: sensor_from_json(name, stated) for name, stated in dict(about["sensors"]).items()}
        pictures = "png" if form is not None and PICTURE in form.types else "video"
        return Layout(fps, sensors, clock=form is not None and TIME in form.names, pictures=pictures).features()
    except BROKEN:
        return features_of_files(root, data, films, video_path)


def features_of_files(root: Path, data: list[str], films: list[str], video_path: str) -> dict[str, dict]:
    """The features that the tables and videos have."""
    features = {}
    for part in next(schemas_of(root, data), ()):
        features |= {part.name: feature} if (feature := _of_column(root, data, part)) else {}
    for name in sorted({camera for file in films if (camera := camera_of(file, video_path))}):
        size = film_size(root, films, video_path, name)
        if size:
            features[name] = {"dtype": "video", "shape": [*size, 3], "names": _PIXELS}
    ordered = [*(name for name in features if name not in AUTOMATIC), *(name for name in AUTOMATIC if name in features)]
    return {name: features[name] for name in ordered}


def mended_features(
    root: Path, features: Mapping[str, dict], data: list[str], films: list[str], video_path: str, notes: list[str]
) -> dict[str, dict]:
    """The features as rows and videos have them; each difference from info.json adds a sentence to `notes`."""
    mended = {name: dict(feature) for name, feature in features.items()}
    forms = list(schemas_of(root, data))
    cameras = {camera for file in films if (camera := camera_of(file, video_path))}
    if forms or cameras:  # without an episode nothing contradicts info.json
        columns = {name for form in forms for name in form.names}
        _swap(mended, columns if forms else None, cameras, notes)
        if len(mended) < len(features):
            for name, feature in features_of_files(root, data, films, video_path).items():
                if name not in mended:
                    notes.append(f"'{name[:100]}' is in the files but not in info.json, and is kept")
                    mended[name] = feature
    for name, feature in list(mended.items()):
        if feature["dtype"] == "video":
            size = film_size(root, films, video_path, name)
            if size and list(size) != feature["shape"][:2]:
                notes.append(f"the pictures of {name} are {size[0]}x{size[1]}, which info.json now states")
                mended[name] = {**feature, "shape": [*size, 3]}
        elif feature["dtype"] != "image" and name not in AUTOMATIC:
            kinds = list(dict.fromkeys(form.field(name).type for form in forms if name in form.names))
            if len(kinds) == 1 and (changed := _retyped(feature, kinds[0])) != feature:
                notes.append(f"'{name}' is {changed['dtype']} {changed['shape']} in the rows, as info.json now states")
                mended[name] = changed
    for name in AUTOMATIC:
        mended.setdefault(name, {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None})
    return mended


def _swap(features: dict[str, dict], columns: set[str] | None, cameras: set[str], notes: list[str]) -> None:
    """Removes features that no table and no video has."""
    for name, feature in list(features.items()):
        stored = cameras if feature["dtype"] == "video" else columns
        if stored is not None and name not in stored and name not in AUTOMATIC:
            notes.append(f"info.json names '{name[:100]}', but no file has it: it is left out")
            del features[name]


def camera_of(file: str, video_path: str) -> str | None:
    """The camera of a video file, read off its path by the template."""
    parts, pattern = file.split("/"), video_path.split("/")
    at = pattern.index("{video_key}") if "{video_key}" in pattern else None
    return parts[at] if at is not None and len(parts) == len(pattern) else None


def film_size(root: Path, films: list[str], video_path: str, camera: str) -> tuple[int, int] | None:
    """(height, width) of a camera's pictures: the most frequent of a sample of its videos."""
    files = [file for file in films if camera_of(file, video_path) == camera]
    sizes = [
        _first([file], lambda file: _size(path_inside(root, file)))
        for file in files[:: max(1, len(files) // _LOOKED_AT)]
    ]
    return max(sizes, key=sizes.count, default=None)


def _size(path: Path) -> tuple[int, int]:
    with mp4.open_video(path) as (_, stream):
        return stream.height, stream.width


def _first(files: Sequence[str], look: Callable[[str], Any]) -> Any:
    """`look` of the first file that can be read; None where none can."""
    for file in files:
        with suppress(*_UNREADABLE):
            return look(file)
    return None


def schemas_of(root: Path, data: Sequence[str]) -> Iterator[pa.Schema]:
    """The Arrow schemas of the data files that can be opened."""
    for name in data:
        with suppress(*BROKEN), open_parquet(path_inside(root, name)) as file:
            yield file.schema_arrow


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
    """The feature that a column holds; None for a type that is no feature."""
    kind, shape = _nested(part.type)

    def first(name: str):
        return read_whole(path_inside(root, name), [part.name])[part.name][0].as_py()

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
