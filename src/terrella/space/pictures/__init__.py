"""Pictures of a place, posed or plain, or a video, as posed views of one camera; learn/recipes/splat.py fits them."""

import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from ...core.errors import DatasetError
from . import colmap, transforms
from .posed import FEWEST, Shots, shown_name
from .reading import ENDINGS, VIDEOS, blurred, is_plain, read_picture, sharpness, video_pictures

LONGEST = 1600  # pixels of pictures whose poses are looked for


def is_pictures(path: Path) -> bool:
    """Whether a path is a video or a folder of pictures, posed or not, and not a recording."""
    if path.is_file():
        return path.suffix.lower() in VIDEOS or transforms.file_of(path) is not None
    recorded = (path / "meta" / "info.json").exists()
    return (
        path.is_dir()
        and not recorded
        and (transforms.file_of(path) is not None or colmap.model_of(path) is not None or bool(_pictures(path)))
    )


def posed_pictures(path: Path, work: Path, frames: int) -> tuple[Shots, list[str]]:
    """At most `frames` pictures with poses, and what was left out, by name. Missing poses are computed by COLMAP; pictures and
    model stay in `work` for the next call."""
    if transforms.file_of(path) is not None:
        shots, out = transforms.read_transforms(path), []
    elif path.is_dir() and colmap.model_of(path) is not None:
        shots, out = colmap.read_colmap(path), []
    else:
        if colmap.model_of(work) is None:
            _place(path, work, frames)
        shots = colmap.read_colmap(work)
        names = {file.name for file in shots.files}
        out = sorted(shown_name(file) for file in _pictures(work / "images") if file.name not in names)
    rows = np.linspace(0, len(shots.files) - 1, min(frames, len(shots.files))).round().astype(int)
    return shots.at(rows.tolist()), [*out, *shots.left_out]


def _place(path: Path, work: Path, frames: int) -> None:
    """Computes the poses of a folder of pictures or of a video in `work`; leaves nothing behind where that fails."""
    fresh = not work.parent.exists()
    try:
        sizes = _stage(path, work, frames)
        colmap.place_pictures(work, film=path.is_file(), alike=sizes == 1)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        if fresh and work.parent.exists():
            work.parent.rmdir()
        raise


def _stage(path: Path, work: Path, frames: int) -> int:
    """Puts the sharp pictures of a folder or a video upright into WORK/images, under their names; how many sizes they have."""
    if path.is_file():
        named = {f"{k:05d}": one for k, one in enumerate(video_pictures(path, frames, LONGEST))}
    else:
        files = _pictures(path)
        files = [files[k] for k in np.linspace(0, len(files) - 1, min(frames, len(files))).round().astype(int)]
        named = {file.name: read_picture(file, longest=LONGEST) for file in files}
    shown = {name: one for name, one in named.items() if not is_plain(one)}
    bad = blurred([sharpness(one) for one in shown.values()])
    kept = {name: one for (name, one), out in zip(shown.items(), bad) if not out}
    if len(kept) < FEWEST:
        blank = f" ({len(named) - len(shown)} of {len(named)} are of one colour)" if len(shown) < len(named) else ""
        count = f"{len(kept)} sharp picture{'s' * (len(kept) != 1)}"
        raise DatasetError(f"{path} has {count}{blank}, and a fit needs {FEWEST} or more; take more.")
    shutil.rmtree(work, ignore_errors=True)
    (work / "images").mkdir(parents=True)
    for name, one in kept.items():
        Image.fromarray(one).save(work / "images" / f"{name}.png", compress_level=1)
    return len({one.shape for one in kept.values()})


def _pictures(folder: Path) -> list[Path]:
    """Files of a folder (or of its images/) that say they are pictures, in the order of their names."""
    home = folder / "images" if (folder / "images").is_dir() else folder
    return sorted(file for file in home.iterdir() if file.suffix.lower() in ENDINGS and not file.name.startswith("."))
