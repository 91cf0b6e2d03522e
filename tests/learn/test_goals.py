"""Goals in hindsight: what is drawn is what happened, and a policy learned of random play reaches goals in a toy world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tests.act.tiny_worlds import Grid, Point
from tests.learn.stopping import goes_on_exactly, quiet

from terrella.act.goal_network import GoalActor
from terrella.act.planning import (
    GoalBeliefPolicy,
    Planner,
    PlaySettings,
    SearchConfig,
    SuccessCriterion,
    distance_to,
    negative_reward,
    play,
)
from terrella.act.policies_by_name import policy_of, proposal_policy
from terrella.cli import main
from terrella.core.errors import ActionError, ChannelError, CheckpointError, PlanningError, TrainingError
from terrella.core.policy import Random
from terrella.core.world import make_rng
from terrella.data import record
from terrella.learn.objectives.goals import Trajectories
from terrella.learn.recipes.goals import GoalTraining, train_goals

QUICK = GoalTraining(farthest=20, hidden=32, steps=400, batch=256, learning_rate=3e-3, save_every_s=1e9)


class Told(Point):
    """Where it is, is its latent."""

    about = {
        **Point.about,
        "channels": {**Point.about["channels"], "latent": spaces.Box(-10, 10, (2,), np.float32)},
        "max_episode_steps": 40,
    }

    def shown(self, state, name):
        return state["at"] if name == "latent" else super().shown(state, name)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("goals")
    world = Told()
    record(world, Random(world.spec), folder / "recording", 2000, make_rng(0))
    facts = train_goals(world, "told", folder / "recording", folder / "run", QUICK, quiet)
    return folder, facts


def test_what_is_drawn_is_what_happened():
    latents, ends = torch.arange(20.0)[:, None], np.repeat([9, 19], 10)
    drawn = Trajectories(latents, -latents, ends, np.arange(20), farthest=6).sample(500, np.random.default_rng(0))
    ahead = (drawn.goal - drawn.latent)[:, 0]
    assert torch.equal(ahead, drawn.steps) and torch.equal(drawn.action, -drawn.latent)
    assert set(ahead.tolist()) == set(map(float, range(1, 7)))
    assert ((drawn.latent < 10) == (drawn.goal < 10)).all(), "no goal of another episode"


def test_it_reaches_goals_that_random_play_does_not(made):
    folder, facts = made
    world, goal = Told(), {"observation": torch.tensor([3.0, -2.0])}
    assert facts["action_explained"]["1"] > 0.9 > facts["action_explained"]["5"] > 0
    cost = distance_to(world, goal, "last")
    acting = policy_of(str(folder / "run"), world.spec, world, cost)
    assert isinstance(acting, GoalBeliefPolicy)
    judge = SuccessCriterion({name: value[None] for name, value in goal.items()}, within=0.04)
    mine, floor = (
        play(world, policy, 20, PlaySettings(25, judge, ("observation",))).episodes
        for policy in (acting, Random(world.spec))
    )
    assert sum(bool(one.success) for one in mine) >= 18 > 6 >= sum(bool(one.success) for one in floor)


def test_it_is_no_file_for_other_programs_which_is_said(made, capsys, tmp_path):
    words = [
        "export",
        "policy",
        str(made[0] / "run"),
        "--world",
        "gym:CartPole-v1",
        "--out",
        str(tmp_path / "goals.onnx"),
    ]
    assert main(words) == 2
    assert "is a policy for goals" in capsys.readouterr().err and not (tmp_path / "goals.onnx").exists()


@pytest.mark.slow
def test_episodes_at_once_have_their_own_goals_and_do_what_each_would_alone(made):
    world, actor = Told(), GoalActor.load(made[0] / "run", Told().spec)
    goals = torch.tensor([[3.0, -2.0], [-4.0, 1.0], [0.0, 0.0]])
    seen, rng = {"observation": torch.tensor([[1.0, 1.0]]).expand(3, -1)}, make_rng(0)

    def moved(rows):
        policy = GoalBeliefPolicy(world, actor, distance_to(world, {"observation": goals[rows]}))
        memory = policy.begin(len(goals[rows]), rng)
        for _ in range(2):
            action, memory = policy.act({"observation": seen["observation"][rows]}, memory, rng)
        return action

    together = moved(slice(None))
    assert torch.allclose(together, torch.cat([moved(slice(n, n + 1)) for n in range(3)]), atol=1e-5)
    assert not torch.allclose(together[0], together[1], atol=1e-2)


@pytest.mark.slow
def test_a_search_that_hardly_searches_is_better_for_its_proposals(made):
    world, folder = Told(), made[0]
    cost = distance_to(world, {"observation": torch.tensor([4.0, 4.0])}, "last")
    config = SearchConfig("random", samples=4, iterations=1, horizon=6)

    def ended(proposal):
        played = play(world, Planner(world, cost, config, proposal=proposal), 6, PlaySettings(6))
        return np.mean([one.best_cost for one in played.episodes])

    assert ended(proposal_policy(str(folder / "run"), world)) < 0.7 * ended(None)


@pytest.mark.exact
def test_it_goes_on_exactly(made, tmp_path):
    world, config = Told(), replace(QUICK, steps=40)
    recording = made[0] / "recording"
    train = lambda out: train_goals(world, "told", recording, out, config, quiet)  # noqa: E731
    goes_on_exactly(train, tmp_path / "whole", tmp_path / "cut", {"goals": 10})


def test_what_does_not_fit_is_refused(made, tmp_path):
    folder, world = made[0], Told()
    cost = distance_to(world, {"observation": torch.tensor([1.0, 1.0])})
    with pytest.raises(PlanningError, match="needs the world"):
        policy_of(str(folder / "run"), world.spec)
    with pytest.raises(PlanningError, match="the goal is the reward"):
        policy_of(str(folder / "run"), world.spec, world, negative_reward(world.spec))
    with pytest.raises(ChannelError, match="train latent"):
        GoalActor.load(folder / "run", Point().spec)
    with pytest.raises(ActionError, match="other actions"):
        GoalActor.load(folder / "run", replace(world.spec, action=Grid().spec.action, action_mode="choice"))
    with pytest.raises(TrainingError, match="--farthest"):
        train_goals(world, "told", folder / "recording", tmp_path, replace(QUICK, farthest=1), quiet)
    (folder / "run" / "policy" / "weights.safetensors").write_bytes(b"no")
    with pytest.raises(CheckpointError, match="damaged"):
        GoalActor.load(folder / "run", world.spec)
    assert cost.goal
