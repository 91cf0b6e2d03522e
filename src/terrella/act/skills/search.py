"""The slow planner: the order and the arguments of skills that are likeliest to reach a goal in words."""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from ...core.errors import PlanningError
from ...core.similar import did_you_mean
from ...core.world import Observation
from ..sentences import words_of
from .library import Skill, SkillLibrary
from .observed_goal import ObservedGoal
from .phrases import ARTICLES, PRONOUNS, Phrase, completed, goal_of, things_of

STEP_COST = 0.002  # of a step, in nats: of two orders that are as likely the shorter one
LEAST_ENDS = 4  # ends of the same instruction from which these alone are what it brings about
LIKELY = 0.5  # the probability above which a skill needs no other before it
MOST_ENDS = 64  # ends at which an instruction is judged


@dataclass(frozen=True)
class SkillForecast:
    """What is expected of an instruction before it begins."""

    text: str
    skill: Skill
    probability: float  # that it works
    spread: float  # standard deviation of that over the states in which it may begin
    steps: float  # that it takes

    @property
    def cost(self) -> float:
        return STEP_COST * self.steps - math.log(max(self.probability, 1e-9))


@dataclass(frozen=True)
class SkillPlan:
    """Instructions in their order."""

    steps: tuple[SkillForecast, ...]
    imagined: float | None = None  # the share of its rollouts in a world that carry it out

    @property
    def probability(self) -> float:
        return math.prod(step.probability for step in self.steps)

    @property
    def cost(self) -> float:
        """In nats: what is unlikely, and what takes long."""
        return sum(step.cost for step in self.steps)

    def __str__(self) -> str:
        return ", then ".join(f"{step.text} ({step.probability:.0%})" for step in self.steps)


Groups = tuple[tuple[tuple[str, ...], ...], ...]  # groups of phrases, each the instructions that it may stand for


