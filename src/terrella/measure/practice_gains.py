"""What practice in a world gained inside it and outside, beside a blind arm, and whether failures outside stay failures inside."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from .policy_evaluation import DREAM, REAL, REPLAY, RETURN, SUCCESS, Scores, percent, with_interval
from .statistics import Figure, mean_interval, wilson

BEFORE, AFTER, BLIND = "before", "after", "blind"
INSIDE, OUTSIDE = "inside", "outside"
FEWEST = 300  # episodes of a result that can be trusted
KEPT = 0.95  # share of failures that must stay failures
PLACES = {INSIDE: DREAM, OUTSIDE: REAL}


@dataclass(frozen=True)
class PracticeGains:
    """Scores by place (inside, outside) and policy (before, after, blind), and gains over `before` by place and policy, from the
    same starts. failures: the share of episodes that failed outside and fail inside under the same actions; successes likewise."""

    what: str  # success or return
    scores: Mapping[str, Mapping[str, Figure]]
    gains: Mapping[str, Mapping[str, Figure]]
    failures: Figure | None
    successes: Figure | None

    def to_json(self) -> dict[str, Any]:
        return {"verdict": self.verdict(), **asdict(self)}

    def verdict(self) -> list[str]:
        """Sentences, a warning first where there is one."""
        inside, outside = (self.gains.get(place, {}).get(AFTER) for place in (INSIDE, OUTSIDE))
        assert inside is not None
        if outside is None:
            return [
                f"Not measured outside: name the environment with --real. Inside the world it gains {self.say(inside)}."
            ]
        lines = []
        if inside.low > 0 and not outside.low > 0:
            why = "practice used errors of the world, or the gain is too small for so few episodes"
            lines.append(
                f"Warning: {self.say(inside)} inside the world and no gain outside, {self.say(outside)}: {why}."
            )
        elif outside.low > 0:
            lines.append(f"It gains {self.say(outside)} outside, and {self.say(inside)} inside the world.")
        else:
            worse = "It is worse" if outside.high < 0 else "It gains nothing"
            lines.append(f"{worse} outside, {self.say(outside)}, and {self.say(inside)} inside the world.")
        return [*lines, *self._warnings(outside)]

    def _warnings(self, outside: Figure) -> list[str]:
        lines, blind = [], self.gains[OUTSIDE].get(BLIND)
        if blind is not None and blind.low > 0 and outside.low > 0 and blind.high >= outside.low:
            lines.append(
                f"Warning: the blind arm gains {self.say(blind)} outside, too: the world's observations are not why."
            )
        if self.failures is not None and self.failures.count and self.failures.value < KEPT:
            kept = f"only {percent(self.failures)} of the failures outside fail inside (bar {KEPT:.0%})"
            lines.append(f"Warning: {kept}: the world rewards what does not work.")
        if outside.count < FEWEST:
            lines.append(f"Only {outside.count} episodes: {FEWEST} or more settle it (--episodes).")
        return lines

    def say(self, figure: Figure) -> str:
        """A gain with its interval."""
        if self.what != SUCCESS:
            return with_interval(figure)
        points = [
            f"{100 * value:+.1f}" if math.isfinite(value) else "unknown"
            for value in (figure.value, figure.low, figure.high)
        ]
        return f"{points[0]} points [{points[1]}, {points[2]}]"

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Heads and rows: a row for each place and arm."""
        say, rows = percent if self.what == SUCCESS else with_interval, []
        for place, scores in self.scores.items():
            for arm, gain in self.gains[place].items():
                rows.append([f"{place}, {arm}", say(scores[BEFORE]), say(scores[arm]), self.say(gain)])
        return [self.what, BEFORE, AFTER, "gain"], rows

    def replay_lines(self) -> list[str]:
        """How far outcomes outside are kept inside, under the same actions."""
        kept = {"failures stay failures": self.failures, "successes stay successes": self.successes}
        return [
            f"{name}: {percent(each)} of {each.count}" for name, each in kept.items() if each is not None and each.count
        ]


def practice_gains(scores: Mapping[str, Scores], seed: int) -> PracticeGains:
    """The gains of policies over that named `before`, episode by episode. scores: policy -> arm -> measure -> [N]."""
    what = SUCCESS if SUCCESS in scores[BEFORE][DREAM] else RETURN
    rng = lambda: torch.Generator().manual_seed(seed)  # noqa: E731  # the same resamples for all
    figures: dict[str, dict[str, Figure]] = {}
    gains: dict[str, dict[str, Figure]] = {}
    for place, arm in PLACES.items():
        values = {name: arms[arm][what].double() for name, arms in scores.items() if arm in arms}
        if values:
            figures[place] = {name: _figure(each, what, rng()) for name, each in values.items()}
            gains[place] = {
                name: mean_interval(each - values[BEFORE], rng()) for name, each in values.items() if name != BEFORE
            }
    failures, successes = _kept(list(scores.values())) if what == SUCCESS else (None, None)
    return PracticeGains(what, figures, gains, failures, successes)


def _figure(values: torch.Tensor, what: str, rng: torch.Generator) -> Figure:
    return wilson(int(values.sum()), len(values)) if what == SUCCESS else mean_interval(values, rng)


def _kept(scores: Sequence[Scores]) -> tuple[Figure | None, Figure | None]:
    """The shares of real failures and of real successes that are the same in the replay, of all policies together."""
    pairs = [(arms[REAL][SUCCESS] > 0, arms[REPLAY][SUCCESS] > 0) for arms in scores if REPLAY in arms]
    if not pairs:
        return None, None
    real, replay = (torch.cat(each) for each in zip(*pairs))
    return wilson(int((~real & ~replay).sum()), int((~real).sum())), wilson(int((real & replay).sum()), int(real.sum()))
