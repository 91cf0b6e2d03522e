"""doctor: examines a recording, ours or a stranger's, however damaged, and names each fault with its place and its mend."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ..core.errors import DatasetError
from ..data.format import INFO
from ..data.storage import journal, mp4
from .film_checks import Shown, examine_films, examine_streams, same
from .motion_checks import misaligned
from .row_checks import Rows, constants, examine_rows, statistics
from .survey import LEFTOVER, Fault, Survey, survey

__all__ = ["Fault", "Findings", "doctor", "examine"]

_ANEW = "let --repair make it anew from the rows"
_STAGING = ".staging/rows.log"


@dataclass(frozen=True)
class Findings:
    """faults: what is wrong. notes: sentences worth reading that are no faults: numbers that never change, a recorder at work."""

    faults: list[Fault]
    notes: list[str]


def doctor(root: str | Path) -> list[Fault]:
    """All faults of a LeRobot v3.0 recording, [] where it is sound. DatasetError where there is no dataset to examine."""
    return examine(root).faults


def examine(root: str | Path) -> Findings:
    """Faults and notes. Every row is read once; of videos the packets, and of each episode the first and last frame."""
    found = survey(root)
    busy = being_written(found.root)
    rows, shown = Rows(), Shown()
    found, faults = _without_leftovers(found, busy)
    faults = [*found.faults, *faults, *_counts(found, busy)]
    faults += examine_rows(found, rows, busy)
    faults += examine_films(found, shown, busy)
    faults += examine_streams(found, busy)
    faults += [] if busy else statistics(found, rows)  # it may be that of an episode more
    faults += _duplicates(found, rows, shown)
    still, notes = constants(found, rows)
    faults += still
    faults += misaligned(found, rows, shown)
    if busy:
        notes.append("a recorder is writing to this folder right now; its episode in flight was not looked at")
    else:
        faults += _interrupted(found)
    return Findings(faults, notes)


def being_written(root: Path) -> bool:
    """Whether a recorder holds the folder's lock."""
    try:
        with open(root / ".lock", "rb") as handle:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


# -- counts ----------------------------------------------------------------------------------------------------------


def _without_leftovers(found: Survey, busy: bool) -> tuple[Survey, list[Fault]]:
    """Without the episodes of a killed commit: info.json, which is written last, counts neither them nor their rows."""
    count, length = found.info.get("total_episodes"), found.info.get("total_frames")
    beyond = [number for number in found.told if isinstance(count, int) and number >= count]
    kept = {number: episode for number, episode in found.told.items() if number not in beyond}
    if not beyond or list(kept) != list(range(int(str(count)))) or max([0, *(e.stop for e in kept.values())]) != length:
        return found, []
    what = f"it lists episode {beyond[0]} beyond the {count} of info.json"
    return replace(found, told=kept), [] if busy else [Fault("meta/episodes", None, what, LEFTOVER)]


def _counts(found: Survey, busy: bool) -> Iterator[Fault]:
    expected = 0
    for number, episode in found.told.items():
        if episode.start != expected and found.complete:
            what = f"episode {number} starts at row {episode.start}, {expected} follows the one before"
            yield Fault("meta/episodes", expected, what, _ANEW)
        expected = episode.stop
    if not found.info:
        return
    count, length = found.info.get("total_episodes"), found.info.get("total_frames")
    if found.complete and not busy:
        before = -1
        for number in found.told:
            if number != before + 1:
                lost = (
                    f"episode {before + 1} is" if number == before + 2 else f"episodes {before + 1} to {number - 1} are"
                )
                yield Fault("meta/episodes", None, f"{lost} not listed", _ANEW)
            before = number
        if count != len(found.told):
            what = f"info.json counts {count} episodes, meta/episodes lists {len(found.told)}"
            yield Fault(INFO, None, what, f"set total_episodes to {len(found.told)}, or let --repair count anew")
        if length != expected:
            what = f"info.json counts {length} rows, the episodes hold {expected}"
            yield Fault(INFO, None, what, f"set total_frames to {expected}")
    if not isinstance(count, int) or not isinstance(length, int):
        yield Fault(INFO, None, "total_episodes or total_frames is no whole number", _ANEW)


# -- duplicates ------------------------------------------------------------------------------------------------------


def _duplicates(found: Survey, rows: Rows, shown: Shown) -> Iterator[Fault]:
    mend = "leave one of them out of training: --repair keeps both"
    observed = any(
        name.startswith("observation.") and f["dtype"] not in ("video", "image") for name, f in found.features.items()
    )
    pictured = any(feature["dtype"] in ("video", "image") for feature in found.features.values())
    numbers = {
        number: seen.digest.hexdigest()
        for number, seen in rows.episodes.items()
        if seen.changes and seen.rows > 1 and (observed or not pictured)
    }
    told: set[int] = set()
    for first, later in same(numbers):
        told.add(later)
        seen = rows.episodes[later]
        yield Fault(seen.file, seen.first, f"episode {later} has the same actions and states as episode {first}", mend)
    pictures = {number: digest.hexdigest() for number, digest in shown.digests.items() if number not in shown.static}
    stored = any(feature["dtype"] == "image" for feature in found.features.values())
    if stored:
        pictures = {number: seen.pictures.hexdigest() for number, seen in rows.episodes.items() if seen.changes}
    for first, later in same(pictures):
        if later not in told:
            seen = rows.episodes.get(later)
            row = found.told[later].start if later in found.told else None
            file = seen.file if seen else "meta/episodes"
            yield Fault(file, row, f"episode {later} shows the same pictures as episode {first}", mend)


# -- an interrupted episode ------------------------------------------------------------------------------------------


def _interrupted(found: Survey) -> Iterator[Fault]:
    """What a killed recorder left: how many of its rows and frames are whole."""
    if not (found.root / _STAGING).exists():
        return
    about, rows, frames = {}, 0, {}
    try:
        about = journal.about(found.path(_STAGING))
        rows = sum(1 for number, _, _ in journal.readings(found.path(_STAGING)) if number == 0)
        frames = {name: mp4.count_whole(found.path(f".staging/{name}.growing.mp4")) for name in found.cameras}
    except (OSError, ValueError, RecursionError, DatasetError):
        rows = 0
    if about and about.get("episode") != found.info.get("total_episodes") and found.info:
        return  # it was killed after the episode was safe
    whole = min([rows, *frames.values()])
    if whole < 2:
        what = "an interrupted episode lies here of which fewer than 2 rows are whole"
        yield Fault(_STAGING, None, what, "record into the folder again, which clears it, or delete .staging")
        return
    shown = "".join(f", {count} frames of {name}" for name, count in frames.items())
    what = f"an interrupted episode lies here, not yet part of the recording: {rows} whole rows{shown}"
    yield Fault(
        _STAGING, None, what, f"record into the folder again, or use --repair: either keeps its first {whole} rows"
    )
