"""The command `terrella plan`: reaches a goal in a real environment by planning in a world, beside acting at random."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tyro.conf import Positional

from .. import library, progress
from ..act.planning import (
    NEAR_M,
    Cost,
    Destination,
    FullyObserved,
    Planner,
    PlayedEpisode,
    PlayResult,
    PlaySettings,
    SearchConfig,
    SuccessCriterion,
    distance,
    distance_to,
    negative_reward,
    play,
)
from ..act.policies_by_name import policy_of, proposal_policy
from ..core.errors import PlanningError, TerrellaError
from ..core.files import write_json
from ..core.policy import Policy, Random
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..measure.plan_page import compute_chart, film, film_strip, plan_page
from ..measure.statistics import Figure, mean_interval, wilson
from ..serve.picture import uncertainty_levels
from .beside import STEPS, check_alike, compared, open_copied, open_real, sound
from .compute_curve import Point, compute_of, gain, helped, less
from .goals import REWARD, read_goal
from .named import Device, Environment, device_of, load_named
from .say import Json, Seed, result, say
from .searching import SEARCH_SETTINGS, Searching
from .walking import WALK_S, Walks, is_recording, search_of, views_of

WITHIN = 0.05  # unless it is said


@dataclass(frozen=True)
class _Case:
    """What is asked, with the worlds open."""

    world: World
    real: World
    goal: Mapping[str, torch.Tensor]
    judge: SuccessCriterion
    searching: Searching
    episodes: int
    steps: int
    seed: int
    walks: Walks | None = None

    @property
    def within(self) -> float:
        return self.walks.within_m if self.walks else self.judge.within

    def cost(self) -> Cost:
        return (
            distance_to(self.world, self.goal, self.searching.cost) if self.goal else negative_reward(self.world.spec)
        )

    def planner(self, config: SearchConfig) -> Planner:
        spec, trust = self.world.spec, config.trust
        leaps = (
            bool(spec.leap) and config.block % spec.leap == 0 and self.searching.cost == "last"
        )  # they say no uncertainty
        if (
            trust is None
            and not leaps
            and isinstance(spec.card.get("uncertainty"), dict)
            and (levels := uncertainty_levels(spec))
        ):
            trust = levels[1]
        name = self.searching.proposal
        proposal = None if name is None else proposal_policy(name, self.world)
        return Planner(self.world, self.cost(), replace(config, trust=trust), proposal)

    def walker(self, config: SearchConfig, goal: Destination) -> Policy:
        """Its plans are short: the uncertainty, for which each picture would be drawn, ends them only if --trust asks for it."""
        return goal.navigator(Planner(self.world, goal.cost(self.world), config))

    def planned(self, config: SearchConfig, what: str, keep: tuple[str, ...] = ()) -> PlayResult:
        """Episodes of the planner."""
        if agent := self.searching.agent:
            policy = policy_of(agent, self.real.spec, self.world, self.cost())
        else:
            policy = partial(self.walker, config) if self.walks else self.planner(config)
        return self._played(policy, what, _seen_by(self), keep)

    def floor(self) -> PlayResult:
        """Episodes of acting at random, from the same starts."""
        policy = Random(self.real.spec)
        return self._played((lambda goal: policy) if self.walks else policy, "acting at random", ())

    def _played(self, policy, what: str, sees: tuple[str, ...], keep: tuple[str, ...] = ()) -> PlayResult:
        with progress.shown(what) as report:
            if self.walks:
                return self.walks.played(self.real, policy, self.episodes, self.steps, self.seed, sees, keep, report)
            settings = PlaySettings(self.steps, self.judge, sees, keep, 1 if keep else 0)
            return play(self.real, policy, self.episodes, settings, self.seed, report)


@dataclass(frozen=True)
class Aim:
    """What is to be reached, and when it is.

    Args:
        goal: A picture's file, numbers of the state (0.5,_,0 with _ for any; --goal=-1,0 where the first is negative),
            CHANNEL=VALUE, or reward; in worlds with places the folder of a recording: each episode walks to one of its views.
        within: The distance at which a goal is reached: numbers count in shares of their range, pictures of full brightness;
            default 0.05. Of places, metres; default 0.5.
        apart: Metres from an episode's start, at least, of a recording's view that it walks to.
        success: A channel of the environment that is above 0 where an episode has succeeded (done), in place of --within.
    """

    goal: str = REWARD
    within: float | None = None
    apart: float = 5.0
    success: str | None = None


def plan(
    name: Positional[str],
    environment: Environment,
    searching: Searching,
    aim: Aim,
    real: str | None = None,
    episodes: int = 10,
    steps: int | None = None,
    curve: bool = True,
    out: Path | None = None,
    device: Device = "auto",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Plan in a world, act in the real environment, and say how often that reached the goal, beside acting at random.

    Leaves a page, a film of dream and reality side by side, and all figures in a folder.

    Args:
        name: The world to plan in: what `terrella list` shows, the path of a checkpoint, or a simulator itself (gym:CartPole-v1).
        real: The environment to act in (gym:CartPole-v1); without one, the world itself.
        steps: Of an episode at most; default: the environment's own limit, or 200, for who walks as many as are 30 s.
        curve: Also play with half, a quarter ... of the plans, or of --budget-ms: does thinking longer help?
        out: Folder for the page, the film and plan.json; default: plans/ and the world's name.
    """
    if searching.agent:
        searching.refuse(f"{searching.agent} acts in place of the search", "cost", "proposal", *SEARCH_SETTINGS)
    case = _opened(name, environment, searching, aim, real, episodes, steps, device, seed)
    folder = out or Path("plans") / (re.sub(r"[^\w.-]+", "-", name.strip("/:")) or "world")
    keep = tuple(dict.fromkeys((*_seen_by(case), *compared(case.world.spec, case.real.spec), *_pictured(case))))
    mine = case.planned(case.searching.search, "acting" if searching.agent else "planning", keep)
    floor = case.floor()
    points = _curve(case, mine) if curve and not searching.agent else []
    about = {"world": name, "real": real or name, **asdict(aim), "within": case.within}
    acting = asdict(case.searching)
    asked = {key: value for key, value in (acting.pop("search") | acting).items() if value is not None}
    facts = {
        **about,
        **asked,
        "steps": case.steps,
        "episodes": episodes,
        "seed": seed,
        "solved_starts_left_out": mine.skipped,
    }
    folder.mkdir(parents=True, exist_ok=True)
    lines, whole = _report(case, mine, floor, points, facts, folder)
    write_json(folder / "plan.json", sound(whole))
    del whole["played"], whole["divergence"]
    result(sound(whole), json, "\n".join([*lines, f"the page: {folder / 'plan.html'}"]))


