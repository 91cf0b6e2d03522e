"""`score`: is a world better than copying the last frame, and how far can it be trusted?"""

import hashlib
import math
import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import library
from ..core.errors import DatasetError, TerrellaError
from ..core.numbers import check_seed
from ..core.world import World, make_rng
from ..data import ClipCache, Dataset, check_game, split
from ..data.training.cache import episodes_with
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
    most_clips_within,
    out_of_sight,
    place_label,
    verdict,
    write_report,
)
from ..version import __version__
from .opening import Device, Fast, device_of, load_named
from .progress import Progress, Report, silent, stage, stopping_with
from .results import jsonable

CONTEXT = 10  # frames that a world observes before it predicts: longer than the effect of a key lasts
DRIFT_STEPS, DRIFT_CLIPS, ENDING_CLIPS = 256, 24, 24
QUICK_CLIPS, QUICK_HORIZONS, HORIZONS = 6, (1, 8, 32), (1, 8, 32, 64)
QUICK_S = 50.0  # of the examination with `quick`, by its forecast


@dataclass(frozen=True)
class ScoreConfig:
    """Settings of `score`."""

    data: Path  # The recording on which the world was trained; only the episodes held out of training are used.
    new: Path | None = None
    """A recording of places that training never saw; default: the part of the map that training kept out."""
    fresh: bool = False  # Use every episode of `data`: for a recording that training never used.
    quick: bool = False
    """Take about a minute once the recording is read: as many clips as fit (2 to 6), shorter horizons, and the world with its
    memory only."""
    out: Path = Path("scores")  # Folder for scorecard.json and scorecard.html.
    clips: int | None = None  # Clips of each kind of place; default 50, quick 6. Intervals need 50 or more.
    horizons: tuple[int, ...] = ()
    """Steps after which figures are given; default 1 8 32 64, quick 1 8 32. A clip is as long as the largest."""
    long_steps: int | None = None
    """Steps of the long rollouts, played and standing still; default 1000, quick 0; 0 leaves them out."""
    drift: int | None = None
    """Steps of the drift curves, on clips of their own (at most 24); 0 leaves them out. Default: 256 where the recordings have
    clips of that length, quick 0."""
    device: Device = "auto"
    fast: Fast = False
    seed: int = 0  # The same seed gives the same result.

    @property
    def exam(self) -> ExamConfig:
        """The settings of the exam, with every default. TerrellaError where a number is out of range."""
        horizons = tuple(sorted(self.horizons or (QUICK_HORIZONS if self.quick else HORIZONS)))
        long_steps = self.long_steps if self.long_steps is not None else 0 if self.quick else 1000
        clips = 1 if self.clips is None else self.clips
        if min(horizons) < 1 or clips < 1 or (long_steps != 0 and long_steps < 100) or (self.drift or 0) < 0:
            raise TerrellaError(
                "--horizons and --clips are whole numbers from 1 up, --drift from 0 up, --long-steps is 0 or at least 100."
            )
        if self.quick:
            return ExamConfig.quick(horizons)
        return ExamConfig(horizons=horizons, long_steps=long_steps, still_steps=long_steps)


@dataclass(frozen=True)
class ScoreResult:
    """A scorecard, and its files."""

    card: Scorecard
    files: tuple[Path, ...]  # scorecard.json and scorecard.html.

    def to_json(self) -> dict[str, Any]:
        return {**as_dict(self.card), "files": jsonable(self.files)}

    def summary(self) -> str:
        return "\n".join([*verdict(self.card), *_figures(self.card), f"the page: {self.files[1]}"])


