"""The command `terrella score`: a world's predictions compared with a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from .. import progress
from .named import Device, Fast, device_of, load_named
from .say import Json, Seed, result, say

if TYPE_CHECKING:
    from ..core.world import World

CONTEXT = 10  # frames that a world is shown before it dreams, when it is scored: longer than a key's history counts


def score(
    name: Positional[str],
    data: Path,
    new: Path | None = None,
    fresh: bool = False,
    out: Path = Path("scores"),
    clips: int = 50,
    horizons: tuple[int, ...] = (1, 8, 32, 64),
    long_steps: int = 1000,
    drift: int | None = None,
    device: Device = "auto",
    fast: Fast = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Hold a learned world's dreams against what really happened, with its memory and without.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        data: The recording it was trained on; only the episodes kept out of training are used.
        fresh: `data` is another recording, of which training saw nothing: every episode is used.
        new: A recording of places that it never saw; without one, the part of the map that training kept out.
        out: Folder for scorecard.json and scorecard.html.
        clips: Clips of each kind of place; intervals want 50 or more.
        horizons: Steps after which figures are given; a clip is as long as the largest.
        long_steps: Length of the long dream; 0 leaves it out.
        drift: Steps of the drift curves, on clips of their own (at most 24); 0 leaves them out. Unless said, 256 where the
            recordings have clips that long.
    """
    from .. import library
    from ..core.errors import DatasetError, TerrellaError
    from ..core.world import make_rng
    from ..data import split
    from ..measure import (
        Album,
        ExamConfig,
        ScoreConfig,
        as_dict,
        bars,
        clips_from_cache,
        examine,
        in_box,
        out_of_sight,
        write_report,
    )
    from ..measure.bars import summary

    if min(horizons, default=0) < 1 or clips < 1 or (long_steps != 0 and long_steps < 100) or (drift or 0) < 0:
        raise TerrellaError(
            "--horizons and --clips are whole numbers from 1 up, --drift from 0 up, --long-steps is 0 or at least 100."
        )
    world, rng, steps = load_named(name, device, fast=fast), make_rng(seed), max(horizons)
    arms = {"memory": world, "no memory": load_named(name, device, memory=False, fast=fast)}
    if "pose" not in world.spec.observes:  # it lives on history alone: there is no memory to leave out
        arms = {"history": world}
    cache = _cache(data, world)
    every = range(len(cache.episodes))
    held_out = every if fresh else split(len(every))[1]
    box: Any = world.spec.card.get("keep_out")  # a part of the map that training never saw
    known = out_of_sight(*box) if box else None
    sources: dict[str, tuple] = {"recorded": (cache, held_out, known)}
    if new is not None:
        unseen = _cache(new, world)
        sources["new"] = (unseen, range(len(unseen.episodes)), None)
    elif box:
        sources["new"] = (cache, every, in_box(*box))

    def draw(place: str, horizon: int, count: int, chance) -> Any:
        source, episodes, where = sources[place]
        return clips_from_cache(source, episodes, CONTEXT, horizon, count, chance, where)

    places = {place: draw(place, steps, clips, rng) for place in sources}
    long_clips, chance = {}, make_rng(seed + 1)  # the other figures do not depend on whether drift is measured
    for place in sources if drift != 0 else ():
        try:
            long_clips[place] = draw(place, drift or 256, min(clips, 24), chance)
        except DatasetError:
            if drift:
                raise
            say(
                f"No drift curve of {place} places: no clip of 256 steps fits there; --drift STEPS asks for shorter ones."
            )
    obeying = tuple(step for step in ScoreConfig().control_horizons if step <= steps) or (steps,)
    scoring = ScoreConfig(horizons=tuple(sorted(horizons)), control_horizons=obeying)
    config = ExamConfig(score=scoring, long_steps=long_steps)
    album = None if cache.pose is None else Album.of_cache(cache)
    closing = {}  # what is seen again by a world that keeps nothing but its last frame
    if len(arms) > 1:
        closing = {"last frame only": library.load(name, device=device_of(device), memory=False, memory_mb=0)}
    with progress.shown("scoring") as report:
        tell = lambda share, words: report(share, 1, words)  # noqa: E731
        card = examine(arms, places, rng, config, album, tell, long_clips, closing)
    card = replace(card, fates=_fates(arms, sources, scoring.horizons, clips, make_rng(seed + 2)))
    found = bars(card, next(iter(arms)))
    files = write_report(card, found, out, f"{world.spec.name}: the scorecard")
    lines = [
        f"{bar.status:>6}  {bar.name}, {bar.place}: {bar.figure} {bar.unit} (bar: {bar.target})"
        for bar in found
        if bar.figure and not bar.side
    ]
    for row in card.drifts:
        within = f"within twice its first error for {row.usable} of {row.steps} steps"
        lines.append(f" drift  {row.arm}{row.motion and f', {row.motion} motion'}, {row.place}: {within}")
    facts = {**as_dict(card, found), "files": [str(file) for file in files]}
    result(facts, json, "\n".join([*lines, summary(found), f"the page: {files[1]}"]))


def _fates(arms: dict[str, World], sources: dict[str, tuple], horizons: tuple[int, ...], clips: int, rng) -> list:
    """What the arms' dreams tell of rewards, vitals and ends, where world and recordings have vitals."""
    from ..measure.outcomes import fates, passages

    spec, found = next(iter(arms.values())).spec, []
    for place, (cache, episodes, where) in sources.items():
        if set(cache.vitals) & set(spec.channels):
            shown = passages(cache, episodes, CONTEXT, max(horizons), clips, rng, where)
            found += fates(arms, place, shown, horizons, rng)
    return found


def _cache(data: Path, world: World) -> Any:
    """The recording's ClipCache at the size that the world shows."""
    from ..core.errors import TerrellaError
    from ..data import ClipCache

    if "rgb" not in world.spec.channels:
        raise TerrellaError(f"{world.spec.name} shows no pictures, so it cannot be scored; score a learned world.")
    height, width = world.spec.channels["rgb"].shape[:2]
    with progress.shown(f"reading {data}") as report:
        return ClipCache.open(data, size=(height, width), progress=report)
