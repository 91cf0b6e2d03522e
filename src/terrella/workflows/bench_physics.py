"""`bench physics`: how well worlds predict moving bodies, within the ranges of training and beyond, with and without a guard."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..core.errors import TerrellaError
from ..core.numbers import check_seed
from ..core.policy import Idle
from ..core.rollouts import rollout
from ..core.spec import neutral_action
from ..core.world import World, make_rng
from ..data import record
from ..learn.recipes.latent import LatentTraining
from ..measure.page_parts import COLOURS, QUIET, document, legend, section, table_of
from ..measure.plot import Line, line_chart
from ..measure.statistics import Band, Figure, mean_band
from ..physics import Guarded, PhysicalSystem, Trajectory, calibrate, certify, trajectory_of
from ..sim.bodies import FAMILIES
from .opening import Device, load_named
from .progress import Progress, silent
from .results import jsonable, table_lines
from .train import train_latent

COPY, LINEAR, NOISY, WORLD, GUARDED = "copy-last", "linear", "truth, noisy start", "world", "guarded"
SPLITS, AT, KNOWN = ("in", "out"), (1, 8, 32), 200
ALL = (*FAMILIES, "stacking")
NOISE = 0.01  # of the spread of each number over starts


@dataclass(frozen=True)
class BenchPhysicsConfig:
    """Settings of `bench physics`."""

    families: tuple[str, ...] = ()
    """Of uniform, parabola, collision, bouncing, pendulum, rolling, stacking. Default: the world's own, else all."""
    train: float | None = None  # Minutes to train a latent world for each family; default: none is trained.
    frames: int = 10_000  # Frames to record for --train.
    rollouts: int = 64  # Rollouts of each family and split.
    steps: int = 32  # Steps of a rollout.
    out: Path = Path("physics")  # Folder for the page, the figures, and what --train records and trains.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class ArmResult:
    """The predictions of one arm."""

    family: str
    split: str  # "in" or "out" of the ranges of training
    arm: str
    error_m: Band  # mean distance of bodies from the truth at each step, m
    broken: float  # share of rollouts that break a law
    guard: str = ""  # what the guard did

    def at(self, step: int) -> Figure:
        return self.error_m.at(step - 1)


@dataclass(frozen=True)
class BenchPhysicsResult:
    """Errors of all arms, families and splits."""

    arms: tuple[ArmResult, ...]
    steps: int
    files: tuple[Path, ...]

    @property
    def horizons(self) -> list[int]:
        return [step for step in AT if step <= self.steps]

    def to_json(self) -> dict[str, Any]:
        return jsonable({"arms": [asdict(one) for one in self.arms], "files": self.files})

    def summary(self) -> str:
        heads, rows = self.table()
        guards = [f"{one.family}, {one.split}: {one.guard}" for one in self.arms if one.guard]
        return "\n".join([*self.verdict(), "", *table_lines(heads, rows), *guards, f"the page: {self.files[-1]}"])

    def verdict(self) -> list[str]:
        """What the guard gains beyond the ranges of training, or what the baselines say where no world was given."""
        last = self.horizons[-1]
        by = {(one.family, one.split, one.arm): one.at(last).value for one in self.arms}
        pairs = [
            (by[family, "out", WORLD], by[family, "out", GUARDED]) for family in ALL if (family, "out", GUARDED) in by
        ]
        if not pairs:
            return ["Baselines alone: give a WORLD, or --train MINUTES."]
        better = sum(plain >= 2 * guarded for plain, guarded in pairs)
        return [
            f"Beyond the ranges of training the guard halves the error after {last} steps in {better} of {len(pairs)} families."
        ]

    def table(self) -> tuple[list[str], list[list[str]]]:
        heads = [
            "family",
            "split",
            "predicted by",
            *(f"error at {step}, m" for step in self.horizons),
            "rollouts that break a law",
        ]
        rows = [
            [one.family, one.split, one.arm, *(_cell(one.at(step)) for step in self.horizons), f"{one.broken:.0%}"]
            for one in self.arms
        ]
        return heads, rows


def _cell(figure: Figure) -> str:
    return f"{figure.value:.3g} [{figure.low:.3g}, {figure.high:.3g}]"


def bench_physics(
    world: str | None = None, config: BenchPhysicsConfig | None = None, *, progress: Progress = silent
) -> BenchPhysicsResult:
    """Compares predictions of families of moving bodies with the truth: copy-last, linear extrapolation, the truth from a noisy
    start, and a world with and without its guard. TerrellaError for a world of no family."""
    config = config or BenchPhysicsConfig()
    if min(config.rollouts, config.steps) < 2 or (config.train is not None and not config.train > 0):
        raise TerrellaError("--rollouts and --steps are 2 or more, and --train is above 0 minutes.")
    check_seed(config.seed)
    if world is not None and config.train is not None:
        raise TerrellaError("a WORLD is given, and --train asks for new ones; leave one of them out.")
    opened = None if world is None else load_named(world, config.device, progress=progress)
    families = config.families or ((_family_of(opened),) if opened else ALL)
    if unknown := sorted(set(families) - set(ALL)):
        raise TerrellaError(f"there is no family {', '.join(unknown)}; there are {', '.join(ALL)}.")
    arms: list[ArmResult] = []
    for family in families:
        mine = opened or (_trained(family, config, progress) if config.train else None)
        for split in SPLITS:
            progress(f"{family}, {split}")
            arms += _judged(family, split, mine, config)
    return _written(arms, config)


