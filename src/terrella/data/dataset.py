"""Dataset: reads LeRobotDataset v3.0 folders, Terrella's own and others', as plain arrays."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core.errors import DatasetError
from . import mp4
from .format import (
    ACTION,
    ACTION_VALID,
    DATA_PATH,
    DEPTH,
    DEPTH_UNIT_M,
    DONE,
    EPISODES_PATH,
    INFO,
    POSE_NAMES,
    REWARD,
    RGB,
    STATE,
    VIDEO_PATH,
    WORLD,
    to_numpy,
)

# array name -> feature that holds it
COLUMNS = {
    "depth": DEPTH,
    "pose": STATE,
    "action": ACTION,
    "action_valid": ACTION_VALID,
    "reward": REWARD,
    "done": DONE,
}


@dataclass(frozen=True)
class Episode:
    """Rows [start, stop) of the dataset; `data` holds them, `video` shows them from frame `first_frame` on."""

    number: int
    start: int
    stop: int
    data: Path
    video: Path | None
    first_frame: int
    task: str

    @property
    def length(self) -> int:
        return self.stop - self.start


class Dataset:
    """A recording. DatasetError where the folder is missing, foreign, of another version, or a file is broken.

    info:         meta/info.json.
    features:     its features.
    fps:          rows a second.
    length:       rows in all.
    episodes:     list of Episode.
    action_names: one per number of an action.
    world:        what Terrella's recorder knew of the recorded world (name, camera, keys, ...); {} for others.
    """

    def __init__(self, root: str | Path):
        self.root = Path(root)
        self.info = _read_info(self.root)
        try:
            self.features: dict[str, dict] = self.info["features"]
            self.fps = float(self.info["fps"])
            self.length, count = int(self.info["total_frames"]), int(self.info["total_episodes"])
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{self.root / INFO} lacks {error}: it is not a whole LeRobot v3 info.json.") from error
        videos = [key for key, feature in self.features.items() if feature["dtype"] == "video"]
        self.rgb_key = RGB if RGB in videos else (videos[0] if videos else None)
        self.world = _read_world(self.root)
        self.episodes = _read_episodes(self, count)

    @property
    def action_names(self) -> tuple[str, ...]:
        feature = self.features.get(ACTION, {"shape": [0], "names": None})
        names = feature["names"]
        if isinstance(names, dict):  # older writers group them
            names = [name for group in names.values() for name in group]
        return tuple(names) if names else tuple(f"action_{i}" for i in range(feature["shape"][0]))

    def has(self, name: str) -> bool:
        """Whether episodes have the array `name` (rgb, depth, pose, action, action_valid, reward, done)."""
        if name == "rgb":
            return self.rgb_key is not None
        if name == "pose":
            return self.features.get(STATE, {}).get("names") == POSE_NAMES
        return name == "action_valid" or COLUMNS[name] in self.features

    def episode(self, number: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The arrays of one episode of T rows (all that there are, or `names`).

        rgb uint8 [T, H, W, 3]; depth float32 [T, h, w] metres (65.535 = beyond range); pose float32 [T, 7];
        action float32 [T, A]; action_valid bool [T]; reward float32 [T]; done bool [T]; other features by their key.
        """
        episode = self._episode(number)
        extra = [key for key in self.features if key.startswith("observation.") and key not in (RGB, DEPTH)]
        extra = [
            key for key in extra if self.features[key]["dtype"] != "video" and not (key == STATE and self.has("pose"))
        ]
        known = [name for name in ("rgb", *COLUMNS) if self.has(name)]
        wanted = [*known, *extra] if names is None else list(names)
        for name in wanted:
            if name not in known and name not in extra:
                raise DatasetError(f"{self.root} has no '{name}'; it has {', '.join([*known, *extra])}.")
        found = self._columns(episode, [name for name in wanted if name != "rgb"])
        if "rgb" in wanted:
            found["rgb"] = np.stack(list(self.frames(number)))
        return found

    def frames(self, number: int) -> Iterator[np.ndarray]:
        """The pictures of one episode, one after another: uint8 [H, W, 3]."""
        episode = self._episode(number)
        return mp4.frames(self._video(episode), episode.first_frame, episode.length, self.fps)

    def rgb_at(self, indices: Sequence[int] | np.ndarray) -> np.ndarray:
        """Full-resolution pictures uint8 [n, H, W, 3] of any rows of the dataset, in the order asked."""
        wanted = np.asarray(indices, dtype=np.int64).reshape(-1)
        if self.rgb_key is None:
            raise DatasetError(f"{self.root} has no pictures; it has {', '.join(self.features)}.")
        if wanted.size and not (0 <= wanted.min() and wanted.max() < self.length):
            raise DatasetError(f"row {wanted.max()} was asked of {self.root}, which has rows 0 to {self.length - 1}.")
        height, width = self.features[self.rgb_key]["shape"][:2]
        result = np.empty((len(wanted), height, width, 3), np.uint8)
        for episode in self.episodes:
            inside = np.flatnonzero((wanted >= episode.start) & (wanted < episode.stop))
            if inside.size:
                rows, back = np.unique(wanted[inside], return_inverse=True)
                numbers = (rows - episode.start + episode.first_frame).tolist()
                result[inside] = mp4.frames_at(self._video(episode), numbers, self.fps)[back]
        return result

    def _episode(self, number: int) -> Episode:
        if not 0 <= number < len(self.episodes):
            raise DatasetError(f"{self.root} has episodes 0 to {len(self.episodes) - 1}, no episode {number}.")
        return self.episodes[number]

    def _video(self, episode: Episode) -> Path:
        if episode.video is None:
            raise DatasetError(f"{self.root} has no pictures; it has {', '.join(self.features)}.")
        return episode.video

    def _columns(self, episode: Episode, names: list[str]) -> dict[str, np.ndarray]:
        stored = {name: COLUMNS.get(name, name) for name in names if COLUMNS.get(name, name) in self.features}
        table = read_table(episode.data, ["index", *stored.values()])
        if len(table) != episode.length:
            index = table["index"].to_numpy()
            table = table.filter(pa.array((index >= episode.start) & (index < episode.stop)))
        if len(table) != episode.length:
            raise DatasetError(
                f"{episode.data} has {len(table)} of the {episode.length} rows of episode {episode.number}; "
                f"restore it from a copy, or see `terrella data doctor {self.root}`."
            )
        found: dict[str, np.ndarray] = {}
        for name in names:
            if name not in stored:  # action_valid of a stranger's recording: what follows the last row is unknown
                found[name] = np.arange(episode.length) < episode.length - 1
                continue
            shape = tuple(self.features[stored[name]]["shape"])
            try:
                array = to_numpy(table[stored[name]], shape)
            except ValueError as error:
                raise DatasetError(
                    f"{episode.data}: column '{stored[name]}' is not what info.json says ({error})."
                ) from error
            found[name] = _as_promised(name, array)
        return found


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """A parquet file's columns; DatasetError where it is missing, truncated or lacks one."""
    try:
        return pq.ParquetFile(path).read(columns=columns)
    except (OSError, pa.ArrowException) as error:
        short = str(error).splitlines()[0]
        raise DatasetError(
            f"the table {path} is missing, truncated or not parquet ({short}); restore it from a copy, or remove its episode."
        ) from error


