"""doctor: examines a recording, ours or a stranger's, however damaged, and names each fault with its place and its mend."""

from __future__ import annotations

import fcntl
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ..core.errors import DatasetError
from ..data.format import INFO, STATS
from ..data.storage import journal, mp4
from .film_checks import Shown, examine_films, same
from .motion_checks import misaligned
from .row_checks import Rows, constants, examine_rows, frozen, statistics
from .streams import examine_streams
from .survey import FROM_ROWS, LEFTOVER, RESTORE, Fault, Survey, survey

__all__ = ["Fault", "Findings", "doctor", "examine"]

_STAGING = ".staging/rows.log"
_TWINS = "leave one of them out of training: --repair keeps both"
_EXAMPLES = 3  # places of a kind of fault that a report names


@dataclass(frozen=True)
class Findings:
    """What an examination found.

    faults: what is wrong, likely causes before what follows from them. notes: sentences worth reading that are no
    faults: numbers that never change, a recorder at work.
    """

    faults: list[Fault]
    notes: list[str]

    @property
    def groups(self) -> list[list[Fault]]:
        """The faults by kind, likely causes first: of one kind is what says the same but for the numbers."""
        kinds: dict[tuple[str, str], list[Fault]] = {}
        for fault in self.faults:
            kinds.setdefault((_kind(fault.what), _kind(fault.mend)), []).append(fault)
        return list(kinds.values())

    def facts(self) -> dict[str, object]:
        """All of it as JSON values; `kinds` are the groups of faults, likely causes first."""
        kinds = [{**asdict(faults[0]), "count": len(faults)} for faults in self.groups]
        return {"faults": [asdict(fault) for fault in self.faults], "kinds": kinds, "notes": self.notes}

    def report(self, name: str) -> str:
        """The verdict, then the likeliest cause, then the other faults by kind, then the notes."""
        groups, count = self.groups, len(self.faults)
        kinds = f" of {len(groups)} kinds" if 1 < len(groups) < count else ""
        lines = [f"{name}: {f'{count} fault' if count else 'sound, no fault'}{'s' * (count > 1)}{kinds}"]
        lines += [
            f"{'likeliest cause: ' * (at == 0 and len(groups) > 1)}{_told(group)}" for at, group in enumerate(groups)
        ]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def doctor(root: str | Path) -> list[Fault]:
    """All faults of a LeRobot v3.0 recording, [] where it is sound. DatasetError where there is no dataset to examine."""
    return examine(root).faults


def examine(root: str | Path) -> Findings:
    """Faults and notes. Every row is read once; of videos the packets, and of each episode some frames."""
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
    faults += [*still, *frozen(found, rows, shown.static), *misaligned(found, rows, shown)]
    if busy:
        notes.append("a recorder is writing to this folder right now; its episode in flight was not looked at")
    else:
        faults += _interrupted(found)
    return Findings(sorted(faults, key=_rank), notes)


def _rank(fault: Fault) -> int:
    """Likely causes are low: what one wrong number or one lost file explains comes after it."""
    if fault.file == INFO:
        return 0 if fault.what.startswith("fps") else 5 if "counts" in fault.what else 1
    if "exchanged" in fault.what or fault.file == "videos":
        return 2
    if fault.file.startswith("meta/episodes"):
        return 3 if fault.mend != LEFTOVER else 8
    if fault.file == STATS or fault.mend in (LEFTOVER, _TWINS):
        return 7
    return 4 if fault.mend == RESTORE else 6


def _told(faults: list[Fault]) -> str:
    """What is said of faults of one kind."""
    first, more, others = faults[0], faults[1:_EXAMPLES], len(faults) - _EXAMPLES
    places = "; ".join([*map(_place, more), *([f"{others} more"] if others > 0 else [])])
    of_kind = f"\n    {len(faults)} of this kind, the others: {places}." if more else ""
    return f"{_place(first)}: {first.what}.{of_kind}\n    mend: {first.mend}."


def _kind(sentence: str) -> str:
    return re.sub(r"\d[\d.,]*", "#", sentence)


