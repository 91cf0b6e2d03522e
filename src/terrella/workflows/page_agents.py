"""The agent that acts on the page instead of a person: by its name, or the one that suits the world."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from .. import library
from ..act.explorer import Explorer
from ..act.imitation import KIND, ImitationActor
from ..act.lerobot_policy import kind_of_policy
from ..act.planning import (
    STRIDE_S,
    Destination,
    FullyObserved,
    Planner,
    cost_discriminates,
    distance,
    distance_to,
    imagined_futures,
    negative_reward,
    search_config_within,
    within_measured_trust,
)
from ..act.policies_by_name import NoisyPolicy, Within, policy_of
from ..act.sentences import words_of
from ..act.skills.actor import SkillActor
from ..act.skills.library import KIND as SKILLS
from ..core.errors import PlanningError
from ..core.instruction import bytes_to_text, text_to_bytes
from ..core.policy import observed_channels
from ..core.spec import TEXT, Spec, shape_of
from ..core.state import State
from ..core.world import Observation, World, make_rng
from ..serve.agent import Agent, Agents, Futures
from .goals import state_channel, with_estimated_pose
from .progress import silent
from .trust import trusted_searches

TEXT_CHANNEL = "text"
INSTRUCTED = (ImitationActor, SkillActor)
_REPLAN_S = 0.06  # world time for which a plan is executed before the next is made
_NEAR = 0.05  # share of a range within which a goal is reached
_SHOWN = ("pose", "places")  # channels by which routes are planned, beside those that a planner's world observes


@dataclass(frozen=True)
class PageAgents:
    """Makes the agents of a page."""

    played: World  # The world on the page.
    learned: World | None = None  # The world to plan in, where that is another (--compare).
    name: str = ""  # The agent's name; "" for the one that suits the world.
    budget_ms: float = 30.0  # Time per decision.

    def agents(self) -> Agents:
        """The agents for the page. TerrellaError for a name that does not fit."""
        if self.name not in ("", "plan"):
            self.make({})
        spec = self.played.spec
        places = self.world is not None and "pose" in spec.channels and "pose" in self.world.spec.channels
        pictures = self.world is not None and "rgb" in spec.channels
        return Agents(self.make, places, pictures, self._instruction if self._follows_instructions else None)

    def make(self, goal: Observation) -> Agent:
        """The agent to a goal or, for {}, the one of the name."""
        if TEXT_CHANNEL in goal:
            return self._instructed(goal[TEXT_CHANNEL])
        if goal:
            return self._seeking(goal)
        if self.name == "":
            return self._planning(always=False) or Agent("the explorer", Explorer(self.played.spec))
        if self.name == "plan":
            agent = self._planning(always=True)
            if agent is None:
                raise PlanningError(f"{self.played.spec.name} cannot be planned in for reward; set a goal.")
            return agent
        policy = policy_of(self.name, self._spec, self.world, within=self._within)
        plans = policy.policy if isinstance(policy, NoisyPolicy) else policy
        if isinstance(plans, Planner):
            return Agent(self.name, policy, self.see, futures=self._futures(plans) if plans is policy else None)
        if isinstance(policy, INSTRUCTED) and TEXT_CHANNEL in policy.sees:
            return Agent(self.name, policy, self._see_with(policy))
        sees = observed_channels(policy, self.played.spec)
        return Agent(self.name, policy, lambda state: self.played.render(state, sees))

    # -- instructions -------------------------------------------------------------------------------------------------

    @cached_property
    def _spec(self) -> Spec:
        """The spec for the policy: where the world gives no instructions to one that imitates, the person may."""
        spec = self.played.spec
        if not Path(self.name).is_dir() or kind_of_policy(self.name) not in (KIND, SKILLS):
            return spec
        return replace(spec, channels={**spec.channels, TEXT_CHANNEL: TEXT})

    @cached_property
    def _follows_instructions(self) -> bool:
        policy = self.make({}).policy if self.name not in ("", "plan") else None
        return isinstance(policy, INSTRUCTED) and TEXT_CHANNEL in policy.sees

    def _instruction(self, words: str) -> Observation:
        """The instruction as a goal. PlanningError if the policy knows none of its words, or no plan of skills does it."""
        policy = library.load_policy(self.name, self._spec, self.world)
        if isinstance(policy, SkillActor):
            policy.search.instructions_of(words)
            return {TEXT_CHANNEL: torch.from_numpy(text_to_bytes(words).copy())[None]}
        assert isinstance(policy, ImitationActor)
        if len(policy.unknown(words)) == len(set(words_of(words))):
            known = ", ".join(policy.network.config.vocabulary)
            raise PlanningError(f"the policy knows none of the words of '{words}'; it knows {known}.")
        return {TEXT_CHANNEL: torch.from_numpy(text_to_bytes(words).copy())[None]}

    def _instructed(self, text: torch.Tensor) -> Agent:
        """The policy with this instruction [1, TEXT_BYTES] in place of the world's own. The agent's name tells what it ignores."""
        policy = library.load_policy(self.name, self._spec, self.world)
        assert isinstance(policy, INSTRUCTED)
        unknown = ", ".join(f"'{word}'" for word in policy.unknown(bytes_to_text(text[0].numpy())))
        name = f"{self.name} (does not know {unknown})" if unknown else self.name
        return Agent(name, policy, self._see_with(policy, text))

    def _see_with(
        self, policy: ImitationActor | SkillActor, text: torch.Tensor | None = None
    ) -> Callable[[State], Observation]:
        """What the policy sees: of the world, with this instruction, or with an empty one where the world has none."""
        given = text is not None or TEXT_CHANNEL not in self.played.spec.channels
        text = torch.zeros(1, *shape_of(TEXT), dtype=torch.uint8) if text is None else text
        sees = [name for name in policy.sees if not (given and name == TEXT_CHANNEL)]
        return lambda state: {**self.played.render(state, sees), **({TEXT_CHANNEL: text} if given else {})}

    # -- where it plans -----------------------------------------------------------------------------------------------

    @cached_property
    def world(self) -> World | None:
        """The world to plan in: the one beside, or the one on the page. None where that can neither be copied nor was learned."""
        if self.learned is not None:
            return self.learned
        return FullyObserved(self.played, here=True) if self.played.spec.forkable else None

    def see(self, state: State) -> Observation:
        """The observation for a planner, of a state of the world on the page."""
        if self.learned is None and self.world is not None:
            spec = self.world.spec
            return self.world.render(state, [*spec.observes, *(name for name in _SHOWN if name in spec.channels)])
        spec, shown = self.played.spec, (self.learned or self.played).spec
        names = dict.fromkeys((*shown.observes, *shown.may_observe, *_SHOWN))
        return self.played.render(state, [name for name in names if name in spec.channels])

    @cached_property
    def _within(self) -> Within:
        return trusted_searches(silent)

    # -- agents -------------------------------------------------------------------------------------------------------

    def _planning(self, always: bool) -> Agent | None:
        """A planner for reward. Unless `always`, None where a search takes too long here, or all plans have the same return."""
        world = self.world
        if world is None or "reward" not in world.spec.channels:
            return None
        cost, state = negative_reward(world.spec), self._first(world)
        config, fits = search_config_within(world, cost, state, self.budget_ms)
        if not always and not (fits and cost_discriminates(world, cost, state)):
            return None
        moves = max(1, round(_REPLAN_S / (world.spec.dt_s * config.block)))
        planner = Planner(world, cost, self._within(world, replace(config, replan=min(moves, config.horizon))))
        return Agent("a planner for reward", planner, self.see, futures=self._futures(planner))

    def _futures(self, planner: Planner) -> Callable[[Any], Futures] | None:
        """Pictures of the futures in a planner's memory, where its world renders any."""
        if "rgb" not in planner.world.spec.channels:
            return None
        world, cost, block = planner.world, planner.cost, planner.config.block
        return lambda memory: imagined_futures(world, cost, memory[0], block)

    def _seeking(self, goal: Observation) -> Agent:
        """A planner for a goal: a place to walk to, else a state in numbers, else a picture."""
        world = self.world
        if world is None:
            raise PlanningError(
                f"{self.played.spec.name} can neither be copied nor was learned: nobody can plan in it."
            )
        goal = with_estimated_pose(goal, self.learned or self.played)
        if "pose" in goal and "pose" in self.played.spec.channels:
            return self._walking(world, goal["pose"][0])
        source, vectors = self.learned or self.played, [name for name in goal if name == _vector(self.played.spec)]
        aim = {name: goal[name] for name in (vectors or ["rgb"])}
        whole = {name: goal[name] for name in source.spec.observes if name in goal}
        latent = "latent" in source.spec.channels and set(whole) == set(source.spec.observes) and whole
        cost = distance_to(source, whole) if latent else distance_to(world, aim, latent=False)
        config, _ = search_config_within(world, cost, self._first(world), self.budget_ms, block=2)
        planner = Planner(world, cost, self._within(world, config))

        def away(state: State) -> float:
            return float(distance(self.played.spec, aim, self.played.render(state, list(aim)))[0])

        return Agent("a planner, to the goal", planner, self.see, away, _NEAR, futures=self._futures(planner))

    def _walking(self, world: World, pose: torch.Tensor) -> Agent:
        """A walker to a pose [7]; NaN matches any value."""
        goal = Destination(pose)
        cost = goal.cost(world)
        block = max(1, round(STRIDE_S / world.spec.dt_s))
        config, _ = search_config_within(world, cost, self._first(world), self.budget_ms, block)
        planner = Planner(world, cost, within_measured_trust(world, config))

        def away(state: State) -> float:
            return float(goal.distance_m(self.played.render(state, ("pose",))["pose"].cpu())[0])

        futures = self._futures(planner)
        shown = futures and (lambda memory: futures([memory[0].planner]))
        return Agent("a walker", goal.navigator(planner), self.see, away, goal.near_m, "m", shown)

    def _first(self, world: World) -> State:
        """A start state, to time the world with."""
        return world.start(1, make_rng(0))


def _vector(spec: Spec) -> str:
    """The channel that holds the state as a vector; "" where there is none."""
    try:
        return state_channel(spec)
    except PlanningError:
        return ""