def _report(
    case: _Case, mine: PlayResult, floor: PlayResult, points: list, facts: Mapping[str, object], folder: Path
) -> tuple[list[str], dict[str, Any]]:
    """Writes the page and the film; what came of it in words, and all of it."""
    arms = {"planner": _figures(mine, case.seed), "random": _figures(floor, case.seed)}
    what = "success" if "success" in arms["planner"] else "return"
    lines = _lines(case, mine, arms, points, what)
    divergence, picture, filmed = _filmed(
        case, next((one for one in mine.episodes if one.seen), mine.episodes[0]), folder
    )
    curve = [(point.imagined, point.worth) for point in points]
    chart = compute_chart(curve, arms["random"][what], what) if curve else ""
    page = plan_page(f"{facts['world']}: {facts['goal']}", lines, arms, chart, picture, filmed, facts)
    (folder / "plan.html").write_text(page, encoding="utf-8")
    return lines, {
        **facts,
        **{arm: _plain(figures) for arm, figures in arms.items()},
        "difference": _plain({what: gain(mine, floor, what, case.seed)}),
        "curve": [
            {"with": point.words, "imagined": point.imagined, **_plain(_figures(point.played, case.seed))}
            for point in points
        ],
        "divergence": divergence,
        "played": [_told(episode) for episode in mine.episodes],
        "page": str(folder / "plan.html"),
        "film": str(folder / filmed) if filmed else "",
    }


