"""A world as other planners' cost model: the same cost as one plan at a time has, lowest for the plan that leads to the goal."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.act.tiny_worlds import Point
from tests.worlds.test_latent import CHOICES, STEERING, made

from terrella.act.goal_network import GoalActor, GoalConfig, GoalNetwork
from terrella.act.planning import ActionModel, CostModel, Planner, SearchConfig, distance_to
from terrella.core import make_rng
from terrella.core.errors import PlanningError
from terrella.workflows.plan_study import PlanConfig, planner_of

SEEN = {"sees_vectors": False, "vectors": ()}


def info(batch: int, samples: int | None = None) -> dict[str, torch.Tensor]:
    rng = make_rng(1)
    shape = (batch, 2, 32, 48, 3)
    found = {name: torch.randint(0, 256, shape, generator=rng, dtype=torch.uint8) for name in ("pixels", "goal")}
    return (
        found if samples is None else {at: it[:, None].expand(batch, samples, *shape[1:]) for at, it in found.items()}
    )


@pytest.mark.parametrize("leap", [0, 2])
def test_a_cost_is_that_of_one_plan_at_a_time(leap):
    world, rng = made(STEERING, leap=leap, **SEEN), make_rng(0)
    candidates = 2 * torch.randn(
        2, 5, 3, 4, generator=rng
    )  # three moves of two actions of two axes, some beyond the limits
    costs = CostModel(world).get_cost(info(2, 5), candidates)
    assert costs.shape == (2, 5) and costs.dtype == torch.float32
    for entry in range(2):
        shown = {name: value[entry : entry + 1, -1] for name, value in info(2).items()}
        goal = world.render(world.observe({"rgb": shown["goal"]}, None, rng), ("latent",))["latent"]
        for sample in range(5):
            state = world.observe({"rgb": shown["pixels"]}, None, rng)
            codes = candidates[entry, sample].reshape(6, 2).clamp(-1, 1)
            actions = torch.stack([codes[:, 0], 2 + 2 * codes[:, 1]], 1)[:, None]
            for pair in actions.split(2):
                if leap:
                    state = world.leap(state, pair.transpose(0, 1), rng)
                else:
                    state = world.imagine(world.imagine(state, pair[0], rng), pair[1], rng)
            latent = world.render(state, ("latent",))["latent"]
            assert torch.allclose(costs[entry, sample], (latent - goal).square().mean().sqrt() / 16, atol=1e-5)


def test_held_moves_of_a_planner_leap():
    world, rng = made(STEERING, leap=2, **SEEN), make_rng(0)
    steps = []
    world.imagine, inner = (
        lambda state, action, rng: steps.append(len(action)) or inner(state, action, rng),
        world.imagine,
    )
    goal = {"rgb": info(1)["goal"][0, 0]}
    config = SearchConfig("cem", samples=4, iterations=2, horizon=3, block=2)
    for over, single in (("last", False), ("sum", True)):
        planner = Planner(world, distance_to(world, goal, over), config)
        steps.clear()
        planner.act({"rgb": info(1)["pixels"][0, :1]}, planner.begin(1, rng), rng)
        assert (max(steps) == 4) == single, "single steps only where what lies between counts"


def test_actions_of_a_policy_for_goals():
    world = made(STEERING, **SEEN)
    actor = GoalActor(GoalNetwork(GoalConfig.of(world.spec, hidden=8)).eval(), world.spec)
    found = ActionModel(world, actor).get_action(info(3))
    assert found.shape == (3, 2) and world.spec.check_action(found, 3) is not None


def test_worlds_that_others_cannot_plan_in_are_refused():
    for world in (Point(), made(CHOICES, **SEEN), made(STEERING, sees_pictures=False)):
        with pytest.raises(PlanningError, match="must observe pictures alone"):
            CostModel(world)


def test_the_command_leaps_too_unless_it_is_told_when_to_trust():
    world, rng, leapt = made(STEERING, leap=2, **SEEN), make_rng(0), []
    world.spec = replace(world.spec, card={"uncertainty": {"sure": 0.1, "invents": 0.5}})
    world.leap, inner = lambda *given: leapt.append(1) or inner(*given), world.leap
    for trust in (None, 0.5):
        config = PlanConfig(search=SearchConfig("cem", 4, 2, 3, 2, trust=trust), cost="last")
        planner = planner_of(world, {"rgb": info(1)["goal"][0, 0]}, config, config.search)
        leapt.clear()
        planner.act({"rgb": info(1)["pixels"][0, :1]}, planner.begin(1, rng), rng)
        assert bool(leapt) == (trust is None)
