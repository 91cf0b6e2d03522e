"""Pictures by the names that another tool wrote, perhaps on another machine or before a folder was moved."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

from .reading import ENDINGS

_BESIDE = ("mask", "depth", "normal", "semantic", "thumb")  # how folders begin whose pictures are no photographs


def locate(homes: Sequence[Path], names: Sequence[str]) -> list[Path | None]:
    """The file of each name, relative to the first of `homes` that has it, or None. Names may have backslashes or %20, lack their
    ending (as in Blender's sets), or be paths of another machine: then the only picture below the last home whose path ends alike,
    and that no other name means."""
    files = [
        next((file for home in homes for one in spellings(name) if (file := _with_ending(home / one))), None)
        for name in names
    ]
    if None in files:
        tails, taken = _by_tail(homes[-1]), set(files)
        guesses = [None if file else _relocated(name, tails, taken) for file, name in zip(files, names)]
        count = Counter(guesses)
        files = [file or (guess if count[guess] == 1 else None) for file, guess in zip(files, guesses)]
    return files


def spellings(name: str) -> list[str]:
    """A name as it is, with slashes for backslashes, and without %20."""
    return list(dict.fromkeys([name, name.replace("\\", "/"), unquote(name), unquote(name.replace("\\", "/"))]))


def _with_ending(file: Path) -> Path | None:
    ends = ("",) if file.suffix.lower() in ENDINGS else ("", *ENDINGS)
    return next((one for end in ends if file.name and (one := file.with_name(file.name + end)).is_file()), None)


def _by_tail(home: Path) -> dict[str, list[Path]]:
    """The pictures below a folder by every end of their paths, in small letters, with and without their ending."""
    tails = defaultdict(list)
    for file in sorted(home.rglob("*")):
        parts = [part.casefold() for part in file.relative_to(home).parts]
        if file.suffix.lower() in ENDINGS and not any(part.startswith(_BESIDE) for part in parts[:-1]):
            for first in range(len(parts)):
                tail = "/".join(parts[first:])
                tails[tail].append(file)
                tails[tail.removesuffix(file.suffix.lower())].append(file)
    return tails


def _relocated(name: str, tails: dict[str, list[Path]], taken: set[Path | None]) -> Path | None:
    parts = [part for part in spellings(name)[-1].casefold().split("/") if part not in ("", ".", "..")]
    for first in range(len(parts)):
        files = [file for file in tails.get("/".join(parts[first:]), ()) if file not in taken]
        if files:
            smaller = [re.fullmatch(r"images_(\d+)", file.parent.name) for file in files]  # nerfstudio's smaller copies
            if all(smaller):
                files = [min(files, key=lambda file: int(file.parent.name.removeprefix("images_")))]
            return files[0] if len(files) == 1 else None
    return None
