"""Loop closure: the camera goes away and comes back; does the world still show what it showed before?"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ..core.errors import ObservationError
from ..core.policy import Replay
from ..core.world import World, without_end
from .clips import Clip
from .exam import Exam, ExamResults, Probe, batches
from .fidelity import psnr
from .rollouts import Results, Tick, fold_context, poses_at
from .scorecard import PREDICTED, TRUE, Picture, ProbeReport, Row, place_label
from .statistics import mean_interval
from .turning import scrolling_actions, turning_actions
from .work_units import UNSEEN, Unit

STATIC_DB = 20.0  # PSNR of far and first view from which the picture hardly changed
WALKED_M = 1.0  # least distance of a walk
LEAD = (
    "The camera goes away and back in small steps, and away once more. On return the picture should be the first one (PSNR, dB); "
    "the far view, which the world invented, is compared between its two visits. If the view never changes on the way, the test "
    "proves nothing and is void."
)


@dataclass(frozen=True)
class RoundTrip:
    """A way out and back."""

    name: str
    # (clips, first poses [B, 7] or None) -> 2n poses [B, 7] to observe, out and back; or 2n actions [A] if `acted`
    steps: Callable[[Sequence[Clip], torch.Tensor | None], list]
    far_deg: float = 0.0  # the largest turn
    acted: bool = False


def yaw_round_trip(far_deg: float, step_deg: float = 3.0) -> RoundTrip:
    """Turns on the spot to `far_deg` and back, in steps of at most `step_deg`."""
    half = math.ceil(far_deg / step_deg)
    turns = [far_deg * step / half for step in (*range(1, half + 1), *range(half - 1, -1, -1))]
    steps = lambda clips, pose: [yawed(pose, math.radians(turn)) for turn in turns]  # noqa: E731
    return RoundTrip(f"yaw 0-{far_deg:g}-0", steps, far_deg)


def walk_round_trip(steps: int = 100) -> RoundTrip:
    """Follows the recorded path for half of the steps, and backwards the same way."""
    half = steps // 2

    def path(clips: Sequence[Clip], pose: torch.Tensor | None) -> list[torch.Tensor]:
        first = clips[0].context - 1
        return [poses_at(clips, first + step) for step in (*range(1, half + 1), *range(half - 1, -1, -1))]

    return RoundTrip(f"walk of {2 * half} steps", path)


def turn_round_trip(out: torch.Tensor, back: torch.Tensor, name: str, steps: int, far_deg: float = 0.0) -> RoundTrip:
    """Holds the action `out` for half of the steps, then `back`: for worlds that take no poses."""
    half = steps // 2
    return RoundTrip(name, lambda clips, pose: [*[out] * half, *[back] * half], far_deg, True)


def run_round_trip(
    world: World, clips: Sequence[Clip], way: RoundTrip, rng: torch.Generator, tick: Tick = lambda done: None
) -> Results:
    """Goes out and back, and out again, from the context of each clip.

    closed, far, again, alike [B] dB: PSNR of the return and the first frame, of the far and the first, of both far views, and of
    the return and the far view; went [B] m; frames uint8 [B, 6, H, W, 3]: first, half way out, far, half way back, back, far
    again. The first frame is the one after the context. ObservationError if the way has poses and the world takes none.
    """
    if not way.acted and "pose" not in world.spec.observes:
        raise ObservationError(f"{world.spec.name} does not observe 'pose', so its camera cannot be moved.")
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
            state = world.imagine(without_end(state), action, rng)
        else:
            state = world.observe({"pose": step}, state, rng)
        frames += [world.render(state, ("rgb",))["rgb"].cpu()] * looked.count(number)
        if number == half and pose is not None:
            went = (world.render(state, ("pose",))["pose"] - pose)[:, :3].norm(dim=1).cpu()
        tick(len(clips))
    first, _, far, _, back, again = frames
    pairs = {"closed": (back, first), "far": (far, first), "again": (again, far), "alike": (back, far)}
    similarity = {name: psnr(*pair) for name, pair in pairs.items()}
    return {**similarity, "went": went, "frames": torch.stack(frames, 1), "steps": torch.full((len(clips),), count)}


def round_trips_of(exam: Exam, world: World, clips: Sequence[Clip]) -> list[tuple[RoundTrip, Sequence[Clip]]]:
    """Along poses if the world takes them, else by pairs of actions that undo each other by turning or scrolling."""
    config, clips = exam.config, clips[: exam.config.closure_clips]
    if exam.follows_poses(world):
        ways = [(yaw_round_trip(far, config.closure_step_deg), clips) for far in config.closure_deg]
        afoot = clips_that_walk(clips, config.closure_walk) if config.closure_walk else []
        return ways + ([(walk_round_trip(config.closure_walk), afoot)] if afoot else [])
    turning = _turning(exam, world)
    if turning is None:
        scrolling = _scrolling(exam, world)
        if scrolling is None:
            return []
        one, other, name, _ = scrolling
        return [
            (
                turn_round_trip(one, other, f"scrolling by {name}, {config.closure_walk} steps", config.closure_walk),
                clips,
            )
        ]
    left, right, name, speed = turning
    halves = {far: min(100, max(5, round(math.radians(far) / speed))) for far in config.closure_deg}
    return [
        (
            turn_round_trip(left, right, f"turning by {name}, {2 * half} steps", 2 * half, math.degrees(half * speed)),
            clips,
        )
        for half in dict.fromkeys(halves.values())
    ]


def _trips(exam: Exam) -> list[tuple[str, World, str, int, RoundTrip, Sequence[Clip]]]:
    return [
        (arm, world, place, number, way, some)
        for arm, world in {**exam.arms, **exam.closing}.items()
        if not _missing(exam, world)
        for place, clips in exam.places.items()
        for number, (way, some) in enumerate(round_trips_of(exam, world, clips))
    ]


def _units(exam: Exam) -> list[Unit]:
    units = []
    for arm, world, place, which, way, clips in _trips(exam):
        verb = ("imagine" if way.acted else "pose") + UNSEEN
        for number, (first, some) in enumerate(batches(exam, world, clips)):
            steps = len(way.steps(some, poses_at(some, 0) if some[0].pose is not None else None))
            calls = {(arm, "observe"): len(some) * some[0].context, (arm, verb): len(some) * (steps + steps // 2)}
            run = partial(_run, exam, world, some, way, first)
            words = f"{arm}, {place_label(place)}: {way.name}"
            units.append(Unit(f"memory|{arm}|{place}|{which}|{number}", words, calls, run))
    return units


def _run(exam: Exam, world: World, clips: Sequence[Clip], way: RoundTrip, first: int, tick: Tick) -> Results:
    results = run_round_trip(world, clips, way, exam.rng(3000 + first), tick)
    return {**results, "frames": results["frames"][: 1 if first == 0 else 0]}  # one is shown


def rows_of(where: tuple, way: RoundTrip, gone: Results, rng: Callable[[], torch.Generator]) -> list[Row]:
    """The rows of the return and of the second far view, and whether they are void."""
    back, far, again = (mean_interval(gone[name], rng()) for name in ("closed", "far", "again"))
    away = float(gone["went"].double().mean())
    void, void_again = far.value >= STATIC_DB, float(gone["alike"].mean()) >= STATIC_DB
    note = f"{away:.1f} m away" if away > 0.1 else f"{way.far_deg:.0f} degrees away" if way.far_deg else ""
    note += ", the far view looks like the first: void" if void else ""
    motion, steps = PREDICTED if way.acted else TRUE, int(gone["steps"][0])
    place, arm = where
    head, tail = ("memory", "rgb"), ("dB", place, arm, motion, steps)
    return [
        Row(*head, way.name, *tail, back, 1, {"far view": far}, void=void, note=note),
        Row(*head, f"{way.name}: far view again", *tail, again, 1, void=void or void_again),
    ]


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole, strips = ProbeReport(), {}
    for arm, _, place, which, way, _ in _trips(exam):
        if gone := results.of("memory", arm, place, str(which)):
            rows = rows_of((place, arm), way, gone, exam.rng)
            whole.rows += rows
            strips.setdefault(f"{way.name}, {place_label(place)}", {})[_label(arm, rows)] = gone["frames"][0].numpy()
    columns = ["first", "on the way", "far", "on the way back", "back", "far again"]
    whole.pictures = [Picture("memory", title, columns, rows) for title, rows in strips.items()]
    return whole


def _label(arm: str, rows: Sequence[Row]) -> str:
    back, again = rows
    figures = f"back {back.figure.value:.1f} dB, far again {again.figure.value:.1f} dB"
    return f"{arm}: void" if back.void else f"{arm}: {figures}"


def _scrolling(exam: Exam, world: World):
    """Actions that scroll a flat world with a mosaic, if the settings ask for walks."""
    if "mosaic" not in world.spec.channels or not exam.config.closure_walk:
        return None
    clips = next(iter(exam.places.values()))[: exam.config.closure_clips]
    return exam.once(f"scrolls {id(world)}", lambda: scrolling_actions(world, clips, exam.rng(2)))


def _turning(exam: Exam, world: World):
    if not exam.config.closure_deg:
        return None
    clips = next(iter(exam.places.values()))
    return exam.once(f"turns {id(world)}", lambda: turning_actions(world, clips, exam.rng(2)))


def _missing(exam: Exam, world: World) -> str:
    if "rgb" not in exam.shared(world, "rgb"):
        return "needs rgb"
    if exam.follows_poses(world):
        return ""
    if _turning(exam, world) or _scrolling(exam, world):
        return ""
    return "needs actions that turn a camera with a known pose, or that scroll the picture and undo each other"


def clips_that_walk(clips: Sequence[Clip], steps: int) -> list[Clip]:
    """The clips that walk at least a metre in half of the steps; others would close without having left."""
    half = steps // 2
    able = [clip for clip in clips if clip.pose is not None and clip.horizon >= half]
    return [clip for clip in able if clip.walked_m()[half - 1] >= WALKED_M]


def yawed(pose: torch.Tensor, angle_rad: float) -> torch.Tensor:
    """Poses [B, 7] rotated about the vertical by `angle_rad`, counter-clockwise from above, at the same place."""
    c, s = math.cos(angle_rad / 2), math.sin(angle_rad / 2)
    w, x, y, z = pose[:, 3:].unbind(-1)
    around = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    return torch.cat([pose[:, :3], around], -1)


MEMORY = Probe("memory", "Does it remember?", LEAD, _missing, _report, units=_units)
