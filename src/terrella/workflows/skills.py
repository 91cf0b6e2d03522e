"""The commands `skills ...` and `plan --skills`: a library of skills, and plans made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from tyro.conf import arg

from ..act.actor import policy_folder
from ..act.imitation import load_network_of_one_body
from ..act.planning import FullyObserved
from ..act.skills.actor import SkillActor
from ..act.skills.imagined import PlanRollouts
from ..act.skills.library import SkillLibrary
from ..act.skills.observed_goal import ObservedGoal
from ..act.skills.search import SkillSearch
from ..core.errors import TerrellaError
from ..core.instruction import bytes_to_text
from ..core.policy import act
from ..core.spec import Spec
from ..core.world import World, make_rng
from ..learn.recipes.imitation import open_demonstrations
from ..learn.recipes.skills import SkillTraining, learn_skills
from ..library import is_truth
from ..measure.statistics import Figure, wilson
from .goals import REWARD, is_observation, read_goal
from .opening import EnvironmentConfig, device_of, load_named
from .plan_study import WITHIN, PlanConfig
from .progress import Progress, silent, stage
from .real_environment import STEPS, check_alike, open_copied, open_real
from .results import changed_settings, jsonable, table_lines

MOST_STARTS = 50  # starts of an environment that are drawn for each try, until its instruction is one of the skill


@dataclass(frozen=True)
class LearnSkillsConfig:
    """Settings of `skills learn`."""

    policy: str  # The folder of a policy that imitates the recording (train policy --method imitation).
    out: Path  # Folder of the library.
    training: SkillTraining = SkillTraining()


@dataclass(frozen=True)
class TrySkillConfig:
    """Settings of `skills try`."""

    inside: Annotated[str, arg(name="in")]  # The environment (gym:BabyAI-GoToLocal-v0).
    environment: EnvironmentConfig = EnvironmentConfig()
    episodes: int = 20  # Tries of the skill.
    seed: int = 0  # The same seed gives the same starts.


@dataclass(frozen=True)
class LibraryResult:
    """A library of skills."""

    library: SkillLibrary
    facts: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        skills = [
            {"name": one.name, "phrase": str(one.phrase), "works": one.works, "steps": one.steps, "recorded": one.tries}
            | {"tries": one.own_tries}
            for one in self.library.skills
        ]
        return jsonable({"skills": skills, "composed": dict(self.library.composed), **self.facts})

    def summary(self) -> str:
        rows = []
        for one in self.library.skills:
            steps = f"{one.steps:.0f} ({one.least_steps} to {one.most_steps})"
            count = f"{one.own_tries} tries" if one.own_tries else f"{one.tries} recorded"
            rows.append([one.name, f"{one.works:.0%} of {count}", steps, str(one.phrase)])
        lines = table_lines(["skill", "works", "steps", "instructions"], rows)
        lines += [f"'{name}' stands for: {goal}" for name, goal in self.library.composed.items()]
        if "ends_recognised" in self.facts:
            lines.append(
                f"Of {self.facts['tested_segments']} segments {self.facts['ends_recognised']:.1%} are ended at their end, and "
                f"{self.facts['ended_too_early']:.1%} before it."
            )
        lines += [
            f"'{one}' is left out: its end looks like any other moment." for one in self.facts.get("without_effect", ())
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class TriesResult:
    """Attempts of a skill in an environment."""

    name: str
    success: Figure  # By the environment's reward.
    recognised: Figure  # Attempts of which the library says rightly whether they are done.

    def to_json(self) -> dict[str, Any]:
        return jsonable({"skill": self.name, "success": asdict(self.success), "recognised": asdict(self.recognised)})

    def summary(self) -> str:
        return (
            f"'{self.name}' works in {self.success} of its tries; the library is right about whether it is done in "
            f"{self.recognised}. Plans count on that from now on."
        )


@dataclass(frozen=True)
class SkillEpisode:
    """An episode by a plan of skills."""

    events: tuple[str, ...]  # what was planned, done and planned anew
    finished: bool  # all instructions are done, by the library's own judgement
    reward: float
    steps: int
    ended: bool = False  # by the environment, before all were done
    success: bool | None = None  # by the environment's channel `success`, if it has one


@dataclass(frozen=True)
class SkillPlanResult:
    """Episodes by plans of skills."""

    goal: str | None  # None: each episode has a goal of its own
    episodes: tuple[SkillEpisode, ...]
    stopped: bool = False
    within: float | None = None  # the distance at which a goal is reached that is no sentence

    @property
    def began_at_goal(self) -> int:
        return sum(one.finished and not one.steps for one in self.episodes)

    @property
    def finished(self) -> Figure:
        return wilson(sum(one.finished for one in self.episodes), len(self.episodes))

    @property
    def rewarded(self) -> Figure:
        won = [one.reward > 0 if one.success is None else one.success for one in self.episodes]
        return wilson(sum(won), len(won))

    def to_json(self) -> dict[str, Any]:
        shares = {"finished": asdict(self.finished), "rewarded": asdict(self.rewarded)}
        facts = {"goal": self.goal, "within": self.within, "began_at_goal": self.began_at_goal}
        return jsonable({**facts, **shares, "episodes": [asdict(one) for one in self.episodes]})

    def summary(self) -> str:
        lines = [f"All steps were done in {self.finished} of the episodes, by the library's own judgement."]
        if self.within is not None:
            lines = [f"The goal, {self.goal} within {self.within:g}, was reached in {self.finished} of the episodes."]
            if self.began_at_goal:
                lines.append(f"{self.began_at_goal} of {len(self.episodes)} began at it.")
        if not self.goal:
            mean = sum(one.reward for one in self.episodes) / len(self.episodes)
            lines.append(f"By the environment's own rules {self.rewarded} succeeded; their mean return is {mean:.2f}.")
        if ended := sum(one.ended for one in self.episodes):
            lines.append(f"The environment ended {ended} of {len(self.episodes)} before, by rules of its own.")
        for number, one in enumerate(self.episodes[:3], 1):
            lines += [f"episode {number}, {one.steps} steps:", *(f"    {event}" for event in one.events)]
        return "\n".join(lines)


def learn_library(data: str | Path, config: LearnSkillsConfig, *, progress: Progress = silent) -> LibraryResult:
    """Learns skills from a recording and a policy that imitates it: their phrases are mined from its instructions. TerrellaError
    for what cannot be learned from."""
    network, _ = load_network_of_one_body(config.policy)
    sees, size = [name for name, _ in network.config.actor.sees], network.config.size
    with stage("learning skills", progress) as report:
        recording, _ = open_demonstrations(data, sees, size, report)
        library, facts = learn_skills(recording, policy_folder(config.policy), config.out, config.training, report)
    return LibraryResult(library, facts)


def list_skills(library: str | Path) -> LibraryResult:
    """The skills of a library."""
    return LibraryResult(SkillLibrary.load(library), {})


def add_skill(library: str | Path, name: str, goal: str) -> LibraryResult:
    """A name for a goal of several instructions. PlanningError for a goal that the skills do not understand, or a name that is
    taken."""
    earlier = SkillLibrary.load(library)
    SkillSearch(earlier).instructions_of(goal)
    added = earlier.added(name, goal)
    added.write_names(library)
    return LibraryResult(added, {})


def rename_skill(library: str | Path, name: str, new: str) -> LibraryResult:
    """Another name for a skill."""
    renamed = SkillLibrary.load(library).renamed(name, new)
    renamed.write_names(library)
    return LibraryResult(renamed, {})


def try_skill(folder: str | Path, name: str, config: TrySkillConfig, *, progress: Progress = silent) -> TriesResult:
    """Tries a skill in an environment that gives its instructions and rewards, and counts the tries in the library."""
    if (episodes := config.episodes) < 1:
        raise TerrellaError("--episodes is 1 or more.")
    library, seed = SkillLibrary.load(folder), config.seed
    world = config.environment.open(config.inside)
    skill, actor = library.named(name), SkillActor(library, world.spec)
    world.spec.check_channels(("text", "reward", "done"))
    won, right, rng, tried = 0, 0, make_rng(seed), 0
    with stage("trying", progress) as report:
        for start in range(MOST_STARTS * episodes):
            state = world.start(1, make_rng(seed + start))
            text = bytes_to_text(world.render(state, ("text",))["text"][0].numpy())
            if library.skill_of(text) != skill:
                continue
            one = _episode(world, state, actor, world.spec.max_episode_steps or STEPS, rng)
            won, right, tried = won + (one.reward > 0), right + ((one.reward > 0) == one.finished), tried + 1
            report(tried, episodes)
            if tried == episodes:
                break
    if not tried:
        raise TerrellaError(f"{world.spec.name} gave no instruction of '{name}' in {MOST_STARTS * episodes} starts.")
    library.tried(name, tried, won).write_names(folder)
    return TriesResult(name, wilson(won, tried), wilson(right, tried))


def plan_with_skills(name: str, config: PlanConfig, *, progress: Progress = silent) -> SkillPlanResult:
    """Plans with the skills of a library and acts in an environment. PlanningError for a goal that it does not understand, or that
    no order of its skills is likely to reach from the first start."""
    used = {"goal", "skills", "rollouts", "real", "episodes", "steps", "seed", *vars(config.environment), "device"}
    used |= {"within"} if is_observation(config.goal) else set()
    if useless := [key for key in changed_settings(config) if key.replace("-", "_") not in used]:
        raise TerrellaError(f"--{useless[0].replace('_', '-')}: plans of skills have no use for that.")
    if config.episodes < 1 or (config.steps is not None and config.steps < 1):
        raise TerrellaError("--episodes and --steps are whole numbers from 1 up.")
    assert config.skills is not None
    library = SkillLibrary.load(config.skills)
    inside, world = _worlds(name, config, progress)
    goal = _goal_of(config, world.spec, library)
    rollouts = None
    if inside is not None:
        rollouts = PlanRollouts(inside, SkillActor(library, inside.spec, goal), config.rollouts, config.seed)
    actor, steps = (
        SkillActor(library, world.spec, goal, rollouts),
        config.steps or world.spec.max_episode_steps or STEPS,
    )
    if goal is not None:
        search = SkillSearch(library)
        first = world.render(world.start(1, make_rng(config.seed)), actor.sees)
        observed = isinstance(goal, ObservedGoal)
        plan = search.plan(search.towards(goal, first) if observed else search.instructions_of(goal), first)
        progress(f"the plan: {plan}, {plan.probability:.0%} in all")
    wanted, within = None if goal is None else str(goal), goal.within if isinstance(goal, ObservedGoal) else None
    episodes, rng = list[SkillEpisode](), make_rng(config.seed)
    try:
        with stage("acting", progress) as report:
            for number in range(config.episodes):
                state = world.start(1, make_rng(config.seed + number))
                episodes.append(_episode(world, state, actor, steps, rng))
                report(number + 1, config.episodes)
    except KeyboardInterrupt:
        if not episodes:
            raise
        return SkillPlanResult(wanted, tuple(episodes), True, within)
    return SkillPlanResult(wanted, tuple(episodes), within=within)


def _goal_of(config: PlanConfig, spec: Spec, library: SkillLibrary) -> str | ObservedGoal | None:
    """The goal of all episodes; None: each has its own instruction."""
    within = WITHIN if config.within is None else config.within
    if not within > 0:
        raise TerrellaError("--within is above 0.")
    if config.goal == REWARD or not is_observation(config.goal):
        return None if config.goal == REWARD else config.goal
    value = {name: value[None] for name, value in read_goal(config.goal, spec).items()}
    return ObservedGoal.of(config.goal, value, spec, within, library)


def _worlds(name: str, config: PlanConfig, progress: Progress) -> tuple[World | None, World]:
    """The world in which plans are rolled out, if they are, and the environment to act in."""
    if config.rollouts < 0:
        raise TerrellaError("--rollouts is 0 or more.")
    if not config.rollouts:
        return None, config.environment.open(config.real or name)
    if is_truth(name):
        inside: World = FullyObserved(open_copied(name, config.environment))
    else:
        inside = load_named(name, device_of(config.device), progress=progress)
    real = inside if config.real in (None, name) else open_real(str(config.real), config.environment, inside.spec)
    check_alike(inside.spec, real.spec)
    return inside, real


@torch.no_grad()
def _episode(world: World, state: Any, actor: SkillActor, steps: int, rng: torch.Generator) -> SkillEpisode:
    """One episode; it ends when the plan is done, the environment ends it, or after `steps` steps."""
    outcome = [name for name in ("reward", "done", "success") if name in world.spec.channels]
    step, over, channels = 0, False, (*actor.sees, *outcome)
    memory, reward, seen = actor.begin(1, rng), 0.0, dict[str, torch.Tensor]()
    for step in range(steps + 1):
        seen = world.render(state, channels)
        reward += float(seen["reward"]) if step and "reward" in seen else 0.0
        action, memory = act(actor, seen, memory, 1, world.spec, rng)
        over = bool(seen["done"]) if step and "done" in seen else False
        if memory[0].finished or over or step == steps:
            break
        state = world.imagine(state, action, rng)
    one, success = memory[0], bool(seen["success"]) if "success" in seen else None
    return SkillEpisode(one.events, one.finished, reward, step, over and not one.finished and not success, success)
