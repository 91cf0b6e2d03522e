"""The episodes of an evaluation so far, kept in evaluate.json, so that a stopped evaluation continues."""

import importlib.util
import json
import math
import time
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from ..act.paired_evaluation import CHUNK, Chunk
from ..act.planning import PlayedEpisode
from ..core.errors import TerrellaError
from ..core.files import write_json
from ..measure.policy_evaluation import CONTROL, DREAM, REAL, REPLAY, RETURN, SUCCESS
from .results import jsonable

SAVED_EVERY_S = 5.0
_DIGITS = 6


def fingerprint(source: str | Path) -> int | None:
    """A checksum of the weights in a folder, or of the file of a user's own policy; None where there is no file. The names of keys,
    which a page may rewrite, do not count, nor what a training run keeps to resume."""
    text = str(source).rpartition("@")[0] if not Path(source).exists() and "@" in str(source) else str(source)
    path, module = Path(text), text.rpartition(":")[0]
    files: list[Path | None] = []
    if path.is_dir():
        files += sorted(file for file in path.rglob("*.safetensors") if not file.name.startswith("resume-"))
    elif module.endswith(".py"):
        files.append(Path(module))
    elif module.replace(".", "").isidentifier():
        files.append(_origin(module))
    checksum = None
    for file in files:
        if file is not None and file.is_file():
            checksum = zlib.crc32(file.read_bytes(), checksum or 0)
    return checksum


def crc_of(file: str | None) -> int | None:
    """The checksum of a file; None where there is none of this name."""
    return zlib.crc32(Path(file).read_bytes()) if file and Path(file).is_file() else None


def _origin(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin else None


class EvaluationLog:
    """The file evaluate.json of a folder: the settings, and the episodes of each policy.

    settings:     must not change once something was played.
    fingerprints: policy -> the checksum of its weights or source; a policy whose checksum has changed is played again.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], fingerprints: Mapping[str, int | None]):
        self.file, self.settings, self.fingerprints = folder / "evaluate.json", dict(settings), fingerprints
        self._played: dict[str, dict[str, Any]] = {}
        self._saved = time.monotonic()
        if self.file.exists():
            self._resume()
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise TerrellaError(f"{folder} holds something else than an evaluation; give another --out.")

    def count(self, name: str) -> int:
        """The number of episodes that are known of a policy."""
        return len(self._played[name]["arms"][DREAM][RETURN]) if name in self._played else 0

    def has(self, name: str, count: int) -> bool:
        return self.count(name) >= count

    def add(self, name: str, first: int, chunk: Chunk) -> None:
        """Adds the episodes from number `first` on, in place of any that were known from there on."""
        new = {"mark": self.fingerprints.get(name), "skipped": {}, "arms": {}, "followed": {}}
        known = self._played.setdefault(name, new)
        known["skipped"][str(first // CHUNK)] = chunk.skipped
        for arm, episodes in _arms_of(chunk).items():
            if episodes:
                measures = known["arms"].setdefault(arm, {})
                for measure, values in _measured(episodes).items():
                    measures[measure] = [*measures.get(measure, [])[:first], *values]
        for channel, curve in chunk.open_loop_errors.items():
            mean = curve.double().nanmean(0).tolist()
            known["followed"][channel] = [jsonable(round(value, _DIGITS)) for value in mean]
        if time.monotonic() - self._saved > SAVED_EVERY_S:
            self.save()

    def scores(self, name: str, episodes: int) -> dict[str, dict[str, torch.Tensor]]:
        """arm -> measure -> [episodes]."""
        arms = self._played[name]["arms"]
        return {
            arm: {
                measure: torch.tensor([float(value) for value in measures[measure][:episodes]], dtype=torch.float64)
                for measure in (RETURN, SUCCESS)
                if measure in measures
            }
            for arm, measures in arms.items()
        }

    def open_loop_errors(self, name: str) -> dict[str, list[float]]:
        """channel -> error of the dream by step under the real actions, the mean over episodes."""
        curves = self._played[name]["followed"]
        return {channel: [math.nan if value is None else value for value in curve] for channel, curve in curves.items()}

    def skipped(self, names: Iterable[str]) -> int:
        """The number of starts that were left out as solved; the same for all policies."""
        return max(sum(self._played[name]["skipped"].values()) for name in names)

    def save(self, result: Mapping[str, Any] | None = None) -> None:
        """Writes the episodes and, once all are played, the result. Writes nothing where nothing was played."""
        self._saved = time.monotonic()
        if self._played:
            write_json(self.file, {**(result or {}), "asked": self.settings, "played": self._played})

    def _resume(self) -> None:
        try:
            kept = json.loads(self.file.read_text(encoding="utf-8"))
            before, played = dict(kept["asked"]), dict(kept["played"])
            counts = [len(known["arms"][DREAM][RETURN]) + len(known["followed"]) for known in played.values()]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise TerrellaError(f"{self.file} is damaged ({error}); give another --out.") from error
        if not counts:
            return
        other = [name for name in self.settings if before.get(name) != self.settings[name]]
        if other == ["world"]:
            raise TerrellaError(
                f"{self.file.parent} evaluated policies in this world before it was trained on: give another --out."
            )
        if other:
            changed = (f"{name} {before.get(name)}, not {self.settings[name]}" for name in other if name != "world")
            raise TerrellaError(
                f"{self.file.parent} was begun with other settings ({'; '.join(changed)}); repeat them, or give another --out."
            )
        marks = {name: known.get("mark") for name, known in played.items()}
        same = [name for name, mark in marks.items() if mark == self.fingerprints.get(name, mark)]
        self._played = {name: played[name] for name in same}


def _arms_of(chunk: Chunk) -> dict[str, list[PlayedEpisode]]:
    return {REAL: chunk.real, DREAM: chunk.dream, CONTROL: chunk.control, REPLAY: chunk.replay}


def _measured(episodes: list[PlayedEpisode]) -> dict[str, list[Any]]:
    values: dict[str, list[Any]] = {RETURN: [episode.reward for episode in episodes]}
    values["steps"] = [episode.steps for episode in episodes]
    if episodes[0].success is not None:
        values[SUCCESS] = [bool(episode.success) for episode in episodes]
    return values
