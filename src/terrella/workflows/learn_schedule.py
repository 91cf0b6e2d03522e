"""The schedule of `learn`: how its minutes are divided among its stages, and what is done of it, kept in a file."""

import html
import json
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import TerrellaError
from ..core.files import write_json
from .progress import Report

RECORDING, TRAINING, DISTILLING, SCORING = "recording", "training", "distilling", "scoring"
STUDENTS_SHARE = 0.3  # of the time of training
STARTING_S = 5.0  # of each stage, for imports and for reading again
SAVE_EVERY_S = 5.0
PAGE = "live.html"
LIVE = """<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="10"><title>{name}</title>
<body style="background:#111;color:#ddd;font:16px sans-serif">
<p>{name} while it trains: the recording above, the world's own prediction from its first picture below; 8 steps from picture to
picture. The page reloads itself; it is empty until the first picture is there.
<p><img src="run/newest.png" alt="" style="width:100%;image-rendering:pixelated">
"""


def folder_for(name: str) -> Path:
    """The default folder in which the world of an environment is learned: learned/CarRacing-v3."""
    title = re.sub(r"[^\w.-]+", "-", re.split(r"[:/]", name.rstrip(":/"))[-1]) or "world"
    return Path("learned") / title


def refuse_other_settings(folder: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """TerrellaError where the run in `folder` was begun with other settings than those of now."""
    other = [f"{name} {begun.get(name)}, not {value}" for name, value in now.items() if begun.get(name) != value]
    if other:
        raise TerrellaError(
            f"{folder} was begun with other settings ({'; '.join(other)}); repeat them, or give another --out."
        )


def refuse_foreign_folder(folder: Path) -> None:
    """TerrellaError where the folder of a new run is a file, or has files already."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise TerrellaError(f"{folder} holds something else than a world that is being learned; give another --out.")


class LearnSchedule:
    """The stages of a folder with `recording`, `run`, `student` and `score`; learn.json keeps the settings and what is done.

    settings: JSON values, which must not change once something is recorded.
    minutes:  for all stages and all runs of the command together; the most that any run was given.
    student:  whether a student is distilled of the world.
    facts:    what is known of the stages that are over, by their names.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], minutes: float, student: bool = False):
        self.folder, self.settings, self.seconds = folder, json.loads(json.dumps(settings)), 60 * minutes
        self.minutes, self.student = minutes, student
        self.spent: dict[str, float] = dict.fromkeys((RECORDING, TRAINING, DISTILLING, SCORING), 0.0)
        self.facts: dict[str, Any] = {}
        self._file, self._began = folder / "learn.json", time.monotonic()
        if self._file.exists():
            self._resume()
        else:
            refuse_foreign_folder(folder)

    @property
    def has_recording(self) -> bool:
        """Whether a part of the recording is on disk."""
        return (self.folder / RECORDING / "meta" / "info.json").exists()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the last stage ended, or this run began."""
        return time.monotonic() - self._began

    @property
    def share_s(self) -> dict[str, float]:
        """Seconds of each stage. Recording has an eighth, scoring a fifteenth (between one and ten minutes, at most an eighth);
        training has the rest."""
        scoring = min(max(60.0, self.seconds / 15), 600.0, self.seconds / 8)
        recording = self.seconds / 8 + self.facts.get("trial_s", 0.0)
        recording = self.spent[RECORDING] if RECORDING in self.facts else recording
        training = max(self.seconds - recording - scoring - STARTING_S, 1.0)
        students = STUDENTS_SHARE * training if self.student else 0.0
        return {RECORDING: recording, TRAINING: training - students, DISTILLING: students, SCORING: scoring}

    def live_page(self) -> str:
        """The address of a page of the newest picture of truth and prediction, which is written."""
        page = self.folder / PAGE
        if not page.exists():
            page.parent.mkdir(parents=True, exist_ok=True)
            page.write_text(LIVE.format(name=html.escape(self.folder.name)), encoding="utf-8")
        return page.resolve().as_uri()

    def left_s(self, stage: str) -> float:
        """Seconds until a stage should end; for the last stage, until the command should."""
        if stage == SCORING and TRAINING in self.facts:
            return max(self.seconds - sum(self.spent.values()), 0.0)
        return self.share_s[stage] - self.spent[stage]

    @contextmanager
    def stage(self, name: str, report: Report) -> Iterator[Report]:
        """Counts the time of a stage, from the end of the last one. Gives a `report` that shows it as a part of all the minutes."""
        before, began, saved = self.spent[name], self._began, 0.0

        def timed(done: float, total: float, text: str = "", left_s: float | None = None) -> None:
            nonlocal saved
            self.spent[name] = before + time.monotonic() - began
            if time.monotonic() - saved > SAVE_EVERY_S:
                saved = time.monotonic()
                self.save()
            share = f"{done / total:.0%}" if total else f"{done:,g}"
            spent = min(sum(self.spent.values()), 0.99 * self.seconds)
            report(spent, self.seconds, " ".join(filter(None, [name, share, text])), max(1.0, self.seconds - spent))

        try:
            yield timed
        finally:
            self._began = time.monotonic()
            self.spent[name] = before + self._began - began
            if self._file.exists():
                self.save()

    def note(self, name: str, facts: object) -> None:
        """Keeps the facts of a stage that is over."""
        self.facts[name] = facts
        self.save()

    def save(self) -> None:
        whole = {"asked": self.settings, "minutes": self.seconds / 60, "spent_s": self.spent, "facts": self.facts}
        write_json(self._file, whole)

    def forget(self) -> None:
        """Removes the folder's files, if nothing was recorded."""
        if self.has_recording or not self._file.exists():
            return
        shutil.rmtree(self.folder / RECORDING, ignore_errors=True)
        (self.folder / PAGE).unlink(missing_ok=True)
        self._file.unlink()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _resume(self) -> None:
        try:
            kept = json.loads(self._file.read_text(encoding="utf-8"))
            settings, minutes = dict(kept["asked"]), float(kept["minutes"])
            spent = self.spent | {name: float(seconds) for name, seconds in kept["spent_s"].items()}
            facts = dict(kept["facts"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise TerrellaError(f"{self._file} is damaged ({error}); give another --out.") from error
        if not self.has_recording:
            return self.forget()
        refuse_other_settings(self.folder, settings, self.settings)
        self.spent, self.facts, self.minutes = spent, facts, max(self.minutes, minutes)
        if self.seconds > 60 * minutes and TRAINING in facts:  # more time for a finished world: train it on
            self.facts = {name: fact for name, fact in facts.items() if name == RECORDING}
            self.spent |= {DISTILLING: 0.0, SCORING: 0.0}
            shutil.rmtree(self.folder / "student", ignore_errors=True)  # of a teacher that learns on
