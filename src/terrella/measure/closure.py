"""Closure: go away and come back; does the world still hold what it showed before?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ..core.errors import ObservationError
from ..core.policy import Replay
from ..core.world import World
from .clips import Clip
from .exam import Exam, ExamResults, Probe, batches
from .fidelity import psnr
from .rollouts import Results, Tick, fold_context, poses_at
from .scorecard import PREDICTED, TRUE, Picture, ProbeReport, Row, place_label
from .statistics import mean_interval
from .turning import scrolling_actions, turning_actions
from .work_units import UNSEEN, Unit

STATIC_DB = 20.0  # a far view this like the first one means that the picture hardly changed at all
WALKED_M = 1.0  # who goes less far does not leave
LEAD = (
    "The camera goes away and back in small steps, and away once more. Back again, the picture should be the first one (PSNR, "
    "dB); the far view, which the world drew itself, is seen a second time against the first time. Where the view never "
    "changed on the way, that proves nothing and is called void."
)


@dataclass(frozen=True)
class RoundTrip:
    """There and back. `steps(clips, pose)`: 2n poses [B, 7] to be observed, that lead away from the first poses (None for a
    world that shows none) and to them again; or, where `acted`, 2n actions [A]."""

    name: str
    steps: Callable[[Sequence[Clip], torch.Tensor | None], list]
    far_deg: float = 0.0
    acted: bool = False


def yaw_round_trip(far_deg: float, step_deg: float = 3.0) -> RoundTrip:
    """Turns on the spot to `far_deg` and back, in steps of `step_deg` or a little less."""
    half = math.ceil(far_deg / step_deg)
    turns = [far_deg * step / half for step in (*range(1, half + 1), *range(half - 1, -1, -1))]
    steps = lambda clips, pose: [yawed(pose, math.radians(turn)) for turn in turns]  # noqa: E731
    return RoundTrip(f"yaw 0-{far_deg:g}-0", steps, far_deg)


def walk_round_trip(steps: int = 100) -> RoundTrip:
    """Walks as the recording did for half of the steps, and backwards the same way."""
    half = steps // 2

    def path(clips: Sequence[Clip], pose: torch.Tensor | None) -> list[torch.Tensor]:
        first = clips[0].context - 1
        return [poses_at(clips, first + step) for step in (*range(1, half + 1), *range(half - 1, -1, -1))]

    return RoundTrip(f"walk of {2 * half} steps", path)


def turn_round_trip(there: torch.Tensor, back: torch.Tensor, name: str, steps: int, far_deg: float = 0.0) -> RoundTrip:
    """Holds the action `there` for half of the steps, then `back`: for worlds that take no poses."""
    half = steps // 2
    return RoundTrip(name, lambda clips, pose: [*[there] * half, *[back] * half], far_deg, True)


def run_round_trip(
    world: World, clips: Sequence[Clip], way: RoundTrip, rng: torch.Generator, tick: Tick = lambda done: None
) -> Results:
    """Goes the way from each clip's context on, there and back, and there again.

    closed, far, again, alike [B] dB: back against the first frame, the far view against it, the far view seen again against
    itself, and back against far; went [B] m; frames uint8 [B, 6, H, W, 3]: first, half way out, far, half way back, back, far
    again. The first frame is what the world shows after its context. ObservationError where the way is one of poses and the
    world takes none.
    """
    if not way.acted and "pose" not in world.spec.observes:
        raise ObservationError(f"{world.spec.name} does not observe 'pose', so nothing can move its camera.")
    state = fold_context(world, clips, rng)
    tick(len(clips) * clips[0].context)
    seen = world.render(state, ("rgb", "pose") if "pose" in world.spec.channels else ("rgb",))
    pose, frames, went = seen.get("pose"), [seen["rgb"].cpu()], torch.zeros(len(clips))
    steps = way.steps(clips, pose)
    count, half = len(steps), len(steps) // 2
    looked = (half // 2, half, count - half // 2, count, count + half)
    twice = [*steps, *steps[:half]]
    held = [step.expand(len(clips), *step.shape) for step in twice] if way.acted else []
    policy = Replay(torch.stack(held)) if held else None
    memory: Any = policy.begin(len(clips), rng) if policy else None
    for number, step in enumerate(twice, start=1):
        if policy:
            action, memory = policy.act({}, memory, rng)
            state = world.imagine(state, action, rng)
        else:
            state = world.observe({"pose": step}, state, rng)
        frames += [world.render(state, ("rgb",))["rgb"].cpu()] * looked.count(number)
        if number == half and pose is not None:
            went = (world.render(state, ("pose",))["pose"] - pose)[:, :3].norm(dim=1).cpu()
        tick(len(clips))
    first, _, far, _, back, again = frames
    pairs = {"closed": (back, first), "far": (far, first), "again": (again, far), "alike": (back, far)}
    found = {name: psnr(*pair) for name, pair in pairs.items()}
    return {**found, "went": went, "frames": torch.stack(frames, 1), "steps": torch.full((len(clips),), count)}


def round_trips_of(exam: Exam, world: World, clips: Sequence[Clip]) -> list[tuple[RoundTrip, Sequence[Clip]]]:
    """Along poses where the world takes them, else by actions that undo each other: that turn, or scroll."""
    config, clips = exam.config, clips[: exam.config.closure_clips]
    if exam.follows_poses(world):
        ways = [(yaw_round_trip(far, config.closure_step_deg), clips) for far in config.closure_deg]
        afoot = clips_that_walk(clips, config.closure_walk) if config.closure_walk else []
        return ways + ([(walk_round_trip(config.closure_walk), afoot)] if afoot else [])
    found = _turns(exam, world)
    if found is None:
        aside = _scrolls(exam, world)
        if aside is None:
            return []
        one, other, name, _ = aside
        return [
            (
                turn_round_trip(one, other, f"scrolling by {name}, {config.closure_walk} steps", config.closure_walk),
                clips,
            )
        ]
    left, right, name, speed = found
    halves = {far: min(100, max(5, round(math.radians(far) / speed))) for far in config.closure_deg}
    return [
        (
            turn_round_trip(left, right, f"turning by {name}, {2 * half} steps", 2 * half, math.degrees(half * speed)),
            clips,
        )
        for half in dict.fromkeys(halves.values())
    ]


def _asked(exam: Exam) -> list[tuple[str, World, str, int, RoundTrip, Sequence[Clip]]]:
    return [
        (arm, world, place, number, way, some)
        for arm, world in {**exam.arms, **exam.closing}.items()
        if not _missing(exam, world)
        for place, clips in exam.places.items()
        for number, (way, some) in enumerate(round_trips_of(exam, world, clips))
    ]


def _units(exam: Exam) -> list[Unit]:
    units = []
    for arm, world, place, which, way, clips in _asked(exam):
        verb = ("imagine" if way.acted else "pose") + UNSEEN
        for number, (first, some) in enumerate(batches(exam, world, clips)):
            steps = len(way.steps(some, poses_at(some, 0) if some[0].pose is not None else None))
            calls = {(arm, "observe"): len(some) * some[0].context, (arm, verb): len(some) * (steps + steps // 2)}
            run = partial(_go, exam, world, some, way, first)
            units.append(
                Unit(f"memory|{arm}|{place}|{which}|{number}", f"{arm}, {place_label(place)}: {way.name}", calls, run)
            )
    return units


def _go(exam: Exam, world: World, clips: Sequence[Clip], way: RoundTrip, first: int, tick: Tick) -> Results:
    found = run_round_trip(world, clips, way, exam.rng(3000 + first), tick)
    return {**found, "frames": found["frames"][: 1 if first == 0 else 0]}  # one is looked at


def rows_of(where: tuple, way: RoundTrip, gone: Results, rng: Callable[[], torch.Generator]) -> list[Row]:
    """closed and again, with the far view against the first, and whether they prove anything."""
    back, far, again = (mean_interval(gone[name], rng()) for name in ("closed", "far", "again"))
    away = float(gone["went"].double().mean())
    void, void_again = far.value >= STATIC_DB, float(gone["alike"].mean()) >= STATIC_DB
    note = f"{away:.1f} m away" if away > 0.1 else f"{way.far_deg:.0f} degrees away" if way.far_deg else ""
    note += ", the far view is like the first: void" if void else ""
    motion, steps = PREDICTED if way.acted else TRUE, int(gone["steps"][0])
    place, arm = where
    head, tail = ("memory", "rgb"), ("dB", place, arm, motion, steps)
    return [
        Row(*head, way.name, *tail, back, 1, {"far view": far}, void=void, note=note),
        Row(*head, f"{way.name}: far view again", *tail, again, 1, void=void or void_again),
    ]


def _report(exam: Exam, found: ExamResults) -> ProbeReport:
    whole, strips = ProbeReport(), {}
    for arm, _, place, which, way, _ in _asked(exam):
        if gone := found.of("memory", arm, place, str(which)):
            rows = rows_of((place, arm), way, gone, exam.rng)
            whole.rows += rows
            strips.setdefault(f"{way.name}, {place_label(place)}", {})[_words(arm, rows)] = gone["frames"][0].numpy()
    columns = ["first", "on the way", "far", "on the way back", "back", "far again"]
    whole.pictures = [Picture("memory", title, columns, rows) for title, rows in strips.items()]
    return whole


def _words(arm: str, rows: Sequence[Row]) -> str:
    back, again = rows
    return (
        f"{arm}: void"
        if back.void
        else f"{arm}: back {back.figure.value:.1f} dB, far again {again.figure.value:.1f} dB"
    )


def _scrolls(exam: Exam, world: World):
    """Of worlds that are flat and have a mosaic, where the score has time for it."""
    if "mosaic" not in world.spec.channels or not exam.config.closure_walk:
        return None
    clips = next(iter(exam.places.values()))[: exam.config.closure_clips]
    return exam.once(f"scrolls {id(world)}", lambda: scrolling_actions(world, clips, exam.rng(2)))


def _turns(exam: Exam, world: World):
    if not exam.config.closure_deg:
        return None
    clips = next(iter(exam.places.values()))
    return exam.once(f"turns {id(world)}", lambda: turning_actions(world, clips, exam.rng(2)))


def _missing(exam: Exam, world: World) -> str:
    if "rgb" not in exam.shared(world, "rgb"):
        return "needs rgb"
    if exam.follows_poses(world):
        return ""
    if _turns(exam, world) or _scrolls(exam, world):
        return ""
    return "needs actions that turn a camera whose pose is shown or recorded, or that scroll the picture and undo each other"


def clips_that_walk(clips: Sequence[Clip], steps: int) -> list[Clip]:
    """Those of the clips that walk at least a metre in half of the steps: others would close without having left."""
    half = steps // 2
    able = [clip for clip in clips if clip.pose is not None and clip.horizon >= half]
    return [clip for clip in able if clip.walked_m()[half - 1] >= WALKED_M]


def yawed(pose: torch.Tensor, angle_rad: float) -> torch.Tensor:
    """Poses [B, 7] turned about the world's vertical by `angle_rad`, counter-clockwise from above; the place stays."""
    c, s = math.cos(angle_rad / 2), math.sin(angle_rad / 2)
    w, x, y, z = pose[:, 3:].unbind(-1)
    around = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    return torch.cat([pose[:, :3], around], -1)


MEMORY = Probe("memory", "Does it remember?", LEAD, _missing, _report, units=_units)