def score(world: str | Path, config: ScoreConfig, *, progress: Progress = silent) -> ScoreResult:
    """Compares a world's predictions with a recording: pictures, states, poses, rewards, memory, speed.

    world: what `terrella.worlds()` lists, or the path of a checkpoint. Figures are kept in the folder as they come; the same call
    continues where it was stopped. TerrellaError or DatasetError for what cannot be scored.
    """
    exam_config, name = config.exam, str(world)
    arms, closing = arms_of(name, config.device, config.fast, config.quick, progress)
    clips = config.clips if config.clips is not None else QUICK_CLIPS if config.quick else 50
    drift = 0 if config.quick and config.drift is None else config.drift
    request = ExamRequest(arms, closing, config.data, config.new, config.fresh, clips, drift, config.seed)
    exam, identity = exam_of(request, exam_config, progress)
    if config.quick and config.clips is None:
        exam = exam.of(most_clips_within(exam, QUICK_S, range(2, QUICK_CLIPS + 1)) or 2)
    identity += f" fast={config.fast} device={device_of(config.device)}"
    kept = f"stopped: the figures so far are kept in {config.out}; the same command continues."
    with stopping_with(kept), stage("scoring", progress) as report:
        card, files = write_card(name, exam, identity, Path(config.out), report)
    return ScoreResult(card, tuple(files))


def write_card(name: str, exam: Exam, identity: str, out: Path, report: Report) -> tuple[Scorecard, list[Path]]:
    """The scorecard of the world `name`, and its files in the folder `out`, where figures are kept as they come."""
    card = examine(
        exam, out / "parts", identity + digest_of(name), lambda share, text, left_s: report(share, 1, text, left_s)
    )
    files = write_report(card, out, f"{next(iter(card.worlds.values()))}: the scorecard")
    shutil.rmtree(out / "parts", ignore_errors=True)
    return card, list(files)


def arms_of(
    name: str, device: str, fast: bool, quick: bool, progress: Progress = silent
) -> tuple[dict[str, World], dict[str, World]]:
    """The world, with its memory and without where it has one; and further arms that take the memory probe only."""
    world = load_named(name, device, fast=fast, progress=progress)
    adds = {"places", "known"} <= set(world.spec.channels) and {"rgb", "pose"} <= set(world.spec.observes)
    if library.is_truth(name) or not adds:
        return {"world": world}, {}
    if quick:
        return {"memory": world}, {}
    bare = library.load(name, device=device_of(device), memory=False, memory_mb=0)  # keeps nothing but its last frame
    without = load_named(name, device, memory=False, fast=fast, progress=progress)
    return {"memory": world, "no memory": without}, {"last frame only": bare}


@dataclass(frozen=True)
class ExamRequest:
    """The worlds and the recordings of an exam."""

    arms: Mapping[str, World]
    closing: Mapping[str, World]  # Further arms that take the memory probe only.
    data: Path
    new: Path | None = None
    fresh: bool = False
    clips: int = 50
    drift: int | None = None
    seed: int = 0


