"""The agent that suits a world: a planner where there is something to plan for, walkers to places, sentences for what cannot be."""

# pyright: reportArgumentType=false, reportOptionalCall=false

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from terrella.act.planning import Navigator, SearchConfig, budget, searches
from terrella.core.errors import TerrellaError
from terrella.core.world import make_rng
from terrella.serve.protocol import Goal
from terrella.serve.timeline import Timeline
from terrella.workflows.page_agents import PageAgents

from .mapped import Mapped
from .panorama import Panorama

PATIENT_MS = 50.0


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """A clock by which whatever is timed takes a millisecond."""
    ticks = itertools.count()
    for module in (budget, searches):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: 1e-3 * next(ticks)))


class Dull(Panorama):
    """Nothing that is done here brings more than anything else."""

    def _channel(self, state, name):
        return 0 * super()._channel(state, name) if name == "reward" else super()._channel(state, name)


def driven(timeline: Timeline, steps: int) -> Timeline:
    for _ in range(steps):
        timeline.step()
    return timeline


def test_where_plans_bring_reward_a_planner_drives_and_gains():
    agents = PageAgents(Panorama(), budget_ms=PATIENT_MS).agents()
    assert agents.make({}).name == "a planner for reward" and agents.pictures
    timeline = Timeline([Panorama()], 0, policy=PageAgents(Panorama(), budget_ms=5.0, name="plan").agents())
    timeline.driver.let(True)
    assert driven(timeline, 20).shown.episode_return > 10


def test_plans_on_the_page_end_where_the_world_is_no_longer_trusted():
    for world, goal in ((Panorama(), {}), (Mapped(), {"pose": torch.tensor([[1.0, 0.0, *[torch.nan] * 5]])})):
        usual = searched(PageAgents(world, budget_ms=PATIENT_MS).make(goal).policy)
        world.spec = replace(world.spec, card={**world.spec.card, "trust_steps_measured": 3})
        cut = searched(PageAgents(world, budget_ms=PATIENT_MS).make(goal).policy)
        assert cut.horizon * cut.block <= max(3, cut.block) < usual.horizon * usual.block
    named = PageAgents(Panorama(), name="plan:horizon=9", budget_ms=PATIENT_MS)
    named.played.spec = replace(named.played.spec, card={"trust_steps_measured": 3})
    assert searched(named.make({}).policy).horizon == 3


def searched(policy) -> SearchConfig:
    return (policy.planner if isinstance(policy, Navigator) else policy).config


def test_where_all_plans_bring_the_same_the_explorer_drives():
    agents = PageAgents(Dull(), budget_ms=PATIENT_MS).agents()
    assert agents.make({}).name == "the explorer" and agents.make({}).futures is None
    assert PageAgents(Dull(), name="plan", budget_ms=PATIENT_MS).make({}).name == "a planner for reward", (
        "asked for by name"
    )


def test_a_walker_goes_to_a_place_and_shows_what_it_considers():
    world = Mapped()
    world.start(1, make_rng(0))
    agents = PageAgents(world, budget_ms=5.0).agents()
    assert agents.places
    agent = agents.make({"pose": torch.tensor([[1.0, 0.0, *[torch.nan] * 5]])})
    assert isinstance(agent.policy, Navigator) and agent.unit == "m"
    timeline = Timeline([world], 0, policy=agents)
    timeline.seek(Goal(at=(1.2, 0.0)))
    driven(timeline, 1)
    found = next(found for found in (timeline.consider() for _ in range(200)) if found)
    assert found["frames"] == 6 and found["plans"][0]["cost"] is not None
    driven(timeline, 60)
    assert timeline.driver.notice.startswith("reached: 0."), timeline.driver.notice
    assert float(timeline._states[0]["x"][0]) == pytest.approx(1.2, abs=0.55)


def test_a_picture_that_is_remembered_is_gone_back_to_with_its_heading():
    world = Mapped()
    agents = PageAgents(world, budget_ms=5.0).agents()
    timeline = Timeline([world], 0, policy=agents)
    seen = world.render(timeline._states[0], world.spec.recorded)
    agent = agents.make(seen)
    assert isinstance(agent.policy, Navigator) and agent.policy.heading is not None
    assert agent.away(timeline._states[0]) == 0.0
    driven(timeline, 3)
    alone = agents.make({"rgb": seen["rgb"]})
    assert not isinstance(alone.policy, Navigator) and alone.unit == "", (
        "a panorama cannot tell where a picture was taken"
    )
    assert 0 <= alone.away(timeline._states[0]) < 0.2


def test_a_lone_picture_is_walked_to_where_the_world_tells_its_place():
    class Told(Mapped):
        def observe(self, observation, prior, rng):
            known = {"pose": torch.tensor([[1.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])}
            return super().observe(known if set(observation) == {"rgb"} else observation, prior, rng)

    world = Told()
    policy = PageAgents(world, budget_ms=5.0).make({"rgb": torch.zeros(1, 48, 64, 3, dtype=torch.uint8)}).policy
    assert isinstance(policy, Navigator) and policy.place.tolist() == [1.5, 0.0] and policy.heading is not None


def test_a_game_that_cannot_be_copied_takes_no_goals():
    driving = PageAgents(Panorama(forkable=False))
    agents = driving.agents()
    assert not agents.places and not agents.pictures and agents.make({}).name == "the explorer"
    with pytest.raises(TerrellaError, match="neither be copied nor was learned"):
        agents.make({"pose": torch.zeros(1, 7)})
    with pytest.raises(TerrellaError, match="cannot be planned in for reward"):
        PageAgents(Panorama(forkable=False), name="plan").make({})


def test_beside_a_game_it_plans_in_the_dream():
    driving = PageAgents(Panorama(forkable=False), Panorama(), budget_ms=PATIENT_MS)
    agent = driving.agents().make({})
    assert agent.name == "a planner for reward"
    timeline = Timeline([driving.played, driving.learned], 0, policy=driving.agents())
    timeline.driver.let(True)
    driven(timeline, 3)
    assert timeline.driver.on and timeline.shown.episode_return > 0


@pytest.mark.parametrize(
    "name", ["idle", "random", "plan:samples=4,iterations=1,horizon=3", "plan:samples=4,horizon=3@0.2"]
)
def test_an_agent_is_named_as_policies_are(name):
    timeline = Timeline([Panorama()], 0, policy=PageAgents(Panorama(), name=name).agents())
    timeline.driver.let(True)
    driven(timeline, 3)
    assert timeline.driver.on and timeline.driver.name == name and timeline.driver.notice == ""
    assert bool(timeline.driver.described()["considers"]) == name.startswith("plan:") * ("@" not in name)


def test_an_agent_of_no_known_name_is_refused_at_once():
    with pytest.raises(TerrellaError, match="no policy 'explorre'"):
        PageAgents(Panorama(), name="explorre").agents()
