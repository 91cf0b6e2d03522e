"""What was judged so far, kept in evaluate.json: stopped at any time, the same command goes on."""

from __future__ import annotations

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
from ..measure.policy_evaluation import CONTROL, DREAM, REAL, RETURN, SUCCESS

SAVED_EVERY_S = 5.0
_DIGITS = 6


def fingerprint(source: str | Path) -> int | None:
    """Changes with the weights in a folder, or with the file of a policy of one's own; None for what has no file. Names of keys
    and the like, which a page may rewrite, do not count, nor what a training keeps to go on."""
    text = str(source).rpartition("@")[0] if not Path(source).exists() and "@" in str(source) else str(source)
    path = Path(text)
    if path.is_dir():
        files = sorted(file for file in path.rglob("*.safetensors") if not file.name.startswith("resume-"))
    else:
        module, _, _ = text.rpartition(":")
        files = (
            [Path(module)]
            if module.endswith(".py")
            else [_origin(module)]
            if module.replace(".", "").isidentifier()
            else []
        )
    found = None
    for file in files:
        if file is not None and file.is_file():
            found = zlib.crc32(file.read_bytes(), found or 0)
    return found


def crc_of(file: str | None) -> int | None:
    """Changes with what a file holds; None where there is none of this name."""
    return zlib.crc32(Path(file).read_bytes()) if file and Path(file).is_file() else None


def _origin(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin else None


class JudgedLog:
    """The file evaluate.json of a folder: what was asked, and the episodes of each policy.

    asked: the settings, which must not change once something was judged. marks: policy -> its fingerprint; where it has changed,
    the policy is judged anew.
    """

    def __init__(self, folder: Path, asked: Mapping[str, Any], marks: Mapping[str, int | None]):
        self.file, self.asked, self.marks = folder / "evaluate.json", dict(asked), marks
        self._played: dict[str, dict[str, Any]] = {}
        self._saved = time.monotonic()
        if self.file.exists():
            self._go_on()
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise TerrellaError(f"{folder} holds something else than an evaluation; give another --out.")

    def count(self, name: str) -> int:
        """The episodes that are known of a policy."""
        return len(self._played[name]["arms"][DREAM][RETURN]) if name in self._played else 0

    def has(self, name: str, count: int) -> bool:
        return self.count(name) >= count

    def add(self, name: str, first: int, chunk: Chunk) -> None:
        """The episodes from number `first` on; what was known from there on is forgotten."""
        known = self._played.setdefault(name, {"mark": self.marks.get(name), "skipped": {}, "arms": {}, "followed": {}})
        known["skipped"][str(first // CHUNK)] = chunk.skipped
        for arm, episodes in ((REAL, chunk.real), (DREAM, chunk.dream), (CONTROL, chunk.control)):
            if episodes:
                measures = known["arms"].setdefault(arm, {})
                for measure, values in _measured(episodes).items():
                    measures[measure] = [*measures.get(measure, [])[:first], *values]
        for channel, curve in chunk.open_loop_errors.items():
            known["followed"][channel] = [_sound(value) for value in curve.double().nanmean(0).tolist()]
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

    def followed(self, name: str) -> dict[str, list[float]]:
        """channel -> error by step, the mean over episodes."""
        curves = self._played[name]["followed"]
        return {channel: [math.nan if value is None else value for value in curve] for channel, curve in curves.items()}

    def skipped(self, names: Iterable[str]) -> int:
        """Starts that were left out; the same for all policies."""
        return max(sum(self._played[name]["skipped"].values()) for name in names)

    def save(self, found: Mapping[str, Any] | None = None) -> None:
        """Writes what is known; `found`: what came of it, once all is judged. Nothing where nothing was judged."""
        self._saved = time.monotonic()
        if self._played:
            write_json(self.file, {**(found or {}), "asked": self.asked, "played": self._played})

    def _go_on(self) -> None:
        try:
            kept = json.loads(self.file.read_text(encoding="utf-8"))
            asked, played = dict(kept["asked"]), dict(kept["played"])
            counts = [len(known["arms"][DREAM][RETURN]) + len(known["followed"]) for known in played.values()]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise TerrellaError(f"{self.file} is damaged ({error}); give another --out.") from error
        if not counts:
            return
        other = [name for name in self.asked if asked.get(name) != self.asked[name]]
        if other == ["world"]:
            raise TerrellaError(
                f"{self.file.parent} judged policies in this world before it was trained on: give another --out."
            )
        if other:
            words = "; ".join(f"{name} {asked.get(name)}, not {self.asked[name]}" for name in other if name != "world")
            raise TerrellaError(
                f"{self.file.parent} was begun with other settings ({words}); repeat them, or give another --out."
            )
        self._played = {
            name: known
            for name, known in played.items()
            if known.get("mark") == self.marks.get(name, known.get("mark"))
        }


def _measured(episodes: list[PlayedEpisode]) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {RETURN: [episode.reward for episode in episodes]}
    found["steps"] = [episode.steps for episode in episodes]
    if episodes[0].success is not None:
        found[SUCCESS] = [bool(episode.success) for episode in episodes]
    return found


def _sound(value: float) -> float | None:
    return round(value, _DIGITS) if math.isfinite(value) else None
