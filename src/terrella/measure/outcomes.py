"""Outcomes: predictions of reward, of single numbers such as health, and of the end of the episode."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from ..core.errors import DatasetError
from ..core.spec import Spec, neutral_action
from ..core.world import World
from .clips import Clip, Where, recorded_channels, runs
from .exam import CLIPS, ENDINGS, Exam, ExamResults, Probe
from .rollouts import Results, StepMetric
from .scorecard import COPY_LAST, EARLY, PREDICTED, ProbeReport, Row
from .statistics import Figure, mean_interval, wilson

LEAD = (
    "Predictions of reward, of numbers such as health, and of the end: the mean absolute error of the return over the steps, and "
    "its correlation with the recorded return; how well the predicted return separates stretches with more reward than usual, and "
    "the predicted end those that ended (area under the ROC curve: 1 is perfect, 0.5 is chance). Half of these stretches "
    "are from shortly before an end, if there are ends. Ends too early: the share of the clips, none of which ends, that the world "
    "ends; their pictures are compared as if it did not. Where ends come by chance, a correct world ends some, too."
)
USUAL = "the usual reward"


def clips_with_endings(
    cache,
    spec: Spec,
    episodes: Sequence[int],
    context: int,
    horizon: int,
    count: int,
    rng: torch.Generator,
    where: Where | None = None,
) -> tuple[list[Clip], list[np.ndarray]]:
    """`count` clips that may include the end of their episode, and for each the rows before the end, bool [T].

    After the end, the last row is repeated with the neutral action of `spec`. Rows are restricted by `where`; half of the clips
    are from shortly before an end, if there are ends. DatasetError if no episode is long enough."""
    spans = [cache.episodes[number] for number in episodes]
    whole = [part for first, stop in spans for part in runs(cache, first, stop, where, False)]
    long = [(first, stop) for first, stop in whole if stop - first > context + 1]
    ends = cache.done is not None
    ending = [(first, stop) for first, stop in long if ends and bool(np.asarray(cache.done[first:stop]).any())]
    if not long:
        raise DatasetError(f"no episode is longer than the {context} rows of context; record longer ones.")
    passages, neutral = [], neutral_action(spec)
    for number in range(count):
        pool = ending if ending and number % 2 == 0 else long
        first, stop = pool[_whole(rng, len(pool))]
        last = stop - context - 2  # a window has a step after its context
        least = max(first, last - horizon + 2) if pool is ending else first
        passages.append(_passage(cache, neutral, least + _whole(rng, last - least + 1), stop, context, horizon))
    return [clip for clip, _ in passages], [real for _, real in passages]


def outcome_rows(
    exam: Exam, place: str, arm: str, shown: Sequence[Clip], going: torch.Tensor, dreamt: Results
) -> list[Row]:
    """Rows of reward, of single numbers, and of the end. going: bool [n, T], rows before the end; predictions after those do not
    count, except for `done`."""
    context, rng = shown[0].context, exam.rng
    channels = {name: np.stack([clip.channels[name] for clip in shown]) for name in dreamt}
    truth = {name: torch.from_numpy(array.reshape(*array.shape[:2])).double() for name, array in channels.items()}
    rows = []
    for step in exam.config.horizons:
        part = slice(context - 1, context - 1 + step)
        live, where = going[:, part], ("outcomes", "reward")
        tail = place, arm, PREDICTED, step
        if "reward" in dreamt:
            usual = float((truth["reward"][going]).median())
            true = (truth["reward"][:, part] * live).sum(1)
            mine = (dreamt["reward"][:, :step].double() * live).sum(1)
            plain = usual * live.double().sum(1)
            baselines = {USUAL: mean_interval((plain - true).abs(), rng())}
            error, gain = (mine - true).abs(), mean_interval((plain - true).abs() - (mine - true).abs(), rng())
            rows.append(Row(*where, "return error", "", *tail, mean_interval(error, rng()), -1, baselines, gain))
            rows.append(Row(*where, "return correlation", "", *tail, correlation(mine, true), 1))
            more = true > plain + 1e-6
            note = f"{int(more.sum())} of {len(shown)} stretches have more reward"
            rows.append(Row(*where, "pays: AUC", "", *tail, _plain(auc(mine, more), len(shown)), 1, note=note))
        if "done" in dreamt:
            ended = (truth["done"][:, part].bool() & live).any(1)
            note = f"{int(ended.sum())} of {len(shown)} stretches ended"
            figure = _plain(auc(dreamt["done"][:, :step].double().sum(1), ended), len(shown))
            rows.append(Row("outcomes", "done", "ends: AUC", "", *tail, figure, 1, note=note))
        reached = live[:, -1]  # episodes that last until this step
        for name in (name for name in dreamt if name not in ("reward", "done") and reached.any()):
            now, then = truth[name][reached, context - 1], truth[name][reached, context - 1 + step]
            error, copied = (dreamt[name][reached, step - 1].double() - then).abs(), (now - then).abs()
            figures = mean_interval(error, rng()), -1, {COPY_LAST: mean_interval(copied, rng())}
            rows.append(Row("outcomes", name, "error", "", *tail, *figures, mean_interval(copied - error, rng())))
    return rows


def early_ends(exam: Exam, place: str, arm: str, dreamt: Results) -> list[Row]:
    """Rows of the share of clips that the world ends, of which none does. dreamt: whether each step ends it, [n, T]."""
    done, tail = dreamt["done"].bool(), (place, arm, PREDICTED)
    ended = {step: done[:, :step].any(1) for step in exam.config.horizons if step <= done.shape[1]}
    return [
        Row("outcomes", "done", EARLY, "", *tail, step, wilson(int(early.sum()), len(done)), -1)
        for step, early in ended.items()
    ]


def correlation(first: torch.Tensor, second: torch.Tensor) -> Figure:
    """Pearson correlation of [n] each, with the interval of Fisher's z (1921); NaN if one of them is constant."""
    a, b = first - first.mean(), second - second.mean()
    size = float(a.norm() * b.norm())
    if size < 1e-9 or len(a) < 4:
        return _plain(float(a @ b) / size if size >= 1e-9 else math.nan, len(a))
    value = max(-1.0, min(1.0, float(a @ b) / size))
    z, wide = math.atanh(max(-1 + 1e-9, min(1 - 1e-9, value))), 1.96 / math.sqrt(len(a) - 3)
    return Figure(value, math.tanh(z - wide), math.tanh(z + wide), len(a))


