"""space grow: fills what a place does not know, step by step, until enough of it is known."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..core.errors import TerrellaError
from ..library import folder_of
from ..space.camera import Intrinsics, directions, rotation
from ..space.growing import (
    KNOWN,
    ROWS,
    Fill,
    GrowthView,
    coverage,
    grow_step,
    known_around,
    next_view,
    planar_fill,
    psnr_of,
)
from ..space.occupancy import Occupancy
from ..space.raster import Gaussians, join, rasterise
from ..space.room_planes import room_planes
from ..space.walkable import spread_out, walkable
from ..worlds.additions import INVENTED, OBSERVED
from ..worlds.splat import MOST_PLACES, SplatConfig, SplatWorld
from ..worlds.splat_folder import merge_edit, read_edits, save_splat, write_edits
from .progress import Progress, silent
from .results import command
from .splat_places import SpaceResult, open_splat

GROWN = "grown"  # the folder in a place where its steps lie
EYES = 6  # points from which the coverage is measured
LEAST_ADDED = 20  # Gaussians: with fewer a step adds nothing
MOST_ERROR, DEVIATION = 0.3, 1.25  # expected error at most; the standard deviation over it, of a normal distribution
AWAY = 90.0  # degrees that a step must look away from the start before a return counts


@dataclass(frozen=True)
class GrowSpaceConfig:
    """How a place grows."""

    to: float = 0.98  # Share of all directions, from points where one can stand, that shall be known.
    steps: int = 40  # Steps, at most.
    seed: int = 0  # Seed of the points that the cameras stand at.


@dataclass(frozen=True)
class GrowthStep:
    """Figures of one step."""

    number: int
    added: int  # Gaussians
    coverage: float  # after it
    seam: float  # median relative difference of depth between known and fill
    away_deg: float  # how far its camera looks away from the start's
    closure_db: float  # of the first start's view against that before all steps

    def line(self) -> str:
        back = f"closure {self.closure_db:.1f} dB after {self.away_deg:.0f} degrees away"
        if self.away_deg < AWAY:
            back = f"looked {self.away_deg:.0f} degrees away: no return to measure"
        done = f"step {self.number}: {self.added:,} Gaussians, {100 * self.coverage:.1f}% known"
        return f"{done}, seam {100 * self.seam:.1f}%, {back}"


def grow_space(world: str, config: GrowSpaceConfig, *, progress: Progress = silent) -> SpaceResult:
    """Adds invented Gaussians to a world of Gaussians where nothing is known. Each step is a place in FOLDER/grown and a merge in
    world.edits.jsonl, so that `space edit --undo` takes it back; the same command goes on where it stopped."""
    if not 0 < config.to <= 1 or not 1 <= config.steps <= 1000 or config.seed < 0:
        raise TerrellaError("--to is above 0 and at most 1, --steps from 1 to 1,000, and --seed 0 or more.")
    folder, place = folder_of(world), open_splat(world)
    if not len(place.gaussians):
        raise TerrellaError(f"{world} has no Gaussian to grow from.")
    began, steps = time.monotonic(), []
    eyes = viewpoints(place, config.seed)
    before = coverage(known_around(place.gaussians, eyes))
    for step, grown in growth(place, config, eyes):
        _save(folder, place, step, grown)
        steps.append(step)
        progress(step.line())
    after = steps[-1].coverage if steps else before
    lines = [
        f"{100 * before:.1f}% was known, now {100 * after:.1f}%, after {len(steps)} steps in {time.monotonic() - began:.0f} s"
    ]
    if after < config.to:
        lines.append(f"stopped below {100 * config.to:.0f}%: " + ("--steps allows no more." if len(steps) == config.steps else
                     "what is left lies before surfaces that were seen, or no step adds anything."))  # fmt: skip
    if steps:
        lines += [f"take the last step back: {command('terrella', 'space', 'edit', world, '--undo')}"]
    facts = {
        "world": str(folder),
        "coverage_before": before,
        "coverage": after,
        "steps": [vars(step) for step in steps],
    }
    return SpaceResult(facts, (*lines, f"walk in it: {command('terrella', 'play', folder)}"))


def viewpoints(place: SplatWorld, seed: int) -> torch.Tensor:
    """Points [E, 3] of eyes in free space: the first start, and others that one can walk to from there."""
    start = place.starts[:1, :3]
    open_collider = place.collider if len(place.solids) else Occupancy.of(place.gaussians)  # no floor that is not there
    reached = walkable(open_collider, place.starts[:, :3], place.config.body, MOST_PLACES)
    eyes = torch.cat([reached[:, :2], start[:, 2:].expand(len(reached), 1)], 1)
    return spread_out(torch.cat([start, eyes]), EYES, np.random.default_rng(seed))


def growth(
    place: SplatWorld, config: GrowSpaceConfig, eyes: torch.Tensor
) -> Iterator[tuple[GrowthStep, tuple[Gaussians, torch.Tensor]]]:
    """The steps, and of each the Gaussians and the pose of its camera."""
    gaussians, start = place.gaussians, place.starts[0]
    cameras: list[tuple[torch.Tensor, Intrinsics]] = [(start, place.config.camera)]
    fill = fill_of(place)
    first = _drawn(gaussians, start, place.config)
    known, tried = known_around(gaussians, eyes), torch.zeros(len(eyes), *known_around(gaussians, eyes[:1]).shape[1:])
    number = 0
    while coverage(known) < config.to and number < config.steps:
        view = next_view(known | (tried > 1), eyes)
        if view.unknown < 0.01:
            return
        step = grow_step(gaussians, view, fill, cameras)
        tried += _looked_at(view, eyes)
        if len(step.gaussians) < LEAST_ADDED:
            if view.unknown < 0.02:
                return
            continue
        number += 1
        gaussians = join([gaussians, step.gaussians])
        known = known_around(gaussians, eyes)
        again = _drawn(gaussians, start, place.config)
        closure = psnr_of(again.rgb[0], first.rgb[0], first.alpha[0] >= KNOWN)
        facts = GrowthStep(number, len(step.gaussians), coverage(known), step.seam, _away(view, start), closure)
        yield facts, (step.gaussians, view.pose)


def fill_of(place: SplatWorld) -> Fill:
    """What fills the unknown of a place."""
    seen = place.gaussians.at(place.provenance == OBSERVED)
    return planar_fill(
        room_planes(seen if len(seen) else place.gaussians, place.starts[0, :3], DEVIATION * depth_error(place))
    )


def depth_error(place: SplatWorld) -> float:
    """The expected error of a place's depth, as a share of it, at most MOST_ERROR: what `space lift` noted; otherwise 0."""
    given = place.card.get("depth_error")
    return min(float(given), MOST_ERROR) if isinstance(given, int | float) and given > 0 else 0.0


