"""The trust horizon of a world: for how many steps a rollout is nearer to the truth than to chance, forecast and measured.

Trust ends where the mean error is half way from that of the first step to that of chance, which is what two random
observations differ by. The forecast needs no truth: it takes the world's own `uncertainty` in a rollout.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from ..core.policy import Policy, Random, act
from ..core.spec import chance_error, measured_trust, trust_level
from ..core.state import State
from ..core.world import World, make_rng
from .clips import Clip, evidence
from .exam import CLIPS, LONG, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric, rows_at
from .scorecard import PREDICTED, ProbeReport, Row
from .statistics import Figure, curve_interval

ROLLOUTS, HOLD = 8, (3, 40)  # of a forecast; steps for which its random actions are held
LEAD = (
    "Trust ends where the mean error is half way from that of the first step to that of chance: what two random "
    "observations differ by. Forecast: by the error that the world itself expects. Measured: by the error that it has."
)


@dataclass(frozen=True)
class TrustForecast:
    """For how long rollouts of a world can be trusted, without a look at the truth."""

    steps: int  # that are within trust; `limit` where the rollouts, or all of their episodes, end before trust does
    limit: int  # steps of the rollouts
    level: float  # expected error at which trust ends, in the unit of `uncertainty`
    expected: tuple[float, ...]  # mean expected error of each step, of the episodes that have not ended before
    measured: bool = (
        False  # whether `steps` is the measured horizon of the world's card, which is shorter than the forecast
    )

    @property
    def ends(self) -> bool:
        """Whether trust ends within the rollouts."""
        return self.steps < self.limit


def steps_within(errors: torch.Tensor, level: float) -> int:
    """The steps before the errors [T] reach the level for good, by the split into lower and higher ones that fits best: of errors
    that only grow, those below the level."""
    return int(_change_points(errors[None], torch.tensor([level]))[0])


def _change_points(errors: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
    """`steps_within` of curves [R, T] and levels [R], float64 [R]."""
    left = (level[:, None] - errors.double()).cumsum(1)
    return torch.cat([torch.zeros_like(left[:, :1]), left], 1).argmax(1).double()


@torch.inference_mode()
def forecast_trust(
    world: World, limit: int, state: State | None = None, policy: Policy | None = None, seed: int = 0
) -> TrustForecast | None:
    """How many steps from `state` (default: 8 starts of the world) can be trusted, of at most `limit`, under a policy (default:
    held random actions) that is shown nothing; never more than the measured horizon of the world's card (`trust_steps_measured`),
    where it has one. Steps after an end that the world predicts do not count. None for a world that expects no error, or always the
    same."""
    chance, rng = chance_error(world.spec), make_rng(seed)
    if not math.isfinite(chance) or limit < 1:
        return None
    state = world.start(min(ROLLOUTS, world.spec.max_batch or ROLLOUTS), rng) if state is None else state
    policy = Random(world.spec, HOLD) if policy is None else policy
    memory, expected, going = policy.begin(state.batch, rng), [], torch.ones(state.batch, dtype=torch.bool)
    for _ in range(limit):
        action, memory = act(policy, {}, memory, state.batch, world.spec, rng)
        state = world.imagine(state, action, rng)
        expected.append(float(world.render(state, ("uncertainty",))["uncertainty"].float().cpu()[going].mean()))
        going &= ~state["done"].bool().cpu() if "done" in state else going
        if not going.any():
            break
    if len(expected) > 1 and max(expected) == min(expected):
        return None
    level = trust_level(expected[0], chance)
    steps, most = steps_within(torch.tensor(expected), level), measured_trust(world.spec)
    steps = limit if steps == len(expected) else steps
    if most is not None and most < steps:
        return TrustForecast(most, limit, level, tuple(expected), True)
    return TrustForecast(steps, limit, level, tuple(expected))


# -- the probe: forecast beside measured ----------------------------------------------------------------------------


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    if of not in (CLIPS, LONG) or _missing(exam, world):
        return []
    if "latent" not in world.spec.channels:
        return [StepMetric(("rgb", "uncertainty"), _picture_error)]

    def latents(seen, clips: Sequence[Clip], row: int, step: int) -> Results:
        truth = world.render(world.observe(evidence(clips, world.spec, row), None, make_rng(0)), ("latent",))["latent"]
        return {"latent": seen["latent"], "true latent": truth.cpu(), "expected": seen["uncertainty"]}

    return [StepMetric(("latent", "uncertainty"), latents)]


def _picture_error(seen, clips: Sequence[Clip], row: int, step: int) -> Results:
    error = (seen["rgb"].float() - rows_at(clips, "rgb", row).float()).abs().mean((1, 2, 3)) / 255
    return {"off": error, "expected": seen["uncertainty"]}


def errors_of(dreamt: Results) -> torch.Tensor:
    """The error [n, T] of the rollouts, in the unit of `uncertainty`."""
    if "off" in dreamt:
        return dreamt["off"]
    truth = dreamt["true latent"]
    unit = truth.flatten(0, 1).std(0, correction=0).clamp_min(1e-6)
    return ((dreamt["latent"] - truth) / unit).square().mean(-1).sqrt()


def _horizons(chance: float, most: float = math.inf) -> Callable[[torch.Tensor], torch.Tensor]:
    """Of mean curves [R, T] of an error: the steps within trust [R], `most` at most."""

    def steps(curves: torch.Tensor) -> torch.Tensor:
        levels = [trust_level(first, chance) for first in curves[:, 0].tolist()]
        return _change_points(curves, torch.tensor(levels, dtype=torch.float64)).clamp(max=most)

    return steps


def trust_figures(
    expected: torch.Tensor, error: torch.Tensor, chance: float, most: int | None = None
) -> dict[str, tuple[Figure, str]]:
    """Name -> (figure, note): the forecast horizon, the measured one, in steps, and, where trust ends within the rollouts, the
    second over the first. Of rollouts [n, T]; intervals are over rollouts, the same resamples for all. most: of the forecast, the
    horizon of the world's card (`measured_trust`)."""
    limit, figures = error.shape[1], {}
    forecast, measured = _horizons(chance, math.inf if most is None else most), _horizons(chance)
    for what, curves, steps in (("forecast", expected, forecast), ("measured", error, measured)):
        figure = curve_interval(curves, steps, make_rng(0))
        level = trust_level(float(curves[:, 0].double().mean()), chance)
        note = f"mean error of {level:.3g}" + ("" if figure.value < limit else "; not reached in these rollouts")
        if steps is forecast and figure.value == most:
            note = "the measured horizon of the world's card: it is trusted for no longer"
        figures[what] = figure, note

    def ratio(curves: torch.Tensor) -> torch.Tensor:
        return measured(curves[:, limit:]) / forecast(curves[:, :limit]).clamp_min(1)

    if max(figure.value for figure, _ in figures.values()) < limit:
        both = torch.cat([expected.double(), error.double()], 1)
        figures["measured over forecast"] = curve_interval(both, ratio, make_rng(0)), "the aim is 0.67 to 1.5"
    return figures


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    """Of the longest rollouts of each place."""
    report = ProbeReport()
    for place in exam.places:
        for arm, world in exam.arms.items():
            dreamt = results.dreamt(LONG, arm, place, PREDICTED) or results.dreamt(CLIPS, arm, place, PREDICTED)
            if "expected" not in dreamt:
                continue
            error = errors_of(dreamt)
            figures = trust_figures(dreamt["expected"], error, chance_error(world.spec), measured_trust(world.spec))
            for what, (figure, note) in figures.items():
                unit, name = "" if "over" in what else "steps", f"trust horizon, {what}"
                report.rows.append(
                    Row("trust", "", name, unit, place, arm, PREDICTED, error.shape[1], figure, note=note)
                )
    return report


def _missing(exam: Exam, world: World) -> str:
    if not math.isfinite(chance_error(world.spec)):
        return "needs uncertainty, a channel of the world, and what two random observations differ by"
    return "" if "latent" in world.spec.channels or "rgb" in exam.shared(world, "rgb") else "needs rgb"


TRUST = Probe("trust", "For how long can it be trusted?", LEAD, _missing, _report, _watch)
