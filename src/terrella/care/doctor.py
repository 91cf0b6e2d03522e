"""doctor: examines any LeRobot v3 recording, however damaged; names each fault, its place and how to mend it."""

import fcntl
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ..core.errors import DatasetError
from ..core.losses import by_reason
from ..data.channels import DONE
from ..data.format import INFO, STATS, some_of
from ..data.storage import journal, mp4
from .film_checks import FilmFacts, equal_digests, examine_films
from .motion_checks import check_alignment
from .row_checks import RowFacts, check_statistics, constant_columns, examine_rows, frozen_states
from .streams import examine_streams
from .survey import FROM_ROWS, LEFTOVER, RESTORE, Fault, Survey, survey

__all__ = ["Fault", "Examination", "doctor", "examine"]

_STAGING = ".staging/rows.log"
_TWINS = "leave one of them out of training: --repair keeps both"
_EXAMPLES = 3  # places of a kind of fault that a report names


@dataclass(frozen=True)
class Examination:
    """The result of an examination."""

    faults: list[Fault]  # what is wrong; likely causes come before their consequences
    notes: list[str]  # sentences about what is unusual but no fault: numbers that never change, a recorder at work

    @property
    def groups(self) -> list[list[Fault]]:
        """The faults by kind, likely causes first. Faults of one kind differ in their numbers alone."""
        kinds: dict[tuple[str, str], list[Fault]] = {}
        for fault in self.faults:
            kinds.setdefault((_kind(fault.what), _kind(fault.mend)), []).append(fault)
        return list(kinds.values())

    def facts(self) -> dict[str, object]:
        """The result as JSON values; `kinds` are the groups of faults."""
        kinds = [{**asdict(faults[0]), "count": len(faults)} for faults in self.groups]
        return {"faults": [asdict(fault) for fault in self.faults], "kinds": kinds, "notes": self.notes}

    def report(self, name: str) -> str:
        """The verdict, then the likeliest cause, then the other faults by kind, then the notes."""
        groups, count = self.groups, len(self.faults)
        kinds = f" of {len(groups)} kinds" if 1 < len(groups) < count else ""
        lines = [f"{name}: {f'{count} fault' if count else 'sound, no fault'}{'s' * (count > 1)}{kinds}"]
        lines += [
            f"{'likeliest cause: ' * (at == 0 and len(groups) > 1)}{_describe(group)}"
            for at, group in enumerate(groups)
        ]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def doctor(root: str | Path) -> list[Fault]:
    """All faults of a LeRobot v3.0 recording, [] where it has none. DatasetError where there is no dataset to examine."""
    return examine(root).faults


def examine(root: str | Path) -> Examination:
    """Faults and notes. Reads every row once, the packets of every video, and some frames of each episode."""
    folder = survey(root)
    busy = is_being_written(folder.root)
    rows, shown = RowFacts(), FilmFacts()
    folder, faults = _without_leftovers(folder, busy)
    faults = [*folder.faults, *faults, *_counts(folder, busy)]
    faults += examine_rows(folder, rows, busy)
    faults += examine_films(folder, shown, busy)
    faults += examine_streams(folder, busy)
    faults += [] if busy else check_statistics(folder, rows)  # they may count the episode that is being committed
    faults += _duplicates(folder, rows, shown)
    still, notes = constant_columns(folder, rows)
    notes += [*_padding(folder), *_unexamined(folder, rows)]
    left_out = folder.world.get("left_out")
    notes += [f"left out when it was recorded: {line}" for line in by_reason(left_out)]
    faults += [*still, *frozen_states(folder, rows, shown.static), *check_alignment(folder, rows, shown)]
    if busy:
        notes.append("a recorder is writing to this folder now; the episode that it is recording was not examined")
    else:
        faults += _interrupted(folder)
    return Examination(sorted(faults, key=_rank), notes)


def _rank(fault: Fault) -> int:
    """Sorts likely causes first: 0 for what explains most other faults."""
    if fault.file == INFO:
        return 0 if fault.what.startswith("fps") else 5 if "counts" in fault.what else 1
    if "exchanged" in fault.what or fault.file == "videos":
        return 2
    if fault.file.startswith("meta/episodes"):
        return 3 if fault.mend != LEFTOVER else 8
    if fault.file == STATS or fault.mend in (LEFTOVER, _TWINS):
        return 7
    return 4 if fault.mend == RESTORE else 6


def _describe(faults: list[Fault]) -> str:
    """The text of the faults of one kind."""
    first, more, others = faults[0], faults[1:_EXAMPLES], len(faults) - _EXAMPLES
    places = "; ".join([*map(_place, more), *([f"{others} more"] if others > 0 else [])])
    of_kind = f"\n    {len(faults)} of this kind, the others: {places}." if more else ""
    return f"{_place(first)}: {first.what}.{of_kind}\n    mend: {first.mend}."


def _kind(sentence: str) -> str:
    return re.sub(r"\d[\d.,]*", "#", sentence)


def _place(fault: Fault) -> str:
    return fault.file if fault.row is None else f"{fault.file}, row {fault.row}"


def is_being_written(root: Path) -> bool:
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


def _without_leftovers(folder: Survey, busy: bool) -> tuple[Survey, list[Fault]]:
    """Leaves out the episodes of a killed commit, which info.json (written last) does not count."""
    count, length = folder.info.get("total_episodes"), folder.info.get("total_frames")
    beyond = [number for number in folder.episodes if isinstance(count, int) and number >= count]
    kept = {number: episode for number, episode in folder.episodes.items() if number not in beyond}
    if not beyond or list(kept) != list(range(int(str(count)))) or max([0, *(e.stop for e in kept.values())]) != length:
        return folder, []
    what = f"it lists episode {beyond[0]}, but info.json counts {count} episodes"
    return replace(folder, episodes=kept), [] if busy else [Fault("meta/episodes", None, what, LEFTOVER)]