def _looked_at(view: GrowthView, eyes: torch.Tensor) -> torch.Tensor:
    """[E, H, W], 1 where a view looked: what stays unknown there after two looks is left."""
    ways = directions(ROWS) @ rotation(view.pose)
    inside = (ways[..., 0] > 0) & (ways[..., 1:].abs().amax(-1) < ways[..., 0])
    return inside.float() * (eyes == view.pose[:3]).all(1)[:, None, None]


def _drawn(gaussians: Gaussians, pose: torch.Tensor, config: SplatConfig) -> Any:
    with torch.no_grad():
        return rasterise(gaussians, pose[None], config.camera, config.size)


def _away(view: GrowthView, start: torch.Tensor) -> float:
    """Degrees between the optical axes of a view and a start."""
    cosine = float(rotation(view.pose)[:, 0] @ rotation(start)[:, 0])
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


def _save(folder: Path, place: SplatWorld, step: GrowthStep, grown: tuple[Gaussians, torch.Tensor]) -> None:
    """Saves a step as a place of its own, and merges it by a line of the world's edits."""
    gaussians, pose = grown
    edits, lying = read_edits(folder), [int(one.name) for one in (folder / GROWN).glob("[0-9]*") if one.name.isdigit()]
    number = sum(str(edit.get("place", "")).startswith(f"{GROWN}/") for edit in edits) + 1
    home = folder / GROWN / f"{max([*lying, 0]) + 1:04d}"
    card = {"objects": [f"invented, step {number}"], "growth": vars(step)}
    origin = torch.full((len(gaussians),), INVENTED, dtype=torch.uint8)
    objects = torch.ones(len(gaussians), dtype=torch.int32)
    save_splat(SplatWorld(f"step {number}", gaussians, origin, pose[None], place.config, card, objects), home)
    write_edits(folder, [*edits, merge_edit(folder, home)])
