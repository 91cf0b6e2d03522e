"""Laws of planners, on worlds whose best plans are known, and in a simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.act.tiny_worlds import Broken, Grid, Perilous, Point, Windy

from terrella.act.planning import (
    FullyObserved,
    Planner,
    PlaySettings,
    SearchConfig,
    SuccessCriterion,
    distance_to,
    negative_reward,
    play,
)
from terrella.core import check_world, make_rng, rollout
from terrella.core.errors import ChannelError, ContractError, ObservationError, PlanningError
from terrella.core.policy import Random, Reactive
from terrella.core.spec import Spec
from terrella.sim.gymnasium import GymnasiumConfig, GymnasiumWorld

AXES = ("cem", "icem", "mppi", "gradient", "random")
GOAL = {"observation": torch.tensor([4.0, -3.0])}
SEEN = ("observation",)


def planner(world, kind, cost=None, **more):
    options = {name: more.pop(name) for name in ("proposal", "proposals") if name in more}
    return Planner(world, cost or distance_to(world, GOAL), SearchConfig(kind, **{"horizon": 6, **more}), **options)


def walked(world, policy, batch=1, steps=8, seed=0):
    return rollout(world, world.start(batch, make_rng(seed)), policy, make_rng(seed + 1), SEEN, steps)


@pytest.mark.parametrize("kind", AXES)
@pytest.mark.parametrize("over", ["sum", "last"])
def test_a_point_goes_where_it_should(kind, over):
    world = Point()
    whole = 6 if over == "last" else 1  # an end that is always six steps ahead need never come
    slack, rounds = 2.0 if kind == "random" else 0.7, 15 if kind == "gradient" else 5
    policy = planner(world, kind, distance_to(world, GOAL, over), samples=48, iterations=rounds, replan=whole)
    assert (walked(world, policy, 2, 12).observations["observation"][-1] - GOAL["observation"]).abs().max() < slack


def test_gradients_find_the_best_plan_of_a_point():
    world = Point()
    start = world.observe({"observation": torch.tensor([[0.0, 0.0]])}, None, make_rng(0))
    policy = planner(world, "gradient", samples=8, iterations=40, horizon=4)
    action, memory = policy.act(world.render(start, SEEN), policy.begin(1, make_rng(0)), make_rng(0))
    assert torch.allclose(action, torch.tensor([[1.0, -1.0]]), atol=0.02)  # straight on, as fast as may be
    with torch.inference_mode():  # as a server does
        policy.act(world.render(start, SEEN), policy.begin(1, make_rng(0)), make_rng(0))


@pytest.mark.parametrize("kind", ["tree", "icem", "cem", "mppi"])
def test_a_grid_is_crossed(kind):
    world, goal = Grid(), {"observation": torch.tensor([3, 3])}
    policy = planner(world, kind, distance_to(world, goal), horizon=8, samples=60, iterations=4)
    assert walked(world, policy, 1, 10).observations["observation"][-1].tolist() == [[3, 3]]


def test_a_tree_finds_the_way_around_a_wall():
    world, goal = Grid(), {"observation": torch.tensor([0, 8])}
    policy = planner(world, "tree", distance_to(world, goal, "least"), horizon=24, samples=100, iterations=4)
    assert walked(world, policy, 1, 24).observations["observation"][-1].tolist() == [[0, 8]]  # 24 steps are the fewest


@pytest.mark.parametrize("kind", [*AXES, "tree"])
@pytest.mark.parametrize("world", [Point, Windy, Grid], ids=lambda world: world.__name__)
def test_the_same_seed_plans_alike_and_a_batch_as_its_episodes_alone(world, kind):
    world = world()
    if (kind == "tree") != isinstance(world, Grid) and kind in ("tree", "gradient"):
        pytest.skip("not for these actions")
    cost = negative_reward(world.spec)
    policy = planner(world, kind, cost, samples=12, iterations=3, horizon=4, replan=2)
    start = world.start(3, make_rng(3))
    memory, alone = policy.begin(3, make_rng(1)), [policy.begin(1, rng) for rng in [make_rng(1)] for _ in range(3)]
    assert [one[0].seed for one in alone] == [one.seed for one in memory]
    for _ in range(4):
        seen = world.render(start, SEEN)
        action, memory = policy.act(seen, memory, make_rng(9))
        again = []
        for entry in range(3):
            shown = {name: value[entry : entry + 1] for name, value in seen.items()}
            one, alone[entry] = policy.act(shown, alone[entry], make_rng(7))
            again.append(one)
        assert torch.allclose(torch.cat(again).float(), action.float(), atol=1e-5)
        start = world.imagine(start, action, make_rng(5))


@pytest.mark.parametrize("world", [Point, Windy], ids=lambda world: world.__name__)
def test_every_step_of_a_batch_is_imagined_once(world):
    world, rows = world(), []
    imagine = world.imagine
    world.imagine = lambda state, action, rng: rows.append(state.batch) or imagine(state, action, rng)
    policy = planner(world, "cem", samples=4, iterations=1, horizon=2)
    memory, seen = policy.begin(3, make_rng(1)), world.render(world.start(3, make_rng(3)), SEEN)
    for _ in range(2):
        rows.clear()
        _, memory = policy.act(seen, memory, make_rng(9))
    assert sum(rows) == 3 * (2 * 4 + 2 + 1)  # candidates, the mean, and the step that is taken
    assert len(rows) == (15 if isinstance(world, Windy) else 5)  # a world of chance is imagined episode by episode


def test_a_plan_ends_where_the_world_no_longer_knows():
    world, goal = Point(), {"observation": torch.tensor([9.0, 0.0])}
    start = world.observe({"observation": torch.tensor([[1.0, 0.0]])}, None, make_rng(0))
    for trust, most in ((0.3, 4), (1.0, 12)):
        policy = planner(world, "icem", distance_to(world, goal), horizon=12, samples=64, trust=trust)
        _, memory = policy.act(world.render(start, SEEN), policy.begin(1, make_rng(0)), make_rng(0))
        known = memory[0].decision.trusted_moves
        assert known == 12 if most == 12 else 1 <= known <= 4
    with pytest.raises(PlanningError, match="uncertainty"):
        planner(Grid(), "tree", negative_reward(Grid().spec), trust=0.1)


def test_an_end_that_is_likely_though_never_certain_is_avoided():
    world = Perilous()
    state = world.observe({"observation": torch.tensor([[-2.0, 0.0]])}, None, make_rng(0))
    policy = planner(world, "icem", negative_reward(world.spec), samples=48, iterations=4)
    seen = rollout(world, state, policy, make_rng(1), SEEN, 6).observations["observation"]
    assert float(seen[-1, 0, 0]) > 1.0


def test_a_position_that_drifts_alike_under_every_plan_ends_none():
    world, lost = Point(), Point()
    lost.spec = replace(world.spec, channels={**world.spec.channels, "invented": world.spec.channels["uncertainty"]})
    render = lost.render
    lost.render = lambda state, channels: {
        **render(state, [name for name in channels if name != "invented"]),
        "invented": torch.zeros(state.batch),
    }
    goal = {"observation": torch.tensor([9.0, 0.0])}
    for one, whole in ((world, False), (lost, True)):
        start = one.observe({"observation": torch.tensor([[1.0, 0.0]])}, None, make_rng(0))
        policy = planner(one, "icem", distance_to(one, goal), horizon=12, samples=64, trust=0.3)
        _, memory = policy.act(one.render(start, SEEN), policy.begin(1, make_rng(0)), make_rng(0))
        assert (memory[0].decision.trusted_moves == 12) == whole


def test_nothing_is_chosen_by_chance_where_costs_are_no_numbers():
    world = Broken()
    for kind in AXES:
        with pytest.raises(PlanningError, match="no action is chosen"):
            walked(world, planner(world, kind, negative_reward(world.spec), samples=8), 1, 1)


def test_a_block_is_held_and_a_plan_is_followed():
    world = Point()
    policy = planner(world, "icem", samples=16, horizon=3, block=3, replan=2)
    actions = walked(world, policy, 1, 12).actions[:, 0]
    held = actions.view(4, 3, 2)
    assert torch.equal(held, held[:, :1].expand(4, 3, 2))
    memory = policy.begin(1, make_rng(0))
    seen, decisions = world.render(world.start(1, make_rng(0)), SEEN), []
    for _ in range(12):
        _, memory = policy.act(seen, memory, make_rng(0))
        decisions.append(id(memory[0].decision))
    assert len(set(decisions)) == 2


def test_a_policy_proposes():
    world = Point()
    start = world.observe({"observation": torch.tensor([[-4.0, 5.0]])}, None, make_rng(0))
    towards = Reactive(lambda seen, rng: (GOAL["observation"] - seen["observation"]).clamp(-1, 1))
    costs = []
    for proposal in (None, towards):
        policy = planner(world, "random", samples=4, iterations=1, proposal=proposal)
        _, memory = policy.act(world.render(start, SEEN), policy.begin(1, make_rng(0)), make_rng(0))
        costs.append(memory[0].decision.cost)
    assert costs[1] < 0.8 * costs[0]
    other = Random(Spec("other", spaces.Discrete(3), {}, (), 1.0))
    with pytest.raises(PlanningError, match="for other actions"):
        walked(world, planner(world, "cem", proposal=other), 1, 1)


def test_bad_goals_and_worlds_are_refused_in_a_sentence():
    world = Point()
    for goal, error in (
        ({"observation": torch.zeros(3)}, ObservationError),
        ({"observation": torch.tensor([99.0, 0.0])}, ObservationError),
        ({"colour": torch.zeros(2)}, ChannelError),
        ({}, PlanningError),
    ):
        with pytest.raises(error):
            distance_to(world, goal)
    with pytest.raises(PlanningError, match="no reward"):
        negative_reward(Spec("mute", spaces.Discrete(2), {"rgb": spaces.Box(0, 255, (2, 2, 3), np.uint8)}, (), 1.0))
    with pytest.raises(PlanningError, match="cannot be planned in"):
        Planner(Point(forkable=False), distance_to(world, GOAL))
    with pytest.raises(PlanningError, match="continuous actions have none"):
        walked(world, planner(world, "tree"), 1, 1)
    with pytest.raises(PlanningError, match="have no gradient"):
        walked(Grid(), planner(Grid(), "gradient", negative_reward(Grid().spec)), 1, 1)
    with pytest.raises(PlanningError, match="no gradients flow"):
        stiff = Point(differentiable=False)
        walked(stiff, planner(stiff, "gradient"), 1, 1)
    with pytest.raises(ObservationError, match="the observation lacks"):
        policy = planner(world, "cem")
        policy.act({}, policy.begin(1, make_rng(0)), make_rng(0))
    with pytest.raises(PlanningError):
        SearchConfig(samples=1)
    with pytest.raises(ContractError):
        rollout(world, world.start(2, make_rng(0)), Reactive(lambda seen, rng: torch.zeros(2)), make_rng(0), SEEN, 1)


def test_numbers_of_a_goal_may_be_any():
    world, goal = Point(), {"observation": torch.tensor([torch.nan, 4.0])}
    walk = walked(world, planner(world, "icem", distance_to(world, goal)), 1, 12).observations["observation"]
    assert abs(float(walk[-1, 0, 1]) - 4) < 0.4 and abs(float(walk[-1, 0, 0] - walk[0, 0, 0])) < 3


def test_a_budget_in_time_is_kept():
    world = Point()
    policy = planner(world, "cem", budget_ms=60, samples=8)
    _, memory = policy.act(world.render(world.start(1, make_rng(0)), SEEN), policy.begin(1, make_rng(0)), make_rng(0))
    assert memory[0].decision.ms >= 60 and memory[0].decision.steps >= 8 * 6


def test_episodes_are_judged_from_unsolved_starts():
    world = Point()
    judge = SuccessCriterion({"observation": torch.zeros(1, 2)}, within=0.1)
    cost = distance_to(world, {"observation": torch.zeros(2)})
    mine = play(world, planner(world, "icem", cost), 12, PlaySettings(20, judge, SEEN, SEEN, 2))
    floor = play(world, Random(world.spec), 12, PlaySettings(20, judge, SEEN, SEEN, 12))
    assert all(episode.success for episode in mine.episodes) and mine.skipped == floor.skipped > 0
    assert all(len(episode.actions) == episode.steps < 20 for episode in mine.episodes), "success ends an episode"
    assert sum(bool(episode.success) for episode in floor.episodes) < 9
    for one, other in zip(mine.episodes[:2], floor.episodes):
        assert torch.equal(one.seen[0]["observation"], other.seen[0]["observation"])
        assert len(one.seen) == one.steps + 1 == len(one.actions) + 1 and one.nearest <= 0.1
    assert not mine.episodes[2].seen
    with pytest.raises(PlanningError, match="already solved"):
        criterion = SuccessCriterion({"observation": torch.zeros(1, 2)}, within=2.0)
        play(world, Random(world.spec), 4, PlaySettings(5, criterion, SEEN))


def test_a_revealed_simulator_is_a_world():
    world = FullyObserved(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)))
    assert "observes" in check_world(world, steps=10)
    with pytest.raises(PlanningError, match="cannot be planned in"):
        FullyObserved(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False, forkable=False)))


def test_a_planner_in_the_simulator_keeps_the_pole_up():
    world = FullyObserved(GymnasiumWorld("CartPole-v1", GymnasiumConfig(rgb=False)))
    policy = Planner(world, negative_reward(world.spec), SearchConfig(samples=16, iterations=2, horizon=12, replan=3))
    mine = play(world, policy, 1, PlaySettings(200))
    floor = play(world, Random(world.spec), 8, PlaySettings(200))
    assert mine.episodes[0].reward == 200
    assert max(episode.reward for episode in floor.episodes) < 150
