"""What `plan` plays: the worlds, opened and checked, and the planner in them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from .. import library
from ..act.planning import (
    NEAR_M,
    Cost,
    Destination,
    FullyObserved,
    Planner,
    PlayResult,
    PlaySettings,
    SearchConfig,
    SuccessCriterion,
    distance_to,
    negative_reward,
    play,
    within_measured_trust,
)
from ..act.planning.episodes import PlayInterrupted
from ..act.planning.routes import NoRoute
from ..act.policies_by_name import policy_of, proposal_policy
from ..core.errors import PlanningError, TerrellaError
from ..core.policy import Policy, Random
from ..core.spec import Spec, cuts_plans
from ..core.world import World
from ..serve.picture import uncertainty_levels
from .compute_curve import CurvePoint, compute_of, figures_of, halved
from .goals import REWARD, read_goal
from .opening import Device, EnvironmentConfig, device_of, load_named
from .place_goals import WALK_S, PlaceGoals, is_recording, views_of, walking_defaults
from .plan_energy import DecisionCost, PlanBudget, priced
from .progress import Progress, stage, stopping_with
from .real_environment import STEPS, check_alike, comparable_channels, open_copied, open_real, refuse_randomised
from .trust import search_within_trust, trusted_searches

WITHIN = 0.05  # default distance at which a goal is reached, where it is no place


@dataclass(frozen=True)
class PlanConfig:
    """Settings of `plan`."""

    # What to reach. `reward`: the highest return. A picture file. Numbers: the state, as in 0.5,_,0, where _ matches any value;
    # write --goal=-1,0 if the first is negative. CHANNEL=VALUE. The folder of a recording, in a world with places: each episode
    # walks to one of the recorded views.
    goal: str = REWARD
    # Distance at which the goal is reached: for numbers a share of their range and for pictures a share of full brightness
    # (default 0.05), for places metres (default 0.5).
    within: float | None = None
    apart: float = 5.0
    """With a recording as the goal: metres, at least, between the start of an episode and the view that it walks to."""
    success: str | None = None
    """Channel of the environment that is above 0 when an episode has succeeded (for example done), instead of --within."""
    search: SearchConfig = SearchConfig()
    cost: Literal["sum", "last", "least"] = "sum"
    """Cost of a plan to a goal: the sum of the distances of all steps, the distance after the last, or the least distance."""
    proposal: str | None = None
    """A policy whose plans the search also tries: a folder of `train goals`, or a policy name as for `terrella evaluate`."""
    agent: str | None = None
    """A policy that acts instead of the search: a folder, or a policy name as for `terrella evaluate`."""
    skills: Path | None = None
    """A library of `terrella skills learn`: the goal is a sentence, reached by the likeliest order of its skills; or a picture,
    numbers or CHANNEL=VALUE, reached by skills that end there. Without --goal each episode has the environment's instruction."""
    watts: float | None = None
    """Power that planning may take, in watts, at one decision each --replan moves: for it down to a sixteenth of the plans and
    one round are searched, and the result says how many, or that it is not kept. Without an energy counter that may be read,
    watts are estimated from processor time."""
    memory_mb: float | None = None
    """Memory that the futures of one episode may take, in MiB: fewer plans a round are searched to keep it, and the result says
    how many."""
    rollouts: int = 0
    """With --skills: rollouts in the world of each of the four likeliest plans, to choose among them. Default: 0, none."""
    real: str | None = None  # The environment to act in (gym:CartPole-v1); default: the world itself.
    environment: EnvironmentConfig = EnvironmentConfig()
    episodes: int = 10  # Number of episodes.
    steps: int | None = None
    """Steps per episode at most; default: the environment's limit, else 200, or 30 s to walk to a place."""
    curve: bool = True
    """Whether to measure how much more compute helps. --no-curve: do not plan again with a half, a quarter, ... of --samples
    or --budget-ms, which shows whether more compute helps."""
    out: Path | None = None  # Folder for the page, the film and plan.json; default: plans/ and the world's name.
    device: Device = "auto"
    seed: int = 0  # The same seed gives the same result.


@dataclass(frozen=True)
class PlannedEpisodes:
    """What `plan` played."""

    planner: PlayResult
    random: PlayResult | None = None  # Random actions from the same starts; None if it was stopped before.
    curve: tuple[CurvePoint, ...] = ()  # The planner with ever more compute.
    stopped: bool = False  # Whether Ctrl-C ended it early.
    cut: int = 0  # Where all were played at once when it was stopped: the steps that they had done.


