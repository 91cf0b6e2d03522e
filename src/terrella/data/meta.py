"""The JSON files and the table of tasks that say what a recording is, read with an error that says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..core.errors import DatasetError
from .format import INFO, TASKS, WORLD, sensor_from_json
from .source import Sensor
from .storage.remote import Files, LocalFiles
from .storage.tables import read_json, read_whole


def read_info(root: Path, files: LocalFiles | Files) -> dict:
    """meta/info.json; DatasetError where there is none, or it is of another version."""
    make_one = f"record one with `terrella record doom --out {root}`"
    if not files.exists(INFO):
        if isinstance(files, LocalFiles) and not root.is_dir():
            raise DatasetError(f"there is no dataset at {root}; {make_one}.")
        if files.exists("meta/episodes.jsonl"):
            raise DatasetError(f"{root} has no {INFO}; it looks like a damaged LeRobot v2 dataset.")
        raise DatasetError(f"{root} is not a LeRobot dataset (it has no {INFO}); {make_one} in a new folder.")
    path = files.local(INFO)
    try:
        info: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        version = str(info["codebase_version"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{root / INFO} is not a LeRobot info.json ({error}); restore it from a copy.") from error
    if version.removeprefix("v").split(".")[0] != "3":
        raise DatasetError(
            f"{root} is a LeRobot dataset of version {version[:20]} and v3.0 is read here; convert it with LeRobot's "
            "`python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`."
        )
    return info


def read_about(root: Path, files: LocalFiles | Files) -> dict:
    """meta/terrella.json; {} where a stranger's recording has none."""
    if not files.exists(WORLD):
        return {}
    path = files.local(WORLD)
    try:
        about: dict = read_json(path)  # pyright: ignore  (a TypeError where it is none)
        channels = {str(name): str(feature) for name, feature in dict(about.get("channels", {})).items()}
        return {**about, "world": dict(about["world"]), "channels": channels}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{root / WORLD} is not readable ({error}); restore it from a copy.") from error


def read_sensors(root: Path, about: Mapping, kind: str) -> dict[str, Sensor]:
    """What meta/terrella.json says of the sensors of a kind ("sensors", "streams")."""
    try:
        return {name: sensor_from_json(name, stated) for name, stated in dict(about.get(kind, {})).items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{root / WORLD} is not readable ({error}); restore it from a copy.") from error


def read_tasks(root: Path, files: LocalFiles | Files) -> tuple[str, ...]:
    """The texts of meta/tasks.parquet by their number, "" for a number that has none; () where there is no such table."""
    if not files.exists(TASKS):
        return ()
    try:
        found = sentences(files.local(TASKS))
    except ValueError as error:
        raise DatasetError(f"{root / TASKS} is damaged ({error}); see `terrella data doctor {root}`.") from error
    return tuple(found.get(number, "") for number in range(max(found, default=-1) + 1))


def sentences(path: Path) -> dict[int, str]:
    """task_index -> its text, of a table of tasks; DatasetError or ValueError where it is none."""
    table = read_whole(path)
    texts = next((name for name in ("__index_level_0__", "task") if name in table.column_names), None)
    if texts is None or "task_index" not in table.column_names:
        raise ValueError("it is no table of tasks")
    numbers = table["task_index"].to_pylist()
    if not all(isinstance(number, int) and 0 <= number < len(numbers) + 1_000_000 for number in numbers):
        raise ValueError("it numbers its tasks by what is no number")
    return {number: str(text) for number, text in zip(numbers, table[texts].to_pylist())}