def _family_of(world: World) -> str:
    """The family that a world was recorded from."""
    name = str(world.spec.card.get("game") or world.spec.name).partition(":")[2].partition(":")[0]
    if name not in ALL:
        raise TerrellaError(f"{world.spec.name} is of no family of bodies; name one with --families, such as bouncing.")
    return name


def _trained(family: str, config: BenchPhysicsConfig, progress: Progress) -> World:
    folder = config.out / family
    truth = library.load(f"physics:{family}", pictures=False)
    names = PhysicalSystem.from_json(truth.spec.system).channels
    record(truth, Idle(truth.spec), folder / "recording", config.frames, make_rng(config.seed))
    settings = LatentTraining(
        name=family, channels=names, history=1, steps=1_000_000, hours=(config.train or 0) / 60, device=config.device,
        seed=config.seed,
    )  # fmt: skip
    train_latent(folder / "recording", folder / "run", settings, progress=progress)
    return load_named(str(folder / "run"), config.device, progress=progress)


@dataclass(frozen=True)
class _Case:
    """True rollouts of a family."""

    world: World
    system: PhysicalSystem
    seen: Mapping[str, torch.Tensor]  # channel -> [T + 1, B, ...]
    motion: Trajectory
    actions: torch.Tensor


def _case(family: str, split: str, batch: int, steps: int, seed: int) -> _Case:
    world = library.load(f"physics:{family}:{split}", pictures=False)
    system = PhysicalSystem.from_json(world.spec.system)
    actions = torch.from_numpy(neutral_action(world.spec))[None, None].expand(
        steps, batch, *(world.spec.action.shape or ())
    )
    seen = rollout(world, world.start(batch, make_rng(seed)), actions, make_rng(0), system.channels).observations
    return _Case(world, system, seen, trajectory_of(system, seen, world.spec.dt_s), actions)


def _judged(family: str, split: str, mine: World | None, config: BenchPhysicsConfig) -> list[ArmResult]:
    tolerances = calibrate(_case(family, "in", KNOWN, config.steps, config.seed + 1).motion)
    case = _case(family, split, config.rollouts, config.steps, config.seed + 2)
    true, results = case.motion, []

    def add(arm: str, motion: Trajectory, guard: str = "") -> None:
        apart = (motion.position[1:] - true.position[1:]).norm(dim=-1).mean(-1)
        broken = float(certify(motion, tolerances).broken.any(1).double().mean())
        results.append(ArmResult(family, split, arm, mean_band(apart.T, make_rng(config.seed)), broken, guard))

    time_s = torch.arange(config.steps + 1, dtype=torch.float64)[:, None, None, None] * true.dt_s
    add(
        COPY,
        replace(true, position=true.position[:1].expand_as(true.position), velocity=torch.zeros_like(true.velocity)),
    )
    ahead = true.position[:1] + true.velocity[:1] * time_s
    add(LINEAR, replace(true, position=ahead, velocity=true.velocity[:1].expand_as(true.velocity)))
    if case.world.spec.observes:
        add(NOISY, _predicted(case.world, case, noise=NOISE)[0])
    if mine is not None:
        add(WORLD, _predicted(mine, case)[0])
        guard = Guarded(mine, case.system, tolerances)
        motion, final = _predicted(guard, case)
        add(GUARDED, motion, str(guard.report(final)))
    return results


def _predicted(world: World, case: _Case, noise: float = 0.0) -> tuple[Trajectory, Any]:
    """The rollouts of a world from the starts of the case, and its final state."""
    rng = make_rng(1)
    first = {name: case.seen[name][0] for name in world.spec.observes}
    for name in ("position", "velocity") if noise else ():
        spread = first[name].std(0, keepdim=True)
        first[name] = first[name] + noise * spread * torch.randn(first[name].shape, generator=rng)
    state = world.observe(first, None, rng)
    done = rollout(world, state, case.actions, make_rng(0), case.system.channels)
    return trajectory_of(case.system, done.observations, world.spec.dt_s), done.final


def _written(arms: list[ArmResult], config: BenchPhysicsConfig) -> BenchPhysicsResult:
    config.out.mkdir(parents=True, exist_ok=True)
    files = config.out / "physics.json", config.out / "physics.html"
    result = BenchPhysicsResult(tuple(arms), config.steps, files)
    files[0].write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
    heads, rows = result.table()
    charts = "".join(
        _chart(family, split, [one for one in arms if (one.family, one.split) == (family, split)])
        for family in dict.fromkeys(one.family for one in arms)
        for split in SPLITS
    )
    lead = "Mean distance of bodies from the truth, with 95% intervals. Out: speeds, sizes and heights beyond those of training."
    parts = [
        section(result.verdict()[0], lead, f"<div class=charts>{charts}</div>"),
        section("All figures", "", table_of(heads, rows)),
    ]
    files[1].write_text(document("Bodies in motion", parts), encoding="utf-8")
    return result


def _chart(family: str, split: str, arms: list[ArmResult]) -> str:
    colours = {COPY: QUIET, LINEAR: COLOURS[3], NOISY: COLOURS[4], WORLD: COLOURS[1], GUARDED: COLOURS[0]}
    lines = []
    for one in arms:
        x, band = [float(step + 1) for step in range(len(one.error_m.value))], one.error_m
        lines.append(
            Line(one.arm, x, band.value, band.low, band.high, colours[one.arm], "2 3" if one.arm == COPY else "")
        )
    ticks = [(float(2**k), str(2**k)) for k in range(8) if 2**k <= len(lines[0].x)]
    svg = line_chart(lines, ticks, "steps", "error, m", True)
    words = "within the ranges of training" if split == "in" else "beyond them"
    return f"<figure><h3>{family}, {words}</h3>{svg}{legend(lines)}</figure>"
