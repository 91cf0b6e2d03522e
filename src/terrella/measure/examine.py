"""The whole examination in one call: score, closures, endurance and speed of every arm."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from gymnasium import spaces

from ..core.errors import TerrellaError
from ..core.world import World
from .album import Album
from .bars import Bar
from .clips import Clip
from .closure import Closure, Way, closure, key_way, walk_way, walkers, yaw_way
from .drift import drift
from .endurance import long_rollout
from .page import page
from .scorecard import Progress, Scorecard, ScoreConfig, score, to_json
from .speed import speed


@dataclass(frozen=True)
class ExamConfig:
    """closure_deg: how far the camera turns before it comes back; closure_walk: steps of the walk there and back, 0 for
    none; long_steps 0 leaves long rollout and speed out."""

    score: ScoreConfig = field(default_factory=ScoreConfig)
    closure_deg: tuple[float, ...] = (90.0, 180.0)
    closure_step_deg: float = 3.0
    closure_walk: int = 100
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
    long_clips: Mapping[str, Sequence[Clip]] | None = None,
    closing: Mapping[str, World] | None = None,
) -> Scorecard:
    """Everything the scorecard holds. Endurance and speed start from the clips of the first place.

    `closing`: more arms, of which only closure is asked.

    `long_clips`, by place, are those whose whole length the drift curves span; without any there are no such curves.

    Give an `album` of all recordings to hold long dreams against real views of wherever they lead; without one the
    clips themselves are the album, and fewer dreamt frames find a counterpart.
    """
    config = config or ExamConfig()
    tell = progress or (lambda share, words: None)
    scored = 0.4 if long_clips else 0.7
    card = score(arms, clips_by_place, rng, config.score, lambda share, words: tell(share * scored, words))
    clips = next(iter(clips_by_place.values()))
    closures, endurance, speeds = [], [], []
    for number, (arm, world) in enumerate(arms.items()):
        tell(scored + 0.3 * number / len(arms), f"closure and {config.long_steps} steps, {arm}")
        for place, shown in clips_by_place.items():
            closures += _closures(world, shown[: config.closure_clips], rng, arm, place, config)
        if config.long_steps:
            endurance.append(long_rollout(world, clips, rng, arm, config.long_steps, config.stories, album=album))
            speeds.append(speed(world, clips, rng, arm, config.long_steps))
    for arm, world in (closing or {}).items():
        for place, shown in clips_by_place.items():
            closures += _closures(world, shown[: config.closure_clips], rng, arm, place, config)
    drifts = []
    if long_clips:
        steps = min(clip.horizon for shown in long_clips.values() for clip in shown)
        later = lambda share, words: tell(0.7 + 0.3 * share, words)  # noqa: E731
        drifts = drift(arms, long_clips, rng, steps, config.score.batch, later)
    tell(1.0, "examined")
    return dataclasses.replace(card, closures=closures, endurance=endurance, speeds=speeds, drifts=drifts)


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
    """The closures that the world can be asked for: along poses where it takes them, else by keys that undo each other."""
    ways: list[tuple[Way, Sequence[Clip]]] = []
    if "pose" in world.spec.observes:
        ways = [(yaw_way(far, config.closure_step_deg), clips) for far in config.closure_deg]
        afoot = walkers(clips, config.closure_walk) if config.closure_walk else []
        ways += [(walk_way(config.closure_walk), afoot)] if afoot else []
    elif config.closure_deg:
        ways = [(way, clips) for way in _key_ways(world)]
    return [closure(world, some, rng, way, arm, place, config.score.batch) for way, some in ways]


def _key_ways(world: World) -> list[Way]:
    """Left and right again, for a world with such buttons."""
    names = [name.upper() for name in world.spec.action_names]
    if not (isinstance(world.spec.action, spaces.MultiBinary) and {"TURN_LEFT", "TURN_RIGHT"} <= set(names)):
        return []
    left, right = (torch.tensor([int(name == turn) for name in names]) for turn in ("TURN_LEFT", "TURN_RIGHT"))
    return [key_way(left, right, f"turning left and right, {steps} steps", steps) for steps in (50, 100)]
