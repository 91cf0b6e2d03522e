"""Physics of a world: certificates of its rollouts under calibrated laws, constants, energy, and the certified horizon."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from ..core.errors import TerrellaError
from ..core.world import make_rng
from ..physics import LAWS, Certificates, Tolerance, Trajectory, calibrate, certify
from ..physics.constants import CONSTANTS
from ..physics.laws.energy import energy, energy_scale
from ..physics.laws.non_penetration import NonPenetration, begins_inside
from ..physics.tolerance import detection
from .statistics import Band, Figure, clopper_pearson, mean_band, mean_interval, median_interval, ratio_interval

COARSE = 0.2  # of the largest tolerance with which a law says something: a violation that a person would see


@dataclass(frozen=True)
class LawReport:
    """One law in one domain."""

    name: str
    unit: str
    tolerance: float  # in the unit
    coarse: float  # in the unit
    origin: str  # of the tolerance
    false_alarms: Figure  # the share of other true rollouts that break it
    detected: Figure  # the share of injected violations of twice the tolerance
    broken: Figure  # the share of the world's rollouts that break it
    broken_coarsely: Figure  # the same with the coarse tolerance
    violation: Figure  # the mean over rollouts of the largest violation, in the unit
    by_step: Band  # the mean violation of each step, in the unit
    wrong_here: str = ""  # why the law says nothing in this domain


@dataclass(frozen=True)
class ConstantReport:
    """A constant of nature, of the truth and of the world."""

    name: str
    unit: str
    truth: Figure
    dream: Figure


@dataclass(frozen=True)
class WorstRollout:
    """The rollout that breaks a law by most, or comes nearest to it, beside the truth."""

    law: str
    unit: str
    step: int  # of the largest violation, from 1
    by_step: tuple[float, ...]  # its violation of that law, in the unit
    tolerance: float  # the coarse one, in the unit
    truth: Trajectory  # of one rollout
    dream: Trajectory


@dataclass(frozen=True)
class PhysicsReport:
    """What a world keeps and breaks."""

    world: str
    rollouts: int
    steps: int
    dt_s: float
    laws: tuple[LawReport, ...]
    missing: Mapping[str, str]  # law -> what it needs
    constants: tuple[ConstantReport, ...]
    energy_spread: Figure | None  # mean over rollouts of the energy's deviation over time, over that of the truth
    energy_deviation: tuple[Figure, Figure] | None  # of truth and world, as shares of the kinetic energy
    horizon: Figure  # median of the certified horizon, steps
    coarse_horizon: Figure  # the same with the coarse tolerances
    change: Figure | None  # how far bodies go in a step, over that of the truth: 0 is frozen
    worst: WorstRollout | None = field(default=None, repr=False)
    notes: tuple[str, ...] = ()  # what a reader of the figures should know


def examine_physics(
    name: str, known: Trajectory, truth: Trajectory, dream: Trajectory, seed: int = 0, coarse: float = COARSE
) -> PhysicsReport:
    """Judges rollouts of a world. known: true rollouts; the first two thirds calibrate the tolerances, the others measure false
    alarms and the power to detect. truth: those with the starts and actions of `dream`. All are of one length. TerrellaError where
    no law applies."""
    if len({known.steps, truth.steps, dream.steps}) > 1:
        raise TerrellaError("the rollouts of truth and world differ in length; give both the same number of steps.")
    system, rng = truth.system, make_rng(seed)
    missing = {law.name: why for law in LAWS if (why := law.missing(system))}
    middle = max(1, 2 * known.batch // 3)
    calibration, others = (
        known.at(torch.arange(middle)),
        known.at(torch.arange(min(middle, known.batch - 1), known.batch)),
    )
    tolerances = calibrate(calibration)
    if not tolerances:
        raise TerrellaError(f"no law applies: {'; '.join(f'{name} {why}' for name, why in missing.items())}.")
    relaxed = [replace(one, value=max(one.value, coarse * one.law.ceiling(calibration))) for one in tolerances]
    strict, loose = certify(dream, tolerances), certify(dream, relaxed)
    laws = tuple(_law(one, wide, others, dream, seed) for one, wide in zip(tolerances, relaxed))
    estimates = [(one, [_constant(one.estimate(part), rng) for part in (truth, dream)]) for one in CONSTANTS.values()]
    constants = tuple(
        ConstantReport(one.name, one.unit, *both) for one, both in estimates if all(figure.count for figure in both)
    )
    deviation = spread = None
    if not [name for name in missing if name == "energy"]:
        deviations = [energy(part).std(0) / energy_scale(part)[-1] for part in (truth, dream)]
        deviation = mean_interval(deviations[0], rng), mean_interval(deviations[1], rng)
        spread = ratio_interval(deviations[1], deviations[0].clamp_min(1e-7), rng)
    travelled = [part.position.diff(dim=0).norm(dim=-1).sum(-1).mean(0) for part in (truth, dream)]
    change = ratio_interval(travelled[1], travelled[0], rng) if float(travelled[0].sum()) > 0 else None
    horizon, wide_horizon = (median_interval(one.horizon.double(), rng) for one in (strict, loose))
    return PhysicsReport(
        name, dream.batch, dream.steps, dream.dt_s, laws, missing, constants, spread, deviation, horizon, wide_horizon, change,
        _worst(loose, relaxed, truth, dream), _begun_inside(tolerances, known, truth),
    )  # fmt: skip


def _begun_inside(tolerances: Sequence[Tolerance], *true: Trajectory) -> tuple[str, ...]:
    """What to say of true rollouts that begin with an overlap beyond what the law allows, or can mean."""
    for one in tolerances:
        if isinstance(one.law, NonPenetration):
            sentences = (begins_inside(motion, min(one.value, one.law.ceiling(motion))) for motion in true)
            return tuple(words for words in sentences if words)[:1]
    return ()


def _law(one: Tolerance, wide: Tolerance, others: Trajectory, dream: Trajectory, seed: int) -> LawReport:
    rng, law = make_rng(seed), one.law
    true, mine = law.residual(others), law.residual(dream)
    hits, tried = detection(one, others, seed)
    return LawReport(
        law.name, law.unit, one.value, wide.value, one.origin,
        clopper_pearson(int((true.amax(0) > one.value).sum()), others.batch),
        clopper_pearson(hits, tried),
        clopper_pearson(int((mine.amax(0) > one.value).sum()), dream.batch),
        clopper_pearson(int((mine.amax(0) > wide.value).sum()), dream.batch),
        mean_interval(mine.amax(0), rng), mean_band(mine.T, rng), one.wrong_here,
    )  # fmt: skip


def _constant(values: torch.Tensor, rng: torch.Generator) -> Figure:
    known = values[values.isfinite()]
    return mean_interval(known, rng) if len(known) else Figure(math.nan, math.nan, math.nan, 0)


def _worst(
    certificates: Certificates, tolerances: Sequence[Tolerance], truth: Trajectory, dream: Trajectory
) -> WorstRollout | None:
    """The rollout and the law with the largest violation, in tolerances; None where no law says anything."""
    if not certificates.laws:
        return None
    row, number = divmod(int(certificates.worst.argmax()), len(certificates.laws))
    pick, name = torch.tensor([row]), certificates.laws[number]
    one = next(one for one in tolerances if one.law.name == name)
    residual, step = one.law.residual(dream)[:, row], int(certificates.step[row, number])
    return WorstRollout(name, one.law.unit, step, tuple(residual.tolist()), one.value, truth.at(pick), dream.at(pick))


def physics_verdict(report: PhysicsReport) -> list[str]:
    """The verdict first, then a line for each thing that a person should know."""
    seconds = report.coarse_horizon.value * report.dt_s
    broken = [one for one in report.laws if not one.wrong_here and one.broken_coarsely.value > 0]
    lines = [
        f"Keeps the laws for {report.coarse_horizon.value:.0f} of {report.steps} steps ({seconds:.2g} s).",
        "That is the median over rollouts, until a violation that a person would see; to the truth's own tolerances it is "
        f"{report.horizon.value:.0f}.",
    ]
    for one in sorted(broken, key=lambda one: -one.broken_coarsely.value)[:3]:
        lines.append(
            f"{one.name}: broken in {one.broken_coarsely.value:.0%} of rollouts by more than {in_words(one.coarse)} {one.unit} (by "
            f"{in_words(one.violation.value)} on average; the truth by {one.tolerance:.2g} at most)."
        )
    for one in report.constants:
        unit = f" {one.unit}" if one.unit else ""
        lines.append(f"{one.name}: {_short(one.dream)}{unit}; the truth {_short(one.truth)}{unit}.")
    if report.energy_spread is not None and report.energy_deviation is not None:
        truth, mine = report.energy_deviation
        lines.append(
            f"energy deviates by {mine.value:.2g} of the kinetic energy, the truth by {truth.value:.2g}: "
            f"{_times(report.energy_spread.value)}."
        )
    if report.change is not None:
        lines.append(f"bodies go {report.change.value:.2f} times as far as in the truth (0 would be frozen).")
    lines += [f"{one.name}: {one.wrong_here}." for one in report.laws if one.wrong_here]
    return [*lines, *report.notes]


def in_words(value: float) -> str:
    """Two digits, and large numbers in full."""
    return f"{value:.2g}" if abs(value) < 99.5 or not math.isfinite(value) else f"{value:,.0f}"


def _times(ratio: float) -> str:
    return f"{ratio:.2g} times as much" if ratio < 1000 else "over 1,000 times as much"


def _short(figure: Figure) -> str:
    if not math.isfinite(figure.low):
        return f"{figure.value:.3g}"
    return f"{figure.value:.3g} [{figure.low:.3g}, {figure.high:.3g}]"


def table_of_laws(report: PhysicsReport) -> tuple[list[str], list[list[str]]]:
    """(heads, rows of text)."""
    heads = ["law", "unit", "tolerance", "violation", "broken", "broken coarsely", "false alarms", "injected, detected"]
    rows = [
        [
            one.name, one.unit, f"{one.tolerance:.2g}", in_words(one.violation.value), _share(one.broken),
            _share(one.broken_coarsely), _share(one.false_alarms), _share(one.detected),
        ]
        for one in report.laws
    ]  # fmt: skip
    return heads, rows


def _share(figure: Figure) -> str:
    return f"{figure.value:.1%} of {figure.count}" if figure.count else "no occasion"
