"""The plan of `terrella learn`: how its minutes are divided among its stages, and what was done of it, kept in a file."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import TerrellaError
from ..core.files import write_json

RECORDING, TRAINING, SCORING = "recording", "training", "scoring"
STARTING_S = 5.0  # of each stage: what is imported, and read again
NOTED_EVERY_S = 5.0


def folder_for(name: str) -> Path:
    """Where the world of an environment is learned, unless it is said: learned/CarRacing-v3."""
    title = re.sub(r"[^\w.-]+", "-", re.split(r"[:/]", name.rstrip(":/"))[-1]) or "world"
    return Path("learned") / title


class Plan:
    """What is made in a folder: `recording`, `run`, `score`, and the file learn.json that says what was asked and done.

    asked:   the settings, JSON values, which must not change once something is recorded.
    minutes: for all stages and all runs of the command together.
    facts:   what is known of stages that are over, by their names.
    """

    def __init__(self, folder: Path, asked: Mapping[str, Any], minutes: float):
        self.folder, self.asked, self.seconds = folder, json.loads(json.dumps(asked)), 60 * minutes
        self.spent: dict[str, float] = dict.fromkeys((RECORDING, TRAINING, SCORING), 0.0)
        self.facts: dict[str, Any] = {}
        self._file, self._began = folder / "learn.json", time.monotonic()
        if self._file.exists():
            self._go_on()
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise TerrellaError(
                f"{folder} holds something else than a world that is being learned; give another --out."
            )

    @property
    def recorded(self) -> bool:
        """Whether any of the recording is safe."""
        return (self.folder / RECORDING / "meta" / "info.json").exists()

    @property
    def share_s(self) -> dict[str, float]:
        """Seconds of each stage: an eighth is recorded, a fifteenth scored (between one and ten minutes, at most a fifth);
        training has what these leave."""
        scoring = min(max(60.0, self.seconds / 15), 600.0, self.seconds / 5)
        recording = self.spent[RECORDING] if RECORDING in self.facts else self.seconds / 8
        training = self.seconds - recording - scoring - STARTING_S
        return {RECORDING: recording, TRAINING: max(training, 1.0), SCORING: scoring}

    def left_s(self, stage: str) -> float:
        """Seconds until a stage should end; of the last, until the command should."""
        if stage == SCORING and TRAINING in self.facts:
            return max(self.seconds - sum(self.spent.values()), self.share_s[SCORING] / 2)
        return self.share_s[stage] - self.spent[stage]

    @contextmanager
    def stage(self, name: str, report: Callable[..., None]) -> Iterator[Callable[..., None]]:
        """Counts what is spent within it, from where the last one ended; gives a `report` that tells the time left by plan."""
        before, began, noted = self.spent[name], self._began, 0.0

        def told(done: float, total: float, words: str = "", left_s: float | None = None) -> None:
            nonlocal noted
            self.spent[name] = before + time.monotonic() - began
            if time.monotonic() - noted > NOTED_EVERY_S:
                noted = time.monotonic()
                self.save()
            report(done, total, words, max(1.0, self.left_s(name)) if left_s is None else left_s)

        try:
            yield told
        finally:
            self._began = time.monotonic()
            self.spent[name] = before + self._began - began
            if self._file.exists():
                self.save()

    def note(self, name: str, facts: object) -> None:
        """Keeps what is known of a stage: it is over."""
        self.facts[name] = facts
        self.save()

    def save(self) -> None:
        whole = {"asked": self.asked, "minutes": self.seconds / 60, "spent_s": self.spent, "facts": self.facts}
        write_json(self._file, whole)

    def forget(self) -> None:
        """Removes what was begun, if nothing of it was recorded."""
        if self.recorded or not self._file.exists():
            return
        shutil.rmtree(self.folder / RECORDING, ignore_errors=True)
        self._file.unlink()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _go_on(self) -> None:
        try:
            found = json.loads(self._file.read_text(encoding="utf-8"))
            asked, minutes = dict(found["asked"]), float(found["minutes"])
            spent, facts = {name: float(found["spent_s"][name]) for name in self.spent}, dict(found["facts"])
        except (ValueError, KeyError, TypeError) as error:
            raise TerrellaError(f"{self._file} is damaged ({error}); give another --out.") from error
        if not self.recorded:
            return self.forget()
        other = [
            f"{name} {asked.get(name)}, not {self.asked[name]}"
            for name in self.asked
            if asked.get(name) != self.asked[name]
        ]
        if other:
            raise TerrellaError(
                f"{self.folder} was begun with other settings ({'; '.join(other)}); repeat them, or give another --out."
            )
        self.spent, self.facts = spent, facts
        if self.seconds > 60 * minutes and TRAINING in facts:  # more is asked of a world that was learned
            self.facts = {name: fact for name, fact in facts.items() if name == RECORDING}
            self.spent[SCORING] = 0.0
