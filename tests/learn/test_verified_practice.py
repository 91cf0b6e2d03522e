"""Practice by verified rewards: rewards are those of the rule, advantages within groups; what is rewarded becomes likelier."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tests.act.tiny_worlds import Grid, Perilous, Point

from terrella.act.actor import Actor
from terrella.act.actor_network import ActorConfig, ActorNetwork
from terrella.act.best_of import BestOf
from terrella.act.choices import Choices
from terrella.act.imitation import ImitationActor
from terrella.act.imitation_network import ImitationConfig, ImitationNetwork
from terrella.act.planning import PlaySettings, SuccessCriterion, play
from terrella.core.errors import PlanningError, TrainingError
from terrella.core.world import make_rng
from terrella.learn.objectives.group_relative import group_advantages, log_prob
from terrella.learn.recipes.verified import RewardRule, VerifiedPractice, check_rewards, practise_verified
from terrella.learn.sized_feed import ResizableFeed
from terrella.learn.train_step import TrainStep
from terrella.learn.verified_rollouts import VerifiedRollouts, WorldStarts

NEAR = SuccessCriterion({"observation": torch.zeros(1, 2)}, within=0.1)


def now(step=0):
    return TrainStep(step, 0.0, torch.device("cpu"), np.random.default_rng(step), make_rng(step))


def imitator(world, std: float | None = 0.3, **changes):
    torch.manual_seed(0)
    config = ImitationConfig(ActorConfig.of(world.spec, ("observation",), 16), history=1, **changes)
    return ImitationActor(ImitationNetwork(config).eval(), world.spec, std=std)


def feed(world, policy, criterion=NEAR, starts=None, steps=6, blind=False):
    return VerifiedRollouts(world, policy, starts or WorldStarts(world), criterion, steps, (4, 8), blind)


def test_advantages_are_within_groups_and_none_where_all_are_alike():
    advantage = group_advantages(torch.tensor([[0.0, 1.0], [1.0, 1.0], [3.0, 5.0]]))
    assert torch.allclose(advantage, torch.tensor([[-1.0, 1.0], [0.0, 0.0], [-1.0, 1.0]]))


def test_the_reward_is_the_rule_and_decisions_after_success_do_not_count():
    world = Point()
    homing = Homing(world)
    batch = feed(world, homing, steps=8).batch(now())
    assert batch.reward.shape == (4, 8) and batch.reward.unique().tolist() == [0.0, 1.0]
    ends = batch.weight.sum(0)
    assert ((ends == 8) | (batch.reward.flatten() == 1)).all() and (ends < 8).any()
    starts = homing.seen[0].view(4, 8, 2)
    assert torch.equal(starts, starts[:, :1].expand_as(starts)), "a group begins in one state"


def test_where_memory_is_out_groups_are_fewer_and_as_large():
    groups = feed(Point(), Homing(Point()), steps=2)
    assert isinstance(groups, ResizableFeed) and groups.size == 4
    groups.resize(2)
    assert groups.batch(now()).reward.shape == (2, 8)


class Homing:
    """Goes to 0, some slower than others."""

    sees = ("observation",)

    def __init__(self, world):
        self.seen = []

    def begin(self, batch, rng):
        return torch.rand(batch, generator=rng)

    def explore(self, observation, memory, rng):
        self.seen.append(observation["observation"])
        action = (-observation["observation"]).clamp(-1, 1) * memory.round()[:, None]
        return action, memory, Choices({}, action)


def test_near_a_reference_is_better_and_its_end_does_not_count():
    world = Point()

    class Starts:
        def begin(self, groups, now):
            state = world.start(groups, make_rng(0))
            path = state["at"][:, None].repeat(1, 7, 1)
            path[:, 3:] = torch.nan
            return state, {"observation": path}

    reward = feed(world, Homing(world), starts=Starts()).batch(now()).reward
    goes = torch.rand(32, generator=now().noise).round().view(4, 8)
    assert (reward[goes == 0] > reward[goes == 1].max()).all()


def test_the_blind_arm_sees_the_same_at_every_step():
    world = Point()
    homing = Homing(world)
    feed(world, homing, blind=True).batch(now())
    assert len(torch.cat(homing.seen).unique(dim=0)) == 1


@pytest.mark.parametrize(
    "world, changes", [(Point(), {"chunk": 2, "execute": 2}), (Grid(), {"chunk": 2, "execute": 1})]
)
def test_the_probability_of_a_choice_is_that_of_drawing_it(world, changes):
    policy = imitator(world, **changes)
    seen = world.render(world.start(1, make_rng(0)).fork(2000), policy.sees)
    _, _, choices = policy.explore(seen, policy.begin(2000, make_rng(1)), make_rng(2))
    assert choices is not None
    logs = log_prob(policy.network, choices, 0.3).detach()
    if "chunk" in changes and changes["execute"] == 1:
        taken = choices.drawn[:, 0].argmax(1)
        for action in taken.unique():
            assert float(logs[taken == action].exp().mean()) == pytest.approx(
                float((taken == action).float().mean()), abs=0.03
            )
    else:  # the squared deviations of a flow's steps are those of the noise
        assert float(-2 * logs.mean()) == pytest.approx(choices.drawn[:, 1:].flatten(1).shape[1], rel=0.05)


@pytest.mark.parametrize("kind", ["imitation", "actor"])
def test_practice_raises_the_share_of_successes(kind, tmp_path):
    world, criterion = Point(), SuccessCriterion({"observation": torch.zeros(1, 2)}, within=0.12)
    torch.manual_seed(0)
    if kind == "imitation":
        ImitationActor.write(imitator(world).network, tmp_path / "before", {})
    else:
        Actor(ActorNetwork(ActorConfig.of(world.spec, ("observation",), 16)), world.spec).save(tmp_path / "before")
    config = VerifiedPractice(updates=12, groups=16, group_size=8, noise=0.5, learning_rate=2e-2)
    rule = RewardRule(criterion, 6)
    practise_verified(world, tmp_path / "before", tmp_path / "run", config, rule, lambda *_: None)
    load = ImitationActor.load if kind == "imitation" else Actor.load

    def share(folder):
        policy = load(tmp_path / folder, world.spec)
        if kind == "imitation":
            assert isinstance(policy.network, ImitationNetwork)
            policy = ImitationActor(policy.network, world.spec, std=0.1)
        return float(
            VerifiedRollouts(world, policy, WorldStarts(world), criterion, 6, (64, 4)).batch(now(9)).reward.mean()
        )

    assert share("run") > share("before") + 0.15


def test_a_goal_that_leaves_numbers_open_is_the_same_goal_when_it_continues(tmp_path):
    world, rule = (
        Point(),
        RewardRule(SuccessCriterion({"observation": torch.tensor([[0.0, torch.nan]])}, within=0.05), 2),
    )
    ImitationActor.write(imitator(world).network, tmp_path / "before", {})
    for updates in (1, 2):
        config = VerifiedPractice(updates=updates, groups=4, group_size=8, noise=0.5)
        facts = practise_verified(world, tmp_path / "before", tmp_path / "run", config, rule, lambda *_: None)
        assert facts["step"] == updates
    network = imitator(world).network  # another policy at the same place is not practised further in its stead
    with torch.no_grad():
        next(network.parameters()).add_(0.1)
    ImitationActor.write(network, tmp_path / "before", {})
    with pytest.raises(TrainingError, match="weights of the policy.*another --out"):
        practise_verified(world, tmp_path / "before", tmp_path / "run", config, rule, lambda *_: None)


def test_what_is_never_reached_is_refused_before_training():
    world = Point()
    far = SuccessCriterion({"observation": torch.full((1, 2), 9.0)}, within=0.001)
    with pytest.raises(PlanningError, match="none of 128 imagined rollouts"):
        check_rewards(feed(world, imitator(world), far), far, lambda *_: None)
    never = SuccessCriterion(channel="done")
    with pytest.raises(PlanningError, match="knows. Give more --steps"):
        check_rewards(feed(world, imitator(world), never), never, lambda *_: None)


def test_a_blind_arm_that_never_reaches_the_goal_stays_as_it_is(tmp_path):
    world, far = Point(), SuccessCriterion({"observation": torch.full((1, 2), 9.0)}, within=0.001)
    ImitationActor.write(imitator(world).network, tmp_path / "before", {})
    config = VerifiedPractice(updates=2, groups=4, group_size=8)
    blind = practise_verified(
        world, tmp_path / "before", tmp_path / "run", config, RewardRule(far, 2), lambda *_: None, True
    )
    assert blind["step"] == 2
    before, after = (
        ImitationActor.load(tmp_path / name, world.spec).network.state_dict() for name in ("before", "run")
    )
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_best_of_many_plans_succeeds_where_one_does_not():
    world = Point()
    usual, drawing = imitator(world, None), imitator(world, 1.0)
    shares = {}
    for count in (1, 16):
        policy = BestOf(world, usual, drawing, count, NEAR)
        played = play(world, policy, 8, PlaySettings(12, NEAR, policy.sees)).episodes
        shares[count] = sum(bool(episode.success) for episode in played) / 8
    assert shares[16] > shares[1] + 0.3
    with pytest.raises(PlanningError, match="cannot imagine 0 plans"):
        BestOf(world, usual, drawing, 0, NEAR)


def test_the_best_plan_avoids_ends_that_are_likely_though_never_certain():
    world = Perilous()
    state = {"observation": torch.zeros(8, 2)}
    policy = BestOf(world, imitator(world, None), imitator(world, 1.0), 32, SuccessCriterion())
    actions, _ = policy.act(state, policy.begin(8, make_rng(0)), make_rng(1))
    assert float(actions[:, 0].mean()) > 0.5  # to the right, where episodes go on