def _counts(folder: Survey, busy: bool) -> Iterator[Fault]:
    expected = 0
    for number, episode in folder.episodes.items():
        if episode.start != expected and folder.complete:
            what = f"episode {number} starts at row {episode.start}; after the episode before it, row {expected} comes next"
            yield Fault("meta/episodes", expected, what, FROM_ROWS)
        expected = episode.stop
    if not folder.info:
        return
    count, length = folder.info.get("total_episodes"), folder.info.get("total_frames")
    if folder.complete and not busy:
        before = -1
        for number in folder.episodes:
            if number != before + 1:
                one = number == before + 2
                lost = f"episode {before + 1} is" if one else f"episodes {before + 1} to {number - 1} are"
                yield Fault("meta/episodes", None, f"{lost} not listed", FROM_ROWS)
            before = number
        if count != len(folder.episodes):
            what = f"info.json counts {count} episodes, but meta/episodes lists {len(folder.episodes)}"
            mend = f"set total_episodes to {len(folder.episodes)}, or use --repair, which counts them again"
            yield Fault(INFO, None, what, mend)
        if length != expected:
            what = f"info.json counts {length} rows, but the episodes hold {expected}"
            yield Fault(INFO, None, what, f"set total_frames to {expected}")
    if not isinstance(count, int) or not isinstance(length, int):
        yield Fault(INFO, None, "total_episodes or total_frames is not a whole number", FROM_ROWS)


def _padding(folder: Survey) -> Iterator[str]:
    """A note on each sensor that some episodes have no reading of."""
    absent: dict[str, list[int]] = {}
    for number, episode in folder.episodes.items():
        for name in episode.absent:
            absent.setdefault(name, []).append(number)
    for name, numbers in absent.items():
        if name in folder.features and name != DONE:
            where = f"{len(numbers)} of {len(folder.episodes)} episodes ({some_of(numbers)})"
            what = f"in {where}: their rows of it are padding, which training leaves out"
            yield f"{name} has no readings {what if len(numbers) < len(folder.episodes) else 'at all: it is padding'}"


def _unexamined(folder: Survey, rows: RowFacts) -> Iterator[str]:
    """Notes on files and columns that are no part of the dataset."""
    known = {*folder.data, *folder.films}
    files = [path.relative_to(folder.root).as_posix() for path in sorted(folder.root.rglob("*")) if path.is_file()]
    plain = ("meta/", "streams/", ".", "README", "LICENSE", "look.jpg")  # the last is the picture of `terrella record`
    strange = [file for file in files if file not in known and not file.startswith(plain)]
    if strange:
        yield f"files that are no part of the dataset were not examined: {some_of(strange)}"
    for name in sorted(rows.unlisted):
        yield f"the column '{name}' is in the tables but not in info.json: no reader sees it until that file names it"


# -- duplicates ------------------------------------------------------------------------------------------------------


def _duplicates(folder: Survey, rows: RowFacts, shown: FilmFacts) -> Iterator[Fault]:
    plain = [name for name, feature in folder.features.items() if feature["dtype"] not in ("video", "image")]
    observed = any(name.startswith("observation.") for name in plain)
    pictured = any(feature["dtype"] in ("video", "image") for feature in folder.features.values())
    numbers = {
        number: seen.digest.hexdigest()
        for number, seen in rows.episodes.items()
        if seen.changes and seen.rows > 1 and (observed or not pictured)
    }
    known: set[int] = set()
    for first, later in equal_digests(numbers):
        known.add(later)
        seen = rows.episodes[later]
        what = f"episode {later} has the same actions and states as episode {first}"
        yield Fault(seen.file, seen.first, what, _TWINS)
    pictures = {number: digest.hexdigest() for number, digest in shown.digests.items() if number not in shown.static}
    if any(feature["dtype"] == "image" for feature in folder.features.values()):
        pictures = {number: seen.pictures.hexdigest() for number, seen in rows.episodes.items() if seen.changes}
    for first, later in equal_digests(pictures):
        if later not in known:
            seen = rows.episodes.get(later)
            row = folder.episodes[later].start if later in folder.episodes else None
            file = seen.file if seen else "meta/episodes"
            yield Fault(file, row, f"episode {later} shows the same pictures as episode {first}", _TWINS)


# -- an interrupted episode ------------------------------------------------------------------------------------------


def _interrupted(folder: Survey) -> Iterator[Fault]:
    """The episode that a killed recorder left, with its number of whole rows and frames."""
    if not (folder.root / _STAGING).exists():
        return
    about, rows, frames = {}, 0, {}
    try:
        about = journal.read_about(folder.path(_STAGING))
        rows = sum(1 for number, _, _ in journal.read_records(folder.path(_STAGING)) if number == 0)
        frames = {name: mp4.whole_fragments(folder.path(f".staging/{name}.growing.mp4"))[1] for name in folder.cameras}
    except (OSError, ValueError, RecursionError, DatasetError):
        rows = 0
    if about and about.get("episode") != folder.info.get("total_episodes") and folder.info:
        return  # the recorder was killed after the commit
    whole = min([rows, *frames.values()])
    if whole < 2:
        what = "an interrupted episode lies here, with fewer than 2 whole rows"
        yield Fault(_STAGING, None, what, "record into the folder again, which removes it, or delete .staging")
        return
    shown = "".join(f", {count} frames of {name}" for name, count in frames.items())
    what = f"an interrupted episode lies here that is not part of the recording: {rows} whole rows{shown}"
    yield Fault(_STAGING, None, what, f"record into the folder again, or use --repair: both keep {whole} rows")