def _as_promised(name: str, array: np.ndarray) -> np.ndarray:
    if name == "depth":
        return array.astype(np.float32) * np.float32(DEPTH_UNIT_M)
    if name in ("reward", "done", "action_valid"):
        return array.reshape(-1).astype(np.float32 if name == "reward" else bool)
    return array.astype(np.float32) if name in ("pose", "action") else array


def _read_info(root: Path) -> dict:
    make_one = f"record one with `terrella record doom --out {root}`"
    if not root.is_dir():
        raise DatasetError(f"there is no dataset at {root}; {make_one}.")
    path = root / INFO
    if not path.exists():
        if (root / "meta" / "episodes.jsonl").exists():
            raise DatasetError(f"{root} has no {INFO}; it looks like a damaged LeRobot v2 dataset.")
        raise DatasetError(f"{root} is not a LeRobot dataset (it has no {INFO}); {make_one} in a new folder.")
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is not a LeRobot info.json ({error}); restore it from a copy.") from error
    if version.removeprefix("v").split(".")[0] != "3":
        raise DatasetError(
            f"{root} is a LeRobot dataset of version {version} and v3.0 is read here; convert it with LeRobot's "
            "`python -m lerobot.datasets.v30.convert_dataset_v21_to_v30`."
        )
    return info


def _read_world(root: Path) -> dict:
    path = root / WORLD
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["world"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is not readable ({error}); restore it from a copy.") from error


def _read_episodes(dataset: Dataset, count: int) -> list[Episode]:
    root, key = dataset.root, dataset.rgb_key
    paths = sorted((root / EPISODES_PATH).parent.parent.glob("chunk-*/file-*.parquet"))
    columns = [
        "episode_index",
        "data/chunk_index",
        "data/file_index",
        "dataset_from_index",
        "dataset_to_index",
        "tasks",
    ]
    if key:
        columns += [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    rows: list[dict] = []
    for path in paths:
        if len(rows) >= count:
            break
        rows += read_table(path, columns).to_pylist()
    rows = sorted(rows, key=lambda row: row["episode_index"])[:count]
    if [row["episode_index"] for row in rows] != list(range(count)):
        raise DatasetError(
            f"{root}/meta/episodes does not list the {count} episodes of info.json; restore it from a copy."
        )
    episodes = []
    for row in rows:
        data = str(dataset.info.get("data_path") or DATA_PATH).format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        video, first = None, 0
        if key:
            at = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            video = root / str(dataset.info.get("video_path") or VIDEO_PATH).format(video_key=key, **at)
            first = round(row[f"videos/{key}/from_timestamp"] * dataset.fps)
        task = (row["tasks"] or [""])[0]
        start, stop = row["dataset_from_index"], row["dataset_to_index"]
        episodes.append(Episode(row["episode_index"], start, stop, root / data, video, first, task))
    return episodes