def _opened(name, environment, searching, aim, real, episodes, steps, device, seed) -> _Case:
    """The worlds by their names, held to each other; a sentence for what does not fit."""
    apart_m, within = aim.apart, aim.within
    if episodes < 1 or (steps is not None and steps < 1) or not (within is None or within > 0) or not apart_m >= 0:
        raise TerrellaError(
            "--episodes and --steps are whole numbers from 1 up, --within is above 0, and --apart is 0 or more."
        )
    truth = library.is_truth(name)
    world = FullyObserved(open_copied(name, environment)) if truth else load_named(name, device_of(device))
    if not world.spec.observes:
        raise PlanningError(f"{name} observes nothing, so nobody can tell it where the episode stands.")
    acted = world if real in (None, name) else open_real(real, environment, world.spec)
    check_alike(world.spec, acted.spec)
    if aim.success and aim.success not in acted.spec.channels:
        raise PlanningError(
            f"{acted.spec.name} has no channel '{aim.success}'; it has {', '.join(acted.spec.channels)}."
        )
    wanted = {} if is_recording(aim.goal) else read_goal(aim.goal, world.spec)
    views = None if aim.success else views_of(aim.goal, wanted, world, acted.spec)
    if views is not None:
        searching.refuse("who walks to places plans the way by the distance", "cost", "proposal", "agent")
        settled = searching.filled(**search_of(world.spec))
        walks = Walks(views, apart_m, within or NEAR_M)
        if len(views) > 1 and apart_m <= walks.within_m:
            raise TerrellaError(f"--apart is more than the {walks.within_m:g} m within which a view is reached.")
        limit = steps or acted.spec.max_episode_steps or round(WALK_S / acted.spec.dt_s)
        case = _Case(world, acted, wanted, SuccessCriterion(), settled, episodes, limit, seed, walks)
        case.walker(settled.search, Destination(views[0]))
        return case
    judge = _judge(aim, wanted, acted.spec)
    limit = steps or acted.spec.max_episode_steps or STEPS
    if not wanted:
        searching.refuse("a reward is summed up to the end of the episode", "cost")
    case = _Case(world, acted, wanted, judge, searching.filled(), episodes, limit, seed)
    case.planner(case.searching.search)  # what does not fit is said before anything is played
    return case


def _judge(aim: Aim, wanted: Mapping[str, torch.Tensor], real: Spec) -> SuccessCriterion:
    judged = {} if aim.success or any(at not in real.channels for at in wanted) else wanted
    if wanted and not judged and not aim.success:
        raise PlanningError(
            f"{real.name} does not show {', '.join(wanted)}, so nobody can tell whether the goal is reached: name a "
            "channel that can with --success."
        )
    return SuccessCriterion({at: value[None] for at, value in judged.items()}, aim.within or WITHIN, aim.success or "")


def _seen_by(case: _Case) -> tuple[str, ...]:
    return (*case.world.spec.observes, *(at for at in case.world.spec.may_observe if at in case.real.spec.channels))


def _pictured(case: _Case) -> tuple[str, ...]:
    return ("rgb",) if "rgb" in case.real.spec.channels else ()


def _figures(played: PlayResult, seed: int) -> dict[str, Figure]:
    episodes = played.episodes
    count = len(episodes)
    ms, imagined = ([value for one in episodes for value in getattr(one, name)] for name in ("ms", "imagined"))
    figures = {}
    if episodes[0].success is not None:
        figures["success"] = wilson(sum(bool(one.success) for one in episodes), count)
    figures["return"] = mean_interval(torch.tensor([one.reward for one in episodes]), make_rng(seed))
    figures["steps"] = mean_interval(torch.tensor([float(one.steps) for one in episodes]), make_rng(seed))
    if ms:
        figures["ms a decision"] = _middle(ms)
    if imagined:
        figures["steps imagined"] = _middle(imagined)
    return figures


def _middle(values: list) -> Figure:
    """The median, with the 5th and the 95th percentile."""
    low, middle, high = np.percentile(values, (5, 50, 95)).tolist()
    return Figure(middle, low, high, len(values))


def _curve(case: _Case, mine: PlayResult) -> list[Point]:
    """The same starts with less and less compute, up to what was asked; nothing where a search imagines nothing."""
    points = []
    asked = case.searching.search
    for config in [*less(asked), asked]:
        played = mine if config is asked else case.planned(config, f"planning with {compute_of(config)}")
        figures = _figures(played, case.seed)
        if "steps imagined" in figures:
            worth = figures["success" if "success" in figures else "return"]
            points.append(Point(config, figures["steps imagined"].value, worth, played))
    return points