def exam_of(
    request: ExamRequest, config: ExamConfig, progress: Progress = silent, report: Report | None = None
) -> tuple[Exam, str]:
    """The exam, with clips of ground that training saw and of ground that it did not, and its identity. Reading the recordings is
    shown by `report`, or as a stage of its own."""
    world, seed = next(iter(request.arms.values())), request.seed
    check_seed(seed)
    cache = open_cache(request.data, world, progress, report)
    box: Any = world.spec.card.get("keep_out")  # a part of the map that training never saw
    every = range(len(cache.episodes))
    held_out = every if request.fresh else split(len(every))[1]
    if not held_out:
        raise DatasetError(
            f"{request.data} has one episode, so none was kept out of training; record more, or say --fresh if training never "
            "saw it."
        )
    sources: dict[str, tuple] = {"recorded": (cache, held_out, out_of_sight(*box) if box else None)}
    if request.new is not None:
        unseen = open_cache(request.new, world, progress)
        sources["new"] = (unseen, range(len(unseen.episodes)), None)
    elif box:
        sources["new"] = (cache, every, in_box(*box))
    sets: dict[str, dict] = {CLIPS: {}, LONG: {}, ENDINGS: {}}
    going, rng, longest = {}, make_rng(seed), max(config.horizons)
    for place, (source, chosen, where) in sources.items():
        needs = [source.keys.get(name, name) for name in (*world.spec.observes, "action")]
        episodes = episodes_with(needs, np.asarray(chosen), source.absent).tolist()  # others hold padding
        sets[CLIPS][place] = clips_from_cache(source, episodes, CONTEXT, longest, request.clips, rng, where)
        drift_rng = make_rng(seed + 1)  # the other figures do not depend on whether drift is measured
        try:
            if request.drift != 0:
                count, steps = min(request.clips, DRIFT_CLIPS), request.drift or DRIFT_STEPS
                sets[LONG][place] = clips_from_cache(source, episodes, CONTEXT, steps, count, drift_rng, where)
        except DatasetError:
            if request.drift:
                raise
            progress(
                f"No drift curve of {place_label(place)}: no clip of 256 steps fits there; --drift STEPS asks for shorter ones."
            )
        count = min(request.clips, ENDING_CLIPS)
        sets[ENDINGS][place], going[place] = clips_with_endings(
            source, world.spec, episodes, CONTEXT, longest, count, make_rng(seed + 2), where
        )
    album = None if cache.pose is None or cache.rgb is None else Album.of_cache(cache)
    paths = " ".join(str(source.path) for source, _, _ in sources.values())
    return Exam(request.arms, sets, config, seed, going, album, request.closing), f"{__version__} {paths} "


def open_cache(data: Path, world: World, progress: Progress, report: Report | None = None) -> Any:
    """The recording's ClipCache at the size that the world renders. DatasetError for recordings of another game."""
    dataset, sizes = Dataset(data), dict[tuple[int, int], list[str]]()
    if doubt := check_game(dataset, world.spec):
        progress(f"{doubt} Figures of another game, or of other steps, say little.")
    for channel in world.spec.kinds("rgb"):
        height, width, _ = world.spec.channels[channel].shape or (0, 0, 3)
        feature = dataset.channels.get(channel)
        sizes.setdefault((height, width), []).extend([feature] if feature and channel != "rgb" else [])
    with nullcontext(report) if report else stage(f"reading {data}", progress) as shown:
        each_size = (sizes or {(96, 128): []}).items()
        caches = [ClipCache.open(dataset, size, shown, cameras) for size, cameras in each_size]
    for cache, cameras in zip(caches, sizes.values()):  # cameras of another size have a cache of their own
        caches[0].arrays.update({feature: cache.arrays[feature] for feature in cameras})
    check_recording(caches[0], world.spec)
    return caches[0]


def digest_of(name: str) -> str:
    """A digest of a learned world's files: other weights are another world."""
    try:
        folder = library.folder_of(name)
    except TerrellaError:  # a simulator
        return name
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _figures(card: Scorecard) -> list[str]:
    """The first arm's figures at its longest horizon, and the probes that did not apply."""
    arm = next(iter(card.worlds))
    last: dict[tuple, Any] = {}
    for row in card.rows:
        if row.arm == arm and row.motion != "true" and not row.void and math.isfinite(row.figure.value):
            last[row.probe, row.channel, row.what, row.place] = row
    lines = []
    for row in last.values():
        interval = f" [{row.figure.low:.3g}, {row.figure.high:.3g}]" if math.isfinite(row.figure.low) else ""
        baselines = "".join(f"; {name} {figure.value:.3g}" for name, figure in row.baselines.items())
        about = " ".join(part for part in (row.channel, row.what) if part)
        figure = f"{row.figure.value:.3g} {row.unit}".rstrip() + interval + baselines
        lines.append(f"{row.probe:>12}  {about}, {place_label(row.place)}, {row.horizon} steps: {figure}")
    return [*lines, *(f"not applicable: {one.probe} {one.why}" for one in card.missing if one.arm == arm)]