@dataclass(frozen=True)
class PlanStudy:
    """The worlds of `plan`, opened and checked."""

    config: PlanConfig
    search: SearchConfig  # The search with its defaults filled in.
    world: World
    real: World
    goal: Mapping[str, torch.Tensor]  # channel -> value; {} for reward or places.
    criterion: SuccessCriterion
    steps: int
    progress: Progress
    places: PlaceGoals | None = None
    decision: DecisionCost | None = None  # None for an agent, which does not search.

    @property
    def within(self) -> float:
        return self.places.within_m if self.places else self.criterion.within

    @property
    def sees(self) -> tuple[str, ...]:
        """The channels that the planner is shown."""
        optional = (name for name in self.world.spec.may_observe if name in self.real.spec.channels)
        return (*self.world.spec.observes, *optional)

    @property
    def pictures(self) -> tuple[str, ...]:
        return ("rgb",) if "rgb" in self.real.spec.channels else ()

    def run(self) -> PlannedEpisodes:
        """Plays the planner, random actions from the same starts, and the compute curve. Ctrl-C ends it with what is done."""
        kept = (*self.sees, *comparable_channels(self.world.spec, self.real.spec), *self.pictures)
        what = "acting" if self.config.agent else "planning"
        try:
            played = self._planned(self.search, what, tuple(dict.fromkeys(kept)))
        except PlayInterrupted as stop:
            return self._stopped(stop)
        random, points = None, list[CurvePoint]()
        try:
            policy = Random(self.real.spec)
            random = self._play((lambda goal: policy) if self.places else policy, "acting at random")
            if self.config.curve and not self.config.agent:
                for config in [*halved(self.search), self.search]:
                    self._add_point(points, config, played)
        except KeyboardInterrupt:
            return PlannedEpisodes(played, random, tuple(points), stopped=True)
        return PlannedEpisodes(played, random, tuple(points))

    def _stopped(self, stop: PlayInterrupted) -> PlannedEpisodes:
        """The episodes that are done. Where all are played at once: their steps so far, beside random ones from the same starts,
        for those that are over sooner are no fair sample."""
        if stop.done.episodes:
            return PlannedEpisodes(stop.done, stopped=True)
        if not stop.begun:
            raise KeyboardInterrupt("stopped before the first decision.") from None
        count, cut = len(stop.begun), max(episode.steps for episode in stop.begun)
        begun, random = PlayResult(stop.begun, stop.done.skipped), None
        try:
            if not self.places:
                beside = replace(self, steps=cut)._play(Random(self.real.spec), "acting at random")
                random = replace(beside, episodes=beside.episodes[:count])
        except KeyboardInterrupt:
            pass
        return PlannedEpisodes(begun, random, stopped=True, cut=cut)

    def _add_point(self, points: list[CurvePoint], config: SearchConfig, whole: PlayResult) -> None:
        """The same starts with less compute. No point where a search imagines nothing."""
        played = whole if config is self.search else self._planned(config, f"planning with {compute_of(config)}")
        figures = figures_of(played, self.config.seed)
        if "steps imagined" in figures:
            score = figures["success" if "success" in figures else "return"]
            points.append(CurvePoint(config, figures["steps imagined"].value, score, played))

    def _planned(self, search: SearchConfig, what: str, keep: tuple[str, ...] = ()) -> PlayResult:
        if self.config.agent:
            planned = self.goal or "reward" in self.world.spec.channels
            cost = cost_of(self.world, self.goal, self.config) if planned else None
            within = trusted_searches(self.progress)
            policy = policy_of(self.config.agent, self.real.spec, self.world, cost, within)
            return self._play(policy, what, self.sees, keep)
        if self.places:
            return self._play(partial(walker, self.world, search), what, self.sees, keep)
        return self._play(planner_of(self.world, self.goal, self.config, search), what, self.sees, keep)

    def _play(self, policy: Any, what: str, sees: tuple[str, ...] = (), keep: tuple[str, ...] = ()) -> PlayResult:
        episodes, seed = self.config.episodes, self.config.seed
        with stage(what, self.progress) as report:
            if self.places:
                return self.places.play(self.real, policy, episodes, self.steps, seed, sees, keep, report)
            settings = PlaySettings(self.steps, self.criterion, sees, keep, 1 if keep else 0)
            return play(self.real, policy, episodes, settings, seed, report)


def cost_of(world: World, goal: Mapping[str, torch.Tensor], config: PlanConfig) -> Cost:
    return distance_to(world, goal, config.cost) if goal else negative_reward(world.spec)


def planner_of(world: World, goal: Mapping[str, torch.Tensor], config: PlanConfig, search: SearchConfig) -> Planner:
    """A planner to the goal. Its plans end where the world invents, if `trust` is not set and the world renders uncertainty after
    each step: a world that leaps over a block does not. In a latent world they end only if `trust` is set."""
    spec = world.spec
    leaps = bool(spec.leap) and search.block % spec.leap == 0 and config.cost == "last"
    if search.trust is None and not leaps and cuts_plans(spec) and isinstance(spec.card.get("uncertainty"), dict):
        if levels := uncertainty_levels(spec):
            search = replace(search, trust=levels[1])
    proposal = None if config.proposal is None else proposal_policy(config.proposal, world)
    return Planner(world, cost_of(world, goal, config), search, proposal)


def walker(world: World, search: SearchConfig, goal: Destination) -> Policy:
    """A policy that walks to a place. Its plans are short: uncertainty, which takes drawing every frame, ends them only if `trust`
    is set, else the world's measured trust horizon, except in latent worlds."""
    search = within_measured_trust(world, search)
    return goal.navigator(Planner(world, goal.cost(world), search))


