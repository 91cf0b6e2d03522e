"""The command `terrella score`: is a world better than copying the last frame, and how far can it be trusted? Imported only
when it is asked for."""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from .. import __version__, library, progress
from ..core.errors import DatasetError, TerrellaError
from ..core.world import World, make_rng
from ..data import ClipCache, Dataset, check_game, split
from ..measure import (
    CLIPS,
    ENDINGS,
    LONG,
    Album,
    Exam,
    ExamConfig,
    Scorecard,
    as_dict,
    check_recording,
    clips_from_cache,
    clips_with_endings,
    examine,
    in_box,
    out_of_sight,
    place_label,
    verdict,
    write_report,
)
from ..worlds.splat import SplatWorld
from .named import Device, Fast, device_of, load_named
from .say import Json, Seed, result, say

CONTEXT = 10  # frames that a world is shown before it predicts: longer than the effect of a key lasts
DRIFT_STEPS, DRIFT_CLIPS, ENDING_CLIPS = 256, 24, 24
QUICK_CLIPS, QUICK_HORIZONS, HORIZONS = 6, (1, 8, 32), (1, 8, 32, 64)

Quick = Annotated[bool, arg(help="An answer in about a minute: few clips, short horizons, one setting of the world.")]


def score(
    name: Positional[str],
    data: Path,
    new: Path | None = None,
    fresh: bool = False,
    quick: Quick = False,
    out: Path = Path("scores"),
    clips: int | None = None,
    horizons: tuple[int, ...] = (),
    long_steps: int | None = None,
    drift: int | None = None,
    device: Device = "auto",
    fast: Fast = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Compare a world's predictions with a recording: pictures, states, poses, rewards, memory, speed.

    What was measured is kept in the folder as it comes; the same command goes on where it was stopped.

    Args:
        name: What `terrella list` shows, or the path of a checkpoint.
        data: The recording it was trained on; only the episodes kept out of training are used.
        fresh: `data` is another recording, of which training saw nothing: every episode is used.
        new: A recording of places that it never saw; without one, the part of the map that training kept out.
        out: Folder for scorecard.json and scorecard.html.
        clips: Clips of each kind of place, 50 unless said; intervals want 50 or more.
        horizons: Steps after which figures are given, 1 8 32 64 unless said; a clip is as long as the largest.
        long_steps: Length of the long rollouts, played and standing still, 1000 unless said; 0 leaves them out.
        drift: Steps of the drift curves, on clips of their own (at most 24); 0 leaves them out. Unless said, 256 where the
            recordings have clips that long.
    """
    horizons = tuple(sorted(horizons or (QUICK_HORIZONS if quick else HORIZONS)))
    clips = clips if clips is not None else QUICK_CLIPS if quick else 50
    long_steps = long_steps if long_steps is not None else 0 if quick else 1000
    drift = 0 if quick and drift is None else drift
    if min(horizons) < 1 or clips < 1 or (long_steps != 0 and long_steps < 100) or (drift or 0) < 0:
        raise TerrellaError(
            "--horizons and --clips are whole numbers from 1 up, --drift from 0 up, --long-steps is 0 or at least 100."
        )
    config = (
        ExamConfig.quick(horizons)
        if quick
        else ExamConfig(horizons=horizons, long_steps=long_steps, still_steps=long_steps)
    )
    arms, closing = arms_of(name, device, fast, quick)
    exam, identity = exam_of(arms, closing, data, new, fresh, clips, drift, config, seed)
    with progress.shown("scoring") as report:
        card, files = carded(name, exam, identity + f" fast={fast} device={device_of(device)}", out, report)
    facts = {**as_dict(card), "files": [str(file) for file in files]}
    result(facts, json, "\n".join([*verdict(card), *_lines(card), f"the page: {files[1]}"]))


def carded(
    name: str, exam: Exam, identity: str, out: Path, report: Callable[..., None]
) -> tuple[Scorecard, list[Path]]:
    """The scorecard of the world `name`, and its files in the folder `out`, where what is measured is kept as it comes."""
    tell = lambda share, words, left_s: report(share, 1, words, left_s)  # noqa: E731
    card = examine(exam, out / "parts", identity + _files_of(name), tell)
    files = write_report(card, out, f"{next(iter(card.worlds.values()))}: the scorecard")
    shutil.rmtree(out / "parts", ignore_errors=True)
    return card, list(files)


def arms_of(name: str, device: str, fast: bool, quick: bool) -> tuple[dict[str, World], dict[str, World]]:
    """The world, with its memory and without where it has one; and more of which only memory is asked."""
    world = load_named(name, device, fast=fast)
    remembers = {"places", "known"} <= set(world.spec.channels) and not isinstance(world, SplatWorld)
    if library.is_truth(name) or "pose" not in world.spec.observes or not remembers:
        return {"world": world}, {}
    if quick:
        return {"memory": world}, {}
    bare = library.load(name, device=device_of(device), memory=False, memory_mb=0)  # keeps nothing but its last frame
    return {"memory": world, "no memory": load_named(name, device, memory=False, fast=fast)}, {"last frame only": bare}


def exam_of(
    arms: Mapping[str, World],
    closing: Mapping[str, World],
    data: Path,
    new: Path | None,
    fresh: bool,
    clips: int,
    drift: int | None,
    config: ExamConfig,
    seed: int,
    report: Callable[..., None] | None = None,
) -> tuple[Exam, str]:
    """Clips of the recordings, of ground that training saw and of ground that it did not; without `report` it shows itself
    what is read."""
    world = next(iter(arms.values()))
    cache = _cache(data, world, report)
    box: Any = world.spec.card.get("keep_out")  # a part of the map that training never saw
    every = range(len(cache.episodes))
    held_out = every if fresh else split(len(every))[1]
    if not held_out:
        raise DatasetError(
            f"{data} has one episode, so none was kept out of training; record more, or say --fresh if training never saw it."
        )
    sources: dict[str, tuple] = {"recorded": (cache, held_out, out_of_sight(*box) if box else None)}
    if new is not None:
        unseen = _cache(new, world)
        sources["new"] = (unseen, range(len(unseen.episodes)), None)
    elif box:
        sources["new"] = (cache, every, in_box(*box))
    sets: dict[str, dict] = {CLIPS: {}, LONG: {}, ENDINGS: {}}
    going, rng = {}, make_rng(seed)
    for place, (source, episodes, where) in sources.items():
        asked = source, episodes, CONTEXT
        sets[CLIPS][place] = clips_from_cache(*asked, max(config.horizons), clips, rng, where)
        chance = make_rng(seed + 1)  # the other figures do not depend on whether drift is measured
        try:
            if drift != 0:
                count = min(clips, DRIFT_CLIPS)
                sets[LONG][place] = clips_from_cache(*asked, drift or DRIFT_STEPS, count, chance, where)
        except DatasetError:
            if drift:
                raise
            say(
                f"No drift curve of {place_label(place)}: no clip of 256 steps fits there; --drift STEPS asks for shorter ones."
            )
        drawn = clips_with_endings(
            source, world.spec, *asked[1:], max(config.horizons), min(clips, ENDING_CLIPS), make_rng(seed + 2), where
        )
        sets[ENDINGS][place], going[place] = drawn
    album = None if cache.pose is None or cache.rgb is None else Album.of_cache(cache)
    paths = " ".join(str(source.path) for source, _, _ in sources.values())
    return Exam(arms, sets, config, seed, going, album, closing), f"{__version__} {paths} "


def _cache(data: Path, world: World, report: Callable[..., None] | None = None) -> Any:
    """The recording's ClipCache at the size that the world shows, if it is of the world's game."""
    dataset, sizes = Dataset(data), dict[tuple[int, int], list[str]]()
    if doubt := check_game(dataset, world.spec):
        say(f"{doubt} Figures of another game say little.")
    for channel in world.spec.kinds("rgb"):
        height, width, _ = world.spec.channels[channel].shape or (0, 0, 3)
        feature = dataset.channels.get(channel)
        sizes.setdefault((height, width), []).extend([feature] if feature and channel != "rgb" else [])
    with nullcontext(report) if report else progress.shown(f"reading {data}") as told:
        asked = (sizes or {(96, 128): []}).items()
        caches = [ClipCache.open(dataset, size, told, cameras) for size, cameras in asked]
    for cache, cameras in zip(caches, sizes.values()):  # cameras of another size have a cache of their own
        caches[0].arrays.update({feature: cache.arrays[feature] for feature in cameras})
    check_recording(caches[0], world.spec)
    return caches[0]


def _files_of(name: str) -> str:
    """A digest of a learned world's files: other weights are another world."""
    try:
        folder = library.folder_of(name)
    except TerrellaError:  # a simulator
        return name
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _lines(card: Scorecard) -> list[str]:
    """The first arm's figures at its longest horizon, and what was not applicable."""
    arm = next(iter(card.worlds))
    last: dict[tuple, Any] = {}
    for row in card.rows:
        if row.arm == arm and row.motion != "true" and not row.void and math.isfinite(row.figure.value):
            last[row.probe, row.channel, row.what, row.place] = row
    lines = []
    for row in last.values():
        sure = f" [{row.figure.low:.3g}, {row.figure.high:.3g}]" if math.isfinite(row.figure.low) else ""
        baselines = "".join(f"; {name} {figure.value:.3g}" for name, figure in row.baselines.items())
        about = " ".join(part for part in (row.channel, row.what) if part)
        figure = f"{row.figure.value:.3g} {row.unit}".rstrip() + sure + baselines
        lines.append(f"{row.probe:>12}  {about}, {place_label(row.place)}, {row.horizon} steps: {figure}")
    return [*lines, *(f"not applicable: {one.probe} {one.why}" for one in card.missing if one.arm == arm)]