def _place(fault: Fault) -> str:
    return fault.file if fault.row is None else f"{fault.file}, row {fault.row}"


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
    beyond = [number for number in found.episodes if isinstance(count, int) and number >= count]
    kept = {number: episode for number, episode in found.episodes.items() if number not in beyond}
    if not beyond or list(kept) != list(range(int(str(count)))) or max([0, *(e.stop for e in kept.values())]) != length:
        return found, []
    what = f"it lists episode {beyond[0]} beyond the {count} of info.json"
    return replace(found, episodes=kept), [] if busy else [Fault("meta/episodes", None, what, LEFTOVER)]


def _counts(found: Survey, busy: bool) -> Iterator[Fault]:
    expected = 0
    for number, episode in found.episodes.items():
        if episode.start != expected and found.complete:
            what = f"episode {number} starts at row {episode.start}, {expected} follows the one before"
            yield Fault("meta/episodes", expected, what, FROM_ROWS)
        expected = episode.stop
    if not found.info:
        return
    count, length = found.info.get("total_episodes"), found.info.get("total_frames")
    if found.complete and not busy:
        before = -1
        for number in found.episodes:
            if number != before + 1:
                lost = (
                    f"episode {before + 1} is" if number == before + 2 else f"episodes {before + 1} to {number - 1} are"
                )
                yield Fault("meta/episodes", None, f"{lost} not listed", FROM_ROWS)
            before = number
        if count != len(found.episodes):
            what = f"info.json counts {count} episodes, meta/episodes lists {len(found.episodes)}"
            yield Fault(INFO, None, what, f"set total_episodes to {len(found.episodes)}, or let --repair count anew")
        if length != expected:
            what = f"info.json counts {length} rows, the episodes hold {expected}"
            yield Fault(INFO, None, what, f"set total_frames to {expected}")
    if not isinstance(count, int) or not isinstance(length, int):
        yield Fault(INFO, None, "total_episodes or total_frames is no whole number", FROM_ROWS)


# -- duplicates ------------------------------------------------------------------------------------------------------


def _duplicates(found: Survey, rows: Rows, shown: Shown) -> Iterator[Fault]:
    observed = any(
        name.startswith("observation.") and f["dtype"] not in ("video", "image") for name, f in found.features.items()
    )
    pictured = any(feature["dtype"] in ("video", "image") for feature in found.features.values())
    numbers = {
        number: seen.digest.hexdigest()
        for number, seen in rows.episodes.items()
        if seen.changes and seen.rows > 1 and (observed or not pictured)
    }
    known: set[int] = set()
    for first, later in same(numbers):
        known.add(later)
        seen = rows.episodes[later]
        yield Fault(
            seen.file, seen.first, f"episode {later} has the same actions and states as episode {first}", _TWINS
        )
    pictures = {number: digest.hexdigest() for number, digest in shown.digests.items() if number not in shown.static}
    stored = any(feature["dtype"] == "image" for feature in found.features.values())
    if stored:
        pictures = {number: seen.pictures.hexdigest() for number, seen in rows.episodes.items() if seen.changes}
    for first, later in same(pictures):
        if later not in known:
            seen = rows.episodes.get(later)
            row = found.episodes[later].start if later in found.episodes else None
            file = seen.file if seen else "meta/episodes"
            yield Fault(file, row, f"episode {later} shows the same pictures as episode {first}", _TWINS)


# -- an interrupted episode ------------------------------------------------------------------------------------------


def _interrupted(found: Survey) -> Iterator[Fault]:
    """What a killed recorder left: how many of its rows and frames are whole."""
    if not (found.root / _STAGING).exists():
        return
    about, rows, frames = {}, 0, {}
    try:
        about = journal.about(found.path(_STAGING))
        rows = sum(1 for number, _, _ in journal.readings(found.path(_STAGING)) if number == 0)
        frames = {name: mp4.whole_fragments(found.path(f".staging/{name}.growing.mp4"))[1] for name in found.cameras}
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