def _plain(value: float, count: int) -> Figure:
    return Figure(value, math.nan, math.nan, count)


def auc(score: torch.Tensor, positive: torch.Tensor) -> float:
    """Area under the ROC curve of scores [n]: the probability that a positive outranks a negative, ties counting half."""
    high, low = score[positive], score[~positive]
    if not len(high) or not len(low):
        return float("nan")
    above = (high[:, None] > low).double() + 0.5 * (high[:, None] == low).double()
    return float(above.mean())


def _compared(exam: Exam, world: World) -> list[str]:
    """reward, done, and single numbers that both the world and the clips have."""
    shown = next(iter(exam.sets.get(ENDINGS, {}).values()), None)
    if not shown:
        return []
    single = [name for name, array in shown[0].channels.items() if array[0].size == 1 and name in world.spec.channels]
    return [name for name in single if not name.startswith(("uncertainty", "drifted", "invented"))]


def _watch(exam: Exam, world: World, of: str, first: int) -> list[StepMetric]:
    compared = _compared(exam, world)
    if of == CLIPS and "done" in compared:
        return [StepMetric(("done",), lambda seen, *_: {"done": seen["done"]})]
    names = compared if of == ENDINGS else []
    flat = lambda seen, *_: {name: seen[name].reshape(len(seen[name])).float() for name in names}  # noqa: E731
    return [StepMetric(tuple(names), flat, ends=True)] if names else []


def _report(exam: Exam, results: ExamResults) -> ProbeReport:
    whole = ProbeReport()
    for place, clips, arm, _, dreamt in results.dreams(exam, ENDINGS, (PREDICTED,)):
        going = torch.from_numpy(np.stack(exam.going[place]))
        whole.rows += outcome_rows(exam, place, arm, clips, going, dreamt)
    for place, _, arm, _, dreamt in results.dreams(exam, CLIPS, (PREDICTED,)):
        whole.rows += early_ends(exam, place, arm, dreamt) if "done" in dreamt else []
    return whole


def _missing(exam: Exam, world: World) -> str:
    needs = "needs reward, done or a number such as health, of the world and of the recording"
    return "" if _compared(exam, world) else needs


OUTCOMES = Probe("outcomes", "Rewards, numbers and ends", LEAD, _missing, _report, _watch)


def _passage(cache, neutral: np.ndarray, start: int, stop: int, context: int, horizon: int) -> tuple[Clip, np.ndarray]:
    wanted = start + np.arange(context + horizon)
    rows, real = np.minimum(wanted, stop - 1), wanted < stop - 1
    played = np.asarray(cache.action[rows])
    action = np.where(real[:, None], played, neutral.reshape(-1).astype(played.dtype))
    channels = {name: np.asarray(array[rows]) for name, array in recorded_channels(cache).items()}
    return Clip(channels, action, context, 0, start), real


def _whole(rng: torch.Generator, below: int) -> int:
    return int(torch.randint(max(below, 1), (1,), generator=rng).item())
