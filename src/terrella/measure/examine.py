"""The whole examination in one call: score, closures, endurance and speed of every arm."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ..core.errors import ObservationError, TerrellaError
from ..core.world import World
from .album import Album
from .bars import Bar
from .clips import Clip
from .closure import Closure, closure
from .endurance import long_rollout
from .page import page
from .scorecard import Progress, Scorecard, ScoreConfig, score, to_json
from .speed import speed


@dataclass(frozen=True)
class ExamConfig:
    """closure_deg: how far the camera turns before it comes back; long_steps 0 leaves long rollout and speed out."""

    score: ScoreConfig = field(default_factory=ScoreConfig)
    closure_deg: tuple[float, ...] = (90.0, 180.0)
    closure_step_deg: float = 3.0
    closure_clips: int = 50
    long_steps: int = 1000
    stories: int = 8


def examine(
    arms: Mapping[str, World],
    clips_by_place: Mapping[str, Sequence[Clip]],
    rng: torch.Generator,
    config: ExamConfig | None = None,
    album: Album | None = None,
    progress: Progress | None = None,
) -> Scorecard:
    """Everything the scorecard holds. Endurance and speed start from the clips of the first place.

    Give an `album` of all recordings to hold long dreams against real views of wherever they lead; without one the
    clips themselves are the album, and fewer dreamt frames find a counterpart.
    """
    config = config or ExamConfig()
    tell = progress or (lambda share, words: None)
    card = score(arms, clips_by_place, rng, config.score, lambda share, words: tell(share * 0.7, words))
    clips = next(iter(clips_by_place.values()))
    closures, endurance, speeds = [], [], []
    for number, (arm, world) in enumerate(arms.items()):
        tell(0.7 + 0.3 * number / len(arms), f"closure and {config.long_steps} steps, {arm}")
        for place, shown in clips_by_place.items():
            closures += _closures(world, shown[: config.closure_clips], rng, arm, place, config)
        if config.long_steps:
            endurance.append(long_rollout(world, clips, rng, arm, config.long_steps, config.stories, album=album))
            speeds.append(speed(world, clips, rng, arm, config.long_steps))
    tell(1.0, "examined")
    return dataclasses.replace(card, closures=closures, endurance=endurance, speeds=speeds)


def write_report(card: Scorecard, bars: Sequence[Bar], folder: str | Path, title: str) -> tuple[Path, Path]:
    """Writes scorecard.json and scorecard.html (one self-contained page) into `folder`; returns both paths."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scorecard.json").write_text(to_json(card, bars) + "\n", encoding="utf-8")
        (folder / "scorecard.html").write_text(page(card, bars, title), encoding="utf-8")
    except OSError as error:
        raise TerrellaError(f"cannot write the report to {folder} ({error}); choose another folder.") from error
    return folder / "scorecard.json", folder / "scorecard.html"


def _closures(world: World, clips: Sequence[Clip], rng, arm: str, place: str, config: ExamConfig) -> list[Closure]:
    step, batch = config.closure_step_deg, config.score.batch
    try:
        return [closure(world, clips, rng, arm, place, far, step, batch) for far in config.closure_deg]
    except ObservationError:
        return []  # a world without poses cannot be turned by evidence
