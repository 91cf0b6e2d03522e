"""Folders of videos or images: which take and camera each file belongs to, and the names that writers use."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from ...core.errors import DatasetError
from ...data.resample import clock_of
from ...data.source import Source, Take
from . import rows

VIDEOS = frozenset(
    ".mp4 .m4v .mov .mkv .webm .avi .mpg .mpeg .ts .m2ts .mts .wmv .flv .ogv .3gp .gif .nut .y4m .h264 .264 .h265 .hevc".split()
)
IMAGES = frozenset(".png .jpg .jpeg .webp .bmp .tif .tiff .ppm .pgm".split())
CAMERA = f"{rows.IMAGES}{rows.CAMERA}"


def takes_of(path: Path, suffixes: frozenset[str], what: str, deep: bool) -> dict[str, dict[str, list[Path]]]:
    """Take -> camera -> its files (of one file: one take), as `videos.read` describes (or, if `deep`, `images.read`)."""
    if path.is_file():
        return {path.stem: {rows.CAMERA: [path]}}
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; name a folder of {what}.")
    here, folders = _listed(path, suffixes)
    inside = {folder.name: _listed(folder, suffixes) for folder in folders}
    if deep:
        takes = {}
        if here:
            takes[path.name] = {rows.CAMERA: here}
        for name, (files, below) in inside.items():
            cameras = {clean(sub.name): _listed(sub, suffixes)[0] for sub in below}
            cameras = {camera: images for camera, images in cameras.items() if images}
            if files and cameras:
                raise DatasetError(f"{path / name} has images and folders of images; keep the one or the other in it.")
            if files or cameras:
                takes[name] = cameras or {rows.CAMERA: files}
    else:
        takes = {file.stem: {rows.CAMERA: [file]} for file in here}
        if len(takes) < len(here):
            takes = {file.name: {rows.CAMERA: [file]} for file in here}
        for name, (files, _) in inside.items():
            cameras = {clean(file.stem): [file] for file in files}
            if len(cameras) < len(files):
                raise DatasetError(f"{path / name} has two videos of the same name; a camera has one in each take.")
            if files:
                takes[name] = cameras
    if here and any(files or below for files, below in inside.values()) and len(takes) > (1 if deep else len(here)):
        raise DatasetError(f"{path} has {what} next to folders of {what}; keep the one or the other in it.")
    if not takes:
        raise DatasetError(f"{path} has no {what} ({', '.join(sorted(suffixes))}); name a folder that has.")
    return takes


def _listed(folder: Path, suffixes: frozenset[str]) -> tuple[list[Path], list[Path]]:
    """Files with one of the suffixes, and folders, in natural order, without hidden ones."""
    every = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: rows.natural(p.name))
    return [p for p in every if p.suffix.lower() in suffixes and p.is_file()], [p for p in every if p.is_dir()]


def cameras(source: Source, kinds: tuple[str, ...], what: str) -> tuple[dict[str, str], list[str]]:
    """Sensor -> the name of its file or folder, and a note on each sensor that has none."""
    names: dict[str, str] = {}
    for name, sensor in source.sensors.items():
        if sensor.kind in kinds:
            if sensor.kind == "depth":
                rest = name.removeprefix(rows.DEPTH).removeprefix(".")
                camera = f"{rest}_depth" if rest else "depth"
            else:
                camera = name.removeprefix(rows.IMAGES).removeprefix("observation.")
            camera = clean(camera)
            if camera in names.values():
                raise DatasetError(f"two sensors would both be called '{camera}'; rename '{name}'.")
            names[name] = camera
    if not names:
        raise DatasetError(f"{source.name or 'the source'} has no pictures; write it in another format.")
    return names, [f"'{name}' has no place in {what} and was left out." for name in source.sensors if name not in names]


def clean(camera: str) -> str:
    return ".".join(rows.clean(part) for part in camera.split("."))


def numbered(source: Source, cameras: Mapping[str, str], progress) -> Iterator[tuple[int, Take]]:
    """Takes reduced to their pictures, with checked clocks, without those that have none; DatasetError where no take has any."""
    empty = True
    for number, take in rows.numbered(source, progress):
        shown = [name for name in cameras if name in take.readings and len(take.readings[name].values)]
        if not shown:
            continue  # `write_source` names what a take lacks
        empty = False
        for name in shown:
            clock_of(take.readings[name], f"'{name}' in take {number}")
        yield number, Take({name: take.readings[name] for name in shown}, take.task)
    if empty:
        raise DatasetError(f"no take of {source.name or 'the source'} has pictures; write it in another format.")