@dataclass(frozen=True)
class SkillSearch:
    """Searches with the predictions of a library as costs (skills to symbols, Konidaris et al. 2018): an instruction works where
    another ended as often as the recorded ends of that one suit it, beside any start."""

    library: SkillLibrary
    least: float = 0.05  # plans that are less likely are refused
    _after: dict[tuple[str, str], SkillForecast] = field(default_factory=dict)
    _starts: dict[str, float] = field(default_factory=dict)

    def instructions_of(self, goal: str) -> Groups:
        """The instructions that the phrases of a goal may stand for; "it", and what a phrase leaves out, is a thing that an
        earlier one names. PlanningError for unknown words, or what no skill does."""
        goal = self.library.spelled_out(goal)
        words, groups = self.library.network.words, goal_of(goal, lambda phrase: bool(self._fits(phrase)))
        assert words is not None
        unknown = [
            word for word in words.unknown(" ".join(itertools.chain(*groups))) if word not in (*ARTICLES, *PRONOUNS)
        ]
        if unknown:
            hint = did_you_mean(unknown[0], words.vocabulary) or "."
            names = ", ".join(f"'{word}'" for word in unknown)
            raise PlanningError(
                f"the skills do not know {names} in '{goal}'{hint} They know {', '.join(words.vocabulary)}."
            )
        if not groups:
            raise PlanningError("say what to do, as in --goal 'go to the red ball, then pick up the blue key'.")
        things, read = list[str](), list[tuple[tuple[str, ...], ...]]()
        for group in groups:
            read.append(tuple(self._instructions(phrase, things) for phrase in group))
            for texts in read[-1]:
                things = [*things_of(texts[0]), *things]  # the last phrase first
        return tuple(read)

    def towards(self, goal: ObservedGoal, seen: Observation) -> Groups:
        """The instructions that bring a goal about; where they are unlikely to work from an observation [1, ...], after any other.
        PlanningError if none does."""
        last = (goal.instructions(self.library),)
        alone: Groups = (last,)
        first = self._cheapest(alone, seen, 1)[0]
        if first.probability > LIKELY:
            return alone
        after: Groups = ((tuple(dict.fromkeys(text for text in self.library.end_texts if text)),), last)
        return min((alone, after), key=lambda groups: self._cheapest(groups, seen, 1)[0].cost)

    def _instructions(self, phrase: str, things: Sequence[str]) -> tuple[str, ...]:
        fits = self._fits(phrase)
        if len(fits) != 1:
            fits = next(filter(None, map(self._fits, completed(phrase, things))), fits)
        if not fits:
            names = "; ".join(skill.name for skill in self.library.skills)
            left_out = [Phrase.of(one) for one in (self.library.card or {}).get("without_effect", ())]
            dull = any(one.fillings(words_of(phrase)) for one in left_out)
            why = ", for its end looks like any other moment" if dull else ""
            raise PlanningError(f"no skill does '{phrase}'{why}. There are: {names}.")
        return fits

    def _fits(self, phrase: str) -> tuple[str, ...]:
        """The instructions that a phrase leaves open; () where no skill does it."""
        words = self.library.network.words
        assert words is not None
        spelled = [word if word in ARTICLES else next(iter(words.spelled(word)), word) for word in words_of(phrase)]
        return tuple(dict.fromkeys(text for skill in self.library.skills for text in skill.phrase.fillings(spelled)))

    def plan(self, groups: Groups, seen: Observation) -> SkillPlan:
        """The likeliest order and arguments of all phrases, from an observation [1, ...]. PlanningError where even that is less
        likely than `least`."""
        return self.plans(groups, seen, 1)[0]

    def plans(self, groups: Groups, seen: Observation, count: int) -> list[SkillPlan]:
        """The `count` likeliest plans, or fewer where there are no more. PlanningError as of `plan`."""
        plans = self._cheapest(groups, seen, count)
        if plans[0].probability < self.least:
            raise PlanningError(_why_hopeless(plans[0]))
        return plans

    def _cheapest(self, groups: Groups, seen: Observation, count: int) -> list[SkillPlan]:
        now = self._now(seen, tuple(itertools.chain(*itertools.chain(*groups))))
        tie, queue = itertools.count(), [(0.0, 0, 0, frozenset[int](), tuple[SkillForecast, ...]())]
        reached: Counter[tuple[int, frozenset[int], str]] = Counter()
        plans: list[SkillPlan] = []
        while queue and len(plans) < count:
            cost, _, at, done, steps = heapq.heappop(queue)
            if at < len(groups) and len(done) == len(groups[at]):
                at, done = at + 1, frozenset()
            if at == len(groups):
                plans.append(SkillPlan(steps))
                continue
            last = steps[-1].text if steps else ""
            reached[at, done, last] += 1
            if reached[at, done, last] > count:
                continue
            for number, texts in enumerate(groups[at]):
                for text in texts if number not in done else ():
                    step = self.after(last, text) if last else now[text]
                    heapq.heappush(queue, (cost + step.cost, next(tie), at, done | {number}, (*steps, step)))
        return plans

    def after(self, before: str, text: str) -> SkillForecast:
        """The forecast of an instruction at the ends of another."""
        if (before, text) not in self._after:
            texts, skill = self.library.end_texts, self.library.skill_of(before)
            rows = [row for row, each in enumerate(texts) if each == before]
            if len(rows) < LEAST_ENDS:
                rows = [row for row, each in enumerate(texts) if each and self.library.skill_of(each) is skill]
            seen = {name: value[rows[:MOST_ENDS]] for name, value in self.library.ends.items()}
            self._after[before, text] = self._forecasts(seen, [text] * min(len(rows), MOST_ENDS), [text])[0]
        return self._after[before, text]

    def _usual(self, text: str) -> float:
        """How well an instruction suits the starts of any: at them what it asks for may be out of sight, or not be there."""
        if text not in self._starts:
            rows = [row for row, each in enumerate(self.library.end_texts) if not each]
            seen = {name: value[rows] for name, value in self.library.ends.items()}
            self._starts[text] = float(self.library.outlook(seen, [text] * len(rows)).suits.mean()) if rows else 1.0
        return self._starts[text]

    def now(self, text: str, seen: Observation) -> SkillForecast:
        """The forecast of an instruction at an observation [1, ...]."""
        return self._now(seen, (text,))[text]

    def _now(self, seen: Observation, texts: tuple[str, ...]) -> dict[str, SkillForecast]:
        channels = [name for name in seen if name in self.library.ends]
        repeated = {name: seen[name].expand(len(texts), *seen[name].shape[1:]) for name in channels}
        return {one.text: one for one in self._forecasts(repeated, texts, texts)}

    def _forecasts(self, seen: Observation, every: Sequence[str], texts: Sequence[str]) -> list[SkillForecast]:
        """Of each text over its share of the observations."""
        outlook, forecasts = self.library.outlook(seen, every), []
        suits, steps = (each.view(len(texts), -1).cpu() for each in (outlook.suits, outlook.log_steps.expm1()))
        for number, text in enumerate(texts):
            skill = self.library.skill_of(text)
            assert skill is not None
            usual = self._usual(text)
            p = skill.works * (suits[number] / usual).clamp_max(1.0)
            spread = float(p.std()) if len(p) > 1 else 0.0
            forecasts.append(SkillForecast(text, skill, float(p.mean()), spread, float(steps[number].mean())))
        return forecasts


def _why_hopeless(plan: SkillPlan) -> str:
    weak = min(plan.steps, key=lambda step: step.probability)
    place = plan.steps.index(weak)
    where = f"where '{plan.steps[place - 1].text}' ends" if place else "from here"
    return (
        f"no order of these skills is likely to work: the best, {plan}, has {plan.probability:.1%}, for '{weak.text}' "
        f"seldom begins {where} in the recordings."
    )


def undone(plan: SkillPlan, at: int, groups: Groups) -> Groups:
    """The groups without the phrases that the first `at` steps of a plan carried out; each takes one phrase, in order."""
    left = [list(group) for group in groups]
    for step in plan.steps[:at]:
        group = next(each for each in left if each)
        group.remove(next(texts for texts in group if step.text in texts))
    return tuple(tuple(group) for group in left if group)