def open_study(name: str, config: PlanConfig, progress: Progress) -> PlanStudy:
    """The worlds by their names, held to each other. TerrellaError for what does not fit."""
    within, steps = config.within, config.steps
    if config.episodes < 1 or (steps is not None and steps < 1) or (within is not None and not within > 0):
        raise TerrellaError("--episodes and --steps are whole numbers from 1 up, and --within is above 0.")
    if not config.apart >= 0:
        raise TerrellaError("--apart is 0 or more.")
    refuse_randomised(name, config.environment)
    if config.success:
        refuse(config, f"--success {config.success} says when an episode has succeeded", "within")
    elif config.goal == REWARD:
        refuse(config, "the highest return has no distance at which it is reached", "within")
    if not is_recording(config.goal):
        refuse(config, "the goal is not drawn from the views of a recording", "apart")
    if library.is_truth(name):
        world: World = FullyObserved(open_copied(name, config.environment))
    else:
        world = load_named(name, device_of(config.device), progress=progress)
    if not world.spec.observes:
        raise PlanningError(f"{name} observes nothing, so it cannot begin where the episode is.")
    real = world if config.real in (None, name) else open_real(config.real, config.environment, world.spec)
    check_alike(world.spec, real.spec)
    if config.success and config.success not in real.spec.channels:
        known = ", ".join(real.spec.channels)
        raise PlanningError(f"{real.spec.name} has no channel '{config.success}'; it has {known}.")
    goal = {} if is_recording(config.goal) else read_goal(config.goal, world.spec)
    views = None if config.success else views_of(config.goal, goal, world, real.spec)
    limit = steps or real.spec.max_episode_steps
    if views is not None:
        return _open_walk(config, world, real, views, limit or round(WALK_S / real.spec.dt_s), progress)
    if not goal:
        refuse(config, "a reward is summed up to the end of the episode", "cost")
    whole = config.search.filled().horizon
    search = config.search.filled(replan=whole) if config.cost == "last" else config.search.filled()
    validation = world.spec.card.get("validation")
    if isinstance(validation, dict) and "verdict" in validation:
        progress(f"{world.spec.name}: {validation['verdict']}")
    if config.agent is None:
        search = search_within_trust(world, search, progress)
        planner_of(world, goal, config, search)  # refuses what does not fit, before anything is played
    study = PlanStudy(config, search, world, real, goal, _criterion(config, goal, real.spec), limit or STEPS, progress)
    return study if config.agent else _priced(study, lambda one: planner_of(world, goal, config, one))


def _priced(study: PlanStudy, policy: Callable[[SearchConfig], Policy]) -> PlanStudy:
    """The study with what a decision costs, and a search that keeps the budget. A route that is not known costs nothing."""
    config, cuda = study.config, device_of(study.config.device).startswith("cuda")
    try:
        with stopping_with("stopped before the first decision."):
            budget = PlanBudget(config.watts, config.memory_mb)
            search, cost = priced(study.search, budget, policy, study.real, study.sees, cuda, config.seed)
    except NoRoute:
        if config.watts is not None or config.memory_mb is not None:
            study.progress(
                "The budget is not kept: no way to the first view is known, so no decision could be measured."
            )
        return study
    for line in cost.lines()[1:]:
        study.progress(line)
    return replace(study, search=search, decision=cost)


def _open_walk(
    config: PlanConfig, world: World, real: World, views: torch.Tensor, steps: int, progress: Progress
) -> PlanStudy:
    refuse(config, "a walk to places plans the way by the distance", "cost", "proposal", "agent")
    places = PlaceGoals(views, config.apart, config.within or NEAR_M)
    if len(views) > 1 and config.apart <= places.within_m:
        raise TerrellaError(f"--apart is more than the {places.within_m:g} m within which a view is reached.")
    search = config.search.filled(**walking_defaults(world.spec))
    walker(world, search, Destination(views[0]))  # refuses what does not fit, before anything is played
    study = PlanStudy(config, search, world, real, {}, SuccessCriterion(), steps, progress, places)
    return _priced(study, lambda one: walker(world, one, Destination(views[0])))


def _criterion(config: PlanConfig, goal: Mapping[str, torch.Tensor], real: Spec) -> SuccessCriterion:
    hidden = [name for name in goal if name not in real.channels]
    if hidden and not config.success:
        raise PlanningError(
            f"{real.name} does not show {', '.join(goal)}, so nobody can tell whether the goal is reached: name a channel that "
            "can with --success."
        )
    values = {name: value[None] for name, value in ({} if config.success or hidden else goal).items()}
    return SuccessCriterion(values, config.within or WITHIN, config.success or "")


def refuse(config: PlanConfig, why: str, *names: str) -> None:
    """TerrellaError where one of these settings was given, though nothing would use it."""
    given, usual = ({**vars(one), **vars(one.search)} for one in (config, PlanConfig()))
    wrong = [f"--{name.replace('_', '-')}" for name in names if given[name] != usual[name]]
    if wrong:
        raise TerrellaError(f"{why}; leave {', '.join(wrong)} out.")