def _lines(
    case: _Case, mine: PlayResult, arms: Mapping[str, Mapping[str, Figure]], points: list[Point], what: str
) -> list[str]:
    """What came of it, for people."""
    count, planner, floor = len(mine.episodes), arms["planner"], arms["random"]
    lines = []
    if "success" in planner:
        lines.append(
            f"reached in {_share(planner['success'])} of {count} episodes; at random {_share(floor['success'])}"
        )
    gained = f"{planner['return']}; at random {floor['return']}"
    if "reward" in case.real.spec.channels:
        lines.append(f"return {gained}")
    lost = sum(not one.steps for one in mine.episodes)
    if lost:
        lines.append(f"to {lost} of the goals no way was known")
    if took := planner.get("ms a decision"):
        imagined = f" for {planner['steps imagined'].value:,.0f} imagined steps" if "steps imagined" in planner else ""
        lines.append(f"a decision takes {took.value:.0f} ms (95% within {took.high:.0f}){imagined}")
    if mine.skipped:
        lines.append(f"{mine.skipped} starts were already solved and left out")
    if (case.goal or case.walks) and planner.get("success") and not planner["success"].value:
        nearest = min(one.nearest for one in mine.episodes)
        measured = case.judge.goal or case.walks
        away = f"; the nearest that it came is {nearest:.3g} (asked: {case.within:g})" if measured else ""
        best = min(one.best_cost for one in mine.episodes)
        cost = f"; the best plan in the world cost {best:.3g}" if math.isfinite(best) else ""
        lines.append(f"the goal was never reached{away}{cost}: it may be impossible")
    lines += [f"{point.imagined:>10,.0f} imagined steps, {point.words}: {what} {point.worth}" for point in points]
    if len(points) > 1:
        lines.append(helped(points, what, case.seed))
    if case.searching.search.budget_ms is not None:
        lines.append("planned by the clock: another run may differ")
    return lines


def _share(figure: Figure) -> str:
    return f"{figure.value:.0%} [{figure.low:.0%}, {figure.high:.0%}]"


def _plain(figures: Mapping[str, Figure]) -> dict[str, object]:
    return {name: asdict(figure) for name, figure in figures.items()}


def _told(episode: PlayedEpisode) -> dict[str, object]:
    told: dict[str, Any] = {"steps": episode.steps, "return": episode.reward, "success": episode.success}
    return {**told, "nearest": episode.nearest, "ended": episode.ended, "best_cost": episode.best_cost}


@torch.no_grad()
def _filmed(
    case: _Case, episode: PlayedEpisode, folder: Path
) -> tuple[dict[str, list[float]], Image.Image | None, str]:
    """The dream of an episode, from its first observation under its actions: the divergence in each channel, a strip of both,
    and the film's file, "" where there are no pictures."""
    seen, names = episode.seen, compared(case.world.spec, case.real.spec)
    shown = tuple(name for name in (*names, *_pictured(case)) if name in case.world.spec.channels)
    first = {name: seen[0][name][None] for name in _seen_by(case)}
    rng, dreamt = make_rng(case.seed), []
    state = case.world.observe(first, None, rng)
    for action in [*episode.actions, None]:
        dreamt.append({name: value[0].cpu() for name, value in case.world.render(state, shown).items()})
        state = state if action is None else case.world.imagine(state, action[None], rng)
    divergence = {}
    for name in names:
        one, other = (torch.stack([frame[name] for frame in frames]) for frames in (seen, dreamt))
        divergence[name] = distance(case.real.spec, {name: one}, {name: other}).tolist()
    if "rgb" not in seen[0]:
        say("No film: the environment shows no pictures.")
        return divergence, None, ""
    rows = {"reality": torch.stack([frame["rgb"] for frame in seen]).numpy()}
    if "rgb" in shown:
        height, width = rows["reality"].shape[1:3]
        frames = [Image.fromarray(frame["rgb"].numpy()).resize((width, height)) for frame in dreamt]
        rows["dream"] = np.stack([np.asarray(frame) for frame in frames])
    what = next(iter(sorted(names, key=lambda name: name == "rgb")), "")
    curve = divergence[what] if what else [0.0] * len(seen)
    film(folder / "plan.mp4", rows, curve, f"divergence in {what}" if what else "", 1 / case.real.spec.dt_s)
    return divergence, film_strip(rows), "plan.mp4"
