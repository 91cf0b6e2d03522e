"""`check`: which laws of physics a world keeps, for how long, and by how much it breaks the others."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import library
from ..core.errors import DatasetError, TerrellaError
from ..core.numbers import check_seed
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..data import split
from ..measure.clips import Clip, clips_from_cache
from ..measure.physics import COARSE, PhysicsReport, examine_physics, physics_verdict, table_of_laws
from ..measure.physics_page import physics_page
from ..measure.rollouts import StepMetric, dream
from ..physics import PhysicalSystem, Trajectory, trajectory_of
from .check_pictures import CONTEXT, EDGE, RECORDED, check_scale, motions_in_pictures, needs_pictures
from .opening import Device, load_named
from .progress import Progress, silent
from .results import folder_name, jsonable, table_lines
from .score import open_cache

KNOWN = 600  # true rollouts at most, two thirds of them for calibration
ADVICE = "take fewer --steps, or record longer episodes"
FEWEST_SEEN, PICTURES_BYTES = (
    150,
    1 << 30,
)  # of pictures: true rollouts at least, and the bytes up to which there are more


@dataclass(frozen=True)
class CheckConfig:
    """Settings of `check`."""

    data: Path  # A recording of the domain. Dreams are made of the episodes held out of training.
    system: str | None = None
    """Where bodies, walls and limits are described: a JSON file, or the name of a simulator. Default: the recording, as Terrella
    records it, else the world."""
    out: Path | None = None  # Folder for check.json and check.html. Default: checks/WORLD.
    pictures: bool = False
    """Judge what the pictures show, even where the world has numbers: things are tracked. Default: only where it has none."""
    metres_per_pixel: float | None = None
    """The size of a pixel, for pictures. Default: fitted to recorded positions, else to things that fall freely."""
    rollouts: int = 60  # Rollouts of the world.
    steps: int = 32  # Steps of a rollout.
    coarse: float = COARSE
    """Share of the largest tolerance with which a law says something: a violation beyond it counts as coarse."""
    fresh: bool = False  # Use every episode for dreams: for a recording that training never used.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class CheckResult:
    """What a world keeps and breaks, and the files of the report."""

    report: PhysicsReport
    files: tuple[Path, ...]  # check.json and check.html

    def to_json(self) -> dict[str, Any]:
        facts = {
            one.name: getattr(self.report, one.name) for one in dataclasses.fields(self.report) if one.name != "worst"
        }
        plain = {name: _plain(value) for name, value in facts.items()}
        return jsonable({**plain, "verdict": physics_verdict(self.report), "files": self.files})

    def summary(self) -> str:
        heads, rows = table_of_laws(self.report)
        missing = [f"not applicable: {name} {why}" for name, why in self.report.missing.items()]
        lines = [*physics_verdict(self.report), "", *table_lines(heads, rows), *missing]
        return "\n".join([*lines, f"the page: {self.files[-1]}"])


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def check(world: str, config: CheckConfig, *, progress: Progress = silent) -> CheckResult:
    """Judges a world's rollouts by the laws of physics, with tolerances that are calibrated on the recording `data`.

    Writes check.json and check.html. TerrellaError, DatasetError or ChannelError for what cannot be judged: no description of the
    bodies, a channel that is missing, a recording that is too short."""
    if min(config.rollouts, config.steps) < 2 or not 0 <= config.coarse <= 1:
        raise TerrellaError("--rollouts and --steps are 2 or more, and --coarse is from 0 to 1.")
    check_seed(config.seed)
    check_scale(config.metres_per_pixel)
    opened = load_named(world, config.device, progress=progress)
    cache = open_cache(config.data, opened, progress)
    system = system_named(config.system, cache.world.get("system"), opened.spec)
    pictures = config.pictures or needs_pictures(system, opened.spec)
    if not pictures:
        if config.metres_per_pixel is not None:
            raise TerrellaError(
                f"{world} is judged by its numbers; for its pictures, with --metres-per-pixel, add --pictures."
            )
        opened.spec.check_channels(_described(system, config.system).channels)
    elif not opened.spec.kinds("rgb"):
        raise TerrellaError(f"{world} shows no pictures; leave --pictures out.")
    train, held_out = split(len(cache.episodes))
    every = list(range(len(cache.episodes)))
    chosen, rng = every if config.fresh else held_out, make_rng(config.seed)
    if not chosen or not train:
        raise DatasetError(f"{config.data} has one episode, and a check needs two or more; record more.")
    length = config.steps + (EDGE if pictures else 0)
    clips = clips_from_cache(cache, chosen, CONTEXT, length, config.rollouts, rng, advice=ADVICE)
    if len(clips) < config.rollouts and not config.fresh:
        progress(
            f"{len(clips)} rollouts, not {config.rollouts}: the episodes held out of training give no more. Another recording, "
            "which training never used, gives more with --fresh."
        )
    apart = [number for number in every if number not in chosen] or every
    most = _most_known(opened.spec, length) if pictures else KNOWN
    known = clips_from_cache(cache, apart, CONTEXT, length, most, rng, advice=ADVICE)
    if (count := 2 * len(known) // 3) < 99:
        progress(
            f"{count} true rollouts calibrate the tolerances: up to {1 / (count + 1):.1%} false alarms; 99 give 1%, so "
            "record more or take fewer --steps."
        )
    notes, chance = (), make_rng(config.seed)
    if pictures:
        seen = motions_in_pictures(opened, system, clips, known, config.metres_per_pixel, chance)
        others, truth, mine, notes = seen.known, seen.truth, seen.dream, (seen.note,)
    else:
        described = _described(system, config.system)
        truth, others = (_true_motion(described, some, opened.spec) for some in (clips, known))
        mine = dream_motion(opened, described, clips, config.steps, chance)
    report = examine_physics(opened.spec.name, others, truth, mine, config.seed, config.coarse)
    return _written(
        dataclasses.replace(report, notes=(*notes, *report.notes)), config.out or Path("checks") / folder_name(world)
    )


def _most_known(spec: Spec, length: int) -> int:
    """True rollouts of pictures that are held at once."""
    size = math.prod(spec.channels[spec.kinds("rgb")[0]].shape or ())
    return max(FEWEST_SEEN, min(KNOWN, PICTURES_BYTES // (size * (CONTEXT + length))))


def _written(report: PhysicsReport, out: Path) -> CheckResult:
    out.mkdir(parents=True, exist_ok=True)
    files = out / "check.json", out / "check.html"
    result = CheckResult(report, files)
    files[0].write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
    files[1].write_text(physics_page(f"{report.world}: the laws of physics", report), encoding="utf-8")
    return result


def system_named(given: str | None, recorded: Any, spec: Spec) -> PhysicalSystem | None:
    """The system in a JSON file, of a simulator, of the recording, or of the world, in this order; None without any."""
    if given is not None and library.is_truth(given):
        recorded = library.load(given).spec.system
    elif given is not None:
        return PhysicalSystem.read(given)
    facts = recorded or spec.system
    return PhysicalSystem.from_json(facts) if facts else None


def _described(system: PhysicalSystem | None, given: str | None) -> PhysicalSystem:
    if system is None:
        raise TerrellaError(
            f"neither {given or 'the recording nor the world'} describes its bodies; give --system with a JSON file "
            "(docs/physics.md), or with the simulator that was recorded."
        )
    return system


def _true_motion(system: PhysicalSystem, clips: list[Clip], spec: Spec) -> Trajectory:
    """The recorded motion from the last context row on."""
    missing = [name for name in system.channels if name not in clips[0].channels]
    if missing:
        raise DatasetError(f"the recording has no {', '.join(missing)}, which the laws need; record those channels.")
    rows = {
        name: torch.from_numpy(
            np.stack([np.asarray(clip.channels[name][CONTEXT - 1 :], np.float32) for clip in clips], 1)
        )
        for name in system.channels
    }
    return trajectory_of(system, rows, spec.dt_s)


@torch.no_grad()
def dream_motion(
    world: World, system: PhysicalSystem, clips: list[Clip], steps: int, rng: torch.Generator
) -> Trajectory:
    """The motion that a world predicts after the context of clips, under their actions; it begins with the last context row."""
    names = system.channels
    metric = StepMetric(names, lambda seen, *_: {name: seen[name].float() for name in names})
    seen = dream(world, clips, RECORDED, steps, rng, [metric])
    rows = {}
    for name in names:
        first = torch.from_numpy(np.stack([np.asarray(clip.channels[name][CONTEXT - 1], np.float32) for clip in clips]))
        predicted = seen[name].transpose(0, 1)
        rows[name] = torch.cat([first.reshape(1, *predicted.shape[1:]), predicted])
    return trajectory_of(system, rows, world.spec.dt_s)
